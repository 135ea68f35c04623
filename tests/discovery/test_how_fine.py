"""The mesh is as fine as the estimate needs: half its steps move no parameter by a tenth of its
sd."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bayesoleo import system
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._loop import _limit, _warnings
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._result_tree import point_group
from bayesoleo.model import Model, Parameter
from bayesoleo.prediction._mesh_steps import FEWEST_STEPS, first_steps
from bayesoleo.prediction._simulate import RunPlan, motion, record_of, simulate_run

MODEL = system("duffing")
PLAN = RunPlan("a", 1.1, {"force": motion(0.0, [3.0, 0.0, 0.5])}, periods=3.0)


def record(noise: float):
    made = simulate_run(
        MODEL, PLAN, noise={"displacement": noise}, rng=np.random.default_rng(8), steps=512
    )
    return replace(record_of(MODEL, PLAN), samples=dict(made.samples))


def fit(noise: float, steps: int | None = None, scheme: str = "thesis"):
    return fit_model(
        MODEL, [record(noise)], Numerics(scheme, steps, jobs=1, backend="numpy"), tolerance=1e-8
    )


@pytest.mark.parametrize("steps", [256, 512])
def test_the_shift_told_is_the_shift_found(steps):
    """By the linearisation at one estimate, and by estimating again with half the steps."""
    coarse, fine = fit(1e-4, steps), fit(1e-4, 2 * steps)
    moved = np.max(np.abs(fine.point.theta - coarse.point.theta) / coarse.point.sd)
    assert coarse.shift == pytest.approx(moved, rel=0.1)
    # Second order: what is left of the shift is a quarter.
    assert fine.shift == pytest.approx(coarse.shift / 4, rel=0.2)


def test_steps_are_halved_until_the_estimate_stays():
    """Less noise asks for more steps, in proportion to its root for a scheme of second order."""
    begin = first_steps(MODEL, [record(1e-3)])
    assert begin == FEWEST_STEPS
    chosen = {}
    for noise in (1e-2, 1e-3, 1e-4):
        found = fit(noise)
        assert found.point.status.ok
        assert found.shift <= SearchPolicy().mesh_shift
        chosen[noise] = found.steps
        if found.steps > begin:
            assert fit(noise, found.steps // 2).shift > SearchPolicy().mesh_shift
    assert chosen[1e-2] < chosen[1e-3] < chosen[1e-4]
    assert fit(1e-4, scheme="radau3").steps < chosen[1e-4]


def test_given_steps_are_kept_and_their_shift_is_told():
    found = fit(1e-4, 64)
    assert found.steps == 64
    assert found.shift > SearchPolicy().mesh_shift


def test_a_mesh_that_did_not_do_is_said_plainly(monkeypatch):
    coarse, fine = fit(1e-4, 64), fit(1e-2, 1024)
    assert fine.doubts == []
    (text,) = coarse.doubts
    assert "the mesh is too coarse: 64 steps leave an error" in text
    assert f"by {coarse.shift:.2g} of its standard deviations" in text
    assert "are not those of the equations" in text
    assert text in json.loads(point_group(coarse).attrs["notes"])
    assert text in _warnings(coarse)
    monkeypatch.setattr("bayesoleo.discovery._mesh_error._halved", lambda *_: None)
    assert "could not be estimated" in fit(1e-2, 1024).doubts[0]


def test_no_effect_is_added_to_a_residual_that_may_be_the_solver_s():
    """Where no finer mesh is allowed, a further effect could explain what the steps leave."""
    found = fit(1e-5, 64)
    (size,) = found.mesh_error[0]
    exact = fit(1e-5, 2048).problem.predictor
    exact.set_anchor(found.problem.full(found.point.theta[None])[0])
    y = exact.simulate(found.problem.full(found.point.theta[None]), 0).y[0]
    assert size == pytest.approx(np.sqrt(np.mean((y - found.predictions[0].y) ** 2)), rel=0.02)

    def limit(repeating: float, expected: float) -> str:
        entry = SimpleNamespace(output="displacement", repeating=repeating, expected=expected)
        errors = SimpleNamespace(entries=[entry])
        assembly = SimpleNamespace(steps=())
        return _limit(SimpleNamespace(assembly=assembly, fit=found, fit_errors=errors), 1, 8)

    assert "the mesh of 64 steps is too coarse" in limit(1.5 * size, size)
    assert limit(1.5 * size, 4.0 * size) == ""  # too small to be seen
    assert limit(5.0 * size, size) == ""  # most of the excess is something else


def test_the_start_told_is_that_of_the_first_mesh():
    found = fit(1e-4)
    assert found.steps > FEWEST_STEPS
    np.testing.assert_array_equal(found.point.start, found.mbe.start)
    nominal = [MODEL.parameters[name].value for name in found.problem.names]
    np.testing.assert_allclose(found.mbe.start, nominal)


def test_an_error_between_the_points_of_all_steps_is_seen():
    """A pulse of a three-hundredth of the period: steps, and their halves, pass over it."""
    width = 1e-3
    model = Model(
        "pulse",
        inputs={"u": "1"},
        dofs={"q": "m"},
        parameters={"c": Parameter(0.5, sd=0.2), "k": Parameter(30.0, sd=3.0)},
        equations={"q": f"ddot(q) + c*dot(q) + k*q - u - 200/(1 + ((u - 0.3)/{width})**2)"},
        outputs={"y": "q"},
    )
    plan = RunPlan("a", 1.0, {"u": motion(0.0, [1.0])}, periods=2.0)
    made = simulate_run(model, plan, noise={"y": 1e-4}, rng=np.random.default_rng(8), steps=16384)
    seen = replace(record_of(model, plan), samples=dict(made.samples))
    found = fit_model(model, [seen], Numerics("radau3", 32, jobs=1, backend="numpy"))
    assert found.shift > SearchPolicy().mesh_shift
    assert found.motion_error > 1e-3
    assert found.doubts
    # Without steps given they are made short enough, or it is said that they are not.
    freely = fit_model(model, [seen], Numerics("radau3", None, jobs=1, backend="numpy"))
    assert freely.steps > 1000
    assert freely.shift <= SearchPolicy().mesh_shift or freely.doubts


def test_a_mesh_that_nobody_asks_about_is_not_looked_at():
    """The estimate is the same; one on a mesh that is too coarse is kept."""
    numerics = Numerics("thesis", None, jobs=1, backend="numpy")
    found = fit_model(MODEL, [record(1e-4)], numerics, tolerance=1e-8, check_mesh=False)
    assert np.isnan(found.shift)
    assert found.steps == FEWEST_STEPS
    np.testing.assert_array_equal(found.point.theta, fit(1e-4, FEWEST_STEPS).point.theta)
