"""Errors at the nodes fall with the order that each method promises."""

import numpy as np
import pytest
from periodic_problems import coupled, duffing, harmonics, problem, relaxation, rest

from bayesoleo.errors import InputError
from bayesoleo.solvers._mesh import tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import solve_periodic
from bayesoleo.solvers._schemes import scheme

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
SYSTEMS = {
    "duffing": (duffing(), 0.2),
    "relaxation": (relaxation(), 0.25),
    "coupled": (coupled(), 0.2),
}
#: Meshes in the asymptotic range, above round-off: where the error is about 1e-4 to 1e-9.
MESHES = {
    "radau2": (64, 128),
    "radau3": (32, 64),
    "gauss2": (32, 64),
    "gauss3": (24, 48),
    "thesis": (512, 1024),
}
NODES = 8
ORDER = {"radau2": 3, "radau3": 5, "gauss2": 4, "gauss3": 6, "thesis": 2}


def nodes(model, frequency, name, n):
    """First dof at eight common phases."""
    boundary, p = problem(model, FORCE, frequency, name, n)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    assert solution.status[0] == Status.CONVERGED
    return solution.x[0, :: n // NODES, 0]


@pytest.fixture(scope="module")
def reference():
    return {key: nodes(*system, "gauss3", 512) for key, system in SYSTEMS.items()}


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("name", ORDER)
def test_order_of_convergence(name, system, reference):
    coarse, fine = (
        np.sqrt(np.mean((nodes(*SYSTEMS[system], name, n) - reference[system]) ** 2))
        for n in MESHES[name]
    )
    assert np.log2(coarse / fine) == pytest.approx(ORDER[name], abs=0.25)
    assert scheme(name, (2,)).order == ORDER[name]


@pytest.mark.parametrize(("name", "order"), [("radau3", 4), ("gauss3", 4), ("thesis", 2)])
def test_between_the_nodes_the_order_is_that_of_the_interpolation(name, order):
    """A first-order dof between nodes has the order of its stages plus one."""
    model, frequency = SYSTEMS["relaxation"]
    phase = (np.arange(200) + 0.37) / 200
    values = []
    for n in (*MESHES[name], 512 if name != "thesis" else 8192):
        boundary, p = problem(model, FORCE, frequency, name, n)
        x = solve_periodic(boundary, p, rest(boundary, n)).x
        plan = boundary.scheme.plan(phase, n)
        values.append(boundary.scheme.sample(x[..., None], plan, boundary.step(n))[0, 0, 0])
    coarse, fine = (np.sqrt(np.mean((v - values[2]) ** 2)) for v in values[:2])
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.25)


def test_tableaux_agree_with_the_printed_ones():
    """Hairer and Wanner (1996), tables IV.5.5 and IV.5.2: two-stage Radau IIA and Gauss."""
    radau, gauss = tableau("radau2"), tableau("gauss2")
    np.testing.assert_allclose(radau.a, [[5 / 12, -1 / 12], [3 / 4, 1 / 4]], atol=1e-15)
    root = np.sqrt(3) / 6
    np.testing.assert_allclose(gauss.a, [[1 / 4, 1 / 4 - root], [1 / 4 + root, 1 / 4]], atol=1e-15)
    assert radau.c[-1] == 1.0


def test_an_unknown_scheme_is_named():
    with pytest.raises(InputError, match=r"unknown scheme.*radau9.*use radau2"):
        scheme("radau9", (2,))


@pytest.mark.parametrize("name", ORDER)
def test_a_motion_survives_the_way_to_unknowns_and_back(name):
    """Rows at the points come back to the interpolation's error."""
    n, period = 128, 2.0
    method = scheme(name, (2, 1))
    rate = 2 * np.pi / period

    def rows(phase):
        t = phase * period
        return np.stack(
            [
                np.sin(rate * t),
                rate * np.cos(rate * t),
                -(rate**2) * np.sin(rate * t),
                np.cos(rate * t),
                -rate * np.sin(rate * t),
            ]
        )

    at_points = rows(method.phases(n))
    x = method.from_motion(rows(np.arange(n) / n)[None], at_points[None])
    assert x.shape == (1, n, method.width)
    z = np.empty((1, 5, at_points.shape[1]))
    method.rows(x, np.array([0]), period / n, z)
    # Second-order differences of a unit sine err by (2 pi / n)**2 = 2.4e-3 of a second derivative
    # of pi**2, times 11/12; collocation by the cube of 2 pi / n and less.
    np.testing.assert_allclose(z[0], at_points, atol=0.12 if name == "thesis" else 2e-4)
