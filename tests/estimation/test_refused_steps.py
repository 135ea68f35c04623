"""A step that does not improve the merit is refused by its residuals alone."""

import numpy as np
import pytest

from bayesoleo.estimation import _iteration, estimate
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._problem import Held
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction import _transient_run as transient
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record, transient_record

STEP, COUNT = 0.05, 400
SWING = Model(
    "pendulum",
    dofs={"swing": Dof("rad", initial="2.5", initial_rate="0")},
    parameters={
        "stiffness": Parameter(9.0, "1/s**2", sd=4.0),
        "viscous": Parameter(0.1, "1/s", sd=0.2),
    },
    equations={"swing": "ddot(swing) + viscous*dot(swing) + stiffness*sin(swing)"},
    outputs={"angle": Output("swing", "rad")},
)
LAW = Model(
    "law",
    inputs={"u": "V"},
    parameters={"a": Parameter(1.0, sd=1.0), "b": Parameter(1.0, "1/V", sd=1.0)},
    outputs={"out": Output("a*u*exp(b*u)", "V")},
)
TRUTH = np.array([12.0, 0.15])


def swinging():
    """A free decay of which the start of the estimate is so far that whole steps fail."""
    time = STEP * np.arange(COUNT)
    empty = transient_record("run", time, {"angle": np.zeros(COUNT)})
    made = Predictor(SWING, [empty], jobs=1)
    made.set_anchor(TRUTH)
    angle = made.simulate(TRUTH[None], 0).y[0, 0]
    angle = angle + 0.01 * np.random.default_rng(1).standard_normal(COUNT)
    record = transient_record("run", time, {"angle": angle})
    return CampaignProblem(Predictor(SWING, [record], jobs=1))


def periodic(model):
    time = np.arange(40) / 20.0
    drive = Harmonics(np.array([1]), np.array([1.0 + 0.0j]), np.array([1e-6]))
    samples = {"u": drive.evaluate(time, 1.0), "out": np.ones(40), "angle": np.ones(40)}
    noise = {"u": 1e-3, "out": 1e-3}
    record = Record("a", "", "fit", "periodic", 1.0, 0.0, 2, time, samples, {"u": drive}, noise)
    return CampaignProblem(Predictor(model, [record], jobs=1))


def test_residuals_first_are_those_of_an_evaluation_and_move_no_anchor():
    problem = swinging()
    assert problem.residuals_first(TRUTH) is None  # nothing is known of the mesh
    problem.evaluate(TRUTH)
    (run,) = problem.predictor.runs
    anchor, away = run.anchor, np.array([11.8, 0.2])
    first = problem.residuals_first(away)
    assert run.anchor is anchor
    whole = problem.evaluate(away)
    assert run.anchor is not anchor
    # A long motion is not held twice.
    assert run._last is None or run._last[0] is run.anchor
    # The same solution at the same samples, by other code.
    np.testing.assert_allclose(first.residual[0], whole.residual[0], rtol=0, atol=1e-12)


def test_an_evaluation_goes_on_from_the_solution_of_its_residuals(monkeypatch):
    problem, away = swinging(), np.array([11.8, 0.2])
    problem.evaluate(TRUTH)
    problem.residuals_first(away)
    monkeypatch.setattr(transient, "solve_transient", lambda *_: pytest.fail("solved again"))
    problem.evaluate(away)


def test_the_anchor_s_vector_is_predicted_from_it(monkeypatch):
    problem = swinging()
    problem.evaluate(TRUTH)
    again = problem.predictor.predict(TRUTH)[0]
    for name in ("solve_transient", "transient_sensitivities"):
        monkeypatch.setattr(transient, name, lambda *_: pytest.fail("computed again"))
    known = problem.predictor.predict(TRUTH)[0]
    np.testing.assert_array_equal(known.sensitivity, again.sensitivity)
    problem.freeze(TRUTH)


def test_an_output_law_shows_its_residuals_first_and_a_periodic_motion_does_not():
    law = periodic(LAW)
    theta = np.array([0.5, 0.2])
    np.testing.assert_array_equal(
        law.residuals_first(theta).residual[0], law.evaluate(theta).residual[0]
    )
    inside = Held(law, theta, [1]).residuals_first(theta[:1])
    np.testing.assert_array_equal(inside.residual[0], law.evaluate(theta).residual[0])
    driven = Model(
        "driven",
        inputs={"u": "V"},
        dofs={"y": Dof("V")},
        parameters={"d": Parameter(1.0, "1/s", sd=1.0)},
        equations={"y": {"all": "dot(y) + d*(y - u)"}},
        outputs={"out": Output("y", "V")},
    )
    problem = periodic(driven)
    problem.evaluate(np.ones(1))
    assert problem.residuals_first(np.ones(1)) is None


def test_refused_steps_take_no_sensitivities_and_the_estimate_is_the_same(monkeypatch):
    calls = []
    solve = transient.transient_sensitivities
    monkeypatch.setattr(
        transient, "transient_sensitivities", lambda *a: calls.append(1) or solve(*a)
    )
    found = estimate(swinging(), "levenberg-marquardt", resolution=1e-3)
    few = len(calls)
    monkeypatch.setattr(_iteration, "residuals_first", lambda *_: None)
    expected = estimate(swinging(), "levenberg-marquardt", resolution=1e-3)
    assert found.status.ok
    assert found.evaluations == expected.evaluations
    # Some steps are refused: each of these saves its sensitivities.
    assert few < len(calls) - few
    # Both are converged to a thousandth of a standard deviation.
    np.testing.assert_allclose(found.theta, expected.theta, rtol=0, atol=2e-3 * expected.sd.max())


def test_a_run_without_an_anchor_is_solved_without_sensitivities(monkeypatch):
    known, fresh = swinging().predictor, swinging().predictor
    known.set_anchor(TRUTH)
    expected = known.simulate(TRUTH[None], 0).y
    monkeypatch.setattr(transient, "transient_sensitivities", lambda *_: pytest.fail("computed"))
    (found,) = fresh.solved_anew(TRUTH)
    assert fresh.runs[0].anchor is None
    # Newton's method leaves round-off, from either start.
    np.testing.assert_allclose(found.y, expected, rtol=0, atol=1e-10)
