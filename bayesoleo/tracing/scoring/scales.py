"""Sizes of the estimated motion, which place the scan grids of effects."""

from __future__ import annotations

import numpy as np

from bayesoleo.effects import Scales
from bayesoleo.prediction.records import Record
from bayesoleo.tracing.fitting.fit import Fit
from bayesoleo.tracing.fitting.masked import weights
from bayesoleo.tracing.scoring.hum import dominant_residual_frequency

POINTS = 512


def scales_of(fit: Fit, drive: str | None, native_dofs: tuple[str, ...]) -> Scales:
    """Ranges of every coordinate over all fitted runs.

    A dof that the drive replaced moves as the driving channel does; offsets and gains on it are
    small.
    """
    position: dict[str, tuple[float, float]] = {}
    velocity: dict[str, float] = {}

    def add(name: str, values: np.ndarray, rates: np.ndarray) -> None:
        low, high = position.get(name, (np.inf, -np.inf))
        position[name] = (min(low, float(values.min())), max(high, float(values.max())))
        velocity[name] = max(velocity.get(name, 0.0), float(np.abs(rates).max()))

    for run, record in zip(fit.predictor.runs, fit.records, strict=True):
        phase = _places(record)
        for dof, motion in run.known_motions().items():
            rows = motion(phase)
            add(dof, rows[0], rows[1])
        for channel, item in record.signals.items():
            values, rates = (item.evaluate(phase, record.rate, k) for k in (0, 1))
            add(channel, values, rates)
            if channel == drive:
                for dof in native_dofs:
                    if dof not in run.known_motions():
                        add(dof, values, rates)
    outputs = {
        name: max(
            float(np.ptp(run.measured[k][weights(run.record) > 0])) for run in fit.predictor.runs
        )
        for k, name in enumerate(fit.predictor.outputs)
    }
    periods = [time for record in fit.records for time in _times(record)]
    ranges = {
        name: (
            min(float(run.measured[k].min()) for run in fit.predictor.runs),
            max(float(run.measured[k].max()) for run in fit.predictor.runs),
        )
        for k, name in enumerate(fit.predictor.outputs)
    }
    kinds = frozenset(record.kind for record in fit.records)
    times = min(periods), max(periods)
    stated = [record.conditions for record in fit.records]
    shared = set.intersection(*map(set, stated))
    conditions = {name: float(np.mean([run[name] for run in stated])) for name in shared}
    return Scales(
        position,
        velocity,
        outputs,
        *times,
        ranges,
        kinds,
        dominant_residual_frequency(fit),
        conditions,
    )


def _places(record: Record) -> np.ndarray:
    """Where to look at the motion: all over a period, or at the samples of a transient."""
    return np.arange(POINTS) / POINTS if record.periodic else record.position


def _times(record: Record) -> tuple[float, ...]:
    """Times on which a run moves: its period; of a transient, its length and, by the channel that
    is fastest for its size, the period that a harmonic motion as fast would have."""
    if record.periodic:
        return (record.span,)
    found = [record.span]
    for item in record.signals.values():
        values, rates = (item.evaluate(record.position, record.rate, k) for k in (0, 1))
        if np.std(values) > 0 and np.std(rates) > 0:
            found.append(float(min(record.span, 2 * np.pi * np.std(values) / np.std(rates))))
    return tuple(found)
