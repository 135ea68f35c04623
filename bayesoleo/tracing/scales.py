"""Sizes of the estimated motion, which place the scan grids of effects."""

from __future__ import annotations

import numpy as np

from bayesoleo.effects import Scales
from bayesoleo.tracing.fit import Fit

POINTS = 512


def scales_of(fit: Fit, drive: str | None, native_dofs: tuple[str, ...]) -> Scales:
    """Ranges of every coordinate over all fitted runs.

    A dof that the drive replaced moves as the driving channel does; offsets and gains on it are
    small.
    """
    position: dict[str, tuple[float, float]] = {}
    velocity: dict[str, float] = {}
    phase = np.arange(POINTS) / POINTS

    def add(name: str, values: np.ndarray, rates: np.ndarray) -> None:
        low, high = position.get(name, (np.inf, -np.inf))
        position[name] = (min(low, float(values.min())), max(high, float(values.max())))
        velocity[name] = max(velocity.get(name, 0.0), float(np.abs(rates).max()))

    for run, record in zip(fit.predictor.runs, fit.records, strict=True):
        for dof, motion in run.known_motions().items():
            rows = motion(phase)
            add(dof, rows[0], rows[1])
        for channel, item in record.harmonics.items():
            values, rates = (item.evaluate(phase, record.frequency, k) for k in (0, 1))
            add(channel, values, rates)
            if channel == drive:
                for dof in native_dofs:
                    if dof not in run.known_motions():
                        add(dof, values, rates)
    outputs = {
        name: max(float(np.ptp(run.measured[k])) for run in fit.predictor.runs)
        for k, name in enumerate(fit.predictor.outputs)
    }
    periods = [1.0 / record.frequency for record in fit.records]
    return Scales(position, velocity, outputs, min(periods), max(periods))
