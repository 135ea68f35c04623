"""Fundamental frequency of a periodic run, by the residual time shift function.

The estimate has two steps. The residual time shift function (Verbeek 1993, eq. B.2), refined around
the nominal frequency, finds the period to a fraction of a sample. Gauss-Newton on all harmonics,
jointly over the channels, then refines it to a fraction of its standard error: a wrong frequency
shifts the late periods against the early ones, which would look like noise.

The intermediate numbers are kept so that a figure can show them.

References
----------
Verbeek (1993), appendix B: eqs. B.1 and B.2, figures B.1 and B.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from bayesoleo._types import Array
from bayesoleo.data._fourier import HarmonicBasis, highest_order, lagged_products
from bayesoleo.data._harmonics import (
    FALSE_DISCOVERY_RATE,
    coefficient_variances,
    significant_orders,
)
from bayesoleo.errors import CampaignError

#: Least correlation between a record and itself one period later, in the channel that repeats best.
LEAST_CORRELATION = 0.5

#: Highest orders that take part in finding the frequency, step by step: the valley that a harmonic
#: of order k sees is k times narrower.
LADDER = (3, 12, 48, np.inf)

#: Part of a period to either side of it that the zoom shows, and shifts at most in a curve.
ZOOM, MOST_SHIFTS = 0.01, 4000
_FEWEST = 5


@dataclass(frozen=True)
class Frequency:
    """A fundamental frequency.

    Parameters
    ----------
    value, sd : float
        Hz. The standard deviation holds for the noise found in the record, coloured or not.
    iterations : int
        Gauss-Newton steps taken.
    """

    value: float
    sd: float
    iterations: int


def residual_time_shift(values: Array, shifts: NDArray[np.int64]) -> Array:
    """Residual time shift function (Verbeek 1993, eq. B.2): ``mean (y_mu - y_(mu+eta))**2``.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times.
    shifts : ndarray of int, shape (L,)
        Shifts eta in samples, ``0 < eta < N``.

    Returns
    -------
    ndarray, shape (L,)
        In the square of the signal's unit; small where the shift is a period.
    """
    return np.array([np.mean((values[:-shift] - values[shift:]) ** 2) for shift in shifts])


def autocovariance(values: Array, shifts: NDArray[np.int64]) -> Array:
    """Autocovariance ``mean (y_mu - m)(y_(mu+eta) - m)`` (Verbeek 1993, eq. B.1).

    Each shift is averaged over its own overlap.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times.
    shifts : ndarray of int, shape (L,)
        Shifts eta in samples, ``0 <= eta < N``.

    Returns
    -------
    ndarray, shape (L,)
        In the square of the signal's unit; large where the shift is a period.
    """
    centred = values - np.mean(values)
    return lagged_products(centred[None])[shifts] / (values.size - shifts)


def find_frequency(values: Array, time_step: float, nominal: float) -> Frequency:
    """Fundamental frequency of a periodic record, near a nominal one.

    Parameters
    ----------
    values : ndarray, shape (C, N)
        Channels at equidistant times, in any units.
    time_step : float
        Sampling interval, s.
    nominal : float
        Declared frequency, Hz.

    Returns
    -------
    Frequency
        Refined frequency and its standard deviation, Hz.

    Raises
    ------
    CampaignError
        If the record does not repeat within reach of the nominal frequency: one resolution cell ``1
        / duration``, at least 2 % and at most 20 %.

    Notes
    -----
    Eq. B.2 of Verbeek (1993), then least squares on harmonics.
    """
    values = np.atleast_2d(np.asarray(values, dtype=float))
    samples = coarse_period(values, 1.0 / (time_step * nominal), time_step)
    step, sd, iterations = _gauss_newton(values, 1.0 / samples)
    return Frequency(step / time_step, sd / time_step, iterations)


def coarse_period(values: Array, nominal: float, time_step: float) -> float:
    """Period in samples from the residual time shift function (Verbeek 1993, eq. B.2).

    The minimum is that of a quadratic through the bottom of the valley.

    Parameters
    ----------
    values : ndarray, shape (C, N)
        Channels.
    nominal : float
        Period expected, samples.
    time_step : float
        Sampling interval, s; for messages only.

    Returns
    -------
    float
        Samples per period.

    Raises
    ------
    CampaignError
        If the record does not repeat within reach of the nominal period.
    """
    size = values.shape[1]
    spread = np.std(values, axis=1, keepdims=True)
    scaled = (values - values.mean(axis=1, keepdims=True)) / np.where(spread > 0, spread, 1.0)
    reach = nominal * np.clip(nominal / size, 0.02, 0.2)
    shifts = _range(nominal, max(reach, 2.0), size)
    residual = _joint_residual(scaled, shifts)
    period = _valley(shifts, residual) if residual.size else None
    if period is None or np.min(residual) > 2.0 * (1.0 - LEAST_CORRELATION):
        raise _no_period(scaled, nominal, time_step)
    # A shift of m periods shows the period m times finer; doubling m keeps each step within the
    # last one's error.
    multiple = 2
    while (multiple + 1) * period <= size:
        shifts = _range(multiple * period, max(3.0, 0.01 * period), size)
        bottom = _valley(shifts, _joint_residual(scaled, shifts))
        if bottom is None:
            break
        period, multiple = bottom / multiple, 2 * multiple
    return period


def _range(centre: float, reach: float, size: int) -> NDArray[np.int64]:
    low, high = int(np.floor(centre - reach)), int(np.ceil(centre + reach))
    # Half a period of overlap at least, or the shift function is the noise's own.
    return np.arange(max(low, 1), min(high, size - 2) + 1)


def _joint_residual(scaled: Array, shifts: NDArray[np.int64]) -> Array:
    """Shift function of all channels, those that repeat best weighing most."""
    each = np.array([residual_time_shift(channel, shifts) for channel in scaled])
    weight = 1.0 / np.maximum(each.min(axis=1), 1e-6)
    return cast(Array, weight @ each / weight.sum())


def _valley(shifts: NDArray[np.int64], residual: Array) -> float | None:
    """Minimum of the quadratic through the bottom of the valley; None at an end of the range."""
    lowest = int(np.argmin(residual))
    if not 0 < lowest < residual.size - 1:
        return None
    # All points in the lowest tenth count: three alone would follow the noise where the valley is
    # wide.
    level = residual[lowest] + 0.1 * (residual.max() - residual[lowest])
    left = lowest - int(np.argmax(residual[lowest::-1] > level)) + 1
    right = lowest + int(np.argmax(residual[lowest:] > level))
    left = 0 if not np.any(residual[: lowest + 1] > level) else left
    right = residual.size if not np.any(residual[lowest:] > level) else right
    left, right = min(left, lowest - 1), max(right, lowest + 2)
    offset = shifts[left:right] - shifts[lowest]
    curvature, slope, _ = np.polyfit(offset, residual[left:right], 2)
    if curvature <= 0:
        return float(shifts[lowest])
    return float(shifts[lowest] + np.clip(-0.5 * slope / curvature, offset[0], offset[-1]))


def _no_period(scaled: Array, nominal: float, time_step: float) -> CampaignError:
    """Say at which frequency the record does repeat, where it does."""
    shifts = np.arange(4, scaled.shape[1] // 2)
    correlation = np.max([autocovariance(channel, shifts) for channel in scaled], axis=0)
    # The first lag after the correlation has fallen off: lags near zero always correlate.
    fallen = np.flatnonzero(correlation < 0.2)
    hint = "declare the run as kind = 'transient', or cut it with start and stop"
    if fallen.size:
        later = correlation[fallen[0] :]
        good = later >= max(0.9 * later.max(), LEAST_CORRELATION)
        if np.any(good):
            first = int(np.argmax(good))
            end = first + int(np.argmax(np.append(~good[first:], True)))
            best = fallen[0] + first + int(np.argmax(later[first:end]))
            hint = f"it repeats at about {1.0 / (shifts[best] * time_step):.4g} Hz"
    return CampaignError(
        "record does not repeat near the declared frequency",
        key="frequency",
        value=float(f"{1.0 / (nominal * time_step):.6g}"),
        hint=hint,
    )


def _gauss_newton(values: Array, step: float) -> tuple[float, float, int]:
    """Refine cycles per sample, first on low harmonics, whose valley is wide, then on all."""
    highest = HarmonicBasis(values.shape[1], step).highest
    steps = 0
    for limit in LADDER:
        # The last rung stops at a thousandth of the standard deviation, the others before it.
        tolerance = 0.3 if limit < highest else 1e-3
        state, taken = _descend(_FrequencyFit(values, step, highest, limit), values, tolerance)
        step, steps = state.step, steps + taken
        if limit >= highest:
            break
    return state.step, state.sd, steps


def _descend(state: _FrequencyFit, values: Array, tolerance: float) -> tuple[_FrequencyFit, int]:
    taken = 0
    while taken < 30 and abs(state.newton) > max(tolerance * state.sd, 1e-14 * state.step):
        change = state.newton
        for _ in range(6):
            trial = _FrequencyFit(values, state.step + change, state.highest, state.limit)
            # The step that is left has to shrink. The sum of squares is no measure of it: the
            # harmonics that are only noise take part in that, and move its minimum.
            if abs(trial.newton) < abs(state.newton):
                break
            change *= 0.5
        else:
            break
        state, taken = trial, taken + 1
    return state, taken


class _FrequencyFit:
    """Least squares on harmonics at one frequency: next step, standard deviation.

    The derivative of the signal with respect to frequency is time times its rate of change, of the
    significant harmonics only (of the others it would be noise), less what the harmonics themselves
    can absorb.
    """

    def __init__(self, values: Array, step: float, highest: int, limit: float) -> None:
        samples = values.shape[1]
        self.step, self.highest, self.limit = step, highest, limit
        # At a shorter period its samples determine fewer harmonics than where the search began.
        basis = HarmonicBasis(samples, step, min(highest, highest_order(step)))
        coefficients = basis.coefficients(values)
        residual = values - basis.evaluate(coefficients)
        rms = np.sqrt(np.mean(values**2, axis=1))
        power = np.sum(residual**2, axis=1) / (samples - basis.size)
        # Noise-free records are fitted to rounding; a floor there keeps the weights finite.
        variance = np.maximum(power, (1e-12 * rms) ** 2 + 1e-300)
        rate = _rate(basis, coefficients, residual, limit)
        time = np.arange(samples) - 0.5 * (samples - 1)
        slope = time * rate
        slope -= basis.fit(slope)
        information = np.sum(slope**2 / variance[:, None])
        if information <= 0:
            self.newton, self.sd = 0.0, np.inf
            return
        self.newton = float(np.sum(slope * residual / variance[:, None]) / information)
        # The score's variance under the noise's own spectrum: red noise moves the frequency more
        # than white.
        share = basis.size / samples
        score = np.sum(_coloured_power(slope, residual, share) / variance**2)
        self.sd = float(np.sqrt(max(score, 1e-300)) / information)


def _rate(
    basis: HarmonicBasis, coefficients: NDArray[np.complex128], residual: Array, limit: float
) -> Array:
    """Derivative per cycle of each channel's significant harmonics up to ``limit``."""
    kept = np.zeros_like(coefficients)
    for channel, (amplitudes, rest) in enumerate(zip(coefficients, residual, strict=True)):
        variances, bins = coefficient_variances(basis, rest)
        mask = significant_orders(amplitudes, variances, bins, FALSE_DISCOVERY_RATE)
        mask &= basis.orders <= limit
        kept[channel, mask] = amplitudes[mask]
    return basis.evaluate(2j * np.pi * basis.orders * kept)


def _coloured_power(slope: Array, residual: Array, share: float, bins: int = 24) -> Array:
    """Variance of ``slope @ noise`` by channel, the noise having the residual's spectrum."""
    samples = slope.shape[1]
    transfer = np.abs(fft.rfft(slope, axis=1)) ** 2
    spectrum = np.abs(fft.rfft(residual, axis=1)) ** 2 / samples
    width = min(2 * bins + 1, spectrum.shape[1])
    ones = np.ones(width)
    smooth = np.array([np.convolve(row, ones, "same") for row in spectrum])
    smooth /= np.convolve(np.ones(spectrum.shape[1]), ones, "same")
    double = np.full(spectrum.shape[1], 2.0)
    double[0] = 1.0
    if samples % 2 == 0:
        double[-1] = 1.0
    # Bins on harmonics are empty in the residual; the smoothed spectrum is lower by their share.
    return cast(Array, np.sum(double * transfer * smooth, axis=1) / samples / (1.0 - share))


@dataclass(frozen=True)
class PeriodSearch:
    """Shift functions of a signal, and the parabola through the bottom of the first valley.

    Parameters
    ----------
    shifts : ndarray, shape (L,)
        Samples, up to a little more than two periods.
    residual : ndarray, shape (L,)
        Residual time shift function at them (eq. B.2), square of the signal's unit.
    covariance : ndarray, shape (L,)
        Autocovariance at them (eq. B.1).
    near : ndarray, shape (Z,)
        Shifts next to one period.
    near_residual : ndarray, shape (Z,)
    parabola : ndarray, shape (3,)
        Coefficients in ``near - period_in_samples``, the highest power first.
    period_in_samples : float
        Minimum of the parabola.
    time_step : float
        s.
    """

    shifts: NDArray[np.int64]
    residual: Array
    covariance: Array
    near: NDArray[np.int64]
    near_residual: Array
    parabola: Array
    period_in_samples: float
    time_step: float

    @property
    def frequency(self) -> float:
        """By the parabola alone, Hz."""
        return 1 / (self.period_in_samples * self.time_step)


def period_search(values: Array, time_step: float, nominal: float) -> PeriodSearch:
    """Shift functions of one signal near a nominal frequency.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times over two periods or more.
    time_step : float
        Sampling interval, s.
    nominal : float
        Declared frequency, Hz.

    Returns
    -------
    PeriodSearch

    Raises
    ------
    CampaignError
        If the signal does not repeat near that frequency.
    """
    signal = np.asarray(values, dtype=float)
    period = coarse_period(signal[None], 1 / (nominal * time_step), time_step)
    last = min(int(2.2 * period), signal.size - 2)
    shifts = np.unique(np.linspace(1, last, min(last, MOST_SHIFTS)).astype(np.int64))
    half = max(_FEWEST, round(ZOOM * period))
    centre = round(period)
    near = np.arange(centre - half, min(centre + half, signal.size - 2) + 1)
    valley = residual_time_shift(signal, near)
    curvature, slope, level = np.polyfit(near - period, valley, 2)
    bottom = -0.5 * slope / curvature if curvature > 0 else 0.0
    return PeriodSearch(
        shifts=shifts,
        residual=residual_time_shift(signal, shifts),
        covariance=autocovariance(signal, shifts),
        near=near,
        near_residual=valley,
        parabola=np.array([curvature, 0.0, level - curvature * bottom**2]),
        period_in_samples=period + bottom,
        time_step=time_step,
    )


#: Correlation of a record with itself, a period later, that counts as periodic; how nearly the
#: best a shorter period has to be; and the ratio of sizes, of one half to the other, of a decay.
_REPEATS, _NEARLY, _DECAY = 0.8, 0.97, 1.1
#: Correlation with itself, a sample or more later, below which a channel without its drift is noise
#: alone, in large records and in standard errors of small ones.
_SILENT, _SILENT_ERRORS = 0.3, 5.0
#: Samples that a frequency is guessed from, at most and at least.
_LOOKED_AT, _LEAST = 200_000, 80


def guess_frequency(values: Array, seconds: Array) -> float | None:
    """Frequency at which all channels repeat, Hz; None for a transient.

    The shortest lag is taken at which the channels, each correlated with itself, are about as much
    alike as they are at any lag up to half the record. Channels that only drift, such as a
    temperature that is logged beside the others, tell nothing.

    Parameters
    ----------
    values : ndarray, shape (channels, N)
    seconds : ndarray, shape (N,)
        Their times, s.
    """
    count = min(values.shape[1], _LOOKED_AT)
    seconds, values = seconds[:count], np.nan_to_num(values[:, :count])
    step = float(np.nanmedian(np.diff(seconds)))
    if count < _LEAST or not step > 0:
        return None
    telling = [one for one in values if not _only_drifts(one)]
    if not telling:
        return None
    alike = np.mean([_likeness(one) for one in telling], axis=0)
    below = np.flatnonzero(alike < 0.3)
    if not below.size:
        return None
    first = int(below[0])
    best = float(alike[first:].max())
    if best < _REPEATS:
        return None
    start = first + int(np.flatnonzero(alike[first:] >= _NEARLY * best)[0])
    lower = np.flatnonzero(alike[start:] < 0.9 * best)
    end = start + int(lower[0]) if lower.size else alike.size
    lag = start + int(np.argmax(alike[start:end]))
    if lag < 4 or any(_grows_or_decays(one, lag) for one in telling):
        return None
    return float(f"{1.0 / (_summit(alike, lag) * step):.4g}")


def _only_drifts(signal: Array) -> bool:
    """Whether a channel is constant or noise but for a linear drift."""
    time = np.linspace(-1.0, 1.0, signal.size)
    rest = signal - np.polynomial.Polynomial.fit(time, signal, 1)(time)
    least = max(_SILENT, _SILENT_ERRORS / np.sqrt(signal.size / 2))
    return bool(np.abs(_likeness(rest)[1:]).max(initial=0.0) < least)


def _grows_or_decays(signal: Array, period: int) -> bool:
    """Whether whole periods at the start and at the end differ in size."""
    length = period * max(1, signal.size // period // 2)
    first, last = float(np.std(signal[:length])), float(np.std(signal[-length:]))
    return max(first, last) > _DECAY * min(first, last)


def _likeness(signal: Array) -> Array:
    """Correlation of a signal with itself later, by lag up to half of it, each part normalised."""
    x = signal - signal.mean()
    n = x.size
    spectrum = np.fft.rfft(x, 2 * n)
    products = np.fft.irfft(np.abs(spectrum) ** 2, 2 * n)[: n // 2 + 1]
    squares = np.concatenate([[0.0], np.cumsum(x**2)])
    lags = np.arange(n // 2 + 1)
    size = np.sqrt(squares[n - lags] * (squares[n] - squares[lags]))
    return np.asarray(products / np.maximum(size, 1e-300))


def _summit(values: Array, at: int) -> float:
    """Place of a maximum between samples, by a parabola."""
    if not 0 < at < values.size - 1:
        return float(at)
    a, b, c = values[at - 1 : at + 2]
    bend = a - 2 * b + c
    return at + (0.5 * (a - c) / bend if bend < 0 else 0.0)
