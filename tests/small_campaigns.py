"""Campaigns of small systems, simulated by NumPy and SciPy alone and read back through files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from bayesoleo.data import (
    ReducedCampaign,
    SimulatedRun,
    load_campaign,
    reduce_campaign,
    write_campaign,
)
from bayesoleo.model import Model, Output, Parameter

Array = NDArray[np.float64]
Force = Callable[[Array, Array, Array], Array]

DAMPER_CHANNELS = {"displacement": ("x_mm", "mm"), "force": ("f_N", "N")}
#: Label, frequency in Hz, amplitude in m, role.
DAMPER_RUNS = (
    ("a", 1.0, 0.010, "fit"),
    ("b", 2.0, 0.006, "fit"),
    ("c", 0.5, 0.012, "fit"),
    ("d", 1.5, 0.008, "hold-out"),
    ("e", 1.0, 0.012, "hold-out"),
)
DAMPING, STIFFNESS, CUBIC, FRICTION = 200.0, 1000.0, 2.0e6, 5.0


def damper(
    *, cubic: bool = True, linear: bool = True, offsets: bool = False, noisy: bool = False
) -> Model:
    """Force law of a damper with a spring, linear in all its parameters."""
    terms = {"damping": "damping*dot(displacement)"}
    parameters = {"damping": Parameter(150.0, "N*s/m", sd=500.0)}
    if linear:
        terms["stiffness"] = "stiffness*displacement"
        parameters["stiffness"] = Parameter(800.0, "N/m", sd=3000.0)
    if cubic:
        terms["cubic"] = "cubic*displacement**3"
        parameters["cubic"] = Parameter(1.0e6, "N/m**3", sd=1e7)
    if offsets:
        terms["offset"] = "offset"
        parameters["offset"] = Parameter(0.0, "N", sd=100.0, by_run=True)
    return Model(
        "damper",
        inputs={"displacement": "m"},
        parameters=parameters,
        outputs={"force": Output(terms, "N")},
    )


def spring_damper_force(x: Array, v: Array, _: Array) -> Array:
    """What :func:`damper` describes."""
    return DAMPING * v + STIFFNESS * x + CUBIC * x**3


def with_friction(x: Array, v: Array, t: Array) -> Array:
    """The same with dry friction."""
    return spring_damper_force(x, v, t) + FRICTION * np.sign(v)


def damper_campaign(
    folder: Path,
    force: Force = with_friction,
    *,
    seed: int = 0,
    noise: float = 0.5,
    input_noise: float = 0.0,
    runs: Sequence[tuple[str, float, float, str]] = DAMPER_RUNS,
    periods: int = 8,
    per_period: float = 100.37,
    offsets: Mapping[str, float] | None = None,
    coloured: float = 0.0,
    transient: bool = False,
) -> ReducedCampaign:
    """Displacement-controlled runs; noise in N and m, white or AR(1) with a coefficient."""
    rng = np.random.default_rng(seed)
    made = []
    for label, frequency, amplitude, role in runs:
        time = np.arange(int(np.ceil(periods * per_period))) / (per_period * frequency)
        omega = 2 * np.pi * frequency
        x = amplitude * (np.sin(omega * time) + 0.05 * np.cos(2 * omega * time))
        v = amplitude * omega * (np.cos(omega * time) - 0.1 * np.sin(2 * omega * time))
        if transient:
            x = x + 0.4 * amplitude * np.sin(0.618 * omega * time)
            v = v + 0.4 * amplitude * 0.618 * omega * np.cos(0.618 * omega * time)
        y = force(x, v, time) + (offsets or {}).get(label, 0.0)
        y = y + noise * _coloured(rng, time.size, coloured)
        x = x + input_noise * rng.standard_normal(time.size)
        samples = {"displacement": x, "force": y}
        kind = "transient" if transient else "periodic"
        known = None if transient else frequency
        made.append(SimulatedRun(label, time, samples, known, role=role, kind=kind))
    write_campaign(
        folder,
        name="damper",
        channels=DAMPER_CHANNELS,
        runs=made,
        controlled="displacement",
        overwrite=True,
    )
    return reduce_campaign(load_campaign(folder), jobs=1)


def _coloured(rng: np.random.Generator, size: int, coefficient: float) -> Array:
    """AR(1) noise of unit variance."""
    white = rng.standard_normal(size)
    if coefficient:
        for k in range(1, size):
            white[k] = coefficient * white[k - 1] + np.sqrt(1 - coefficient**2) * white[k]
    return white


MASS, SPRING, DRAG, HARDENING = 1.0, 100.0, 0.8, 3.0e4
#: Label, frequency in Hz, amplitude of the force in N, role.
OSCILLATOR_RUNS = (
    ("a", 1.0, 2.0, "fit"),
    ("b", 1.3, 1.5, "fit"),
    ("c", 2.1, 3.0, "fit"),
    ("d", 1.1, 2.5, "hold-out"),
    ("e", 1.8, 2.0, "hold-out"),
)


def oscillator_campaign(
    folder: Path,
    *,
    restoring: Callable[[Array, Array], Array],
    seed: int = 0,
    noise: float = 2e-5,
    runs: Sequence[tuple[str, float, float, str]] = OSCILLATOR_RUNS,
    periods: int = 6,
    per_period: int = 100,
    each: Mapping[str, tuple[Callable[[Array, Array], Array], float]] = MappingProxyType({}),
) -> ReducedCampaign:
    """A mass under ``F sin`` against a restoring force ``(x, v)``, after its transient; some runs
    have a force of their own and an offset of the sensor."""
    rng = np.random.default_rng(seed)
    made = []
    for label, frequency, amplitude, role in runs:
        period, omega = 1 / frequency, 2 * np.pi * frequency
        law, offset = each.get(label, (restoring, 0.0))

        def rates(t, s, amplitude=amplitude, omega=omega, law=law):
            pull = amplitude * np.sin(omega * t) - law(s[0], s[1])
            return [s[1], pull / MASS]

        settle = 60 * period
        time = np.arange(periods * per_period) * period / per_period
        found = solve_ivp(
            rates, (0, settle + periods * period), [0.0, 0.0], "DOP853", settle + time, rtol=1e-9,
            atol=1e-12,
        )  # fmt: skip
        y = found.y[0] + offset + noise * rng.standard_normal(time.size)
        samples = {"force": amplitude * np.sin(omega * time), "displacement": y}
        made.append(SimulatedRun(label, time, samples, frequency, role=role))
    write_campaign(
        folder,
        name="oscillator",
        channels={"force": ("f_N", "N"), "displacement": ("x_mm", "mm")},
        runs=made,
        overwrite=True,
    )
    return reduce_campaign(load_campaign(folder), jobs=1)
