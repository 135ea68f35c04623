"""Five ways to one orbit: its motion, its outputs, and their derivatives by the parameters."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bayesoleo import system
from bayesoleo.errors import InputError, ModelError
from bayesoleo.model._kernels import kernels
from bayesoleo.prediction._inputs import input_rows
from bayesoleo.prediction._orbits import periodic_orbit
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.solvers._library_integrator import shoot_by_library
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import SOLVERS
from bayesoleo.solvers._state_space import StateSpace

DUFFING = system("duffing")
PLAN = RunPlan("a", 1.1, {"force": motion(0.1, [3.0, 0.0, 0.5])})
PHASES = np.linspace(0.0, 1.0, 41)
STIFFNESSES = [80.0, 100.0, 130.0]
END_STOP = RunPlan("end stop", 1.0, {"force": motion(23.0, [20.0])})


def by_integration(stiffness: float) -> tuple[np.ndarray, np.ndarray]:
    """Position ``(N,)`` and its derivatives by damping, stiffness and cubic spring ``(3, N)``.

    By DOP853 with the variational equations written out by hand, and Newton's method on the start.
    """
    c, k, k3, period = 0.5, stiffness, 1e4, 1 / PLAN.frequency

    def rates(t, s):
        q, v, *rest = s
        f = 0.1 + 3 * np.cos(2 * np.pi * 1.1 * t) + 0.5 * np.cos(6 * np.pi * 1.1 * t)
        table = np.array(rest).reshape(2, 5)
        bend = -(k + 3 * k3 * q**2) * table[0] - c * table[1]
        bend[2:] -= [v, q, q**3]
        return [v, f - c * v - k * q - k3 * q**3, *table[1], *bend]

    def run(state, **options):
        first = np.concatenate([state, np.eye(2, 5).ravel()])
        return solve_ivp(
            rates, (0, period), first, method="DOP853", rtol=1e-12, atol=1e-14, **options
        )

    state = np.zeros(2)
    for _ in range(8):
        end = run(state).y[:, -1]
        table = end[2:].reshape(2, 5)
        state = state + np.linalg.solve(np.eye(2) - table[:, :2], end[:2] - state)
    start = np.linalg.solve(np.eye(2) - table[:, :2], table[:, 2:])
    y = run(state, t_eval=PHASES * period).y
    first = y[2:7]
    return y[0], start.T @ first[:2] + first[2:]


@pytest.fixture(scope="module")
def exact():
    found = [by_integration(k) for k in STIFFNESSES]
    return np.stack([q for q, _ in found]), np.stack([slope for _, slope in found])


OWN = SOLVERS[:-1]


@pytest.mark.slow
@pytest.mark.parametrize("method", [*OWN, pytest.param("library", marks=pytest.mark.slow)])
def test_all_ways_agree_with_another_code_in_motion_and_derivatives(method, exact):
    """Three parameter vectors at once."""
    found = periodic_orbit(
        DUFFING, PLAN, {"stiffness": STIFFNESSES}, method,
        steps=512, tolerance=1e-9, backend="numpy", jobs=1,
    )  # fmt: skip
    assert found.parameters == ("damping", "stiffness", "cubic_spring")
    assert set(found.status) == {Status.CONVERGED}
    assert all(orbit.stable for orbit in found.orbits)
    assert max(orbit.error for orbit in found.orbits) <= 1e-9
    q, slope = exact
    # Of an integrator at 1e-12 through a closure; derivatives carry the orbit's error a thousand
    # times where two of them cancel.
    np.testing.assert_allclose(found.rows(PHASES)[:, 0], q, atol=1e-7 * np.abs(q).max())
    np.testing.assert_allclose(
        found.outputs(PHASES)["displacement"], q, atol=1e-7 * np.abs(q).max()
    )
    size = np.abs(slope).max(axis=2, keepdims=True)
    given = found.outputs_by_parameter(PHASES)["displacement"]
    np.testing.assert_allclose(given / size, slope / size, atol=1e-6)
    np.testing.assert_allclose(found.rows_by_parameter(PHASES)[:, 0], given, rtol=1e-12)


def test_states_of_an_orbit_are_those_of_its_motion():
    for method in SOLVERS:
        options = {"backend": "numpy", "steps": 64, "tolerance": 1e-6}
        found = periodic_orbit(DUFFING, PLAN, None, method, **options)
        orbit = found.orbits[0]
        rows = found.rows(orbit.phases)[0]
        np.testing.assert_allclose(orbit.states.T, rows[:2], atol=1e-9)
        assert orbit.period == pytest.approx(1 / 1.1)
        assert np.isfinite(orbit.multipliers).all()
        assert orbit.evaluations > 0


def test_a_vector_does_not_know_the_others():
    for method in OWN:
        options = {"backend": "numpy", "steps": 64, "solver": method}
        together = periodic_orbit(DUFFING, PLAN, {"stiffness": STIFFNESSES}, **options, jobs=2)
        alone = periodic_orbit(DUFFING, PLAN, {"stiffness": STIFFNESSES[1]}, **options, jobs=1)
        assert together.rows(PHASES)[1].tobytes() == alone.rows(PHASES)[0].tobytes()
        assert (
            together.rows_by_parameter(PHASES)[1].tobytes()
            == alone.rows_by_parameter(PHASES)[0].tobytes()
        )


@pytest.mark.parametrize("stiffness", [2500.0, 1e5, 1e8, 1e11])
def test_shooting_and_hybrid_agree_where_equal_steps_fail(stiffness):
    """The hybrid's mesh has the integrator's steps, which end at the contact."""
    model, stiff = system("end_stop"), {"stop_stiffness": stiffness}
    shot = periodic_orbit(model, END_STOP, stiff, "shooting", backend="numpy")
    mixed = periodic_orbit(model, END_STOP, stiff, "hybrid", steps=400, backend="numpy")
    assert shot.status[0] == mixed.status[0] == Status.CONVERGED
    np.testing.assert_array_equal(mixed.rows(PHASES), shot.rows(PHASES))
    here, there = mixed.rows_by_parameter(PHASES)[0, 0, 0], shot.rows_by_parameter(PHASES)[0, 0, 0]
    np.testing.assert_allclose(here, there, atol=2e-5 * np.abs(there).max())


def test_derivatives_across_a_stiff_contact_are_differences_of_motions():
    model, stiffness, part = system("end_stop"), 1e5, 1e-3
    options = {"solver": "shooting", "tolerance": 1e-11, "backend": "numpy"}
    sides = {"stop_stiffness": stiffness * np.array([1 - part, 1.0, 1 + part])}
    found = periodic_orbit(model, END_STOP, sides, **options)
    q, by_stiffness = found.rows(PHASES)[:, 0], found.rows_by_parameter(PHASES)[1, 0, 0]
    difference = (q[2] - q[0]) / (2 * part * stiffness)
    # Central differences err by the square of the part.
    np.testing.assert_allclose(by_stiffness, difference, atol=1e-5 * np.abs(difference).max())


@pytest.mark.slow
@pytest.mark.reference
@pytest.mark.parametrize("integrator", ["LSODA", "Radau"])
def test_a_library_integrates_the_stiff_contact_too(integrator):
    """Steps are chosen by the error alone; digits are fewer, and derivatives have three."""
    model, stiff = system("end_stop"), {"stop_stiffness": 2500.0}
    shot = periodic_orbit(model, END_STOP, stiff, "shooting", backend="numpy")
    run = RunPredictor(model, shot.kernels, shot.record, 64, "radau3")
    space = StateSpace(
        run.kernels, (2,), lambda t: input_rows(run.record, shot.kernels.derived.inputs, t), 1, 1
    )
    found = shoot_by_library(
        space, shot.p[0], 1.0, np.array([0.5, 0.0]), integrator=integrator, tolerance=1e-8
    )
    # By itself the library estimates no error of the motion.
    assert found.orbit.status is Status.NO_ERROR_ESTIMATE
    np.testing.assert_allclose(found.sample(PHASES)[0], shot.rows(PHASES)[0, 0], atol=2e-6)
    there = shot.rows_by_parameter(PHASES)[0, 0]
    np.testing.assert_allclose(
        found.sample_theta(PHASES)[0], there, atol=2e-3 * np.abs(there).max()
    )


def test_a_library_says_why_it_failed():
    model = system("end_stop")
    run = RunPredictor(
        model, kernels(model, model.estimated(), "numpy"), record_of(model, END_STOP), 64, "radau3"
    )
    space = StateSpace(
        run.kernels, (2,), lambda t: input_rows(run.record, (("force", 0),), t), 1, 1
    )
    outside = shoot_by_library(space, run.base_constants(), 1.0, np.array([1.2, 0.0]))
    assert outside.orbit.status is Status.INADMISSIBLE
    assert np.isnan(outside.orbit.multipliers).all()
    with pytest.raises(InputError, match=r"no such integrator.*use LSODA, Radau"):
        shoot_by_library(space, run.base_constants(), 1.0, np.zeros(2), integrator="RK45")


def test_failures_have_a_status_and_no_numbers():
    free = {"damping": 0.0, "stiffness": 0.0, "cubic_spring": 0.0}
    for method in SOLVERS:
        found = periodic_orbit(DUFFING, PLAN, free, method, backend="numpy", steps=64)
        assert found.status[0] != Status.CONVERGED
        assert np.isnan(found.rows(PHASES)).all()
        assert np.isnan(found.outputs_by_parameter(PHASES)["displacement"]).all()


def test_bad_input_says_what_to_write():
    with pytest.raises(InputError, match=r"unknown solver.*euler.*one of: collocation, adaptive"):
        periodic_orbit(DUFFING, PLAN, None, "euler")
    with pytest.raises(InputError, match=r"stifness: no such parameter; parameters there are"):
        periodic_orbit(DUFFING, PLAN, {"stifness": 1.0})
    with pytest.raises(InputError, match=r"lengths differ.*as many of each"):
        periodic_orbit(DUFFING, PLAN, {"stiffness": [1.0, 2.0], "damping": [1.0, 2.0, 3.0]})
    with pytest.raises(InputError, match=r"needs the input 'force'.*give inputs"):
        periodic_orbit(DUFFING, RunPlan("a", 1.0, {}))
    with pytest.raises(ModelError, match=r"has no dof.*evaluate its outputs"):
        periodic_orbit(system("gas_spring"), RunPlan("a", 1.0, {"compression": motion(0.1, [0.1])}))
