"""Significant harmonics of a channel, and spectral lines that the drive does not make.

Differentiation amplifies noise: harmonic 100 of a 2 Hz displacement with 0.05 mm of noise is
hundreds of newtons of false inertia. A channel that drives a model therefore keeps only the
harmonics that its own noise cannot explain.

Lines between the harmonics belong to a periodic source other than the drive, such as a pump, the
mains or a motor. At a harmonic of the drive, one run cannot distinguish a periodic force from any
other law that repeats with the drive. At a foreign frequency the force does not repeat, counts as
noise, and shows as a line in the spectrum of the residual of the average over periods. It is
therefore reported as a data warning and is no candidate effect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array
from bayesoleo.data._fourier import HarmonicBasis
from bayesoleo.data._noise import periodic_average
from bayesoleo.data._sample_quality import rounding_that_repeats, step_of
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.prediction._spectrum import FEWEST_SAMPLES, lines_of, rounding_density

#: Expected share of false harmonics among those kept. A false one of high order is no small error:
#: an inertia sees it times the order squared. One in ten thousand keeps a hundred campaigns of
#: dozens of channels free of them; what it costs is harmonics below some five standard deviations.
FALSE_DISCOVERY_RATE = 1e-4

#: Spectral bins between harmonics that are averaged for the noise at one harmonic, where the record
#: has as many.
NOISE_BINS = 48

#: A floor of the harmonics this many times above what the periods scatter by repeats.
REPEATING = 4.0

#: Probability of naming a line in any channel of a run that has none.
FALSE_ALARM = 1e-3
#: Least amplitude, in standard deviations of a single sample, that is reported.
LEAST_AMPLITUDE = 0.2
#: And in ranges of the channel: what no converter resolves is rounding of a signal without noise.
LEAST_SHARE = 2.0**-24
#: Lines on either side from whose median the level of the noise is taken, and periods over the
#: record below which a line may be drift.
_BESIDE, _FEWEST = 50, 3


def significant_harmonics(
    basis: HarmonicBasis,
    values: Array,
    *,
    rate: float = FALSE_DISCOVERY_RATE,
) -> Harmonics:
    """Select the harmonics of a channel by their false-discovery rate.

    The noise of a harmonic is the power of what does not repeat, averaged over the spectral bins
    round it; each harmonic's power over it is compared with the F-distribution, and the p-values go
    through Benjamini and Hochberg (1995). Order 0 is always kept.

    Parameters
    ----------
    basis : HarmonicBasis
        All harmonics at the channel's samples, over whole periods.
    values : ndarray, shape (N,)
        The channel, SI.
    rate : float
        False-discovery rate.

    Returns
    -------
    Harmonics
        Significant orders with coefficients and variances, SI.
    """
    coefficients = basis.coefficients(values)
    rest = values - basis.evaluate(coefficients)
    variances, bins = coefficient_variances(basis, rest)
    keep = significant_orders(coefficients, variances, bins, rate)
    return Harmonics(
        orders=basis.orders[keep].astype(np.int64),
        coefficients=coefficients[keep],
        variances=variances[keep],
        limits=_limits(coefficients, variances, _rounding(basis, values, rest)),
    )


def within_bandwidth(item: Harmonics, frequency: float, bandwidth: float | None) -> Harmonics:
    """Harmonics of a channel with a declared bandwidth, which decides alone.

    Parameters
    ----------
    item : Harmonics
    frequency : float
        Fundamental frequency, Hz.
    bandwidth : float or None
        Hz; None leaves the harmonics as they are.
    """
    return item if bandwidth is None else replace(item, limits=(bandwidth / frequency,))


def _rounding(basis: HarmonicBasis, values: Array, rest: Array) -> Array:
    """Mean power of the harmonics of those rounding errors that repeat, shape (K,)."""
    quantum = step_of(values)
    orders = basis.orders[1:].astype(float)
    if quantum == 0.0:
        return np.zeros(orders.size)
    scatter = float(np.sqrt(np.mean(rest**2)))
    repeats = 12.0 * (rounding_that_repeats(quantum, scatter) / quantum) ** 2
    # With one sampling interval as the unit of time the fundamental is the basis's step.
    return repeats * basis.step * rounding_density(orders * basis.step, values, 1.0, quantum)


def _limits(
    coefficients: NDArray[np.complex128], variances: Array, rounding: Array
) -> tuple[float, ...]:
    """Orders up to which one and two derivatives may be taken.

    What repeats is no signal where it is rounding, or a floor that stands far above what the
    periods scatter by and that the spectrum has fallen to.
    """
    power = np.maximum(0.5 * np.abs(coefficients[1:]) ** 2, 1e-300)
    if power.size < FEWEST_SAMPLES // 2:
        return ()
    lines = lines_of(np.arange(1.0, power.size + 1), power, rounding)
    if np.median(lines.floor / np.maximum(variances[1:], 1e-300)) < REPEATING:
        return ()
    return (np.inf, lines.cut(1), lines.cut(2))


def significant_orders(
    coefficients: NDArray[np.complex128], variances: Array, bins: Array, rate: float
) -> NDArray[np.bool_]:
    """Mask of the orders to keep; order 0 always is.

    Parameters
    ----------
    coefficients : ndarray of complex, shape (K + 1,)
        Amplitudes of all orders.
    variances, bins : ndarray, shape (K + 1,)
        From :func:`coefficient_variances`.
    rate : float
        False-discovery rate.
    """
    power = np.abs(coefficients[1:]) ** 2 / (2.0 * np.maximum(variances[1:], 1e-300))
    # Ratio of an exponential to a mean of ``bins`` exponentials: survival function of F(2, 2 bins).
    log_p = -bins[1:] * np.log1p(power / bins[1:])
    order = np.argsort(log_p)
    rank = np.arange(1, log_p.size + 1)
    passed = np.flatnonzero(log_p[order] <= np.log(rate * rank / max(log_p.size, 1)))
    keep = np.zeros(coefficients.size, dtype=bool)
    keep[0] = True
    if passed.size:
        keep[1 + order[: passed[-1] + 1]] = True
    return keep


def coefficient_variances(basis: HarmonicBasis, residual: Array) -> tuple[Array, Array]:
    """Noise variance of the real part of each coefficient, from the spectrum between the harmonics.

    Parameters
    ----------
    basis : HarmonicBasis
        All harmonics at the samples.
    residual : ndarray, shape (N,)
        Channel minus its average over periods.

    Returns
    -------
    variances : ndarray, shape (K + 1,)
        Square of the channel's unit; that of order 0, which is real, is half of what its neighbours
        say.
    bins : ndarray, shape (K + 1,)
        Number of spectral bins each variance is the mean of.
    """
    samples = basis.samples
    power = np.abs(fft.rfft(residual)) ** 2 / samples
    total, used = _cumulative_between(power, samples * basis.step)
    centre = basis.orders * samples * basis.step
    width = _half_width(samples * basis.step, power.size)
    low = np.clip(np.floor(centre - width), 0, power.size - 1).astype(int)
    high = np.clip(np.ceil(centre + width) + 1, 1, power.size).astype(int)
    bins = np.maximum(used[high] - used[low], 1.0)
    variances = 2.0 / samples * (total[high] - total[low]) / bins
    variances[0] *= 0.5
    return variances, bins


def _half_width(periods: float, size: int) -> float:
    """Half width in bins that holds about NOISE_BINS bins off the harmonics."""
    share = 1.0 - 1.0 / max(periods, 2.0)
    return min(0.5 * NOISE_BINS / share, 0.5 * size)


def _cumulative_between(power: Array, periods: float) -> tuple[Array, Array]:
    """Running sums of power and count over the bins half a bin or more off the harmonics."""
    orders = np.arange(power.size) / periods
    off = np.abs(orders - np.round(orders)) * periods >= 0.5
    total = np.concatenate([[0.0], np.cumsum(np.where(off, power, 0.0))])
    used = np.concatenate([[0.0], np.cumsum(off.astype(float))])
    return total, used


@dataclass(frozen=True)
class SpectralLine:
    """A line between the harmonics.

    Parameters
    ----------
    channel : str
    frequency : float
        Hz.
    amplitude : float
        SI.
    noise : float
        Standard deviation of a single sample about the average over periods, SI.
    p_value : float
        Probability of one as high anywhere in the spectrum of noise (Fisher 1929, Proc. R. Soc. A
        125, for a level that varies).
    """

    channel: str
    frequency: float
    amplitude: float
    noise: float
    p_value: float


def foreign_line(
    values: Array, time_step: float, frequency: float, channel: str = ""
) -> SpectralLine | None:
    """The highest line between the harmonics of a periodic signal.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Over two periods or more.
    time_step : float
        Sampling interval, s.
    frequency : float
        Fundamental frequency, Hz.
    channel : str, optional
        Name of the signal.

    Returns
    -------
    SpectralLine or None
        None where the record is too short for a line to stand out.
    """
    average = periodic_average(values, time_step, frequency)
    left = np.asarray(values) - average.values
    # Over whole periods the average takes the lines at harmonics, and no other ones.
    power = np.abs(np.fft.rfft(left)) ** 2
    place = np.arange(power.size) * (frequency * left.size * time_step) ** -1
    free = np.abs(place - np.round(place)) * frequency * left.size * time_step > 0.75
    free[:_FEWEST] = False
    lines = np.flatnonzero(free)
    if lines.size < 2 * _BESIDE or not power[lines].any():
        return None
    # The median of exponentially distributed powers is ln 2 times the mean.
    level = ndimage.median_filter(power[lines], 2 * _BESIDE + 1, mode="reflect") / np.log(2.0)
    ratio = power[lines] / np.maximum(level, 1e-6 * power[lines].mean())
    best = int(np.argmax(ratio))
    k = int(lines[best])
    amplitude = 2.0 * float(np.sqrt(power[k])) / left.size
    # A median scatters as a mean of half as many would: the ratio has nearly an F distribution.
    p = float(-np.expm1(lines.size * np.log1p(-distributions.f.sf(ratio[best], 2, _BESIDE))))
    return SpectralLine(
        channel, k / (left.size * time_step), amplitude, max(average.sigma, 1e-300), p
    )


def foreign_lines(record: Record) -> tuple[SpectralLine, ...]:
    """Channels of a periodic run with a line that is higher than chance makes it, and matters."""
    if not record.periodic:
        return ()
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    found = (
        foreign_line(values, step, record.frequency, name)
        for name, values in record.samples.items()
    )
    return tuple(
        line
        for line in found
        if line is not None
        and line.p_value * len(record.samples) < FALSE_ALARM
        and line.amplitude > LEAST_AMPLITUDE * line.noise
        and line.amplitude > LEAST_SHARE * np.ptp(record.samples[line.channel])
    )
