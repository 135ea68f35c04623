"""An offset of a sensor and a constant force that differ from run to run."""

from __future__ import annotations

import numpy as np
import pytest
from fitted_states import fitted
from small_campaigns import (
    DRAG,
    HARDENING,
    OSCILLATOR_RUNS,
    SPRING,
    damper,
    damper_campaign,
    oscillator_campaign,
    spring_damper_force,
)

from bayesoleo.discovery._ranking import scales_of
from bayesoleo.discovery._score_tests import score_all
from bayesoleo.effects import catalogue, find_effect
from bayesoleo.systems import system

EFFECTS = ("sensor_offset_by_run", "force_offset_by_run")
FORCES = (0.6, -0.4, 0.3, -0.7, 0.5)
METRES = (2e-3, -1e-3, 1.5e-3, -2e-3, 1e-3)


def scored(state, effects=None):
    scales = scales_of(state.fit, state.assembly.drive, state.assembly.native)
    chosen = catalogue() if effects is None else tuple(map(find_effect, effects))
    return score_all(state.base(), state.assembly.options(scales, chosen), jobs=1)[0]


def hardening(x, v):
    return SPRING * x + DRAG * v + HARDENING * x**3


def with_offsets(folder, shown):
    """A hardening spring whose displacement is shown with an offset, or that something pushes."""

    def pushed(force):
        return lambda x, v: hardening(x, v) - force

    each = {
        run[0]: (hardening, offset) if shown else (pushed(force), 0.0)
        for run, offset, force in zip(OSCILLATOR_RUNS, METRES, FORCES, strict=True)
    }
    return oscillator_campaign(folder, restoring=hardening, each=each)


@pytest.mark.slow
@pytest.mark.parametrize("shown", [True, False])
def test_what_the_sensor_adds_is_told_from_what_pushes(shown, tmp_path):
    """A spring that hardens makes harmonics of what pushes, and none of what the sensor adds."""
    found = scored(fitted(with_offsets(tmp_path, shown), system("duffing")))
    place = {"sensor_offset_by_run": "displacement", "force_offset_by_run": "position"}
    right = EFFECTS[0 if shown else 1]
    assert found[0].option.key == (right, place[right])
    fall = {score.option.key: score.fall for score in found}
    other = next(effect for effect in EFFECTS if effect != right)
    assert fall[other, place[other]] < 0.99 * found[0].fall
    known = METRES[:3] if shown else [-push for push in FORCES[:3]]
    if shown:  # a score is linear: the offset is, and the spring is not
        np.testing.assert_allclose(found[0].expected, known, rtol=0.02)
    else:
        assert np.array_equal(np.sign(found[0].expected), np.sign(known))


def test_in_a_force_law_both_are_one(tmp_path):
    left = iter((1.0, -1.0, 0.5, -0.4, 0.7))

    def law(x, v, t):
        return spring_damper_force(x, v, t) + 2.0 * next(left)

    found = scored(fitted(damper_campaign(tmp_path, law, noise=0.1), damper()), EFFECTS)
    fall = {score.option.key: score.fall for score in found}
    shown, pushed = (fall[effect, "force"] for effect in EFFECTS)
    assert shown == pytest.approx(pushed, rel=1e-9)
