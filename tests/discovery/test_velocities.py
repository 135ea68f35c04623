"""Friction of a motor whose dof is its speed is found; the form of a model changes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted, scored
from scipy.integrate import solve_ivp
from small_campaigns import HARDENING, MASS, SPRING, oscillator_campaign

from bayesoleo.data import (
    ReducedCampaign,
    SimulatedRun,
    load_campaign,
    reduce_campaign,
    write_campaign,
)
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._nonparametric_quantities import Motions, quantities_of
from bayesoleo.discovery._ranking import scales_of
from bayesoleo.discovery._result_tree import _coordinate
from bayesoleo.discovery._structure_search import _curves
from bayesoleo.model import Model, Output, Parameter

INERTIA, VISCOUS, FRICTION, TRANSITION = 2e-3, 4e-3, 0.04, 0.15
#: Label, frequency in Hz, amplitude and mean of the torque in N*m, role.
RUNS = (
    ("a", 0.5, 0.12, 0.0, "fit"),
    ("b", 1.0, 0.15, 0.0, "fit"),
    ("c", 2.0, 0.20, 0.05, "fit"),  # a free shaft that turns on has a speed that repeats
    ("d", 1.5, 0.15, 0.02, "hold-out"),
)
#: Of speed, rad/s.
NOISE = 0.05


def motor_campaign(folder: Path, friction: float, *, transient: bool = False) -> ReducedCampaign:
    rng = np.random.default_rng(7)
    made = []
    for label, frequency, amplitude, mean, role in RUNS:

        def torque(t, f=frequency, a=amplitude, m=mean):
            more = 0.6 * np.sin(2 * np.pi * 0.618 * f * t) if transient else 0.0
            return m + a * (np.sin(2 * np.pi * f * t) + more)

        def rate(t, w, torque=torque):
            dry = friction * 2 / np.pi * np.arctan(w / TRANSITION)
            return (torque(t) - VISCOUS * w - dry) / INERTIA

        settled = 0 if transient else 6
        time = np.arange((settled + 6) * 100) / (100 * frequency)
        speed = solve_ivp(
            rate, (0.0, time[-1]), [0.0], t_eval=time, rtol=1e-9, atol=1e-9, max_step=2 * time[1],
            method="LSODA",
        ).y[0]  # fmt: skip
        keep = slice(100 * settled, None)
        samples = {
            "torque": torque(time[keep]),
            "speed": speed[keep] + NOISE * rng.standard_normal(time[keep].size),
        }
        kind = "transient" if transient else "periodic"
        known = None if transient else frequency
        at = time[keep] - time[keep][0]
        made.append(SimulatedRun(label, at, samples, known, role=role, kind=kind))
    channels = {"torque": ("t_Nm", "N*m"), "speed": ("w", "rad/s")}
    write_campaign(
        folder, name="motor", channels=channels, runs=made, controlled="torque", overwrite=True
    )
    return reduce_campaign(load_campaign(folder), jobs=1)


def motor() -> Model:
    return Model(
        "motor",
        inputs={"torque": "N*m"},
        dofs={"speed": "rad/s"},
        parameters={
            "inertia": Parameter(1.5e-3, "kg*m**2", relative_sd=0.5),
            "viscous": Parameter(3e-3, "N*m*s/rad", relative_sd=1.0),
        },
        equations={
            "speed": {
                "inertia": "inertia*dot(speed)", "viscous": "viscous*speed", "drive": "-torque"
            }
        },
        outputs={"speed": Output("speed", "rad/s")},
    )  # fmt: skip


def oscillator(*, states: bool) -> Model:
    """A mass on a spring, of second order or with its velocity as a state."""
    rate, inertia = ("v", "dot(v)") if states else ("dot(x)", "ddot(x)")
    balance = {"inertia": f"mass*{inertia}", "drag": f"drag*{rate}"}
    balance |= {"spring": "spring*x", "drive": "-force"}
    return Model(
        "oscillator",
        inputs={"force": "N"},
        dofs={"x": "m", "v": "m/s"} if states else {"x": "m"},
        parameters={
            "mass": Parameter(MASS, "kg", fixed=True),
            "drag": Parameter(1.0, "N*s/m", relative_sd=0.5),
            "spring": Parameter(SPRING, "N/m", relative_sd=0.3),
        },
        equations={"x": "dot(x) - v", "v": balance} if states else {"x": balance},
        outputs={"displacement": Output("x", "m")},
    )


def hardening(x, v):
    return SPRING * x + HARDENING * x**3 + 0.8 * v


def test_a_velocity_is_followed_once_as_what_it_is():
    assert [(q.name, q.unit) for q in quantities_of(motor())] == [("speed", "rad/s")]
    found = {q.name: q.unit for q in quantities_of(oscillator(states=True))}
    assert found == {"x": "m", "v": "m/s"}
    found = {q.name: q.unit for q in quantities_of(oscillator(states=False))}
    assert found == {"x": "m", "velocity of x": "m/s"}


def test_sizes_of_a_free_shaft_are_those_of_its_speed(tmp_path):
    """The way is that since the start, which grows where the shaft turns on."""
    state = fitted(motor_campaign(tmp_path, 0.0), motor())
    scales = scales_of(state.fit, state.assembly.drive, state.assembly.native)
    largest, way = 0.0, 0.0
    for _, f, a, m, role in RUNS:
        if role == "fit":
            impedance = abs(VISCOUS + 2j * np.pi * f * INERTIA)
            largest = max(largest, m / VISCOUS + a / impedance)
            way = max(way, m / VISCOUS / f, a / impedance / (np.pi * f))
    assert scales.velocity["speed"] == pytest.approx(largest, rel=0.02)
    low, high = scales.position["speed"]
    assert high - low == pytest.approx(way, rel=0.1)


def test_functions_of_a_motion_do_not_depend_on_the_form_of_the_model(tmp_path):
    """A velocity that is a dof is that of its position."""
    reduced = oscillator_campaign(tmp_path, restoring=hardening)
    found = []
    for states in (False, True):
        state = fitted(reduced, oscillator(states=states))
        native = state.assembly.native
        motions = Motions(state.fit, state.assembly, quantities_of(native))
        names = [name for name, _ in _curves(motions, dict(motions.axes({})), native)]
        found.append([name.replace("velocity of x", "v") for name in names])
    assert found[0] == found[1]
    assert {"x", "v", "x by direction", "v times position"} <= set(found[0])


def test_sizes_of_a_motion_do_not_depend_on_the_form_of_the_model(tmp_path):
    reduced = oscillator_campaign(tmp_path, restoring=hardening)
    found = []
    for states in (False, True):
        state = fitted(reduced, oscillator(states=states))
        scales = scales_of(state.fit, state.assembly.drive, state.assembly.native)
        name = "v" if states else "x"
        found.append((*scales.position[name], scales.velocity[name]))
    # Of two solutions on their own meshes.
    assert found[0] == pytest.approx(found[1], rel=1e-3)


def test_scores_do_not_depend_on_the_form_of_the_model(tmp_path):
    reduced = oscillator_campaign(tmp_path, restoring=hardening)
    names = ("cubic_stiffness", "end_stop_upper", "coulomb_friction", "dahl_friction")
    shares = []
    for states in (False, True):
        found = scored(fitted(reduced, oscillator(states=states)), *names)
        shares.append({name: score.share for name, score in found.items()})
    assert shares[0].keys() == shares[1].keys() == set(names)
    assert max(shares[0], key=shares[0].__getitem__) == "cubic_stiffness"
    for name, share in shares[0].items():
        assert share == pytest.approx(shares[1][name], rel=0.01), name


@pytest.mark.slow
@pytest.mark.parametrize("transient", [False, True], ids=["periodic", "transient"])
def test_coulomb_friction_of_a_motor_is_found(tmp_path, transient):
    reduced = motor_campaign(tmp_path, FRICTION, transient=transient)
    loop = close_loop(Assembly(motor(), None), assign(reduced.records), NUMERICS)
    assert loop.effects == ("coulomb_friction",)
    assert loop.targets == ("speed",)
    point = loop.final.fit.point
    for name, true in {"coulomb_friction": FRICTION, "inertia": INERTIA}.items():
        k = point.names.index(name)
        assert abs(point.theta[k] - true) < 4 * point.sd[k] < 0.1 * true
    # It has no position that could be shown.
    assert list(_coordinate(loop)) == ["velocity"]


@pytest.mark.slow
def test_nothing_is_missing_in_a_motor_without_friction(tmp_path):
    reduced = motor_campaign(tmp_path, 0.0)
    assert close_loop(Assembly(motor(), None), assign(reduced.records), NUMERICS).effects == ()
