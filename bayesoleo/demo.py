"""A small shaker campaign of an oleo, simulated with one effect that the model it is for lacks."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from bayesoleo.data import SimulatedRun, write_campaign
from bayesoleo.effects import Scales, find_effect
from bayesoleo.model import Model, driven_by
from bayesoleo.prediction.simulate import RunPlan, motion, simulate_run
from bayesoleo.simulation import to_simulated_run
from bayesoleo.systems import system

#: The model that the demonstration fits, and the effect that it lacks.
DEMO_SYSTEM = "f16n2d2"
DEMO_EFFECT = "stribeck_friction"

#: Every parameter that is not at the model's nominal value, SI; the last two belong to the effect.
DEMO_TRUTH: Mapping[str, float] = MappingProxyType(
    {
        "piston_area": 3484e-6 * 0.990,
        "initial_volume": 9.20e-4 * 1.008,
        "orifice_damping": 2897.0 * 1.10,
        "friction_base": 65.0 * 1.20,
        "friction_per_pressure": 2.0e-5 * 0.80,
        "friction_slope": 3400.0 * 1.20,
        "solubility": -1.570e-8 * 0.85,
        "heat_conduction": 2.567 * 0.75,
        "stribeck_friction": 140.0,
        "stribeck_friction_decay": 0.006,
    }
)

#: Standard deviation of the noise by channel, SI: 0.05 mm, 20 N, 0.05 bar.
NOISE = MappingProxyType({"displacement": 0.05e-3, "force": 20.0, "pressure": 0.05e5})
#: Steps of 16 bits over 0.3 m, 60 kN and 100 bar.
QUANTISATION = MappingProxyType(
    {
        name: full / 2**16
        for name, full in (("displacement", 0.3), ("force", 6e4), ("pressure", 1e7))
    }
)
CHANNELS = MappingProxyType(
    {
        "displacement": ("stroke_mm", "mm"),
        "force": ("force_kN", "kN"),
        "pressure": ("pressure_bar", "bar"),
    }
)
PRESSURE, PRESSURE_SCATTER, TEMPERATURE = 4.9e5, 0.015, 293.0
FREQUENCY_SCATTER = 0.002
#: Second and third harmonic of the displacement over its amplitude.
DISTORTION = (0.008, 0.004)


@dataclass(frozen=True)
class _Test:
    """One row of the thesis's test grid: static position and amplitude in mm, nominal frequency."""

    label: str
    group: str
    role: str
    frequency: float
    position: float
    amplitude: float


# Verbeek (1993), tables 5.1 and 5.2; amplitudes trimmed where they would touch a stop.
_TESTS = (
    _Test("b", "middle", "fit", 0.1, 133, 115),
    _Test("k", "low", "fit", 0.2, 79, 74),
    _Test("d", "high", "fit", 0.5, 219, 32),
    _Test("j", "middle", "fit", 2.0, 133, 10),
    _Test("c", "high", "hold-out", 0.2, 179, 73),
    _Test("i", "middle", "hold-out", 1.0, 133, 21),
)


def true_model() -> Model:
    """The model that makes the data, driven by displacement, at :data:`DEMO_TRUTH`."""
    # Scales place the scan grid of the effect's shape, which gets its true value here anyway.
    scales = Scales(
        position={"stroke": (0.0, 0.264)},
        velocity={"stroke": 0.15},
        output={},
        shortest_period=0.5,
        longest_period=10.0,
    )
    candidate = find_effect(DEMO_EFFECT).extend(system(DEMO_SYSTEM), "stroke", scales)
    return driven_by(candidate.model.with_values(DEMO_TRUTH), "displacement")


def demo_campaign(folder: str | os.PathLike[str], seed: int = 0) -> Path:
    """Simulate the demonstration's campaign and write it as a rig would.

    Six runs of about four periods, displacement under control, four to fit and two to hold out.

    Parameters
    ----------
    folder : path-like
        Made if it is not there; must be empty.
    seed : int
        Of noise, starting phases, frequencies and initial pressures. The truth does not change.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    CampaignError
        If the folder holds files.

    References
    ----------
    Verbeek (1993), tables 5.1 and 5.2.
    """
    model = true_model()
    streams = np.random.default_rng(seed).spawn(len(_TESTS))
    runs = [_simulate(model, test, rng) for test, rng in zip(_TESTS, streams, strict=True)]
    return write_campaign(
        folder,
        name="demo",
        description="Shaker test of an oleo, simulated for the demonstration.",
        controlled="displacement",
        channels=CHANNELS,
        runs=runs,
    )


def _simulate(model: Model, test: _Test, rng: np.random.Generator) -> SimulatedRun:
    amplitudes = 1e-3 * test.amplitude * np.array([1.0, *DISTORTION])
    # Recorded as a gauge shows it: what is written is what the run had.
    pressure = float(np.round(PRESSURE * (1 + PRESSURE_SCATTER * rng.standard_normal())))
    plan = RunPlan(
        test.label,
        test.frequency * (1 + FREQUENCY_SCATTER * rng.standard_normal()),
        {
            "displacement": motion(
                1e-3 * test.position, amplitudes.tolist(), rng.uniform(0, 2 * np.pi, 3).tolist()
            )
        },
        {"initial_pressure": pressure, "ambient_temperature": TEMPERATURE},
        periods=rng.uniform(4.0, 4.2),
        samples_per_period=rng.uniform(400.0, 500.0),
        group=test.group,
        role=test.role,
    )
    made = simulate_run(model, plan, noise=NOISE, quantisation=QUANTISATION, rng=rng)
    units = {name: item.unit for name, item in model.conditions.items()}
    return replace(to_simulated_run(made, units), frequency=test.frequency)
