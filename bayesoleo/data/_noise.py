"""Noise of a record: averages over periods, local averages, spectrum between the harmonics.

For a periodic run the average is a least-squares fit of all harmonics of the frequency that the
samples of one period determine. Folding by linear interpolation smooths the noise and
underestimates it by a fifth where the number of samples per period is not whole.

A repeating signal has lines at the harmonics only. A record of P periods has P - 1 lines between
two harmonics, which hold noise alone. The noise *at* a harmonic is interpolated between the mean of
the lines below it and the mean of those above, even where a removed drift has left fewer of the
former: a slope of the spectrum then cancels. The power of a line of normal noise scatters as much
as its mean. Where it scatters more, as where noise is made of a few lines, the average is known
with fewer degrees of freedom.

A transient has no periods to average over. Its noise is estimated as the error of a local
polynomial prediction. The model error is smooth on the scale of the samples and noise is not, so
that local averages of the residual equal their standard error where no effect is missing and are
larger where one is.

References
----------
Pintelon and Schoukens (2012), System Identification: A Frequency Domain Approach, sections 2.5
and 3.5; Fan and Gijbels (1996), Local Polynomial Modelling and Its Applications, section 3.2, for
averages in which a slope cancels; Satterthwaite (1946), Biometrics Bulletin 2(6), 110-114, for
degrees of freedom; McCullagh and Nelder (1989), Generalized Linear Models, section 8.3, for a
dispersion that is estimated from the scatter.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from math import comb
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from bayesoleo._types import Array, Complex, ComplexArray, Float
from bayesoleo.data._fourier import HarmonicBasis, basis_of
from bayesoleo.data._sample_quality import step_of
from bayesoleo.errors import InputError

#: Highest order of differences tried; beyond it white noise would be all that is left of any
#: sensible sampling.
HIGHEST_DIFFERENCE = 8

#: A jump exceeds the usual change between samples this many times: normal noise exceeds its
#: standard deviation so far once in a thousand million samples.
JUMP = 6.0
#: It exceeds the two changes on either side this many times, a steep part of a sinusoid 8.5 times
#: at most, and takes so many intervals at most: a filter before the converter spreads it.
QUIET, LONGEST_JUMP = 10.0, 3
#: Lower quartile of the absolute value of a normal variate.
_LOWER_QUARTILE = 0.3186
#: Levels are this part of the whole range apart, and each holds this part of the samples.
LEVELS_APART, FEWEST_AT_LEVEL = 0.05, 0.01
#: Averages of a run, and samples in one at least.
MOST_AVERAGES, FEWEST_SAMPLES = 200, 4
#: Lines that are averaged lie within this many periods' worth of lines, or this part of the
#: frequency, whichever is wider: one harmonic on either side where noise may be steep.
HARMONICS, PART = 1.0, 0.25
#: The same for the mean. Slow noise is largest there and decreases on either side, so that lines of
#: a whole harmonic would give half of it; elsewhere steep noise is rather overestimated.
AT_MEAN = 0.5


def innovation_noise(values: Array, kept: NDArray[np.bool_] | None = None) -> float:
    """Standard deviation of white noise on a smooth signal (variate differences, Tintner 1940).

    Differences of order d remove a local polynomial of degree d - 1 and leave noise with variance
    ``binomial(2 d, d)`` times that of a sample. The order grows until the estimate stops falling.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times.
    kept : ndarray of bool, shape (N,), optional
        Samples that count: what bridges the others is smooth, and would hide the noise. Where too
        few stand in a row, all count.

    Returns
    -------
    float
        In the signal's unit.
    """
    found = _from_differences(values, kept, None)
    if found is None:
        found = _from_differences(values, None, None)
    return np.inf if found is None else found


def noise_beside_jumps(values: Array) -> float:
    """The same of a signal with jumps: differences across these do not count, see :func:`jumps`.

    The search for missing effects does without: where a prediction jumps too, an error of when it
    does would stand beside a noise that knows of no jump.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times.

    Returns
    -------
    float
        In the signal's unit.
    """
    found = _from_differences(values, None, jumps(values))
    return innovation_noise(values) if found is None else found


def _from_differences(
    values: Array, kept: NDArray[np.bool_] | None, jumped: NDArray[np.bool_] | None
) -> float | None:
    """Noise by the differences that hold no jump and only samples that count; None if too few."""
    whole = np.ones(values.size, dtype=bool) if kept is None else kept
    across = np.zeros(values.size - 1, dtype=bool) if jumped is None else jumped
    some = kept is not None or bool(across.any())
    difference, estimate, latest = np.diff(values, 2), np.inf, np.inf
    joined = whole[1:] & whole[:-1] & ~across
    valid = joined[1:] & joined[:-1]
    for order in range(2, HIGHEST_DIFFERENCE + 1):
        used = difference[valid] if some else difference
        if some and used.size < 8:
            break
        latest = float(np.sqrt(np.mean(used**2) / comb(2 * order, order)))
        # Two per cent is within the scatter of the estimate for a few thousand samples.
        if used.size < 8 or latest > 0.98 * estimate:
            break
        estimate = latest
        difference, valid = np.diff(difference), valid[1:] & valid[:-1]
    found = min(estimate, latest)
    return found if np.isfinite(found) or not some else None


def jumps(values: Array) -> NDArray[np.bool_]:
    """Intervals between samples across which a signal jumps to another level, shape (N - 1,).

    A jump takes up to :data:`LONGEST_JUMP` intervals in one direction, and the signal is quiet
    right before and after it. So neither an outlier is one, which returns at once, nor a pulse, nor
    a burst of noise, nor the fast part of a sweep: they have large changes side by side. Where most
    large changes stand alone like that, the others are jumps in quick succession. Steps of a
    converter's digits are none. A jump of the slope counts too, at the interval after it: what
    follows an input that is switched has one.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times.
    """
    digit = step_of(values)
    found = _jumps(values, digit)
    found[1:] |= _jumps(np.diff(values), digit)
    return found


def _jumps(values: Array, digit: float) -> NDArray[np.bool_]:
    """Intervals of jumps that exceed so many digits of a converter."""
    size = np.abs(np.diff(values))
    none = np.zeros(size.size, dtype=bool)
    if size.size < 2 * HIGHEST_DIFFERENCE:
        return none
    usual = _usual(size)
    if not size.max() * LONGEST_JUMP > JUMP * usual:  # nor where they are not finite
        return none
    least = JUMP * max(usual, digit)
    # Noise that neighbours of a jump may show: of the fourth differences, which see no slope.
    slack = 3.0 * _usual(np.abs(np.diff(values, 4))) * np.sqrt(2.0 / comb(8, 4))
    alone = np.logical_or.reduce(
        [_alone(values, size, width, least, slack) for width in range(1, LONGEST_JUMP + 1)]
    )
    tall = size[alone & (size > least)]
    if tall.size:
        # What moves fast after a jump, such as a current that decays, is no jump.
        least = max(least, 0.5 * float(np.quantile(tall, 0.25)))
    large = alone | (size > least)
    return large if np.count_nonzero(alone) >= 0.5 * np.count_nonzero(large) else none


def _usual(size: Array) -> float:
    """Standard deviation of normal numbers of these sizes, the larger ones whatever they are."""
    return float(np.quantile(size, 0.25)) / _LOWER_QUARTILE


def _alone(values: Array, size: Array, width: int, least: float, slack: float) -> NDArray[np.bool_]:
    """Intervals of jumps that take so many intervals and have quiet ones on both sides."""
    whole = np.abs(values[width:] - values[:-width])
    # All changes within go one way where their sizes add up to the whole.
    steady = np.convolve(size, np.ones(width), mode="valid") <= whole * (1.0 + 1e-9)
    # Before the first and after the last sample nothing is known: no jump is found there.
    padded = np.concatenate([[np.inf, np.inf], size, [np.inf, np.inf]])
    sides = [padded[k : k + whole.size] for k in (0, 1, width + 2, width + 3)]
    quiet = np.max(sides, axis=0) < np.maximum(whole / QUIET, slack)
    jump = (steady & quiet & (whole > width * least)).astype(float)
    return np.asarray(np.convolve(jump, np.ones(width)) > 0.5)


def scatter_about_levels(values: Array) -> float:
    """Standard deviation about few levels that a signal has; infinite where there are none.

    It bounds the noise of a signal that is switched, even one that is switched at every sample.
    Levels without any scatter may be those of a coarse converter, and say nothing.

    Parameters
    ----------
    values : ndarray, shape (N,)
    """
    ordered = np.sort(values)
    gaps, span = np.diff(ordered), float(ordered[-1] - ordered[0])
    apart = gaps > LEVELS_APART * span
    level = np.concatenate([[0], np.cumsum(apart)])
    counts = np.bincount(level)
    if counts.size < 2 or counts.min() < max(8, FEWEST_AT_LEVEL * values.size):
        return np.inf
    mean = np.bincount(level, ordered) / counts
    free = values.size - counts.size
    scatter = float(np.sqrt(np.sum((ordered - mean[level]) ** 2) / free))
    known = 1e-6 * span < scatter < gaps[apart].min() / JUMP
    return scatter if known else np.inf


@dataclass(frozen=True)
class PeriodicAverage:
    """The repeating part of a signal, and what is left.

    Parameters
    ----------
    values : ndarray, shape (N,)
        The average over periods at each sample, in the signal's unit.
    coefficients : ndarray of complex, shape (K + 1,)
        Of ``Re sum_k c_k exp(2 pi i k f (t - t_0))``, all orders 0..K.
    samples, number : int
        Number N of samples and M = 2K + 1 of real coefficients.
    repeating : float
        Root mean square of ``values``.
    sigma : float
        Standard deviation of a single sample about the average, ``sqrt(RSS / (N - M))``.
    noise : float
        Standard error of the average, root mean square over the period: ``sigma * sqrt(M / N)``.
    """

    values: Float[Array, " samples"]
    coefficients: Complex[ComplexArray, " harmonics"]
    samples: int
    number: int
    repeating: float
    sigma: float
    noise: float

    @property
    def ratio(self) -> float:
        """``repeating / noise``: about one where only noise repeats."""
        return self.repeating / self.noise

    def on_phase(self, points: int) -> Array:
        """The average at phases ``0, 1/points, ...`` of one period, counted from the first sample.

        Parameters
        ----------
        points : int
            Number of phases.

        Returns
        -------
        ndarray, shape (points,)
            In the signal's unit.
        """
        orders = np.arange(self.coefficients.size)
        folded = np.zeros(points, dtype=complex)
        # Orders that differ by ``points`` agree on the grid, so they add up in one bin.
        np.add.at(folded, orders % points, self.coefficients)
        return (np.fft.ifft(folded) * points).real


def periodic_average(values: Array, time_step: float, frequency: float) -> PeriodicAverage:
    """Average a signal over its periods by least squares on all harmonics 0..K.

    ``K = (floor(samples per period) - 1) // 2``; samples per period need not be whole.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times over two periods or more.
    time_step : float
        Sampling interval, s.
    frequency : float
        Fundamental frequency, Hz.

    Returns
    -------
    PeriodicAverage
        The average, its standard error and the noise of a single sample.

    Raises
    ------
    InputError
        If the signal is shorter than it takes to tell repeating from not repeating.
    """
    signal = np.asarray(values, dtype=float)
    check_length(signal.size, time_step * frequency)
    return average_on(basis_of(signal.size, time_step * frequency), signal)


def average_on(basis: HarmonicBasis, values: Array) -> PeriodicAverage:
    """Like :func:`periodic_average`, with a basis made before; it serves all channels of a run.

    Parameters
    ----------
    basis : HarmonicBasis
        All harmonics at the samples.
    values : ndarray, shape (N,)
        Signal.
    """
    coefficients = basis.coefficients(values)
    fitted = basis.evaluate(coefficients)
    free = basis.samples - basis.size
    sigma = float(np.sqrt(np.sum((values - fitted) ** 2) / free))
    return PeriodicAverage(
        values=fitted,
        coefficients=coefficients,
        samples=basis.samples,
        number=basis.size,
        repeating=float(np.sqrt(np.mean(fitted**2))),
        sigma=sigma,
        noise=sigma * float(np.sqrt(basis.size / basis.samples)),
    )


def check_length(samples: int, step: float) -> None:
    """Raise unless the samples hold two periods of four samples or more.

    Parameters
    ----------
    samples : int
        Number of samples.
    step : float
        Cycles per sample.

    Raises
    ------
    InputError
        With the number of periods found.
    """
    if not 0 < step <= 0.25:
        raise InputError(
            "a period needs four samples or more", value=step, hint="give the frequency in Hz"
        )
    # One sample short of two periods is what a record from 0 to 2 T without its end point holds.
    if (samples + 1) * step < 2:
        raise InputError(
            "fewer than two periods", value=round(samples * step, 3), hint="record two or more"
        )


@dataclass(frozen=True)
class LocalAverage:
    """Averages over blocks of neighbouring samples, in the terms of a periodic average.

    Parameters
    ----------
    values : ndarray, shape (N,)
        The average of each sample's block, in the signal's unit.
    samples, number : int
        Number N of samples that count and M of blocks.
    repeating : float
        Root mean square of ``values``.
    sigma : float
        Standard deviation of a single sample's noise, from differences of neighbours.
    noise : float
        Standard error of a block's average, root mean square over the samples.
    differences : int
        Number of differences of neighbours that count, by which ``sigma`` is known.
    """

    values: Array
    samples: int
    number: int
    repeating: float
    sigma: float
    noise: float
    differences: int

    @property
    def ratio(self) -> float:
        """``repeating / noise``: about one where only noise remains."""
        return self.repeating / self.noise

    @property
    def free(self) -> float:
        """Degrees of freedom of ``sigma`` squared: neighbouring differences share samples.

        Those of order d are correlated so that their mean square varies as that of
        ``1 / (binomial(4 d, 2 d) / binomial(2 d, d)**2)`` as many independent ones.
        """
        order = HIGHEST_DIFFERENCE
        shared = comb(4 * order, 2 * order) / comb(2 * order, order) ** 2
        return max(self.differences / shared, 1.0)

    def on_phase(self, points: int) -> Array:
        """A transient has no phase: not a number, shape (points,)."""
        return np.full(points, np.nan)


def local_average(
    values: Array, sigma: float | None = None, kept: NDArray[np.bool_] | None = None
) -> LocalAverage:
    """Average a signal over neighbouring samples.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times.
    sigma : float, optional
        Standard deviation of a sample's noise, where it is known; by default from differences of
        neighbours.
    kept : ndarray of bool, shape (N,), optional
        Samples that are averaged.
    """
    signal = np.asarray(values, dtype=float)
    if sigma is None:
        sigma = innovation_noise(signal, kept)
    block, means = _blocks(signal.size), local_means(signal, kept)
    counts = np.bincount(block, kept)
    part = np.where(counts > 0, 1.0 / np.maximum(counts, 1.0), 0.0)
    number = int(block[-1]) + 1
    return LocalAverage(
        values=means,
        samples=signal.size if kept is None else int(kept.sum()),
        number=number,
        repeating=float(np.sqrt(np.mean(means**2))),
        sigma=sigma,
        noise=sigma * float(np.sqrt(np.mean(part[block]))),
        differences=signal.size if kept is None else _in_a_row(kept),
    )


def _in_a_row(kept: NDArray[np.bool_]) -> int:
    """Number of differences of the highest order that hold no sample which does not count."""
    window = np.convolve(kept.astype(float), np.ones(HIGHEST_DIFFERENCE + 1), mode="valid")
    return max(1, int(np.sum(window > HIGHEST_DIFFERENCE + 0.5)))


def local_means(values: Array, kept: NDArray[np.bool_] | None = None) -> Array:
    """Mean over each sample's block of neighbours.

    Parameters
    ----------
    values : ndarray, shape (..., N)
    kept : ndarray of bool, shape (N,), optional
        Samples that are averaged; a block without any has the mean zero.

    Returns
    -------
    ndarray, shape (..., N)
    """
    block = _blocks(values.shape[-1])
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    counted = values if kept is None else np.where(kept, values, 0.0)
    sums = np.add.reduceat(counted, starts, axis=-1)
    means: Array = (sums / np.maximum(np.bincount(block, kept), 1.0))[..., block]
    return means


def _blocks(samples: int) -> NDArray[np.int64]:
    """Number of the block that each sample lies in, shape (N,)."""
    size = max(FEWEST_SAMPLES, samples // MOST_AVERAGES)
    number = max(samples // size, 1)
    return np.minimum(np.arange(samples) // size, number - 1)


@dataclass(frozen=True)
class NoiseSpectrum:
    """Noise by spectral line of a run.

    Parameters
    ----------
    level : ndarray, shape (N // 2 + 1,)
        Variance of a single sample that white noise of this line's strength would have, by line.
    lines : int
        Lines from one harmonic to the next: the number of periods.
    samples : int
        Number N of samples.
    emptied : ndarray of bool, shape (N // 2 + 1,), optional
        Lines that say nothing of the noise, because something was removed there.
    dispersion : ndarray, shape (N // 2 + 1,), optional
        Variance of the powers of the lines next to each line over that in normal noise; by default
        one.
    """

    level: Array
    lines: int
    samples: int
    emptied: NDArray[np.bool_] | None = None
    dispersion: Array | None = None

    def __getstate__(self) -> dict[str, Any]:
        # What follows from these takes less time to make than to send, and is many times as large.
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @cached_property
    def weights(self) -> Array:
        """Real coefficients that each line stands for: two, and one at the ends."""
        found = np.full(self.level.size, 2.0)
        found[0] = 1.0
        if self.samples % 2 == 0:
            found[-1] = 1.0
        return found

    @property
    def noise(self) -> float:
        """Standard error of the average over periods, root mean square over the period."""
        return float(np.sqrt(self._at_harmonics().sum() / self.samples))

    @property
    def coefficients(self) -> float:
        """Number of equally noisy coefficients that the average's noise scatters like."""
        power = self._at_harmonics()
        weights = np.where(power > 0, self.weights, 1.0)
        return float(power.sum() ** 2 / np.sum(power**2 / weights))

    @property
    def free(self) -> float:
        """Degrees of freedom of :attr:`noise` squared, as of normal noise.

        The scatter of a few loud lines, such as those of the mains, tells of the noise at them:
        with it any excess elsewhere would be within chance.
        """
        return self._freedom(np.where(self._harmonic(), self.weights, 0.0), 1.0)

    def _harmonic(self) -> NDArray[np.bool_]:
        return np.asarray(np.arange(self.level.size) % self.lines == 0)

    def _at_harmonics(self) -> Array:
        return np.where(self._harmonic(), self.weights * self.level, 0.0)

    def power(self, signal: Array) -> Array:
        """Weight of each line in the variance of ``signal @ noise``, shape (N // 2 + 1,)."""
        transform = scipy.fft.rfft(signal)
        power: Array = self.weights * np.abs(transform) ** 2 / self.samples
        return power

    def freedom(self, power: Array) -> float:
        """Degrees of freedom of ``power @ level``: few lines have said what the level is."""
        return self._freedom(power, 1.0 if self.dispersion is None else self.dispersion)

    def _freedom(self, power: Array, scattered: Array | float) -> float:
        measured = self._neighbours.received(power) * self.level
        scatter = float(np.sum(2.0 * scattered * measured**2 / self.weights))
        return 2.0 * float(measured.sum()) ** 2 / scatter if scatter > 0 else 0.0

    @cached_property
    def _neighbours(self) -> _Neighbours:
        return _Neighbours(self.level.size, self.lines, self.emptied)


def noise_spectrum(
    rest: Array, periods: int, emptied: NDArray[np.bool_] | None = None
) -> NoiseSpectrum:
    """Spectrum of noise.

    Parameters
    ----------
    rest : ndarray, shape (N,)
        What of a signal does not repeat, over whole periods.
    periods : int
        Their number, at least two.
    emptied : ndarray of bool, shape (N // 2 + 1,), optional
        Lines that something was removed at; the noise there is that of the nearest lines.
    """
    size = rest.size
    power = np.abs(scipy.fft.rfft(rest)) ** 2 / size
    beside = _Neighbours(power.size, periods, emptied)
    level = beside.mean(power)
    return NoiseSpectrum(level, periods, size, emptied, beside.dispersion(power, level))


class _Neighbours:
    """Lines that say what the noise at each line is.

    The level is interpolated linearly between the mean of those below a line and the mean of those
    above it, so that a slope of the spectrum cancels, however many are left on either side. Where
    one side has none, the other one stands alone. Below the fundamental, where zero cuts one side
    short, all lines count alike.

    Parameters
    ----------
    size : int
        Number of lines.
    periods : int
        Lines from one harmonic to the next.
    emptied : ndarray of bool, shape (size,), or None
        Lines that say nothing of the noise.
    """

    def __init__(self, size: int, periods: int, emptied: NDArray[np.bool_] | None) -> None:
        line = np.arange(size)
        used = line % periods != 0
        used = used if emptied is None else used & ~emptied
        self.used = used.astype(float)
        low, middle, high = _windows(size, periods, emptied)
        #: Lines from and to before which they are, below and above.
        self.sides = ((low, middle), (middle, high))
        self.counts = [_between(self.used, *side) for side in self.sides]
        places = [
            _between(line * self.used, *side) / np.maximum(count, 1.0)
            for side, count in zip(self.sides, self.counts, strict=True)
        ]
        cut = high - middle > middle - low + 1
        self.parts = _interpolating(middle, cut, *places, *self.counts)
        #: All of them, and those beyond the means of the sides.
        self.number = np.sum(self.counts, axis=0)
        self.free = self.number - np.sum([count > 0 for count in self.counts], axis=0)

    def mean(self, values: Array) -> Array:
        """Mean over the neighbours of each line, by which the level is interpolated."""
        sums = [
            part * _between(values * self.used, *side)
            for part, side in zip(self.parts, self.sides, strict=True)
        ]
        return np.asarray(np.sum(sums, axis=0))

    def received(self, values: Array) -> Array:
        """What each line receives if every line's value is taken from its neighbours."""
        change = np.zeros(values.size + 1)
        for part, (low, high) in zip(self.parts, self.sides, strict=True):
            change += np.bincount(low, values * part, change.size)
            change -= np.bincount(high, values * part, change.size)
        return np.asarray(self.used * np.cumsum(change)[:-1])

    def dispersion(self, power: Array, level: Array) -> Array:
        """Variance of the neighbours' powers about the mean of their side, over the squared level.

        It is one in normal noise, whose powers are exponentially distributed; less is chance.
        """
        variance = self.mean(power**2)
        for part, count, side in zip(self.parts, self.counts, self.sides, strict=True):
            variance -= part * _between(power * self.used, *side) ** 2 / np.maximum(count, 1.0)
        variance *= self.number / np.maximum(self.free, 1.0)
        known = (self.free > 0) & (level > 0)
        ratio = np.divide(variance, level**2, out=np.ones_like(level), where=known)
        return np.maximum(ratio, 1.0)


def _interpolating(
    middle: NDArray[np.int64],
    cut: NDArray[np.bool_],
    below: Array,
    above: Array,
    fewer: Array,
    more: Array,
) -> tuple[Array, Array]:
    """Part of each line's power in the level of the middle, by side.

    Parameters
    ----------
    middle : ndarray of int, shape (K,)
    cut : ndarray of bool, shape (K,)
        Where all lines count alike.
    below, above : ndarray, shape (K,)
        Mean places of the lines on either side.
    fewer, more : ndarray, shape (K,)
        Their numbers.
    """
    both = (fewer > 0) & (more > 0) & ~cut
    share = more / np.maximum(fewer + more, 1.0)
    share[both] = ((middle - below) / np.where(both, above - below, 1.0))[both]
    return (1.0 - share) / np.maximum(fewer, 1.0), share / np.maximum(more, 1.0)


def _windows(
    size: int, periods: int, emptied: NDArray[np.bool_] | None
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """First line of each line's neighbourhood, its middle, and the first beyond it.

    Where a neighbourhood has emptied lines only, it is that of the next line that has another.
    """
    line = np.arange(size)
    half = np.maximum(HARMONICS * periods, PART * line).astype(np.int64)
    # As many lines above as below up to half the sampling rate: nothing is extrapolated there.
    half = np.minimum(half, np.maximum(periods, size - 1 - line))
    half[:1] = max(1, int(AT_MEAN * periods))
    high = np.minimum(line + half + 1, size)
    low = np.maximum(line - half, 0)
    if emptied is None:
        return low, line, high
    used = (line % periods != 0) & ~emptied
    known = np.flatnonzero(_between(used.astype(float), low, high) > 0)
    if not known.size:
        return low, line, high
    # Lines are emptied from the slowest on, so that the next faster one is the nearest.
    nearest = known[np.clip(np.searchsorted(known, line), 0, known.size - 1)]
    return low[nearest], nearest, high[nearest]


def _between(values: Array, low: NDArray[np.int64], high: NDArray[np.int64]) -> Array:
    """Sums of values from ``low`` to before ``high``."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    sums: Array = total[high] - total[low]
    return sums
