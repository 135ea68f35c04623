r"""Quality of samples: outliers, gaps, unsettled periods, converter resolution and saturation.

An outlier is a single sample far beyond all others. A masked stretch is one in which a sensor
dropped out or the rig was touched; its samples take no part in estimates. Where a periodic channel
drives a model, or its noise is estimated, they are interpolated from the other periods. Leading
periods that have not settled are left out.

A converter rounds samples to a grid and clips them at its ends. Rounding to steps :math:`\Delta`
adds an error of variance :math:`\Delta^2/12`. Where the noise exceeds a step, the rounding error is
white and is contained in the noise measured from the samples. Where a channel has less noise and
its samples fall on the same phases in every period, the rounding error repeats and looks like a
missing effect; it is added to the noise of the average. Its variance is then (Widrow and Kollar
2008, Quantization Noise)

.. math:: \sum_k \frac{\Delta^2}{2 \pi^2 k^2} e^{-4 \pi^2 k^2 \sigma^2 / \Delta^2}.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array
from bayesoleo.data._fourier import HarmonicBasis, lagged_products
from bayesoleo.errors import CampaignError
from bayesoleo.prediction._records import Record

#: Beyond the next sample by this factor a few samples are taken for mistakes: it is the resolution
#: of a converter of twenty bits, and between the samples of a pulse there is no such step.
BEYOND = 1e6
#: Beyond this, in any unit, squares overflow before they are summed.
LARGEST = 1e100
#: Part of the samples that may stand alone.
FEW = 0.005

Stretches = tuple[tuple[float, float], ...]
#: Smallest part of a record that must remain.
LEAST_PART = 0.5
# Each iteration reduces the error of the bridged samples by the number of periods, two at least.
_ITERATIONS = 40
#: Chance of dropping the first period of a settled channel whose noise is stationary.
FALSE_ALARM = 1e-4
#: Least excess of a first period's mean square over the noise's. Less than this, 0.7 standard
#: deviations of the noise, costs less than the period is worth.
LEAST_EXCESS = 0.5
#: A step is reported if it is larger than this times the noise of a sample: below, rounding adds at
#: most a sixth of that noise's variance.
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
#: Phases at which the rate of a signal is evaluated.
_PHASES = 512


def impossible_sample(values: Array) -> tuple[int | None, str]:
    """The first sample that stands far beyond all but a few.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Finite.

    Returns
    -------
    row : int or None
        Where it stands; None where there is none.
    beyond : str
        How far beyond the others, in words.
    """
    if float(np.abs(values).max()) > LARGEST:
        return int(np.argmax(np.abs(values))), "more than 1e100 times"
    away = np.abs(values - np.median(values))
    most = min(max(1, int(FEW * values.size)), values.size - 1)
    largest = np.sort(np.partition(away, values.size - most - 1)[values.size - most - 1 :])[::-1]
    # Where all others are alike a pulse may be one.
    steps = largest[:-1] / np.where(largest[1:] > 0, largest[1:], np.inf)
    alone = np.flatnonzero(steps > BEYOND)
    if not alone.size:
        return None, ""
    last = alone[-1]
    return int(np.flatnonzero(away >= largest[last])[0]), f"{steps[last]:.2g} times"


def read_stretches(value: Any, run: str, file: str) -> Stretches:
    """The key ``mask`` of a run: pairs of seconds on the file's own clock.

    Raises
    ------
    CampaignError
        If it is anything else.
    """

    def good(pair: Any) -> bool:
        return (
            isinstance(pair, list)
            and len(pair) == 2
            and all(isinstance(end, int | float) and not isinstance(end, bool) for end in pair)
            and pair[0] < pair[1]
        )

    if not isinstance(value, list) or not all(good(pair) for pair in value):
        raise CampaignError(
            "must be pairs of seconds, from and to",
            file=file,
            run=run,
            key="mask",
            value=value,
            hint="write mask = [[1.0, 1.5], [7.2, 7.3]]",
        )
    return tuple((float(first), float(last)) for first, last in value)


def masked(time: Array, stretches: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Samples within the stretches, both ends included, shape (N,).

    Parameters
    ----------
    time : ndarray, shape (N,)
        Equidistant times, s.
    stretches : sequence of (float, float)
        From and to, s, on the same clock.

    Raises
    ------
    CampaignError
        If a stretch holds no sample, or too few samples are left.
    """
    inside, slack = np.zeros(time.size, dtype=bool), 1e-3 * (time[1] - time[0])
    for first, last in stretches:
        here = (time >= first - slack) & (time <= last + slack)
        if not here.any():
            raise CampaignError(
                "no sample lies in this stretch",
                key="mask",
                value=[first, last],
                hint=f"the run is from {time[0]:.6g} to {time[-1]:.6g} s",
            )
        inside |= here
    if np.mean(inside) > 1 - LEAST_PART:
        raise CampaignError(
            f"{100 * np.mean(inside):.3g} % of the run is masked",
            key="mask",
            hint="mask less than half of it, or cut the run with start and stop",
        )
    return inside


def bridged(values: Array, inside: NDArray[np.bool_], step: float | None = None) -> Array:
    """Channels with other values where they are masked.

    Parameters
    ----------
    values : ndarray, shape (c, N)
    inside : ndarray of bool, shape (N,)
        Which samples are masked.
    step : float, optional
        Cycles per sample: the values are then those of least squares on all harmonics of the other
        samples, as far as another period shows them. Without, a straight line.

    Returns
    -------
    ndarray, shape (c, N)
    """
    filled, place = np.array(values, dtype=float), np.arange(inside.size)
    for channel in filled:
        channel[inside] = np.interp(place[inside], place[~inside], channel[~inside])
    if step is None:
        return filled
    basis = HarmonicBasis(inside.size, step)
    for _ in range(_ITERATIONS):
        filled[:, inside] = basis.fit(filled)[:, inside]
    return filled


def whole_periods(samples: int, step: float) -> int:
    """Number of whole periods in a record.

    Parameters
    ----------
    samples : int
        Number of samples.
    step : float
        Cycles per sample.
    """
    # A record from 0 to P T without its end point may miss the P-th period by a rounding of the
    # frequency.
    return int(np.floor(samples * step + 1e-3))


def sample_count(periods: int, step: float) -> int:
    """Number of samples with ``0 <= phase < periods``, to a hundredth of a sample.

    Parameters
    ----------
    periods : int
        Whole periods.
    step : float
        Cycles per sample.
    """
    return int(np.floor(periods / step + 0.01))


def settled_start(values: Array, step: float, level: float = FALSE_ALARM) -> tuple[int, int]:
    """First sample of the settled whole periods at the end of a record.

    The first period is compared with what the later ones predict for it. While it differs by more
    than the noise and more than any later period does, it is left out; three periods are kept at
    least (two where there are three).

    Parameters
    ----------
    values : ndarray, shape (C, N)
        Channels.
    step : float
        Cycles per sample.
    level : float
        Chance of a false alarm in a settled record, over all channels.

    Returns
    -------
    first : int
        Index of the first sample to keep.
    dropped : int
        Whole periods left out before it; a leading fraction of a period is not counted.
    """
    samples = values.shape[1]
    periods = whole_periods(samples, step)
    least = 3 if periods > 3 else 2
    dropped = 0
    while periods - dropped > least:
        first = samples - sample_count(periods - dropped, step)
        later = samples - sample_count(periods - dropped - 1, step)
        if not _differs(values[:, first:], later - first, step, level / values.shape[0]):
            break
        dropped += 1
    return max(0, samples - sample_count(periods - dropped, step)), dropped


def _differs(values: Array, length: int, step: float, level: float) -> bool:
    """Whether the first ``length`` samples depart from the average of the others in any channel."""
    later = values[:, length:]
    basis = HarmonicBasis(later.shape[1], step)
    coefficients = basis.coefficients(later)
    residual = later - basis.evaluate(coefficients)
    before = coefficients * np.exp(-2j * np.pi * basis.orders * length * step)
    predicted = HarmonicBasis(length, step, basis.highest).evaluate(before)
    share = basis.size / basis.samples
    first = np.mean((values[:, :length] - predicted) ** 2, axis=1) / (1.0 + share)
    return any(
        _exceeds(power, rest / np.sqrt(1.0 - share), length, share, level)
        for power, rest in zip(first, residual, strict=True)
    )


def _exceeds(power: float, rest: Array, length: int, share: float, level: float) -> bool:
    """One-sided F-test, degrees of freedom cut by correlated noise; no later period as bad."""
    usual = float(np.mean(rest**2))
    together = _samples_per_degree(rest)
    free = rest.size * (1.0 - share)
    bound = distributions.f.isf(level, max(length / together, 1.0), max(free / together, 1.0))
    others = rest[: rest.size // length * length].reshape(-1, length)
    worst = float(np.max(np.mean(others**2, axis=1)))
    return power > max(bound, 1.0 + LEAST_EXCESS) * usual and power > worst


def _samples_per_degree(rest: Array) -> float:
    """Samples per degree of freedom of a mean square: ``1 + 2 sum rho**2``."""
    covariance = lagged_products(rest[None])[: rest.size // 10]
    correlation = covariance[1:] / max(float(covariance[0]), 1e-300)
    # Chance correlations of white noise have variance 1/N; without them white noise keeps all its
    # samples.
    return 1.0 + 2.0 * float(np.sum(np.maximum(correlation**2 - 4.0 / rest.size, 0.0)))


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


def emptied_lines(record: Record, channel: str) -> NDArray[np.bool_] | None:
    """Lines of a channel's spectrum that hold no noise since a disturbance was removed.

    Parameters
    ----------
    record : Record
    channel : str

    Returns
    -------
    ndarray of bool, shape (N // 2 + 1,), or None
        None where there are none.
    """
    what = record.disturbances.get(channel)
    if what is None or not (what.terms or what.tones):
        return None
    span = record.periods / record.frequency
    line = np.arange(record.time.size // 2 + 1)
    # A cosine of k half cycles lies at the line k / 2. The last one takes two thirds of that line,
    # and next to nothing of the line after it.
    found = line <= 0.5 * what.terms
    for tone in what.tones:
        found = found | (np.abs(line - tone.frequency * span) < 0.75)
    return np.asarray(found)
