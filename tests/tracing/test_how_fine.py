"""The mesh is as fine as the estimate needs: half its steps move no parameter by a tenth of its
sd."""

from dataclasses import replace

import numpy as np
import pytest

from bayesoleo import system
from bayesoleo.prediction.simulate import RunPlan, motion, record_of, simulate_run
from bayesoleo.tracing.fitting.fit import (
    FEWEST_STEPS,
    LARGEST_SHIFT,
    Numerics,
    first_steps,
    fit_model,
)

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
        assert found.shift <= LARGEST_SHIFT
        chosen[noise] = found.steps
        if found.steps > begin:
            assert fit(noise, found.steps // 2).shift > LARGEST_SHIFT
    assert chosen[1e-2] < chosen[1e-3] < chosen[1e-4]
    assert fit(1e-4, scheme="radau3").steps < chosen[1e-4]


def test_given_steps_are_kept_and_their_shift_is_told():
    found = fit(1e-4, 64)
    assert found.steps == 64
    assert found.shift > LARGEST_SHIFT


def test_a_mesh_that_nobody_asks_about_is_not_looked_at():
    """The estimate is the same; one on a mesh that is too coarse is kept."""
    numerics = Numerics("thesis", None, jobs=1, backend="numpy")
    found = fit_model(MODEL, [record(1e-4)], numerics, tolerance=1e-8, check_mesh=False)
    assert np.isnan(found.shift)
    assert found.steps == FEWEST_STEPS
    np.testing.assert_array_equal(found.point.theta, fit(1e-4, FEWEST_STEPS).point.theta)
