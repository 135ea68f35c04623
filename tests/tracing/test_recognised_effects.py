"""Data made with an effect, by other code than the package's, are recognised as its."""

from __future__ import annotations

import numpy as np
import pytest
from fitted_states import fitted, options
from small_campaigns import damper, damper_campaign, oscillator_campaign, spring_damper_force

from bayesoleo.effects import catalogue
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.tracing.scoring.score import score_all
from bayesoleo.tracing.scoring.significance import classes


def preload(x, v, t):
    return spring_damper_force(x, v, t) + 6.0 * 2 / np.pi * np.arctan(x / 5e-4)


def cavitation(x, v, t):
    return spring_damper_force(x, v, t) + 4000.0 * np.maximum(-v - 0.03, 0.0) ** 2


def clipped_above(x, v, t):
    return np.minimum(spring_damper_force(x, v, t), 14.0)


def clipped_below(x, v, t):
    return np.maximum(spring_damper_force(x, v, t), -16.0)


def coulomb(x, v, t):
    return spring_damper_force(x, v, t) + 3.0 * np.sign(v)


def stop(x, v, t):
    return spring_damper_force(x, v, t) + 8e3 * np.maximum(x - 0.009, 0.0)


def hertz(x, v, t):
    return spring_damper_force(x, v, t) - 5e5 * np.maximum(-x - 0.009, 0.0) ** 1.5


def gap(x, v, t):
    return spring_damper_force(x, v, t) - 900.0 * np.clip(x, -0.003, 0.003)


def power_law(x, v, t):
    return spring_damper_force(x, v, t) + 5.0 * np.abs(v / 0.08) ** 0.5 * np.sign(v)


LAWS = {
    "preload": preload,
    "cavitating_rebound": cavitation,
    "sensor_saturation_upper": clipped_above,
    "sensor_saturation_lower": clipped_below,
    "coulomb_friction": coulomb,
    "end_stop_upper": stop,
    "hertzian_contact_lower": hertz,
    "play": gap,
    "power_law_damping": power_law,
}


def first_class(state) -> set[str]:
    """The effect that scores best, and those that these data cannot tell from it."""
    scores, _ = score_all(state.base(), options(state, [e.id for e in catalogue()]), jobs=1)
    groups = classes(scores)
    return {scores[k].option.candidate.effect for k in (0, *groups[0])}


@pytest.mark.slow
@pytest.mark.parametrize("effect", LAWS)
def test_effect_in_a_force_law_is_first_or_in_the_first_class(effect, tmp_path):
    state = fitted(damper_campaign(tmp_path, LAWS[effect], noise=0.1), damper())
    assert effect in first_class(state)


@pytest.mark.slow
def test_gravity_that_is_not_what_was_stated(tmp_path):
    """It sits in a term that softens with the motion, so that no constant force is like it."""

    def restoring(x, v):
        return 60.0 * x + 0.8 * v + 4.0 * 10.6 * np.sin(8.0 * x) / 8.0

    model = Model(
        "pendulum",
        inputs={"force": "N"},
        dofs={"position": "m"},
        parameters={
            "mass": Parameter(1.0, "kg", fixed=True),
            "gravity": Parameter(9.81, "m/s**2", fixed=True),
            "damping": Parameter(0.7, "N*s/m", sd=1.0),
            "stiffness": Parameter(60.0, "N/m", fixed=True),
        },
        equations={
            "position": "mass*ddot(position) + damping*dot(position) + stiffness*position"
            " + 4*mass*gravity*sin(8*position)/8 - force"
        },
        outputs={"displacement": Output("position", "m")},
    )
    state = fitted(oscillator_campaign(tmp_path, restoring=restoring), model)
    assert "gravity_error" in first_class(state)
