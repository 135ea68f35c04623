"""Friction behind a gap is found with its size; friction without a gap is not called backlash."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted, scored
from scipy.interpolate import CubicSpline
from small_campaigns import (
    damper,
    damper_campaign,
    spring_damper_force,
)

from bayesoleo.data import SimulatedRun, load_campaign, reduce_campaign, write_campaign
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import close_loop
from bayesoleo.effects import Scales, catalogue, find_effect
from bayesoleo.model import Model, Output, Parameter

FRICTION = [e for e in catalogue() if e.family == "friction" and e.id != "lugre_friction"]
#: Instants between two samples at which a slider is marched.
FINE = 32


def slider(friction: float, gap: float, rise: float, soft: bool = False):
    """Force of a slider along a fine motion; soft as Dahl's, else elastic until it slides."""

    def along(x):
        z, deflection = 0.0, np.zeros(x.size)
        for _ in range(2):
            for k in range(x.size):
                step = x[k] - x[k - 1]
                if soft:
                    z += step - abs(step) * (z - min(max(z, -gap), gap)) / rise
                else:
                    z = min(max(z + step, -gap - rise), gap + rise)
                deflection[k] = z
        return friction * (deflection - np.clip(deflection, -gap, gap)) / rise

    return along


def beside_spring_and_damper(device):
    """A law of the whole damper."""

    def law(x, v, t):
        fine = np.linspace(t[0], t[-1], FINE * (t.size - 1) + 1)
        return spring_damper_force(x, v, t) + device(CubicSpline(t, x)(fine))[::FINE]

    return law


def with_rigid_friction() -> Model:
    """The damper with Coulomb friction of its own, which the device lacks."""
    model = damper()
    terms = dict(model.outputs["force"].terms)
    terms["friction"] = "coulomb*2/pi*atan(2000*dot(displacement))"
    coulomb = {"coulomb": Parameter(5.0, "N", relative_sd=0.5)}
    return replace(
        model, outputs={"force": Output(terms, "N")}, parameters={**model.parameters, **coulomb}
    )


def behind_a_gap(model: Model, target: str, place: str, values: dict[str, float]) -> Model:
    """A model with the effect, its parameters a little off, with wide priors."""
    scales = Scales({place: (-0.01, 0.01)}, {place: 0.06}, {}, 1.0, 1.0)
    model = find_effect("backlash_friction").extend(model, target, scales).model
    units = {name: model.parameters[name].unit for name in values}
    near = {n: Parameter(1.1 * v, units[n], sd=v) for n, v in values.items()}
    return replace(model, parameters={**model.parameters, **near})


def assert_known(state, values: dict[str, float]):
    """Estimates within three and a half standard deviations, which are small."""
    point = state.fit.point
    found = {n: (v, s) for n, v, s in zip(point.names, point.theta, point.sd, strict=True)}
    for name, true in values.items():
        value, sd = found[name]
        assert abs(value - true) < 3.5 * sd, (name, value, sd, true)
        assert sd < 0.1 * true


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "gap", "rise"),
    [(5.0, 3e-3, 3e-4), (5.0, 2e-3, 2e-3), (40.0, 5e-4, 1e-3)],
    ids=["stiff", "soft", "small gap"],
)
def test_gap_friction_and_rise_of_a_force_law_are_within_their_intervals(
    friction, gap, rise, tmp_path
):
    law = beside_spring_and_damper(slider(friction, gap, rise))
    true = {
        "backlash_friction": friction, "backlash_friction_gap": gap, "backlash_friction_rise": rise
    }  # fmt: skip
    model = behind_a_gap(with_rigid_friction(), "force", "displacement", true)
    state = fitted(damper_campaign(tmp_path, law, noise=0.2), model)
    assert_known(state, true)
    point = state.fit.point
    k = point.names.index("coulomb")
    assert abs(point.theta[k]) < 3.5 * point.sd[k]


@pytest.mark.slow
def test_a_slider_is_scored_though_a_stiff_one_is_not_reached_from_a_soft_one(tmp_path):
    state = fitted(damper_campaign(tmp_path, noise=0.2), damper())
    assert set(scored(state, "backlash_friction")) == {"backlash_friction"}


# -- a mass that such a joint holds ----------------------------------------------------------------

DAMPING, STIFFNESS = 4.0, 100.0
TRUE = {
    "backlash_friction": 0.4, "backlash_friction_gap": 4e-3, "backlash_friction_rise": 2e-3
}  # fmt: skip


def oscillator() -> Model:
    """A mass of 1 kg, on a spring and a damper, that a force drives."""
    return Model(
        "oscillator",
        inputs={"force": "N"},
        dofs={"position": "m"},
        parameters={
            "damping": Parameter(3.0, "N*s/m", sd=3.0),
            "stiffness": Parameter(90.0, "N/m", sd=50.0),
        },
        equations={
            "position": {
                "inertia": "ddot(position)",
                "damping": "damping*dot(position)",
                "spring": "stiffness*position",
                "drive": "-force",
            }
        },
        outputs={"displacement": Output("position", "m")},
    )


def _answer(drive, period: float, per_period: int, periods: int, device):
    """Positions at the samples: a central difference in short steps, with a slider on its way."""
    friction, gap, rise = device
    fine, settle = 16, 10
    h, count = period / (per_period * fine), per_period * fine
    force = drive(np.arange(count) * h)
    x, v, z, found = 0.0, 0.0, 0.0, []
    for k in range((settle + periods) * count):
        if k >= settle * count and k % fine == 0:
            found.append(x)
        held = friction * (z - min(max(z, -gap), gap)) / rise
        middle = v + h / 2 * (force[k % count] - DAMPING * v - STIFFNESS * x - held)
        x += h * middle
        z = min(max(z + h * middle, -gap - rise), gap + rise)
        held = friction * (z - min(max(z, -gap), gap)) / rise
        v = (middle + h / 2 * (force[(k + 1) % count] - STIFFNESS * x - held)) / (
            1 + h / 2 * DAMPING
        )
    return np.array(found)


def oscillator_campaign(folder: Path, device, noise: float = 2e-5):
    """Runs with sines and with a second harmonic."""
    rng, made = np.random.default_rng(3), []
    runs = [("a", 1.0, 2.5, 0.0), ("b", 1.5, 2.0, 0.4), ("c", 0.6, 2.0, 0.3), ("d", 1.2, 2.0, 0.0)]
    for label, frequency, size, second in runs:
        omega = 2 * np.pi * frequency

        def drive(t, size=size, second=second, omega=omega):
            return size * (np.sin(omega * t) + second * np.cos(2 * omega * t))

        per_period, periods = 80, 4
        x = _answer(drive, 1 / frequency, per_period, periods, device)
        time = np.arange(x.size) / (per_period * frequency)
        samples = {"force": drive(time), "displacement": x + noise * rng.standard_normal(x.size)}
        role = "hold-out" if label == "d" else "fit"
        made.append(SimulatedRun(label, time, samples, frequency, role=role))
    channels = {"force": ("f_N", "N"), "displacement": ("x_mm", "mm")}
    write_campaign(folder, name="oscillator", channels=channels, runs=made, overwrite=True)
    return reduce_campaign(load_campaign(folder), jobs=1)


@pytest.mark.slow
def test_gap_friction_and_rise_of_an_oscillator_are_within_their_intervals(tmp_path):
    reduced = oscillator_campaign(tmp_path, tuple(TRUE.values()))
    state = fitted(reduced, behind_a_gap(oscillator(), "position", "position", TRUE))
    assert_known(state, {**TRUE, "damping": DAMPING, "stiffness": STIFFNESS})


# -- names -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("device", "expected"),
    [
        (slider(5.0, 1e-3, 3e-4), "backlash_friction"),
        (slider(5.0, 2e-3, 2e-3, soft=True), "backlash_friction"),
        (slider(5.0, 0.0, 1e-3, soft=True), "dahl_friction"),
    ],
    ids=["small gap", "soft behind a gap", "soft"],
)
@pytest.mark.parametrize("declared", [damper, with_rigid_friction], ids=["plain", "rigid"])
def test_what_has_a_gap_is_called_backlash_and_nothing_else(declared, device, expected, tmp_path):
    reduced = damper_campaign(tmp_path, beside_spring_and_damper(device), noise=0.2)
    loop = close_loop(
        Assembly(declared(), None), assign(reduced.records), NUMERICS, effects=FRICTION,
        max_effects=1, nonparametric=False,
    )  # fmt: skip
    accepted = loop.rounds[0].accepted
    assert accepted is not None
    assert accepted.effect == expected


@pytest.mark.slow
def test_a_joint_of_an_oscillator_is_named(tmp_path):
    reduced = oscillator_campaign(tmp_path, (0.4, 4e-3, 2e-3))
    loop = close_loop(
        Assembly(oscillator(), None), assign(reduced.records), NUMERICS, effects=FRICTION,
        max_effects=1, nonparametric=False,
    )  # fmt: skip
    accepted = loop.rounds[0].accepted
    assert accepted is not None
    assert accepted.effect == "backlash_friction"
