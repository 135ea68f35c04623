r"""What a converter does to a record: values on a grid, and values cut off at its ends.

Rounding to steps :math:`\Delta` adds an error of variance :math:`\Delta^2/12`. Where noise spreads
over more than a step it is white, and is counted with the noise, which is measured from the same
samples. Where a channel is quieter than that, and samples fall on the same phases in every period,
the error repeats itself and looks like something missing; it is counted with the noise of the
average. Its variance is then (Widrow and Kollar
2008, Quantization Noise)

.. math:: \sum_k \frac{\Delta^2}{2 \pi^2 k^2} e^{-4 \pi^2 k^2 \sigma^2 / \Delta^2}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.prediction.records import Record

#: A step is worth a word if it is larger than this times the noise of a sample: below, rounding is
#: a sixth of that noise's variance at most.
COARSE = 1.4
#: A grid has at least so many values, and all but a few samples lie on it to this part of a step.
_VALUES, _ON, _MOST_OFF = 6, 0.02, 0.01
#: A record is cut off where so many samples in a row have its extreme value, so many times as many
#: in all as have any other within a tenth of the range of it: of a sinusoid that is rounded, at
#: most 2.4 times as many samples have the extreme value as the next.
_IN_A_ROW, _TIMES = 4, 5.0
#: A signal that jumps to its extreme value by more than this part of its range, and by so many
#: times what it changed by just before, is switched there and not cut off: steps, random binary
#: signals.
_JUMP, _SWITCHED = 0.1, 3.0
#: Phases at which the rate of a signal is looked at.
_PHASES = 512


@dataclass(frozen=True)
class Clipped:
    """An end of the range at which a channel is cut off.

    Parameters
    ----------
    channel : str
    end : str
        ``highest`` or ``lowest``.
    value : float
        SI.
    share : float
        Part of the samples that have it.
    """

    channel: str
    end: str
    value: float
    share: float


def step_of(values: Array) -> float:
    """Step of the grid that samples lie on; zero where there is none.

    Parameters
    ----------
    values : ndarray, shape (N,)
    """
    levels = np.unique(values)
    if levels.size < _VALUES:
        return 0.0
    gaps = np.diff(levels)
    # Numbers that are the same but for their last digits are one level.
    gaps = gaps[gaps > 1e-9 * np.ptp(levels)]
    if gaps.size < _VALUES - 1:
        return 0.0
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    counts = np.round(gaps / step)
    step = float(gaps.sum() / counts.sum())
    off = np.abs(gaps / step - counts) > _ON
    return step if np.mean(off) < _MOST_OFF else 0.0


def repeating_rounding(step: float, noise: float) -> float:
    """Standard deviation of the part of rounding errors that noise does not average out.

    Parameters
    ----------
    step : float
        Of the grid.
    noise : float
        Standard deviation of a sample before rounding.
    """
    k = np.arange(1, 200)
    spread = np.exp(-4.0 * (np.pi * k * noise / max(step, 1e-300)) ** 2)
    return float(step * np.sqrt(np.sum(spread / (2.0 * (np.pi * k) ** 2))))


def rounding_that_repeats(step: float, scatter: float) -> float:
    """The same, given what samples of the same phase scatter by after rounding.

    Of the variance of noise and rounding together, ``noise**2 + step**2 / 12``, the part that
    repeats does not scatter; the noise for which the rest is the scatter is found by bisection.

    Parameters
    ----------
    step : float
        Of the grid.
    scatter : float
        Standard deviation of a sample about the average over periods.
    """
    low, high = 0.0, step  # of noise as large as a step no rounding repeats
    for _ in range(40):
        noise = 0.5 * (low + high)
        rest = noise**2 + step**2 / 12.0 - repeating_rounding(step, noise) ** 2
        low, high = (noise, high) if rest < scatter**2 else (low, noise)
    return repeating_rounding(step, low)


def rounding_in_average(record: Record, channel: str) -> float:
    """Standard error that rounding leaves in a channel's average over periods, beyond its noise.

    Where samples fall on other phases in every period, the signal has moved on by then; errors of
    rounding add up as the steps that it moved turn.

    Parameters
    ----------
    record : Record
    channel : str

    Returns
    -------
    float
        SI; zero for a transient, and where steps are small against the noise.
    """
    scatter = record.signal_noise[channel]
    step = step_of(record.samples[channel]) if record.periodic else 0.0
    if step <= COARSE * scatter:
        return 0.0
    time_step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    samples = 1.0 / (record.frequency * time_step)
    phases = np.arange(_PHASES) / _PHASES
    rate = record.harmonics[channel].evaluate(phases, record.frequency, 1)
    turn = np.pi * rate * (samples - round(samples)) * time_step / step
    together = np.sinc(record.periods * turn / np.pi) / np.sinc(turn / np.pi)
    share = float(np.mean(np.clip(together, -1.0, 1.0) ** 2))
    return rounding_that_repeats(step, scatter) * float(np.sqrt(share))


def coarse_steps(record: Record) -> dict[str, float]:
    """Steps by channel where they are large against the noise of a sample, SI."""
    found = {name: step_of(values) for name, values in record.samples.items()}
    return {n: s for n, s in found.items() if s > COARSE * record.signal_noise[n]}


def clipped(record: Record) -> tuple[Clipped, ...]:
    """Channels of a run that are cut off at an end of their range."""
    found = []
    for name, values in record.samples.items():
        for end, sign in (("highest", 1.0), ("lowest", -1.0)):
            share = _cut_off(sign * values)
            if share > 0:
                found.append(Clipped(name, end, float(sign * np.max(sign * values)), share))
    return tuple(found)


def _cut_off(values: Array) -> float:
    """Part of the samples that have the highest value, if that is where they are cut off, or 0."""
    highest, span = float(values.max()), float(np.ptp(values))
    if span == 0:
        return 0.0
    at = values >= highest - 1e-9 * span
    edges = np.flatnonzero(np.diff(np.concatenate([[0], at.astype(np.int8), [0]])))
    if (edges[1::2] - edges[::2]).max() < _IN_A_ROW:
        return 0.0
    if _is_switched(values, edges[::2], edges[1::2]):
        return 0.0
    near = values[(values > highest - 0.1 * span) & ~at]
    counts = np.unique(near, return_counts=True)[1] if near.size else np.array([1])
    return float(at.mean()) if at.sum() > _TIMES * counts.max() else 0.0


def _is_switched(values: Array, first: NDArray[np.intp], end: NDArray[np.intp]) -> bool:
    """Whether a signal jumps to its highest value, which it has from `first` to before `end`."""
    if np.unique(values).size < _VALUES:
        return True
    first, end = first[first > 1], end[end < values.size - 1]
    step = np.abs(np.diff(values))
    jump = np.concatenate([step[first - 1], step[end - 1]])
    beside = np.concatenate([step[first - 2], step[end]])
    if not jump.size:
        return False
    least = max(_JUMP * float(np.ptp(values)), _SWITCHED * float(np.median(beside)))
    return float(np.median(jump)) > least
