"""Moments of the amplitudes of effects, and evidence of effects with one amplitude each.

The posterior of the amplitudes that act is normal but for their moment densities. What these make
of the evidence is the mean of the product of all effects' mean squares, each on one side of zero
more than on the other where an effect has a likely side. That of two effects is exact where one of
them at most has a likely side. Of more effects, and of two likely sides, correlations count by
pairs. All loops over covariances, effects and sizes are compiled: a search compares millions of
these densities.

References
----------
Johnson and Rossell (2010), *J. R. Statist. Soc.* B 72, 143-170, eqs. 4 and 11, for moment
densities; Abramowitz and Stegun (1972), eq. 7.1.14, for the continued fraction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesoleo._compiled import inner, jit
from bayesoleo._types import Array, Integers

#: Standard deviations beyond which the other side of zero has less than 1e-15 of a normal density.
NEAR = 8.0
#: Standard deviations at which moments of the far side have lost ten digits to cancellation.
FARTHEST = 30.0
#: Standard deviations beyond which a tail is its first asymptotic term, to 5e-4 of it.
FAR = 100.0
#: Logarithm below an effect's largest evidence from which a moment is taken as if there were no
#: likely sides and no correlations. That makes it smaller by e^10 at most; it makes it larger where
#: a side is impossible, but what is e^40 below the largest counts for nothing.
SMALL_SHARE = 40.0
#: Argument from which the continued fraction of the error function has all digits by so many terms.
FRACTION, TERMS = 5.0, 20


def log_moments(
    counts: Sequence[int],
    positive: Sequence[Array | float],
    mean: Array,
    covariance: Array,
) -> Array:
    """Logarithm of the mean of the product of effects' moments, each the mean square of its
    amplitudes.

    Parameters
    ----------
    counts : sequence of int
        Amplitudes of each effect.
    positive : sequence of float or ndarray, shape (...)
        Prior probability that its size is above zero.
    mean : ndarray, shape (m, ...)
        Of each amplitude.
    covariance : ndarray, shape (m, m, ...)

    Returns
    -------
    ndarray, shape (...)
    """
    shape = mean.shape[1:]
    sides = np.stack([np.broadcast_to(np.asarray(one, dtype=float), shape) for one in positive])
    spread = np.broadcast_to(covariance, (*covariance.shape[:2], *shape))
    found = np.empty(math.prod(shape))
    _over(
        np.asarray(counts, dtype=np.int64),
        np.ascontiguousarray(sides.reshape(len(sides), -1)),
        np.ascontiguousarray(mean.reshape(len(mean), -1)),
        # Copied in any case: an array that may not be written to is another type to compile for.
        np.array(spread.reshape(*covariance.shape[:2], -1), order="C"),
        found,
    )
    return found.reshape(shape)


@jit
def _over(counts: Integers, sides: Array, mean: Array, covariance: Array, found: Array) -> None:
    """Of many means ``(m, n)`` and covariances ``(m, m, n)``."""
    size, moments = len(mean), np.empty((len(counts), 3))
    one, spread, likely = np.empty(size), np.empty((size, size)), np.empty(len(sides))
    for k in range(len(found)):
        # Copied: a column of an array is another type to compile for.
        for effect in range(len(sides)):
            likely[effect] = sides[effect, k]
        for i in range(size):
            one[i] = mean[i, k]
            for j in range(size):
                spread[i, j] = covariance[i, j, k]
        found[k] = math.log(_squares(counts, one, spread, moments))
        found[k] += _log_sides(counts, likely, one, spread, moments)


@inner
def _squares(counts: Integers, mean: Array, covariance: Array, moments: Array) -> float:
    """Product of effects' mean squares, which go to the first column of ``moments``: the moment,
    were there no likely sides and no correlations of effects. Variances are all that it takes of
    the covariance."""
    product, start = 1.0, 0
    for k in range(len(counts)):
        total = 0.0
        for c in range(start, start + counts[k]):
            total += mean[c] ** 2 + covariance[c, c]
        moments[k, 0] = total / counts[k]
        product *= moments[k, 0]
        start += counts[k]
    return product


@inner
def _log_sides(
    counts: Integers, sides: Array, mean: Array, covariance: Array, moments: Array
) -> float:
    """What likely sides and correlations add to the logarithm of :func:`_squares`."""
    sided, start = 0.0, 0
    for k in range(len(counts)):
        if counts[k] == 1 and sides[k] != 0.5:
            distance = mean[start] / math.sqrt(covariance[start, start])
            sided += _log_second(sides[k], distance) - math.log1p(distance**2)
            if len(counts) > 1:
                moments[k, 1], moments[k, 2] = _higher_moments(sides[k], distance)
        start += counts[k]
    # A zero that is no constant: for one, all that takes it would be compiled once more.
    product, first = 1.0, 0 * counts[0]
    for i in range(len(counts)):
        second = first + counts[i]
        for j in range(i + 1, len(counts)):
            has_i = counts[i] == 1 and sides[i] != 0.5
            has_j = counts[j] == 1 and sides[j] != 0.5
            if has_i or has_j:
                # Of two likely sides each is conditioned on the other's by halves.
                log = 0.0
                if has_i:
                    square = _square_given(moments[i], first, second, counts[j], mean, covariance)
                    log += math.log(square / moments[j, 0])
                if has_j:
                    square = _square_given(moments[j], second, first, counts[i], mean, covariance)
                    log += math.log(square / moments[i, 0])
                sided += 0.5 * log if has_i and has_j else log
            else:
                between = _between(first, counts[i], second, counts[j], mean, covariance)
                product *= 1.0 + between / (moments[i, 0] * moments[j, 0])
            second += counts[j]
        first += counts[i]
    return math.log(product) + sided


@inner
def _between(
    first: int, count: int, second: int, number: int, mean: Array, covariance: Array
) -> float:
    """Mean of ``E[x^2 y^2] - E[x^2] E[y^2]`` of normal amplitudes x and y of two effects."""
    total = 0.0
    for a in range(first, first + count):
        for b in range(second, second + number):
            total += covariance[a, b] * (covariance[a, b] + 2.0 * mean[a] * mean[b])
    return 2.0 * total / (count * number)


@inner
def _square_given(
    moments: Array, place: int, start: int, count: int, mean: Array, covariance: Array
) -> float:
    """Mean square of some amplitudes under the moment of another one ``u``, which has a likely
    side.

    An amplitude is a straight line in ``u`` but for a rest that is independent of it, so that the
    means of ``u^3`` and ``u^4`` over that of ``u^2`` are all that is needed.
    """
    root = math.sqrt(covariance[place, place])
    distance, third, fourth = mean[place] / root, moments[1], moments[2]
    total = 0.0
    for c in range(start, start + count):
        slope = covariance[place, c] / root
        origin = mean[c] - slope * distance
        rest = max(covariance[c, c] - slope**2, 0.0)
        total += origin**2 + rest + 2.0 * origin * slope * third + slope**2 * fourth
    return total / count


@inner
def _log_second(positive: float, distance: float) -> float:
    """Logarithm of the mean of ``u^2`` of a normal ``u`` with unit variance, whose sides of zero
    have different weights, by its mean."""
    if positive == 0.5:
        return math.log1p(distance**2)
    size = abs(distance)
    likely = positive if distance > 0.0 else 1.0 - positive
    near = -math.inf if likely == 0.0 else math.log1p(size**2) + math.log(2.0 * likely)
    # The other side counts where it is near, or is the only one.
    if size >= NEAR and likely != 0.0:
        return near
    # Its part is (d^2 + 1) Phi(-d) - d phi(d). Both terms nearly cancel: exp(-d^2 / 2) is taken
    # out. Beyond, the first term of the series, 2 phi(d) / d^3.
    there = min(size, FAR)
    scaled = 0.5 * (there**2 + 1.0) * _scaled_tail(there / math.sqrt(2.0))
    scaled -= there / math.sqrt(2.0 * math.pi)
    beyond = math.log(scaled) - 0.5 * size**2 - 3.0 * math.log(max(size, FAR) / FAR)
    if likely == 0.0:
        return math.log(2.0) + beyond
    here = math.log1p(size**2 - math.exp(beyond)) + math.log(2.0 * likely)
    if likely == 1.0:
        return here
    beyond += math.log(2.0 * (1.0 - likely))
    top = max(here, beyond)
    return top + math.log(math.exp(here - top) + math.exp(beyond - top))


@inner
def _higher_moments(positive: float, distance: float) -> tuple[float, float]:
    """Means of ``u^3`` and ``u^4`` over that of ``u^2``, of the same ``u``."""
    square = distance**2
    likely = positive if distance > 0.0 else 1.0 - positive
    # The other side counts where it is near, or is the only one.
    if positive == 0.5 or (abs(distance) >= NEAR and likely != 0.0):
        third = distance * (square + 3.0) / (square + 1.0)
        return third, ((square + 6.0) * square + 3.0) / (square + 1.0)
    up, down = _half_moments(distance), _half_moments(-distance)
    other = 1.0 - positive
    second = positive * up[0] + other * down[0]
    return (
        (positive * up[1] - other * down[1]) / second,
        (positive * up[2] + other * down[2]) / second,
    )


@inner
def _half_moments(distance: float) -> tuple[float, float, float]:
    """Means of ``u^2``, ``u^3`` and ``u^4`` over ``u > 0``, divided by the normal density at the
    distance of its mean from zero."""
    # Beyond, the terms of the far side cancel; the ratios hardly depend on the distance there.
    d = min(max(distance, -FARTHEST), FARTHEST)
    tail = math.sqrt(0.5 * math.pi) * _scaled_tail(-d / math.sqrt(2.0))
    square = d * d
    return (
        (square + 1.0) * tail + d,
        d * (square + 3.0) * tail + square + 2.0,
        ((square + 6.0) * square + 3.0) * tail + d * (square + 5.0),
    )


@jit
def _scaled_tail(x: float) -> float:
    """``exp(x^2) erfc(x)``, as :func:`scipy.special.erfcx`."""
    if x < FRACTION:
        return math.exp(x * x) * math.erfc(x)
    value = x
    for k in range(TERMS, 0, -1):
        value = x + 0.5 * k / value
    return 1.0 / (math.sqrt(math.pi) * value)


@inner
def _joined(
    own: Array,
    spread: Array,
    gain: Array,
    mean: Array,
    covariance: Array,
    root: float,
    every: Array,
    whole: Array,
) -> None:
    """Means ``every`` of an anchor's amplitudes and of those of one more effect, in units of the
    noise, and their covariance ``whole``, from those of both by themselves.

    An amplitude that stood in for the further effect is smaller beside it. ``gain`` (m, n) is by
    how much it falls with each further amplitude. Covariances of the anchor's amplitudes with each
    other are left to :func:`_complete`, for most of these densities do without.
    """
    before, more = len(own), len(mean)
    for k in range(more):
        every[before + k] = mean[k] / root
        for j in range(more):
            whole[before + k, before + j] = covariance[k, j]
    for i in range(before):
        moved = own[i]
        for k in range(more):
            moved -= gain[i, k] * mean[k]
            shared = 0.0
            for j in range(more):
                shared -= gain[i, j] * covariance[j, k]
            whole[i, before + k] = whole[before + k, i] = shared
        every[i] = moved / root
        value = spread[i, i]
        for k in range(more):
            value -= gain[i, k] * whole[i, before + k]
        whole[i, i] = value


@inner
def _complete(spread: Array, gain: Array, whole: Array) -> None:
    """Covariances that :func:`_joined` leaves."""
    before, more = gain.shape
    for i in range(before):
        for j in range(before):
            if i == j:
                continue
            value = spread[i, j]
            for k in range(more):
                value -= gain[j, k] * whole[i, before + k]
            whole[i, j] = value


@inner
def _student(square: float, log_det: float, count: float, freedom: float) -> float:
    """Log density but for a constant, as :class:`Likelihood` has it."""
    return -0.5 * log_det - 0.5 * (freedom + count) * math.log1p(max(square, 0.0) / freedom)


@jit
def singles(
    counts: Integers,
    sides: Array,
    own: Array,
    spread: Array,
    gain: Array,
    slope: Array,
    gram: Array,
    square: Array,
    log_det: Array,
    power: Array,
    count: int,
    freedom: float,
    labels: Integers,
    best: Array,
    found: Array,
) -> None:
    """Log evidence of effects of one amplitude each, as the only one or beside an anchor's.

    Parameters
    ----------
    counts : ndarray of int, shape (K,)
        Amplitudes of each of the anchor's effects, and one.
    sides : ndarray, shape (S, K)
        Prior probabilities that their sizes are above zero, the last for each further effect.
    own : ndarray, shape (P, m)
        Means of the anchor's amplitudes, with ``m = 0`` where there are none.
    spread : ndarray, shape (P, m, m)
        Their covariance.
    gain : ndarray, shape (P, S, m, 1)
    slope, gram : ndarray, shape (P, S)
        Of each effect's column.
    square, log_det : ndarray, shape (P,)
    power : ndarray, shape (T,)
        Variances of the normal parts of the amplitude's density.
    count : int
        Coefficients.
    freedom : float
        With which the noise is known.
    labels : ndarray of int, shape (S,)
    best : ndarray, shape (2, labels)
        Largest log evidence so far by label, without and with something outside the catalogue;
        moments are rough that far below it (:data:`SMALL_SHARE`). Written.
    found : ndarray, shape (P, S, T)
        Written.
    """
    size = own.shape[1] + 1
    moments, every, whole = np.empty((len(counts), 3)), np.empty(size), np.empty((size, size))
    variance, falls, total = np.empty(size - 1), np.empty(size - 1), freedom + count
    for p in range(len(square)):
        top, before, around = best[min(p, 1)], own[p], spread[p]
        for i in range(size - 1):
            variance[i] = around[i, i]
        for s in range(slope.shape[1]):
            lost, label = gain[p, s], labels[s]
            for i in range(size - 1):
                falls[i] = lost[i, 0]
            data = slope[p, s], gram[p, s], square[p], log_det[p], float(count), freedom
            first = 0
            for t in range(len(power)):
                found[p, s, t] = _height_of_single(
                    data[:4], total, freedom, power[t], counts, before, variance, falls
                )
                if found[p, s, t] > found[p, s, first]:
                    first = t
            # The likely size comes first: beside it most of the others are small.
            for n in range(-1, len(power)):
                t = first if n < 0 else n
                if n != first and found[p, s, t] > top[label] - SMALL_SHARE:
                    _single(data, power[t], before, around, lost, every, whole)
                    _squares(counts, every, whole, moments)
                    _complete(around, lost, whole)
                    found[p, s, t] += _log_sides(counts, sides[s], every, whole, moments)
                    top[label] = max(top[label], found[p, s, t])


@inner
def _height_of_single(
    data: tuple[float, float, float, float],
    total: float,
    freedom: float,
    power: float,
    counts: Integers,
    before: Array,
    variance: Array,
    lost: Array,
) -> float:
    """Log evidence but for likely sides and correlations: that of :func:`_student` with the product
    of mean squares, without what only sides and correlations need. Most of all densities end here.
    """
    slope, gram, square, log_det = data
    grown = 1.0 + power * max(gram, 0.0)
    mean, own = power * slope / grown, power / grown
    left = max(square - slope * mean, 0.0)
    inverse = total / (freedom + left)
    product, start = inverse * mean**2 + own, 0
    for k in range(len(counts) - 1):
        sum_of_squares = 0.0
        for i in range(start, start + counts[k]):
            moved = before[i] - lost[i] * mean
            sum_of_squares += inverse * moved**2 + variance[i] + own * lost[i] ** 2
        product *= sum_of_squares / counts[k] if counts[k] > 1 else sum_of_squares
        start += counts[k]
    density = -0.5 * log_det - 0.5 * total * math.log1p(left / freedom)
    return density + math.log(product / (power * math.sqrt(grown)))


@inner
def _single(
    data: tuple[float, float, float, float, float, float],
    power: float,
    before: Array,
    around: Array,
    lost: Array,
    every: Array,
    whole: Array,
) -> None:
    """Means of the amplitudes, and what :func:`_joined` has of their covariance, into the last
    arrays; its loops are written out for one further amplitude."""
    slope, gram, square, _, count, freedom = data
    grown = 1.0 + power * max(gram, 0.0)
    left = square - power * slope**2 / grown
    mean, variance = power * slope / grown, power / grown
    root = math.sqrt((freedom + max(left, 0.0)) / (freedom + count))
    last = len(before)
    every[last], whole[last, last] = mean / root, variance
    for i in range(last):
        shared = -lost[i, 0] * variance
        every[i] = (before[i] - lost[i, 0] * mean) / root
        whole[i, last] = whole[last, i] = shared
        whole[i, i] = around[i, i] - lost[i, 0] * shared


@jit
def beside(
    counts: Integers,
    sides: Array,
    own: Array,
    spread: Array,
    gain: Array,
    mean: Array,
    covariance: Array,
    noise: Array,
    density: Array,
    label: int,
    best: Array,
    found: Array,
) -> None:
    """Log evidence of an effect of several amplitudes beside an anchor's.

    Parameters
    ----------
    counts : ndarray of int, shape (K,)
        Amplitudes of each of the anchor's effects, and of the further one.
    sides : ndarray, shape (K,)
    own : ndarray, shape (P, m)
    spread : ndarray, shape (P, m, m)
    gain : ndarray, shape (P, m, n)
    mean : ndarray, shape (P, T, n)
        Of the further effect's amplitudes, by size.
    covariance : ndarray, shape (P, T, n, n)
    noise : ndarray, shape (P, T)
        Variance of the noise over that measured.
    density : ndarray, shape (P, T)
        Log evidence but for the moments.
    label : int
    best : ndarray, shape (2, labels)
        As of :func:`singles`.
    found : ndarray, shape (P, T)
        Written.
    """
    size = own.shape[1] + mean.shape[2]
    moments, every, whole = np.empty((len(counts), 3)), np.empty(size), np.empty((size, size))
    for p in range(len(own)):
        for t in range(mean.shape[1]):
            root = math.sqrt(noise[p, t])
            _joined(own[p], spread[p], gain[p], mean[p, t], covariance[p, t], root, every, whole)
            value = density[p, t] + math.log(_squares(counts, every, whole, moments))
            top = best[min(p, 1)]
            if value > top[label] - SMALL_SHARE:
                _complete(spread[p], gain[p], whole)
                value += _log_sides(counts, sides, every, whole, moments)
                top[label] = max(top[label], value)
            found[p, t] = value


@jit
def pairs(
    sides: Array,
    first: Array,
    own: Array,
    slope: Array,
    gram: Array,
    cross: Array,
    square: Array,
    log_det: Array,
    power: Array,
    count: int,
    freedom: float,
    labels: Integers,
    best: Array,
    found: Array,
) -> None:
    """Log evidence of an effect together with each of others, all of one amplitude.

    Parameters
    ----------
    sides : ndarray, shape (S, 2)
        Prior probabilities that the sizes of both are above zero.
    first, own : ndarray, shape (P,)
        Slope and square of the one effect's column.
    slope, gram, cross : ndarray, shape (P, S)
        Slopes and squares of the others' columns, and their products with the first.
    square, log_det : ndarray, shape (P,)
    power : ndarray, shape (T,)
    count : int
    freedom : float
    labels : ndarray of int, shape (S,)
    best : ndarray, shape (2, labels)
        As of :func:`singles`.
    found : ndarray, shape (P, S, T, T)
        Written; rows for the sizes of the one effect.
    """
    counts, moments = np.ones(2, dtype=np.int64), np.empty((2, 3))
    mean, covariance = np.empty(2), np.empty((2, 2))
    for p in range(len(square)):
        top = best[min(p, 1)]
        for s in range(slope.shape[1]):
            likely, label = sides[s], labels[s]
            for t in range(len(power)):
                for u in range(len(power)):
                    # In units of the normal parts of their priors.
                    a, b = math.sqrt(power[t]) * first[p], math.sqrt(power[u]) * slope[p, s]
                    one = 1.0 + power[t] * max(own[p], 0.0)
                    other = 1.0 + power[u] * max(gram[p, s], 0.0)
                    mixed = math.sqrt(power[t] * power[u]) * cross[p, s]
                    det = max(one * other - mixed**2, 1e-12 * one * other)
                    left = square[p] - (other * a**2 + one * b**2 - 2.0 * mixed * a * b) / det
                    root = math.sqrt((freedom + max(left, 0.0)) / (freedom + count))
                    mean[0] = (other * a - mixed * b) / det / root
                    mean[1] = (one * b - mixed * a) / det / root
                    covariance[0, 0], covariance[1, 1] = other / det, one / det
                    covariance[0, 1] = covariance[1, 0] = -mixed / det
                    value = _student(left, log_det[p] + math.log(det), float(count), freedom)
                    value += math.log(_squares(counts, mean, covariance, moments))
                    if value > top[label] - SMALL_SHARE:
                        value += _log_sides(counts, likely, mean, covariance, moments)
                        top[label] = max(top[label], value)
                    found[p, s, t, u] = value
