"""The compiled sweep of chunks takes the same iteration to the same orbit as the general one."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from periodic_problems import (
    coupled,
    duffing,
    friction_oscillator,
    gas_spring,
    harmonics,
    problem as discretised,
    relaxation,
    rest,
)

from bayesoleo.solvers import (
    _period_arrangement as arrangement,
    _periodic as periodic,
    _periodic_newton as newton,
    _unrolled_program as program,
)
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic_newton import Extrapolation

FORCE = harmonics(h0=0.3, h1=1.0, h3=0.2j)
#: The longest to compile; the model goes through the default schemes, and others through these.
LONG = [("coupled", "radau2"), ("coupled", "gauss3")]
CASES = [
    pytest.param(
        model,
        name,
        id=f"{model.name}-{name}",
        marks=[pytest.mark.slow] if (model.name, name) in LONG else [],
    )
    for model in (duffing(quadratic=0.4), relaxation(), coupled(), friction_oscillator())
    for name in ("radau2", "radau3", "gauss3", "thesis")
]


def both(model, name, n, force=FORCE, start=0.0, **options):
    boundary, p = discretised(model, force, 0.2, name, n, backend="numba")
    assert boundary.arranged is not None
    x = rest(boundary, n, start)
    settings = {"max_iterations": 40, "monotone": True} | options
    compiled = periodic._compiled(boundary, boundary.arranged, p, x.copy(), *settings.values())
    general = periodic._Newton(boundary, p, x.copy(), *settings.values()).run()
    return compiled, general


# One step more or less than whole chunks, a whole block and one more: every way to fill the rest.
@pytest.mark.parametrize("n", [8, 13, 64, 65, 100, 257])
@pytest.mark.parametrize(("model", "name"), CASES)
def test_orbits_agree(model, name, n):
    compiled, general = both(model, name, n)
    assert general.status[0] == Status.CONVERGED.value
    assert compiled.status[0] == Status.CONVERGED.value
    size = np.abs(general.x).max()
    # Both end within a last step of 1e-7 that squares: differences of rounding, over the period.
    np.testing.assert_allclose(compiled.x, general.x, rtol=0, atol=1e-9 * size)
    # Steps with old derivatives come on top.
    assert abs(compiled.iterations[0] - general.iterations[0]) <= 1 + program.MOST_CHORDS


@pytest.mark.parametrize("name", ["radau3", "thesis"])
def test_arrays_that_a_thread_keeps_carry_nothing_over(name):
    """What a failure leaves behind is not seen by the next solve of the same sizes."""
    boundary, p = discretised(duffing(quadratic=0.4), FORCE, 0.2, name, 65, backend="numba")
    x = rest(boundary, 65)

    def solved(constants):
        return periodic.solve_periodic(boundary, constants, x)

    with ThreadPoolExecutor(1) as fresh:
        alone = fresh.submit(solved, p).result()
    assert alone.status[0] == Status.CONVERGED.value
    assert solved(np.full_like(p, np.nan)).status[0] != Status.CONVERGED.value
    np.testing.assert_array_equal(solved(p).x, alone.x)


def test_statuses_agree_where_the_gas_law_ends():
    compiled, general = both(gas_spring(), "radau3", 32, start=1.5)
    assert compiled.status[0] == general.status[0] == Status.INADMISSIBLE.value


def test_statuses_agree_where_iterations_run_out():
    compiled, general = both(duffing(), "radau3", 32, max_iterations=1)
    assert compiled.status[0] == general.status[0] == Status.NO_CONVERGENCE.value


def test_long_systems_and_few_steps_are_left_to_the_general_iteration():
    boundary, _ = discretised(duffing(), FORCE, 0.2, "radau3", arrangement.LEAST_STEPS - 1, "numba")
    assert boundary.arranged is None


@pytest.mark.parametrize(("model", "name"), CASES)
def test_steps_with_old_derivatives_end_at_the_same_orbit(model, name):
    boundary, p = discretised(model, FORCE, 0.2, name, 100, backend="numba")
    settled = periodic.solve_periodic(boundary, p, rest(boundary, 100))
    exact = periodic.solve_periodic(boundary, p, settled.x).x
    # From every distance, so that some starts are where one such step is judged to suffice.
    away = exact * np.geomspace(1e-9, 1e-1, 33)[:, None, None]
    found = periodic.solve_periodic(boundary, np.repeat(p, 33, axis=0), exact + away)
    assert (found.status == Status.CONVERGED.value).all()
    error = np.abs(found.x - exact).max(axis=(1, 2)) / np.abs(exact).max()
    # Rounding of both, which the stiffest of these problems amplify over a hundred steps.
    assert error.max() < 1e-12


@pytest.mark.parametrize("n", [64, 101])
@pytest.mark.parametrize("name", ["radau3", "thesis"])
def test_starts_made_on_the_way_are_those_of_the_extrapolation(name, n):
    boundary, p = discretised(duffing(), FORCE, 0.2, name, n, backend="numba")
    solved = periodic.solve_periodic(boundary, p, rest(boundary, n))
    solved, x_p, _ = periodic.sensitivities(boundary, p, solved)
    line = Extrapolation(solved.x[0], np.ascontiguousarray(np.moveaxis(x_p[0], 2, 0)))
    change = 1e-2 * np.random.default_rng(1).standard_normal((5, boundary.active))
    many = np.repeat(p, 5, axis=0)
    # At the old parameters still: all come back, in as many steps as from the starts themselves.
    found = periodic.solve_extrapolated(boundary, many, line, change)
    told = periodic.solve_periodic(boundary, many, line.starts(change))
    np.testing.assert_array_equal(found.iterations, told.iterations)
    np.testing.assert_allclose(found.x, told.x, rtol=0, atol=1e-13 * np.abs(told.x).max())
    assert (found.iterations > 1).all()


def test_parameters_that_move_nothing_take_no_part_in_a_start():
    """Those of a force law, whatever they are."""
    boundary, p = discretised(duffing(), FORCE, 0.2, "radau3", 64, backend="numba")
    solved = periodic.solve_periodic(boundary, p, rest(boundary, 64))
    solved, x_p, _ = periodic.sensitivities(boundary, p, solved)
    slopes = np.ascontiguousarray(np.moveaxis(x_p[0], 2, 0))
    still = np.zeros((1, *slopes.shape[1:]))
    change = 1e-2 * np.random.default_rng(1).standard_normal((3, len(slopes)))
    many = np.repeat(p, 3, axis=0)
    for first, own, moves in ((slopes, change, len(slopes)), (slopes[:0], change[:, :0], 0)):
        wide = np.concatenate([first, still]), np.c_[own, np.full(3, np.inf)]
        alone, beside = Extrapolation(solved.x[0], first), Extrapolation(solved.x[0], wide[0])
        assert beside.moving.size == moves
        np.testing.assert_array_equal(beside.starts(wide[1]), alone.starts(own))
        found = periodic.solve_extrapolated(boundary, many, beside, wide[1])
        told = periodic.solve_extrapolated(boundary, many, alone, own)
        assert (found.status == Status.CONVERGED.value).all()
        np.testing.assert_array_equal(found.x, told.x)


@pytest.mark.parametrize("name", ["radau3", "thesis"])
def test_lanes_do_not_know_each_other(name):
    boundary, p = discretised(friction_oscillator(), FORCE, 0.2, name, 50, backend="numba")
    many = p * np.linspace(0.97, 1.03, 7)[:, None]
    start = np.repeat(rest(boundary, 50), 7, axis=0)
    together = periodic.solve_periodic(boundary, many, start)
    for lane in range(7):
        alone = periodic.solve_periodic(boundary, many[lane : lane + 1], start[:1])
        np.testing.assert_array_equal(alone.x[0], together.x[lane])


def test_a_residual_falls_in_the_larger_of_its_terms():
    """Squares of two equations, then of their terms: in all, and against what they were made of."""
    falls = getattr(newton._reduces, "py_func", newton._reduces)
    before = np.array([1.0, 4.0, 100.0, 400.0])
    assert falls(before, np.array([0.25, 1.0, 100.0, 400.0]), 2) == (
        True,
        pytest.approx(0.005**0.5),
    )
    assert not falls(before, np.array([1.1, 4.0, 100.0, 400.0]), 2)[0]
    assert falls(before, np.array([0.1, 5.0, 100.0, 400.0]), 2)[0], "what one gains, one may lose"
    # A start at rest fulfils an equation without terms; it may be left all the same.
    rest = np.array([1.0, 0.0, 1.0, 0.0])
    assert falls(rest, np.array([0.1, 0.01, 1.0, 1.0]), 2)[0]
