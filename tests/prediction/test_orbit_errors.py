"""Every periodic motion has an error estimate, and where steps pass over something it says so."""

import numpy as np
import pytest
from scipy.integrate import quad

from bayesoleo import system
from bayesoleo.model import Model, Parameter
from bayesoleo.prediction._orbits import periodic_orbit
from bayesoleo.prediction._simulate import RunPlan, motion
from bayesoleo.solvers import _error_estimate as errors, _shooting as shoot
from bayesoleo.solvers._mesh import Mesh, tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import SOLVERS
from bayesoleo.solvers._switched import Level, PeriodicProblem

OWN = SOLVERS[:-1]
PHASES = np.arange(4096) / 4096
#: Samples of a period from which exact answers of linear equations are made; the Fourier
#: coefficients of what is sampled fall to round-off long before.
COUNT = 2**17


def lag(tau: float, steepness: float) -> Model:
    """A state that follows a steep function of the input at once."""
    return Model(
        "lag",
        inputs={"u": "1"},
        dofs={"T": "K"},
        parameters={"tau": Parameter(tau, sd=tau)},
        equations={"T": f"tau*dot(T) + T - tanh({steepness}*u)"},
        outputs={"y": "T"},
    )


COSINE = RunPlan("cosine", 1.0, {"u": motion(0.0, [1.0])})


def linear_answer(forcing: np.ndarray, response) -> np.ndarray:
    """Exact periodic answer at :data:`PHASES` to a forcing at ``COUNT`` phases.

    ``response`` gives the answer to ``exp(i w t)`` for angular frequencies of a period of 1 s.
    """
    rate = 2 * np.pi * np.arange(COUNT // 2 + 1)
    answer = np.fft.irfft(np.fft.rfft(forcing) * response(rate), n=COUNT)
    return answer[:: COUNT // PHASES.size]


INPUT = np.cos(2 * np.pi * np.arange(COUNT) / COUNT)


def lagged(tau: float, steepness: float) -> np.ndarray:
    """The exact answer of :func:`lag`."""
    return linear_answer(np.tanh(steepness * INPUT), lambda w: 1 / (1 + 1j * w * tau))


def oscillator(plan: RunPlan) -> np.ndarray:
    """Exact position of the linear oscillator at :data:`PHASES`."""
    item = plan.inputs["force"]
    rate = 2 * np.pi * plan.frequency * item.orders
    answer = item.coefficients / (100.0 - rate**2 + 0.5j * rate)
    return (np.exp(2j * np.pi * np.outer(PHASES, item.orders)) @ answer).real


def true_error(found, exact: np.ndarray) -> float:
    return float(np.abs(found.rows(PHASES)[0, 0] - exact).max() / np.ptp(exact))


@pytest.mark.parametrize("method", OWN)
@pytest.mark.parametrize("tau", [1e-6, 1e-2])
def test_a_steep_function_of_the_input_is_resolved(method, tau):
    """An integrator's damped estimate steps over it: the answer was 82 % of the swing off."""
    found = periodic_orbit(lag(tau, 50.0), COSINE, None, method, backend="numpy", jobs=1)
    assert found.status[0] == Status.CONVERGED
    assert found.orbits[0].error <= 1e-8
    # Round-off of 2**17 samples is far below.
    assert true_error(found, lagged(tau, 50.0)) < 2e-8


def test_without_finer_steps_the_error_is_told(monkeypatch):
    """Shooting alone passes over the step of the function, and its estimate knows."""
    from bayesoleo.prediction import _periodic_solver as solver

    monkeypatch.setattr(solver, "MORE_SHOTS", 0)
    found = periodic_orbit(lag(1e-6, 50.0), COSINE, None, "shooting", backend="numpy", jobs=1)
    assert found.status[0] == Status.TOLERANCE_NOT_MET
    error = true_error(found, lagged(1e-6, 50.0))
    assert error > 0.5
    # Linear in the residual, which of a lag is the truth but for what lies between the looks.
    assert found.orbits[0].error == pytest.approx(error, rel=0.5)


@pytest.mark.parametrize("steps", [64, 256, 1024])
def test_equal_steps_too_long_for_the_input_say_so(steps):
    """Harmonic 200 of a force: 64 and 256 steps alias it."""
    plan = RunPlan("fast", 1.0, {"force": motion(0.0, [1.0, *[0.0] * 198, 300.0])})
    found = periodic_orbit(system("linear_oscillator"), plan, steps=steps, backend="numpy", jobs=1)
    error = true_error(found, oscillator(plan))
    assert found.status[0] == Status.TOLERANCE_NOT_MET
    # Velocities err by more than positions.
    assert found.orbits[0].error > error / 2


def test_by_default_steps_are_halved_until_the_tolerance_is_met():
    plan = RunPlan("fast", 1.0, {"force": motion(0.0, [1.0, *[0.0] * 48, 30.0])})
    model = system("linear_oscillator")
    for tolerance in (1e-4, 1e-8):
        found = periodic_orbit(model, plan, tolerance=tolerance, backend="numpy", jobs=1)
        assert found.status[0] == Status.CONVERGED
        assert true_error(found, oscillator(plan)) <= found.orbits[0].error <= tolerance


def test_a_pulse_narrower_than_any_step_is_seen():
    """A thousandth of the period wide, and high enough to matter."""
    width, height = 1e-3, 40.0
    model = Model(
        "pulse",
        inputs={"u": "1"},
        dofs={"q": "m"},
        parameters={"c": Parameter(0.5, sd=0.1), "k": Parameter(100.0, sd=1.0)},
        equations={"q": f"ddot(q) + c*dot(q) + k*q - {height}/(1 + ((u - 0.3)/{width})**2)"},
        outputs={"y": "q"},
    )
    force = height / (1 + ((INPUT - 0.3) / width) ** 2)
    exact = linear_answer(force, lambda w: 1 / (100.0 - w**2 + 0.5j * w))
    for method in OWN:
        found = periodic_orbit(model, COSINE, None, method, backend="numpy", jobs=1)
        if found.status[0] == Status.CONVERGED:
            assert true_error(found, exact) < 1e-7
        elif found.status[0] == Status.TOLERANCE_NOT_MET:  # the pulse is a step and a half wide
            assert method == "collocation"
            assert found.orbits[0].error > 0.3 * true_error(found, exact)
        else:  # an integrator that meets the pulse in one pass and not in the next does not close
            assert method in ("shooting", "hybrid")


def test_a_stop_of_equal_steps_is_not_called_converged():
    plan, stiff = RunPlan("stop", 1.0, {"force": motion(23.0, [20.0])}), {"stop_stiffness": 2500.0}
    model, phases = system("end_stop"), np.linspace(0, 1, 1001)
    coarse = periodic_orbit(model, plan, stiff, steps=256, backend="numpy")
    exact = periodic_orbit(model, plan, stiff, "shooting", tolerance=1e-10, backend="numpy")
    assert coarse.status[0] == Status.TOLERANCE_NOT_MET
    assert exact.status[0] == Status.CONVERGED
    states, true = coarse.rows(phases)[0, :2], exact.rows(phases)[0, :2]
    error = (np.abs(states - true).max(axis=1) / np.ptp(true, axis=1)).max()
    # The estimate is of one Newton step, and a contact inside a step is not linear.
    assert 0.5 * error < coarse.orbits[0].error < 20 * error


def test_an_error_that_cannot_be_estimated_has_a_status(monkeypatch):
    from bayesoleo.solvers import _error_estimate as error_estimate

    monkeypatch.setattr(error_estimate, "_look", lambda *_: None)
    found = periodic_orbit(lag(1e-2, 1.0), COSINE, backend="numpy", jobs=1)
    assert found.status[0] == Status.NO_ERROR_ESTIMATE
    assert "could not be estimated" in Status(int(found.status[0])).message
    assert np.isnan(found.orbits[0].error)
    assert np.isfinite(found.rows(PHASES)).all()
    answer = periodic_orbit(lag(1e-2, 1.0), COSINE, None, "adaptive", backend="numpy")
    assert answer.orbits[0].status is Status.NO_ERROR_ESTIMATE


def test_shooting_by_given_steps_closes_on_them():
    """The same motion by steps half as long; none where the steps are far too long."""
    from bayesoleo.prediction._inputs import dynamics_of
    from bayesoleo.prediction._simulate import record_of

    model = lag(1e-2, 1.0)
    dynamics = dynamics_of(model, record_of(model, COSINE), backend="numpy")
    p = np.array([1e-2])
    first = shoot.solve_shooting(dynamics, p, 1.0, np.zeros(1))
    steps = np.linspace(0.0, 1.0, 41)
    again = shoot.shoot_on_steps(dynamics, p, first, first.start, steps, np.zeros(40, dtype=bool))
    assert again is not None
    np.testing.assert_allclose(again.trajectory.times, steps, atol=1e-12)
    np.testing.assert_allclose(again.sample(PHASES)[0], first.sample(PHASES)[0], atol=1e-7)


def test_pulses_are_seen_in_long_steps_too():
    """Several pulses of a thirty-thousandth of the period, of which some lie in long steps.

    A mesh that is fine about those that were met had few looks left for the others.
    """
    width = 2e-4
    model = Model(
        "pulses",
        inputs={"u": "1"},
        dofs={"T": "K"},
        parameters={"tau": Parameter(7.5e-3, sd=1e-3)},
        equations={"T": f"tau*dot(T) + T - 1.4*exp(-((u - 0.037)/{width})**2)"},
        outputs={"y": "T"},
    )
    plan = RunPlan("a", 1.0, {"u": motion(0.0, [1.0, *[0.0] * 20, 0.011])})
    turn = 2 * np.pi * np.arange(COUNT) / COUNT
    u = np.cos(turn) + 0.011 * np.cos(22 * turn)
    # A pulse is seven samples wide, and a Gaussian's coefficients fall to round-off before half of
    # the sampling frequency.
    exact = linear_answer(
        1.4 * np.exp(-(((u - 0.037) / width) ** 2)), lambda w: 1 / (1 + 7.5e-3j * w)
    )
    found = periodic_orbit(model, plan, None, "adaptive", backend="numpy", jobs=1)
    if found.status[0] == Status.CONVERGED:
        assert true_error(found, exact) < 1e-7
    else:
        assert found.orbits[0].error > 0.1 * true_error(found, exact)


class Rates:
    """``q' = u``, or ``q'' = u``: what is missed between stages is an error of quadrature."""

    def jacobian(self, z, u, p, lanes, g, gz):
        for lane in lanes:
            g[lane, 0] = z[lane, -1] - u[0]
            gz[lane] = 0.0
            gz[lane, 0, -1] = 1.0

    def admissible(self, *_):
        raise AssertionError("there are no conditions")


def forcing(phase):
    return np.stack([np.exp(3.0 * phase)])


@pytest.mark.parametrize("order", [1, 2])
def test_what_is_missed_between_stages_is_the_error_of_quadrature(order):
    """Of the rate, and of the position that it leads to: integrals against sums over stages."""
    method, mesh, period = tableau("radau2"), Mesh(np.array([0.0, 0.4, 1.0])), 2.0
    problem = PeriodicProblem(Rates(), (order,), period, forcing)
    boundary = problem.on(method, mesh)
    rate = forcing(mesh.points(method.c))[0]
    rows = np.zeros((order + 1, 2 * method.stages))
    rows[-1] = rate
    x = boundary.scheme.from_motion(np.zeros((1, order + 1, 2)), rows[None])[0]
    level = Level(boundary, x, Status.CONVERGED, None, 0)
    look = errors._look(problem, level, np.zeros(0), 64)
    for step, (low, high) in enumerate(zip(mesh.edges[:-1], mesh.edges[1:], strict=True)):
        h = (high - low) * period
        stages = forcing(low + (high - low) * method.c)[0]
        exact = quad(lambda s: forcing(s)[0] * period, low, high)[0]
        missed = exact - h * method.b @ stages
        assert abs(missed) > 1e-4
        assert look.jumps[order - 1, step] == pytest.approx(missed, rel=1e-6)
        if order == 2:
            ahead = (
                period**2
                * quad(lambda s, end: (end - s) * forcing(s)[0], low, high, args=(high,))[0]
            )
            twice = method.weights(np.ones(1))[2][0]  # what a stage's rate moves, over h^2
            assert look.jumps[0, step] == pytest.approx(ahead - h**2 * twice @ stages, rel=1e-6)


def test_the_error_holds_what_is_missed_between_stages(monkeypatch):
    """Where a Newton step changes nothing, a pulse that no stage sees is all of the error."""
    mesh, method = Mesh(np.array([0.0, 0.5, 1.0])), tableau("radau2")
    problem = PeriodicProblem(Rates(), (1,), 1.0, forcing)
    x = np.zeros((2, 3))
    level = Level(problem.on(method, mesh), x, Status.CONVERGED, None, 0)
    change = np.zeros((2, 3, 2))
    change[1, 0, 1] = -0.06  # what the missed pulse makes of the second state
    monkeypatch.setattr(errors, "linearised_change", lambda *_, **__: (change, np.zeros((0, 2))))
    look = errors._Look(np.zeros((1, 2)), np.array([0.01]), np.array([2.0]), np.zeros(2))
    found, missed = errors._estimate(problem, level, np.zeros(0), level.motion, look, False)
    assert missed == pytest.approx((0.06 + 0.01) / 2.0)
    assert found.error == pytest.approx(missed)
