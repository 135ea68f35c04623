"""An estimate that ended in a wrong optimum is no missing effect, and is not passed over."""

from __future__ import annotations

import numpy as np
import pytest
from fitted_states import NUMERICS
from small_campaigns import MASS, oscillator_campaign

from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import OTHER_OPTIMUM, close_loop
from bayesoleo.model import Model, Output, Parameter

#: Driven on both sides of the resonance, and far above it.
RUNS = (("a", 9.0, 20.0, "fit"), ("b", 12.0, 20.0, "fit"), ("c", 16.0, 20.0, "fit"))
RESONANCE = 10.4
STIFFNESS = MASS * (2 * np.pi * RESONANCE) ** 2


def oscillator(resonance):
    start = MASS * (2 * np.pi * resonance) ** 2
    return Model(
        "oscillator",
        inputs={"force": "N"},
        dofs={"x": "m"},
        parameters={
            "stiffness": Parameter(start, "N/m", sd=start / 2, bounds=(0.0, np.inf)),
            "damping": Parameter(2.0, "N*s/m", sd=2.0, bounds=(0.0, np.inf)),
        },
        equations={"x": f"{MASS}*ddot(x) + damping*dot(x) + stiffness*x - force"},
        outputs={"displacement": Output("x", "m")},
    )


@pytest.mark.slow
@pytest.mark.parametrize(("start", "told"), [(10.0, False), (17.0, True)])
def test_the_other_side_of_a_frequency_that_was_driven(tmp_path, start, told):
    reduced = oscillator_campaign(
        tmp_path, restoring=lambda x, v: STIFFNESS * x + 3.0 * v, runs=RUNS
    )
    roles = assign(reduced.records)
    loop = close_loop(Assembly(oscillator(start)), roles, NUMERICS, max_effects=0)
    found = dict(zip(loop.final.fit.problem.names, loop.final.fit.point.theta, strict=True))
    assert found["stiffness"] == pytest.approx(STIFFNESS, rel=1e-2)
    assert loop.verdict == "nothing missing"
    assert any(note.startswith(OTHER_OPTIMUM) for note in loop.notes) == told
