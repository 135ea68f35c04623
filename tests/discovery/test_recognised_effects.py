"""Data made with an effect, by other code than the package's, are recognised as its."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted, options
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from small_campaigns import damper, damper_campaign, oscillator_campaign, spring_damper_force

from bayesoleo import Campaign
from bayesoleo.data import load_campaign, reduce_campaign
from bayesoleo.discovery._assembly import assign
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._score_tests import classes, score_all
from bayesoleo.effects import catalogue
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.prediction import RunPlan, motion


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


def plus(extra):
    """A force beside that of spring and damper."""
    return lambda x, v, t: spring_damper_force(x, v, t) + extra(x, v, t)


def smooth_sign(v, at=2e-3):
    return 2 / np.pi * np.arctan(v / at)


def followed(rate_of, x, v, t):
    """A state that starts where it ends, by SciPy's integrator."""
    velocity = CubicSpline(t, v)

    def rates(time, state):
        return [rate_of(float(velocity(time)), state[0])]

    start = 0.0
    for _ in range(2):
        found = solve_ivp(rates, (t[0], t[-1]), [start], "LSODA", t, rtol=1e-8, atol=1e-10)
        start = found.y[0, -1]
    return found.y[0]


def dahl(x, v, t):
    return 5.0 * followed(lambda u, w: 1000.0 * (u - abs(u) * w), x, v, t)


def bouc_wen(x, v, t):
    rate = 1000.0
    return 5.0 * followed(lambda u, w: rate * (u - (abs(u) * w + u * abs(w)) / 2), x, v, t)


def lugre(x, v, t):
    def rate(u, w):
        return 2000.0 * (u - abs(u) * w / (1 + np.exp(-((u / 0.008) ** 2)) / 2))

    return 5.0 * followed(rate, x, v, t)


def behind_a_frame(x, v, t, compliance=2e-5):
    """x = q + c F: the motion behind the frame follows from its own differential equation."""
    place = CubicSpline(t, x)

    def rates(time, state):
        force = (float(place(time)) - state[0]) / compliance
        return [(force - 1000.0 * state[0] - 2e6 * state[0] ** 3) / 200.0]

    start = x[0]
    for _ in range(2):
        found = solve_ivp(rates, (t[0], t[-1]), [start], "LSODA", t, rtol=1e-9, atol=1e-12)
        start = found.y[0, -1]
    return (x - found.y[0]) / compliance


def late(x, v, t):
    """What the sensor shows is a hundredth of a second old."""
    old = CubicSpline(t, spring_damper_force(x, v, t))
    return old(t - 0.01)


def behind_a_gap(x, v, t, gap=0.003, give=3e-4):
    """A slider that moves once gap and spring are taken up: a march from sample to sample."""
    z, deflection = 0.0, np.zeros(x.size)
    for _ in range(2):
        for k in range(x.size):
            z = float(np.clip(z + x[k] - x[k - 1], -gap - give, gap + give))
            deflection[k] = z
    return 5.0 * (deflection - np.clip(deflection, -gap, gap)) / give


def accelerated(x, v, t):
    return spring_damper_force(x, v, t) + 4.0 * CubicSpline(t, v).derivative()(t)


def by_run(law):
    """A law that differs from run to run."""
    left = iter((1.0, -1.0, 0.5, -0.4, 0.7))
    return lambda x, v, t: spring_damper_force(x, v, t) + law(x, v, t) * next(left)


LAWS = {
    "preload": preload,
    "cavitating_rebound": cavitation,
    "sensor_saturation_upper": clipped_above,
    "sensor_saturation_lower": clipped_below,
    "coulomb_friction": coulomb,
    "end_stop_upper": stop,
    "end_stop_lower": plus(lambda x, v, t: 8e3 * np.minimum(x + 0.009, 0.0)),
    "hertzian_contact_lower": hertz,
    "hertzian_contact_upper": plus(lambda x, v, t: 5e5 * np.maximum(x - 0.009, 0.0) ** 1.5),
    "play": gap,
    "power_law_damping": power_law,
    "quadratic_damping": plus(lambda x, v, t: 400.0 * v * np.abs(v)),
    "stroke_dependent_damping": plus(lambda x, v, t: 200.0 * 20.0 * x * v),
    "extension_damping": plus(lambda x, v, t: 500.0 * v * np.abs(v) * (v < 0)),
    "choked_rebound": plus(lambda x, v, t: 8000.0 * v**3 * (v < 0)),
    "asymmetric_friction": plus(lambda x, v, t: 2.0 * smooth_sign(v) ** 2),
    "stribeck_friction": plus(
        lambda x, v, t: 4.0 * np.exp(-((v / 0.01) ** 2)) * smooth_sign(v, 5e-4)
    ),
    "stroke_dependent_friction": plus(lambda x, v, t: 400.0 * x * smooth_sign(v)),
    "load_dependent_friction": plus(
        lambda x, v, t: 0.3 * np.abs(1000.0 * x + 2e6 * x**3) * smooth_sign(v)
    ),
    "dahl_friction": plus(dahl),
    "bouc_wen_friction": plus(bouc_wen),
    "lugre_friction": plus(lugre),
    "backlash_friction": plus(behind_a_gap),
    "quadratic_stiffness": plus(lambda x, v, t: 3e4 * x**2),
    "quintic_stiffness": plus(lambda x, v, t: 1e10 * x**5),
    "constant_force": plus(lambda x, v, t: 3.0),
    "force_offset_by_run": by_run(lambda x, v, t: 2.0),
    "varies_by_run": by_run(lambda x, v, t: 300.0 * x),
    "mass_error": accelerated,
    "frame_compliance": behind_a_frame,
    "sensor_lag": late,
    "sensor_drift": plus(lambda x, v, t: 0.5 * (t - t[-1] / 2)),
}
#: Effects that are a term of the model, which is left out of it.
TERMS = {"viscous_damping": "damping", "linear_stiffness": "stiffness", "cubic_stiffness": "cubic"}


def first_class(state) -> set[str]:
    """The effect that scores best, and those that these data cannot tell from it."""
    scores, _ = score_all(state.base(), options(state, [e.id for e in catalogue()]), jobs=1)
    groups = classes(scores)
    return {scores[k].option.candidate.effect for k in (0, *groups[0])}


def estimated_best(state) -> str:
    """Which of the best scores explains most once it is estimated, its shape with it: between the
    values of a grid that is a factor of two apart, a score may be a few per cent low."""
    roles = assign(state.fit.records)
    loop = close_loop(state.assembly, roles, NUMERICS, max_effects=1, nonparametric=False)
    return loop.rounds[0].ranking[0].effect


@pytest.mark.slow
@pytest.mark.parametrize("effect", LAWS)
def test_effect_in_a_force_law_is_first_or_in_the_first_class(effect, tmp_path):
    state = fitted(damper_campaign(tmp_path, LAWS[effect], noise=0.1), damper())
    assert effect in first_class(state) or effect == estimated_best(state)


@pytest.mark.slow
@pytest.mark.parametrize("effect", TERMS)
def test_a_term_that_is_left_out_is_first(effect, tmp_path):
    whole, term = damper(), TERMS[effect]
    left = {name: text for name, text in whole.outputs["force"].terms.items() if name != term}
    model = replace(
        whole,
        outputs={"force": Output(left, "N")},
        parameters={n: p for n, p in whole.parameters.items() if n != term},
    )
    state = fitted(damper_campaign(tmp_path, spring_damper_force, noise=0.1), model)
    assert effect in first_class(state)


@pytest.mark.slow
@pytest.mark.parametrize("side", [-1, 1])
def test_damping_that_differs_by_direction(side, tmp_path):
    """Less one way is more the other way beside the damping itself: the two are one question."""

    def law(x, v, t):
        return spring_damper_force(x, v, t) + 60.0 * v * (side * v > 0)

    state = fitted(damper_campaign(tmp_path, law, noise=0.1), damper())
    assert first_class(state) & {"direction_dependent_damping", "compression_damping"}


@pytest.mark.slow
def test_friction_that_a_current_changes(tmp_path):
    """A magnetorheological damper: the current is an input that is neither motion nor force."""

    def damper_with(friction, **more):
        terms = {"damping": "damping*current*dot(displacement)", "friction": friction}
        return Model(
            "magnetorheological",
            inputs={"displacement": "m", "current": "A"},
            parameters={
                "damping": Parameter(200.0, "N*s/(m*A)", sd=100.0),
                "coulomb": Parameter(6.0, "N", sd=3.0),
                **more,
            },
            outputs={"force": Output(terms, "N")},
        )

    law = "coulomb*tanh(dot(displacement)/0.002)"
    plans = [
        RunPlan(
            f"run {k}",
            frequency,
            {
                "displacement": motion(0.0, [amplitude, 0.05 * amplitude]),
                "current": motion(1.0, [0.0, 0.4], [0.0, 0.7 * k]),
            },
            periods=6,
            samples_per_period=120.3,
        )
        for k, (frequency, amplitude) in enumerate([(1.0, 0.01), (2.0, 0.006), (0.5, 0.012)])
    ]
    share = Parameter(0.4, "1/A", fixed=True)
    true = damper_with(f"(1 + share*current)*{law}", share=share)
    Campaign.simulate(tmp_path, true, plans, noise={"force": 0.1})
    state = fitted(reduce_campaign(load_campaign(tmp_path), jobs=1), damper_with(law))
    assert "input_dependent_term" in first_class(state)


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
