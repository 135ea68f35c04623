"""What must hold whatever the equations are: Liouville, shift of phase, energy balance."""

import numpy as np
import pytest
from periodic_problems import coupled, duffing, friction_oscillator, harmonics, problem, rest

from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import sensitivities, solve_periodic

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
FREQUENCY = 0.2


def solved(model, name="gauss3", n=128, force=FORCE):
    boundary, p = problem(model, force, FREQUENCY, name, n)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    assert solution.status[0] == Status.CONVERGED
    return boundary, p, solution


def average(boundary, solution, function):
    """Integral over a period by the scheme's own quadrature."""
    n = solution.x.shape[1]
    z = np.zeros(
        (1, sum(boundary.scheme.orders) + len(boundary.scheme.orders), boundary.inputs.shape[1])
    )
    boundary.scheme.rows(solution.x, np.array([0]), boundary.step(n), z)
    weights = np.tile(boundary.scheme.method.b, n) / n
    return np.sum(weights * function(z[0])) * boundary.period


@pytest.mark.parametrize(
    ("model", "trace"),
    [
        (duffing(quadratic=0.6), lambda z: -(0.3 + 1.2 * np.abs(z[1]))),
        (coupled(), lambda z: np.full(z.shape[1], -0.4 - 0.7)),
    ],
    ids=["duffing", "coupled"],
)
@pytest.mark.parametrize(("name", "n"), [("gauss3", 128), ("radau3", 256)])
def test_floquet_multipliers_obey_liouville(model, trace, name, n):
    boundary, p, solution = solved(model, name, n)
    _, _, monodromy = sensitivities(boundary, p, solution)
    multipliers = np.linalg.eigvals(monodromy[0])
    expected = np.exp(average(boundary, solution, trace))
    # The discretised map has the scheme's error (1e-8) and that of |q'| at its kinks (h**2: 1e-4).
    tolerance = 5e-4 if model.name == "duffing" else 1e-7
    assert np.prod(multipliers).real == pytest.approx(expected, rel=tolerance)
    assert np.all(np.abs(multipliers) < 1)


@pytest.mark.parametrize("name", ["radau2", "radau3", "gauss2", "gauss3", "thesis"])
@pytest.mark.parametrize("model", [duffing(), coupled()], ids=["duffing", "coupled"])
def test_a_shift_of_phase_shifts_the_solution(model, name):
    n, shift = 64, 13
    _, _, solution = solved(model, name, n)
    turned = FORCE.coefficients * np.exp(2j * np.pi * FORCE.orders * shift / n)
    later = harmonics(**{f"h{k}": c for k, c in zip(FORCE.orders, turned, strict=True)})
    _, _, shifted = solved(model, name, n, later)
    np.testing.assert_allclose(
        np.roll(solution.x, -shift, axis=1),
        shifted.x,
        atol=1e-11,  # round-off through a closure whose condition is below 100
    )


@pytest.mark.parametrize(
    "model", [duffing(quadratic=0.5), friction_oscillator()], ids=lambda m: m.name
)
def test_work_done_equals_what_is_dissipated(model):
    boundary, _, solution = solved(model, "gauss3", 256)
    assert isinstance(boundary.scheme, Collocation)
    force = boundary.inputs[0]
    if model.name == "duffing":
        work = average(boundary, solution, lambda z: force * z[1])
        lost = average(boundary, solution, lambda z: 0.3 * z[1] ** 2 + 0.5 * np.abs(z[1]) ** 3)
    else:
        work = average(boundary, solution, lambda z: (force - 0.1) * z[1])
        lost = average(
            boundary,
            solution,
            lambda z: 0.3 * z[1] ** 2 + 0.5 * np.abs(z[1]) ** 3 + 0.4 * z[1] * np.arctan(3 * z[1]),
        )
    assert work > 0.1
    # Exact but for the quadrature of |q'|**3 across its kink, of fourth order in h = 0.02 s.
    assert work == pytest.approx(lost, rel=1e-7)
