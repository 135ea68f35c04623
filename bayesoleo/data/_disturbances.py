"""Disturbances of a periodic record that are no physics: drift, tones, heavy tails.

A model predicts what repeats with the drive, and noise is normal, stationary and without lines.
Three disturbances break this and would pass for missing physics. They are removed from the outputs
of periodic runs before a model is compared with them.

* A drift (a random walk, a slow polynomial) leaks into the harmonics and moves the mean. Low-order
  polynomials and cosines are fitted beside *all* harmonics, so that no periodic motion loses
  anything. The mean of a channel that drifts is unknown: the model gets an offset of each run's
  own, with a prior as wide as the drift lets expect.
* A tone, a line between the harmonics, is fitted beside all harmonics with its frequency.
* Outliers are replaced by pseudo-values. With the repeating part ``f`` and the residual ``r``,
  least squares on ``f + psi(r) / mean(psi')`` is to first order the maximum-likelihood estimate
  under Student-t noise, and the pseudo-residuals have the variance of that estimate.

A transient is left as it is: nothing in it tells a drift from slow physics.

References
----------
Huber and Ronchetti (2009), Robust Statistics, section 7.10: pseudo-observations. Lange, Little and
Taylor (1989), Journal of the American Statistical Association 84(408), 881-896: the t
distribution. Anscombe and Glynn (1983), Biometrika 70(1), 227-234: kurtosis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy import optimize

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array
from bayesoleo.data._fourier import HarmonicBasis
from bayesoleo.data._harmonics import (
    coefficient_variances,
    foreign_line,
    significant_harmonics,
)
from bayesoleo.data._noise import average_on
from bayesoleo.prediction._records import Disturbances, Record, Tone

#: The words that choose what is looked for.
DRIFT, TONE, TAILS = "drift", "tone", "tails"
KINDS = (DRIFT, TONE, TAILS)
#: Probability of finding one of a kind in any output of a campaign that has none.
FALSE_ALARM = 5e-3
#: What is smaller than this part of a channel's range is an error of a simulation without noise.
LEAST_SHARE = 1e-4
#: Terms of a drift that are tested together, and those of them that are polynomials.
_TESTED, _POLYNOMIALS = 4, 3
#: Terms at most: what takes more is no drift but noise with a colour.
_MOST_TERMS = 24
#: Probability by which further terms of a drift that was found, or harmonics next to half the
#: sampling rate, must exceed the noise.
_FURTHER = 0.01
#: Lines that tell the noise beside a drift: those of so many harmonics, and so many at least.
_HARMONICS, _FEWEST_LINES = 4, 24
#: Prior standard deviation of the mean's error over the drift's root mean square. A random walk
#: from zero has 1.4 of it, a straight line 1.7; one that began before the record has more.
BASELINE = 5.0
#: Neighbours on either side that a line must exceed as well, and tones of a channel at most.
_BESIDE, _MOST_TONES = 8, 4
#: Weighting is worth it where it lowers the variance of the noise below this part.
_WORTH = 0.9
#: Degrees of freedom of the t distribution that are tried.
_DEGREES = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0)
#: A phase whose median residual is so many times the usual one has a jump, and so many samples on
#: either side of it. The other samples must be this part of all.
_UNUSUAL, _JUMP, _MOSTLY = 4.0, 2, 0.6
#: Iterations of the repeating part and its weights, and the standard errors beyond which what
#: repeats is part of it although no single harmonic is significant.
_ITERATIONS, _REPEATS = 6, 4.5


def without_disturbances(
    records: Sequence[Record], channels: Sequence[str], kinds: Sequence[str] = KINDS
) -> tuple[Record, ...]:
    """Records whose channels have lost drift, tones and outliers.

    Parameters
    ----------
    records : sequence of Record
        Reduced runs. Transients and runs with masked stretches stay as they are.
    channels : sequence of str
        Outputs of a model. Inputs stay: a model answers to all that is in them.
    kinds : sequence of {"drift", "tone", "tails"}
        What is looked for.

    Returns
    -------
    tuple of Record, the same objects where nothing was found.
    """
    level = FALSE_ALARM / max(len(channels) * len(records), 1)
    found = [_cleaned(record, channels, frozenset(), level, kinds) for record in records]
    # A sensor that drifts in one run drifts in all of them.
    drifting = frozenset(name for r in found for name, it in r.disturbances.items() if it.drift)

    def alike(record: Record, one: Record) -> Record:
        own = {name for name, item in one.disturbances.items() if item.drift}
        if drifting <= own:
            return one
        again = _cleaned(record, channels, drifting, level, kinds)
        told = {
            name: replace(item, drift_elsewhere=name in drifting - own)
            for name, item in again.disturbances.items()
        }
        return replace(again, disturbances=told) if told else again

    return tuple(alike(record, one) for record, one in zip(records, found, strict=True))


def _cleaned(
    record: Record,
    channels: Sequence[str],
    drifting: frozenset[str],
    level: float,
    kinds: Sequence[str],
) -> Record:
    """One run; channels that are known to drift are not tested for it."""
    if not record.periodic or record.kept is not None:
        return record
    found: dict[str, Disturbances] = {}
    samples, basis = dict(record.samples), _basis(record)
    for name in channels:
        values, what = clean(
            basis, samples[name], record.periods, level, kinds, known=name in drifting
        )
        if what:
            tones = tuple(
                replace(tone, frequency=tone.frequency * record.frequency / basis.step)
                for tone in what.tones
            )
            samples[name] = np.ascontiguousarray(values)
            found[name] = replace(what, tones=tones)
    return _with_samples(record, basis, samples, found) if found else record


def clean(
    basis: HarmonicBasis,
    values: Array,
    periods: int,
    level: float,
    kinds: Sequence[str] = KINDS,
    *,
    known: bool = False,
) -> tuple[Array, Disturbances]:
    """One signal without drift, tones and outliers.

    Parameters
    ----------
    basis : HarmonicBasis
        All harmonics at the samples.
    values : ndarray, shape (N,)
        Over whole periods.
    periods : int
        Their number.
    level : float
        Probability of finding one of a kind where there is none.
    kinds : sequence of {"drift", "tone", "tails"}
        What is looked for.
    known : bool
        Whether it is known to drift, from other runs.

    Returns
    -------
    ndarray, shape (N,)
        The signal itself where nothing was found.
    Disturbances
        Frequencies of tones in cycles a sample.
    """
    what, none = Disturbances(), np.zeros_like(values)

    def drift_of(rest: Array) -> tuple[Array, int]:
        if known or (DRIFT in kinds and drifts(basis, rest, periods, level)):
            return _drift(basis, rest, periods)
        return none, 0

    drift, terms = drift_of(values)
    tones = none
    smooth = _is_resolved(basis, values - drift)
    if TONE in kinds and smooth:
        # A tone below the fundamental looks like a drift: a drift is no tone, but may hide one.
        left, found = _without_tones(basis, values, periods, level)
        if terms and not found:
            left, found = _without_tones(basis, values - drift, periods, level, 1 + terms // 2)
            left = left + drift
        if found:
            tones, what = values - left, replace(what, tones=found)
            drift, terms = drift_of(values - tones) if terms else (none, 0)
    if terms:
        what = replace(what, drift=float(np.sqrt(np.mean(drift**2))), terms=terms)
    cleaned = values - drift - tones if what else values
    if TAILS in kinds and smooth:
        cleaned, degrees = _without_outliers(basis, cleaned, level)
        what = replace(what, degrees=degrees)
    return cleaned, what


def _with_samples(
    record: Record,
    basis: HarmonicBasis,
    samples: Mapping[str, Array],
    found: Mapping[str, Disturbances],
) -> Record:
    """A record with other samples, and harmonics and noise to match."""
    harmonics, noise = dict(record.harmonics), dict(record.signal_noise)
    for name in found:
        limits = record.harmonics[name].limits
        harmonics[name] = replace(significant_harmonics(basis, samples[name]), limits=limits)
        noise[name] = average_on(basis, samples[name]).sigma
    sd = {baseline_of(name): BASELINE * what.drift for name, what in found.items() if what.drift}
    return replace(
        record,
        samples=samples,
        harmonics=harmonics,
        signal_noise=noise,
        disturbances=dict(found),
        condition_sd={**record.condition_sd, **sd},
    )


def baseline_of(channel: str) -> str:
    """Name of the condition that stands for the unknown mean of a channel that drifts."""
    return f"{channel}_baseline"


def _basis(record: Record) -> HarmonicBasis:
    """All harmonics at a record's samples."""
    span = float(record.time[-1] - record.time[0])
    return HarmonicBasis(record.time.size, record.frequency * span / (record.time.size - 1))


def _is_resolved(basis: HarmonicBasis, values: Array) -> bool:
    """Whether the harmonics end below half the sampling rate.

    Faster ones, as of a jump, show at other frequencies: as lines between the harmonics, and as
    outliers next to the jump. A model predicts them, so that they are no disturbance.
    """
    coefficients = basis.coefficients(values)
    variances, _ = coefficient_variances(basis, values - basis.evaluate(coefficients))
    fast = basis.orders > 0.5 * basis.highest
    power = np.abs(coefficients[fast]) ** 2 / (2.0 * np.maximum(variances[fast], 1e-300))
    # As many lines between the harmonics have told the noise, each of a pair of coefficients.
    free = (basis.samples - basis.size) // 2
    return bool(distributions.f.sf(power.mean(), 2 * power.size, max(free, 2)) > _FURTHER)


# -- drift -----------------------------------------------------------------------------------------


def drifts(basis: HarmonicBasis, values: Array, periods: int, level: float) -> bool:
    """Whether the slowest terms exceed the noise above the fundamental.

    Parameters
    ----------
    basis, values, periods, level
        As for :func:`clean`.
    """
    terms, coefficients, noise, lines = _slow_terms(basis, values, periods)
    if not noise > 0:
        return False
    tested = min(_TESTED, coefficients.size)
    ratio = float(np.mean(coefficients[:tested] ** 2)) / noise
    change = float(np.ptp(terms @ coefficients))
    return bool(
        distributions.f.sf(ratio, tested, 2 * lines) < level
        and change > LEAST_SHARE * np.ptp(values)
    )


def _slow_terms(
    basis: HarmonicBasis, values: Array, periods: int
) -> tuple[Array, Array, float, int]:
    """Orthonormal slow terms beside all harmonics ``(N, K)``, their coefficients ``(K,)``, the
    variance of noise in each, and the number of lines that told it."""
    size = basis.samples
    columns = _slow_columns(size, _most_terms(periods))
    own = columns - basis.fit(columns.T).T
    terms = np.linalg.qr(own)[0]
    rest = values - basis.fit(values)
    coefficients = terms.T @ rest
    left = rest - terms @ coefficients
    power = np.abs(scipy.fft.rfft(left)) ** 2 / size
    line = np.arange(power.size)
    between = (line % periods != 0) & (line > periods)
    # An exact whole number of samples a period may hold few lines.
    chosen = np.flatnonzero(between)
    chosen = chosen[: max(_FEWEST_LINES, int(np.sum(chosen < _HARMONICS * periods)))]
    level = float(power[chosen].mean()) if chosen.size else 0.0
    return terms, coefficients, level, chosen.size


def _drift(basis: HarmonicBasis, values: Array, periods: int) -> tuple[Array, int]:
    """The drift (N,) about its mean and the number of its terms: as many as exceed the noise."""
    _, coefficients, level, lines = _slow_terms(basis, values, periods)
    size = coefficients.size
    number = min(_TESTED, size)
    while number < size:
        rest = coefficients[number : number + _TESTED]
        if not distributions.f.sf(np.mean(rest**2) / level, rest.size, 2 * lines) < _FURTHER:
            break
        number += 1
    return _fitted_drift(basis, number, values), number


def _most_terms(periods: int) -> int:
    """Half of the lines below the fundamental are left to tell the noise there."""
    return min(max(min(_POLYNOMIALS, 2 * periods - 2), periods - 1), _MOST_TERMS)


def _slow_columns(size: int, count: int) -> Array:
    """Polynomials, then cosines of ever more half cycles over the record, shape (N, K)."""
    place = (np.arange(size) + 0.5) / size
    polynomials = min(_POLYNOMIALS, count)
    table = np.polynomial.legendre.legvander(2 * place - 1, polynomials)[:, 1:]
    waves = np.cos(np.pi * np.outer(place, np.arange(polynomials + 1, count + 1)))
    return np.hstack([table, waves])


def _fitted_drift(basis: HarmonicBasis, number: int, values: Array) -> Array:
    """Least-squares drift of so many slow functions beside all harmonics, about its mean (N,)."""
    columns = _slow_columns(basis.samples, number)
    own = columns - basis.fit(columns.T).T
    drift = columns @ np.linalg.lstsq(own, values - basis.fit(values), rcond=None)[0]
    found: Array = drift - drift.mean()
    return found


# -- tones -----------------------------------------------------------------------------------------


def _without_tones(
    basis: HarmonicBasis, values: Array, periods: int, level: float, slowest: int = 1
) -> tuple[Array, tuple[Tone, ...]]:
    """A signal without its lines between the harmonics, and those, in cycles a sample.

    Of lines below the slowest one a drift has taken the noise.
    """
    tones: list[Tone] = []
    left = searched = values
    for _ in range(_MOST_TONES):
        line = foreign_line(searched, 1.0, basis.step)
        if line is None or not line.p_value < level:
            break
        if line.amplitude < LEAST_SHARE * np.ptp(values):
            break
        (frequency, amplitude), wave = _fitted_tone(basis, searched, line.frequency)
        searched = searched - wave
        tone = Tone(frequency, amplitude)
        if _stands_out(basis, left - wave, tone, wave, periods, level, slowest):
            left = left - wave
            tones.append(tone)
    return left, tuple(tones)


def _stands_out(
    basis: HarmonicBasis,
    left: Array,
    tone: Tone,
    wave: Array,
    periods: int,
    level: float,
    slowest: int,
) -> bool:
    """Whether a line exceeds what is left beside it when it is gone, on either side.

    What falls with frequency exceeds the faster lines alone, and is no tone: both comparisons must
    show it (Berger 1982, Technometrics 24(4), 295-300). Noise that is made of lines itself has
    neighbours whose powers scatter more than those of normal noise, and are known as if they were
    fewer: its highest line is no tone either. It would leave too little noise at the harmonics, of
    which as many hold a line that nobody sees.
    """
    after, before = (
        np.abs(scipy.fft.rfft(part - basis.fit(part))) ** 2 for part in (left, left + wave)
    )
    line, centre = np.arange(after.size), round(tone.frequency * left.size)
    free = (line % periods != 0) & (line >= slowest)
    below = after[free & (line < centre - 1)][-_BESIDE:]
    above = after[free & (line > centre + 1)][:_BESIDE]
    if not (below.size and above.size):
        return False
    means = [max(float(side.mean()), 1e-300) for side in (below, above)]
    ratios = np.concatenate([below / means[0], above / means[1]])
    dispersion = max(1.0, float(np.sum((ratios - 1.0) ** 2)) / max(ratios.size - 2, 1))
    highest = float(before[max(centre - 1, 0) : centre + 2].max())
    return all(
        distributions.f.sf(highest / mean, 2, 2 * side.size / dispersion) < level
        for side, mean in zip((below, above), means, strict=True)
    )


def _fitted_tone(
    basis: HarmonicBasis, values: Array, near: float
) -> tuple[tuple[float, float], Array]:
    """Frequency in cycles a sample, amplitude, and the sinusoid beside all harmonics (N,)."""
    index, rest = np.arange(basis.samples), values - basis.fit(values)

    def fitted(frequency: float) -> tuple[Array, Array]:
        turn = 2 * np.pi * frequency * index
        columns = np.stack([np.cos(turn), np.sin(turn)])
        own = columns - basis.fit(columns)
        size = np.linalg.lstsq(own.T, rest, rcond=None)[0]
        return size, size @ columns

    def left(frequency: float) -> float:
        wave = fitted(frequency)[1]
        return float(np.sum((rest - wave + basis.fit(wave)) ** 2))

    width = 0.75 / basis.samples
    found = optimize.minimize_scalar(
        left, bounds=(near - width, near + width), method="bounded",
        options={"xatol": 1e-3 / basis.samples},
    )  # fmt: skip
    size, wave = fitted(float(found.x))
    return (float(found.x), float(np.hypot(*size))), wave


# -- heavy tails -----------------------------------------------------------------------------------


def _without_outliers(basis: HarmonicBasis, values: Array, level: float) -> tuple[Array, float]:
    """Pseudo-values and the degrees of freedom of the noise; zero where it may be normal."""
    rest = values - basis.fit(values)
    if not np.std(rest) > LEAST_SHARE * np.ptp(values):
        return values, 0.0
    counts = _smooth_phases(basis, values)
    if np.mean(counts) < _MOSTLY or not _kurtosis_p(rest[counts]) < level:
        return values, 0.0
    cleaned, degrees = values, 0.0
    for _ in range(_ITERATIONS):
        repeating = _repeating(basis, values, cleaned)
        left = values - repeating
        degrees, scale = _student_t(left[counts])
        pseudo = _pseudo(left[counts], degrees, scale)
        if pseudo is None or np.var(pseudo) > _WORTH * np.var(left[counts]):
            return values, 0.0
        cleaned = np.array(values)
        cleaned[counts] = repeating[counts] + pseudo
    return cleaned, degrees


def _kurtosis_p(rest: Array) -> float:
    """Probability of a kurtosis as large in normal noise of the same colour."""
    size = rest.size
    power = np.abs(scipy.fft.rfft(rest, 2 * size)) ** 2
    correlation = scipy.fft.irfft(power)[:size] / max(float(power.mean()), 1e-300)
    correlation = correlation / correlation[0]
    # Fourth powers of correlated normal variates scatter as fewer independent ones.
    count = max(size / (1.0 + 2.0 * float(np.sum(correlation[1:] ** 4))), 20.0)
    value = float(distributions.kurtosis(rest))
    mean = 3.0 * (count - 1) / (count + 1)
    variance = 24.0 * count * (count - 2) * (count - 3)
    variance /= (count + 1) ** 2 * (count + 3) * (count + 5)
    x = (value - mean) / np.sqrt(variance)
    skew = 6.0 * (count**2 - 5 * count + 2) / ((count + 7) * (count + 9))
    skew *= np.sqrt(6.0 * (count + 3) * (count + 5) / (count * (count - 2) * (count - 3)))
    a = 6.0 + 8.0 / skew * (2.0 / skew + np.sqrt(1.0 + 4.0 / skew**2))
    ratio = (1.0 - 2.0 / a) / (1.0 + x * np.sqrt(2.0 / (a - 4.0)))
    z = (1.0 - 2.0 / (9.0 * a) - np.cbrt(ratio)) / np.sqrt(2.0 / (9.0 * a))
    return float(distributions.norm.sf(z))


def _repeating(basis: HarmonicBasis, values: Array, cleaned: Array) -> Array:
    """The significant harmonics, and what else repeats in most periods, as a jump does (N,)."""
    significant = significant_harmonics(basis, cleaned)
    found = significant.evaluate(_phase(basis), 1.0)
    rest = values - found
    place, table = _folded(basis, rest)
    some = np.isfinite(table).sum(axis=1)
    # A median of two is no median: the smaller one counts where both have a sign.
    low, high = np.nanmin(table, axis=1), np.nanmax(table, axis=1)
    both = np.where(low > 0, low, np.where(high < 0, high, 0.0))
    middle = np.where(some > 2, np.nanmedian(table, axis=1), both)
    scale = 1.4826 * float(np.median(np.abs(rest)))
    least = _REPEATS * 1.2533 * scale / np.sqrt(np.maximum(some, 1))
    return np.asarray(found + np.where(np.abs(middle) > least, middle, 0.0)[place])


def _phase(basis: HarmonicBasis) -> Array:
    return basis.step * np.arange(basis.samples, dtype=float)


def _folded(basis: HarmonicBasis, values: Array) -> tuple[NDArray[np.int64], Array]:
    """Bin of each sample's phase (N,), one as wide as a sampling interval, and the samples by bin,
    not a number where a bin has fewer than others (bins, periods)."""
    bins = int(1.0 / basis.step)
    # A phase on the edge of two bins belongs to the upper one, however it was rounded.
    place = ((_phase(basis) * bins + 1e-6) % bins).astype(np.int64) % bins
    order = np.argsort(place, kind="stable")
    first = np.searchsorted(place[order], np.arange(bins))
    turn = np.arange(basis.samples) - first[place[order]]
    table = np.full((bins, int(turn.max()) + 1), np.nan)
    table[place[order], turn] = values[order]
    return place, table


def _smooth_phases(basis: HarmonicBasis, values: Array) -> NDArray[np.bool_]:
    """Samples at phases where most periods are no outliers (N,).

    A jump between two samples is no sum of the harmonics that the samples determine. What is left
    of it differs from period to period, but is always at the same phase.
    """
    # About the median: an average over periods spreads one outlier over all of them.
    found = significant_harmonics(basis, values).evaluate(_phase(basis), 1.0)
    place, table = _folded(basis, values - found)
    # Few samples may leave a bin without any.
    full = np.isfinite(table).any(axis=1)
    away = np.abs(table[full] - np.nanmedian(table[full], axis=1, keepdims=True))
    unusual = np.zeros(len(table), dtype=bool)
    unusual[full] = np.nanmedian(away, axis=1) > _UNUSUAL * np.nanmedian(away)
    beside = np.arange(-_JUMP, _JUMP + 1)
    near = np.add.outer(np.flatnonzero(unusual), beside) % unusual.size
    unusual[near.ravel()] = True
    return np.asarray(~unusual[place])


def _student_t(rest: Array) -> tuple[float, float]:
    """Degrees of freedom and scale of a Student-t variate by maximum likelihood."""
    best = (-np.inf, _DEGREES[-1], 1.0)
    scale = float(np.median(np.abs(rest))) / 0.6745
    for degrees in _DEGREES:
        for _ in range(30):  # expectation maximisation
            weight = (degrees + 1) / (degrees + (rest / scale) ** 2)
            scale = float(np.sqrt(np.mean(weight * rest**2)))
        density = float(np.sum(distributions.t.logpdf(rest / scale, degrees))) - rest.size * np.log(
            scale
        )
        best = max(best, (density, degrees, scale))
    return best[1], best[2]


def _pseudo(rest: Array, degrees: float, scale: float) -> Array | None:
    """``psi(r) / mean(psi')`` of the t distribution (N,); None where it has no use."""
    unit = rest / scale
    across = degrees + unit**2
    psi = (degrees + 1) * unit / across
    slope = float(np.mean((degrees + 1) * (degrees - unit**2) / across**2))
    return scale * psi / slope if slope > 0.05 else None
