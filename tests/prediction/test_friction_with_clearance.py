"""Draws of friction behind a gap, whose many kinks catch damped steps of Newton's method."""

from __future__ import annotations

import numpy as np

from bayesoleo.model import Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.solvers._orbit import Status

BEHIND = "((max(memory*(gap + rise) - gap, 0) + min(memory*(gap + rise) + gap, 0))/rise)"
SLIP = f"((max({BEHIND} - 255/256, 0) + min({BEHIND} + 255/256, 0))*256)"
MODEL = Model(
    "friction behind a gap",
    inputs={"displacement": "m"},
    dofs={"memory": "1"},
    parameters={
        "gap": Parameter(1.7e-3, "m", relative_sd=0.1),
        "rise": Parameter(2.3e-3, "m", relative_sd=0.15),
        "friction": Parameter(1e4, "N", relative_sd=0.1),
    },
    equations={
        "memory": "dot(memory) - (dot(displacement) - abs(dot(displacement))"
        f"*({SLIP} + memory/10000))/(gap + rise)"
    },
    outputs={"force": Output(f"friction*{BEHIND}", "N")},
)
PLAN = RunPlan("a", 1.0, {"displacement": motion(0.0, [0.0254])})


def drawn(predictor: Predictor, count: int) -> np.ndarray:
    start = predictor.layout.start(MODEL)
    rng = np.random.default_rng(0)
    return start * (1 + rng.standard_normal((count, start.size)) * [0.1, 0.15, 0.1])


def test_every_draw_is_solved_as_a_fresh_start_solves_it() -> None:
    """With damped steps alone one in seven had no solution, and so no probability."""
    predictor = Predictor(MODEL, [record_of(MODEL, PLAN)], steps=4096, jobs=1)
    predictor.set_anchor(predictor.layout.start(MODEL))
    draws = drawn(predictor, 100)
    squares, status = predictor.sum_of_squares(draws)
    np.testing.assert_array_equal(status, Status.CONVERGED)
    assert predictor.runs[0].jumps == 0
    fresh = Predictor(MODEL, [record_of(MODEL, PLAN)], steps=4096, jobs=1)
    for draw, found in zip(draws[:20], squares[:20], strict=True):
        fresh.runs[0].anchor = None
        fresh.set_anchor(draw)
        told, _ = fresh.sum_of_squares(draw[None])
        # Newton leaves round-off of terms a few hundred times larger than the residual.
        np.testing.assert_allclose(found, told[0], rtol=1e-8)
