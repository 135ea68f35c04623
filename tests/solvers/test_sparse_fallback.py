"""Where a sweep through the period loses its digits, a factorisation of all of it answers."""

from types import SimpleNamespace

import numpy as np
import pytest
from periodic_problems import coupled, duffing, harmonics, problem, rest

from bayesoleo.model import Model, Parameter
from bayesoleo.solvers import _elimination as sparse, _periodic as periodic
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import (
    Solution,
    sensitivities,
    solve_extrapolated,
    solve_from_guess,
    solve_periodic,
)
from bayesoleo.solvers._periodic_newton import NEEDS_EXCHANGE

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)


def repelled(kind: str) -> Model:
    """Pushed away from rest: disturbances grow by exp(rate * period), and so do rounding errors."""
    equation = {
        "second order": "ddot(q) - rate**2*q - force",
        "first order": "dot(q) - rate*q - force",
    }[kind]
    return Model(
        "repelled",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"rate": Parameter(10.0, sd=1.0)},
        equations={"q": equation},
        outputs={"displacement": "q"},
    )


@pytest.mark.parametrize(("name", "n"), [("radau3", 400), ("gauss3", 200), ("thesis", 4000)])
@pytest.mark.parametrize("kind", ["first order", "second order"])
def test_a_motion_that_repels_is_found_with_its_derivatives(kind, name, n):
    """A growth of exp(40) to exp(80) leaves a sweep nothing; the answer is known in closed form."""
    frequency, rate = 0.25 if kind == "first order" else 0.125, 10.0
    boundary, p = problem(repelled(kind), FORCE, frequency, name, n)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    assert solution.status[0] == Status.CONVERGED
    solution, x_theta, _ = sensitivities(boundary, p, solution)
    assert solution.status[0] == Status.CONVERGED
    w = 2j * np.pi * frequency * FORCE.orders
    stiffness = w - rate if kind == "first order" else w**2 - rate**2
    slope = 1 / stiffness**2 * (1 if kind == "first order" else 2 * rate)
    turns = np.exp(2j * np.pi * FORCE.orders * np.arange(n)[:, None] / n)
    # Second-order differences err by about (2 pi / n)**2 of a harmonic; collocation by round-off.
    tolerance = 1e-3 if name == "thesis" else 1e-8
    exact = np.real(turns @ (FORCE.coefficients / stiffness))
    np.testing.assert_allclose(solution.x[0, :, 0], exact, atol=tolerance * np.abs(exact).max())
    exact = np.real(turns @ (FORCE.coefficients * slope))
    np.testing.assert_allclose(x_theta[0, :, 0, 0], exact, atol=tolerance * np.abs(exact).max())


def test_the_compiled_iteration_hands_over():
    """It sees the growth itself; the answer is that of the general iteration."""
    found = []
    for backend in ("numpy", "numba"):
        boundary, p = problem(repelled("second order"), FORCE, 0.125, "radau3", 400, backend)
        found.append(solve_periodic(boundary, p, rest(boundary, 400)))
    assert boundary.arranged is not None
    assert found[1].status[0] == Status.CONVERGED
    np.testing.assert_allclose(found[1].x, found[0].x, atol=1e-12)


def test_it_hands_over_only_where_that_is_wanted():
    """A model that is only compared does not wait for a factorisation of thousands of steps."""
    boundary, p = problem(repelled("second order"), FORCE, 0.125, "radau3", 400, "numba")
    solution = solve_periodic(boundary, p, rest(boundary, 400), exchange=False)
    assert solution.status[0] == Status.NO_CONVERGENCE
    solution = solve_from_guess(boundary, p, rest(boundary, 400), exchange=False)
    assert solution.status[0] == Status.NO_CONVERGENCE
    solution = solve_from_guess(boundary, p, rest(boundary, 400))
    assert solution.status[0] == Status.CONVERGED


@pytest.mark.parametrize("name", ["radau3", "gauss2", "thesis"])
@pytest.mark.parametrize("model", [duffing(), coupled()], ids=lambda model: model.name)
def test_both_ways_take_the_same_step(model, name, monkeypatch):
    """From a state with jumps between steps, with two right-hand sides, where both can."""
    n, rng = 40, np.random.default_rng(3)
    boundary, p = problem(model, FORCE, 0.2, name, n)
    method, d = boundary.scheme, len(boundary.scheme.orders)
    points, nz = boundary.inputs.shape[1], method.state_size + d
    x = rng.standard_normal((1, n, method.width))
    z, g = np.zeros((1, nz, points)), np.zeros((1, d, points))
    gz, lane = np.zeros((1, d, nz, points)), np.array([0])
    method.rows(x, lane, boundary.step(n), z)
    boundary.equations.jacobian(z, boundary.inputs, p, lane, g, gz)
    several = rng.standard_normal((1, d, 2, points))
    cases = ((g[:, :, None], x), (several, None))
    swept = [method.linear(gz, right, at, lane, boundary.step(n))[0] for right, at in cases]
    monkeypatch.setattr(sparse, "needs_factorisation", lambda ok, monodromy: True)
    for (right, at), expected in zip(cases, swept, strict=True):
        dx, _, ok = method.linear(gz, right, at, lane, boundary.step(n))
        assert ok[0]
        np.testing.assert_allclose(dx, expected, rtol=1e-8, atol=1e-9)


def test_what_is_singular_stays_singular():
    """A free mass under a constant force has no periodic motion."""
    free = Model(
        "free",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"mass": Parameter(1.0, sd=1.0)},
        equations={"q": "mass*ddot(q) - force"},
        outputs={"displacement": "q"},
    )
    for name in ("radau3", "thesis"):
        for n in (64, 1000):
            boundary, p = problem(free, FORCE, 0.2, name, n)
            assert solve_periodic(boundary, p, rest(boundary, n)).status[0] == Status.SINGULAR
            found = Solution(rest(boundary, n), np.zeros(1, int), np.zeros(1, int))
            assert sensitivities(boundary, p, found)[0].status[0] == Status.SINGULAR


def test_rows_in_small_units_are_no_singularity():
    matrix = sparse.csc_array(np.array([[2e-20, 1e-20], [1.0, -1.0]]))
    np.testing.assert_allclose(sparse.solve(matrix, np.array([[3e-20], [0.0]])), [[1.0], [1.0]])
    assert sparse.solve(sparse.csc_array(np.ones((2, 2))), np.ones((2, 1))) is None
    assert sparse.solve(sparse.csc_array(np.full((1, 1), np.nan)), np.ones((1, 1))) is None


@pytest.mark.parametrize("extrapolated", [False, True])
@pytest.mark.parametrize("exchange", [False, True])
def test_rows_are_exchanged_only_where_that_is_wanted(monkeypatch, exchange, extrapolated):
    """Of two lanes the second one needs it; the first has its answer either way."""
    lanes, x, again = 2, np.zeros((2, 4, 1)), []

    def swept(*_):
        status = np.array([Status.CONVERGED.value, NEEDS_EXCHANGE])
        return Solution(x.copy(), status, np.full(lanes, 5))

    class General:
        def __init__(self, _, p, start, *__):
            again.append((p.tolist(), start.tolist()))

        def run(self):
            return Solution(np.ones((1, 4, 1)), np.array([Status.CONVERGED]), np.array([9]))

    monkeypatch.setattr(periodic, "_compiled", swept)
    monkeypatch.setattr(periodic, "_Newton", General)
    stub = SimpleNamespace(arranged=SimpleNamespace(layout=None))
    p, most = np.array([[1.0], [2.0]]), {"max_iterations": 3, "exchange": exchange}
    if extrapolated:
        start = SimpleNamespace(
            x=x[0], moving=np.array([0]), swept=lambda _: (x, x), starts=lambda change: 7.0 * change
        )
        found = solve_extrapolated(stub, p, start, np.array([[1.0], [2.0]]), **most)
    else:
        found = solve_periodic(stub, p, x, **most)
    assert found.status[0] == Status.CONVERGED
    assert found.status[1] == (Status.CONVERGED if exchange else Status.NO_CONVERGENCE)
    assert again == ([([[2.0]], [[14.0]] if extrapolated else x[1:].tolist())] if exchange else [])
    assert found.iterations.tolist() == [5, 9 if exchange else 5]
