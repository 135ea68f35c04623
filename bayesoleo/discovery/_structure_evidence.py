r"""Marginal likelihoods of structures, linearised about an estimate.

A structure is a set of effects that act, with or without something outside the catalogue. About an
estimate the residual of all runs is

.. math:: e = J \delta + \sum_{k \in S} C_k b_k + \sum_k c_k \beta_k + g + \varepsilon

with the sensitivities :math:`J` of the present unknowns, whose priors are those of the model; the
changes :math:`C_k` of the outputs by each effect that acts, scaled to unit root mean square in
units of the noise; and what lies outside the catalogue: a law that resembles many effects a
little, :math:`\beta_k \sim N(0, a^2 w_k)`, and a smooth function of phase :math:`g` of each run.
The amplitude of an effect that acts has a moment density,
:math:`p(b_k) \propto b_k^2 N(b_k; 0, \tau^2/3)` with root mean square :math:`\tau`: it vanishes at
zero, for an effect of no size is none. Under a normal density most of what is called missing could
not be seen in the data, and nothing could ever be said to be missing for sure. Sizes :math:`\tau`,
:math:`a` and that of :math:`g` are integrated over a grid, with equal weight by decade from the
smallest change that could be seen to the size of the signal itself. The size of an effect is that
of the part of its change that the unknowns cannot make. The measured noise is itself uncertain,
which makes the density Student's; sizes are in units of the noise as the data have it.

References
----------
Kennedy and O'Hagan (2001), *J. R. Statist. Soc.* B 63, section 4; Kass and Raftery (1995), *JASA*
90, 773-795, for marginal likelihoods; Johnson and Rossell (2010), *J. R. Statist. Soc.* B 72,
143-170, eqs. 4 and 11, for moment densities; Rasmussen and Williams (2006), *Gaussian Processes for
Machine Learning*, eqs. A.9-A.10 for the lemma by which unknowns are integrated out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcx, logsumexp

from bayesoleo._types import Array, Integers

#: Sizes of one effect, of the law outside the catalogue, and of the remainder over phase.
SIZES, LAW_SIZES, SMOOTH_SIZES = 10, 5, 5
#: Standard deviations by which the smallest change of interest differs from nothing: about the size
#: at which a score is significant in half of all campaigns, among sixty candidates.
VISIBLE = 4.0
#: Difference of a law from the effect that it resembles, as a part of the effect's size, and the
#: spread of its logarithm.
DIFFERENCE, DIFFERENCE_SPREAD = 0.25, 1.2
#: Standard deviations beyond which the other side of zero has less than 1e-15 of a normal density.
NEAR = 8.0
#: Standard deviations at which moments of the far side have lost ten digits to cancellation.
FARTHEST = 30.0
#: Standard deviations beyond which a tail is its first asymptotic term, to 5e-4 of it.
FAR = 100.0
#: Logarithm below an effect's largest evidence from which moments are taken as if there were no
#: likely sides and no correlations, which changes them by less than e^10: to 1e-12 of the whole.
SMALL_SHARE = 40.0
_LOG_2 = float(np.log(2.0))


@dataclass(frozen=True)
class Covariances:
    """Noise with a remainder over phase of several sizes, or none: the first is noise alone.

    Parameters
    ----------
    variance : ndarray, shape (n,)
        Of the noise.
    smooth : ndarray, shape (n,)
        Of a remainder of unit mean square, in units of the noise's mean square of each output.
    output_of : ndarray of int, shape (n,)
    levels : ndarray, shape (outputs, SMOOTH_SIZES)
        Mean squares of the remainder.
    patterns : tuple of tuple of int
        By pattern and output: which of the levels, zero for none.
    """

    variance: Array
    smooth: Array
    output_of: Integers
    levels: Array
    patterns: tuple[tuple[int, ...], ...]

    @classmethod
    def of(
        cls, variance: Array, smooth: Array, output_of: Integers, reach: Array, samples: int
    ) -> Covariances:
        """Remainders of all outputs together, and of each alone.

        Parameters
        ----------
        variance, smooth : ndarray, shape (n,)
            Of the noise, and of a remainder of unit mean square.
        output_of : ndarray of int, shape (n,)
        reach : ndarray, shape (outputs,)
            Root mean square of the signal, SI.
        samples : int
            Of one output.
        """
        outputs = reach.size
        unit = np.array([variance[output_of == b].mean() for b in range(outputs)])
        largest = np.maximum(reach / np.sqrt(unit), 1.0)
        least = VISIBLE / np.sqrt(samples)
        levels = np.array([np.geomspace(least, top, SMOOTH_SIZES) ** 2 for top in largest])
        sets = [tuple(range(outputs))]
        sets += [(b,) for b in range(outputs)] if outputs > 1 else []
        patterns = [(0,) * outputs]
        patterns += [
            tuple(k + 1 if b in one else 0 for b in range(outputs))
            for one in sets
            for k in range(SMOOTH_SIZES)
        ]
        return cls(variance, smooth * unit[output_of], output_of, levels, tuple(patterns))

    def products(self, rows: Array) -> tuple[Array, Array]:
        """``X V^-1 X'`` of rows ``X (p, n)`` for each pattern (patterns, p, p), and ``ln det V``
        (patterns,)."""
        outputs, sizes = self.levels.shape
        grams: list[list[Array]] = [[] for _ in range(outputs)]
        logs = np.zeros((outputs, sizes + 1))
        for b in range(outputs):
            own = self.output_of == b
            chosen = rows[:, own]
            for k in range(sizes + 1):
                level = self.levels[b, k - 1] if k else 0.0
                variance = self.variance[own] + level * self.smooth[own]
                white = chosen / np.sqrt(variance)
                grams[b].append(white @ white.T)
                logs[b, k] = np.log(variance).sum()
        found = np.zeros((len(self.patterns), len(rows), len(rows)))
        for q, pattern in enumerate(self.patterns):
            for b, k in enumerate(pattern):
                found[q] += grams[b][k]
        total = [sum(logs[b, k] for b, k in enumerate(pattern)) for pattern in self.patterns]
        return found, np.array(total)


@dataclass(frozen=True)
class Reduced:
    """Columns after the unknowns are integrated out, for ``P`` covariances.

    Parameters
    ----------
    gram : ndarray, shape (P, k, k)
        ``C' V^-1 C`` with ``V`` the covariance of noise, remainder and unknowns.
    slope : ndarray, shape (P, k)
        ``C' V^-1 e``.
    square, log_det : ndarray, shape (P,)
        ``e' V^-1 e`` and ``ln det V``.
    own : Amplitudes, optional
        Of effects that act in the covariance (:meth:`with_effects`).
    """

    gram: Array
    slope: Array
    square: Array
    log_det: Array
    own: Amplitudes | None = None

    @classmethod
    def of(cls, products: Array, log_det: Array, unknowns: int, offset: Array) -> Reduced:
        """Integrate unknowns out.

        Parameters
        ----------
        products : ndarray, shape (P, 1 + l + k, 1 + l + k)
            Of the residual, the ``l`` unknowns in units of their priors, and the columns.
        log_det : ndarray, shape (P,)
        unknowns : int
        offset : ndarray, shape (l,)
            Centres of the priors, from the estimate.
        """
        inner, rest = slice(1, 1 + unknowns), slice(1 + unknowns, None)
        first = products[:, 0, inner]
        at_centre = first - products[:, inner, inner] @ offset
        # The residual with the unknowns at the centres of their priors.
        square = products[:, 0, 0] - (first + at_centre) @ offset
        slope = products[:, rest, 0] - products[:, rest, inner] @ offset
        every = cls(
            products[:, 1:, 1:],
            np.concatenate([at_centre, slope], axis=1),
            square,
            np.asarray(log_det, dtype=float),
        )
        return every.with_columns(range(unknowns), np.ones(unknowns), range(unknowns, every.size))

    @property
    def size(self) -> int:
        """Number of columns."""
        return int(self.slope.shape[1])

    def scaled(self, factors: Array) -> Reduced:
        """The same with each column times a factor."""
        assert self.own is None
        gram = self.gram * factors[:, None] * factors
        return replace(self, gram=gram, slope=self.slope * factors)

    def of_some(self, parts: Sequence[int] | Integers, columns: Sequence[int]) -> Reduced:
        """The same for some covariances and columns, in this order."""
        chosen, kept = np.asarray(columns, dtype=int), np.asarray(parts, dtype=int)
        return Reduced(
            self.gram[np.ix_(kept, chosen, chosen)],
            self.slope[np.ix_(kept, chosen)],
            self.square[kept],
            self.log_det[kept],
            None if self.own is None else self.own.of_some(kept, chosen),
        )

    def with_effects(self, groups: Sequence[Group], sizes: Sequence[float]) -> Reduced:
        """The same with effects that act in the covariance, whose columns come first and are left
        out.

        Parameters
        ----------
        groups : sequence of Group
            Of each effect.
        sizes : sequence of float
            Root mean squares of their moment densities.
        """
        assert self.own is None  # those of one model, all together
        inner = [column for group in groups for column in group.columns]
        counts = np.array([len(group.columns) for group in groups])
        power = np.repeat(moment_power(np.array(sizes), counts), counts)
        root, index = np.sqrt(power)[:, None], np.array(inner, dtype=int)
        rest = [k for k in range(self.size) if k not in inner]
        precision = np.eye(index.size) + root * self.gram[:, index[:, None], index] * root.T
        covariance = np.linalg.inv(precision)
        mean = covariance @ (root * self.slope[:, index, None])
        gain = covariance @ (root * self.gram[:, index[:, None], rest])
        turned = mean[:, :, 0].T, np.moveaxis(covariance, 0, 2), np.moveaxis(gain, 0, 1)
        own = Amplitudes(tuple(groups), *turned)
        return replace(self.with_columns(inner, power, rest), own=own)

    def log_moment(self, likelihood: Likelihood) -> Array:
        """Logarithm of the moment of effects that act, if nothing else does, shape (P,)."""
        own = self.own
        if own is None:
            return np.zeros(len(self.square))
        rows, noise = range(len(own.mean)), likelihood.noise(self.square)
        upper = [[own.covariance[i, j] for j in rows[i:]] for i in rows]
        return log_moments(own.counts, own.positive, list(own.mean / np.sqrt(noise)), upper)

    def with_columns(
        self, columns: Sequence[int], power: Array, keep: Sequence[int] | None = None
    ) -> Reduced:
        """The same with independent multiples of some columns in the covariance.

        Parameters
        ----------
        columns : sequence of int, length m
        power : ndarray, shape (m,) or (P, m)
            Their variances.
        keep : sequence of int, optional
            Columns of the result; by default all.
        """
        chosen = np.asarray(columns, dtype=int)
        kept = np.arange(self.size) if keep is None else np.asarray(keep, dtype=int)
        root = np.broadcast_to(np.sqrt(power), (len(self.square), chosen.size))
        inner = root[:, :, None] * self.gram[:, chosen[:, None], chosen] * root[:, None, :]
        lower = np.linalg.cholesky(np.eye(chosen.size) + inner)
        cross = self.gram[:, chosen[:, None], kept]
        rows = np.concatenate([self.slope[:, chosen, None], cross], axis=2) * root[:, :, None]
        white = np.linalg.solve(lower, rows)
        first, others = white[:, :, 0], white[:, :, 1:]
        turned = np.swapaxes(others, 1, 2)
        logs = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
        return Reduced(
            self.gram[:, kept[:, None], kept] - turned @ others,
            self.slope[:, kept] - (turned @ first[:, :, None])[:, :, 0],
            self.square - np.sum(first**2, axis=1),
            self.log_det + 2.0 * logs,
        )


@dataclass(frozen=True)
class Amplitudes:
    """Posterior of amplitudes of effects that act, in units of the normal parts of their priors.

    A further effect changes it: an amplitude that stood in for that effect is then small.

    Parameters
    ----------
    groups : tuple of Group
    mean : ndarray, shape (m, P)
    covariance : ndarray, shape (m, m, P)
    gain : ndarray, shape (m, P, k)
        By how much the mean falls with the amplitude of each further column.
    """

    groups: tuple[Group, ...]
    mean: Array
    covariance: Array
    gain: Array

    @property
    def counts(self) -> list[int]:
        """Columns of each effect."""
        return [len(group.columns) for group in self.groups]

    @property
    def positive(self) -> list[Array | float]:
        """Prior probabilities that their sizes are above zero."""
        return [group.positive for group in self.groups]

    def of_some(self, parts: Integers, columns: Integers) -> Amplitudes:
        """The same for some covariances and further columns."""
        gain = self.gain[:, parts[:, None], columns]
        return Amplitudes(self.groups, self.mean[:, parts], self.covariance[:, :, parts], gain)

    def beside(
        self,
        columns: Integers,
        positive: Array | float,
        mean: Array,
        covariance: Array,
        noise: Array,
    ) -> Moments:
        """Moment of these amplitudes and of those of one more effect, shape (P, S, T).

        Parameters
        ----------
        columns : ndarray of int, shape (S, n)
            Of each of several further effects.
        positive : float or ndarray
            Prior probability that its size is above zero.
        mean : ndarray, shape (n, P, S, T)
            Of its amplitudes, by size.
        covariance : ndarray, shape (n, n, P, S, T)
        noise : ndarray, shape (P, S, T)
            Variance of the noise over that measured.
        """
        own, more = range(len(self.mean)), range(len(mean))
        gain = self.gain[:, :, columns]  # (m, P, S, n)

        def moved(i: int, values: Sequence[Array] | Array) -> Array:
            """Of an own amplitude, by one of each further amplitude."""
            if len(values) == 1:  # of nearly all effects
                return np.asarray(gain[i] * values[0])
            return np.asarray(np.einsum("psn,npst->pst", gain[i], np.asarray(values)))

        shared = [[-moved(i, covariance[:, k]) for k in more] for i in own]
        now = [self.mean[i][:, None, None] - moved(i, mean) for i in own]
        its = [self.covariance[i][:, :, None, None] for i in own]
        upper = [[*(its[i][j] - moved(j, shared[i]) for j in own[i:]), *shared[i]] for i in own]
        upper += [list(covariance[k, k:]) for k in more]
        counts, sides = [*self.counts, len(more)], [*self.positive, positive]
        root = np.sqrt(noise)
        return Moments(counts, sides, [one / root for one in (*now, *mean)], upper)


@dataclass(frozen=True)
class Remainders:
    """Covariances of what lies outside the catalogue.

    Parameters
    ----------
    covariances : Covariances
    weights : tuple of (pattern, law, weight)
        Number of a covariance, number of a size of the law or None, and prior probability given
        that there is something outside; the first of all stands for nothing outside.
    laws : ndarray
        Sizes of the law.
    """

    covariances: Covariances
    weights: tuple[tuple[int, int | None, float], ...]
    laws: Array

    @property
    def power(self) -> Array:
        """Mean square of each, in units of the noise, shape (parts,)."""
        covariances = self.covariances
        levels = np.pad(covariances.levels, ((0, 0), (1, 0)))  # the first is none
        smooth = np.array(
            [np.mean([levels[b, k] for b, k in enumerate(p)]) for p in covariances.patterns]
        )
        law = [0.0 if j is None else float(self.laws[j] ** 2) for _, j, _ in self.weights]
        return np.asarray(smooth[[k for k, _, _ in self.weights]] + np.array(law))

    @classmethod
    def of(cls, covariances: Covariances, laws: Array) -> Remainders:
        """Half of what is outside is a function of phase alone, half a law with or without one."""
        patterns, sizes = len(covariances.patterns), laws.size
        together = range(1, 1 + covariances.levels.shape[1])
        found: list[tuple[int, int | None, float]] = [(0, None, 0.0)]
        found += [(k, None, 0.5 / (patterns - 1)) for k in range(1, patterns)]
        found += [(0, j, 0.25 / sizes) for j in range(sizes)]
        found += [(k, j, 0.25 / sizes / len(together)) for k in together for j in range(sizes)]
        return cls(covariances, tuple(found), laws)

    def parts(self, reduced: Reduced, keep: Sequence[int], law: Sequence[int]) -> Reduced:
        """Some columns for each covariance in turn, after a law is integrated out."""
        size = len(law)
        patterns = [k for k, _, _ in self.weights]
        grown = reduced.of_some(patterns, [*law, *keep])
        power = np.array([0.0 if j is None else self.laws[j] ** 2 for _, j, _ in self.weights])
        some = np.repeat(power[:, None], size, axis=1)
        return grown.with_columns(range(size), some, range(size, size + len(keep)))

    def split(self, logs: Array) -> tuple[Array, Array]:
        """Log evidence without, and with something outside, from that of all parts (parts, ...)."""
        weights = np.array([w for _, _, w in self.weights[1:]])
        shape = (-1, *(1,) * (logs.ndim - 1))
        return logs[0], logsumexp(logs[1:], axis=0, b=weights.reshape(shape))

    def similar(self, logs: Array, sizes: Array) -> Array:
        """Log evidence of a law that resembles an effect, from that of all parts and sizes of the
        effect (parts, ..., sizes): it differs from it by some part of the effect's size."""
        share = np.log([w for _, _, w in self.weights[1:]])[:, None]
        share = share + log_difference(np.sqrt(self.power[1:, None]) / sizes)
        share = share - logsumexp(share, axis=0)
        shape = (len(share), *(1,) * (logs.ndim - 2), sizes.size)
        return np.asarray(logsumexp(logs[1:] + share.reshape(shape), axis=0))


def log_difference(ratio: Array) -> Array:
    """Log prior of the size of the difference of a law from an effect, over the effect's size."""
    return np.asarray(-0.5 * (np.log(ratio / DIFFERENCE) / DIFFERENCE_SPREAD) ** 2)


@dataclass(frozen=True)
class Likelihood:
    """Student's density of a residual whose noise is known to some degrees of freedom.

    Parameters
    ----------
    count : int
        Number of coefficients.
    freedom : float
        Of the measured noise.
    """

    count: int
    freedom: float

    def __call__(self, square: Array, log_det: Array) -> Array:
        """Log density but for a constant, of any shape."""
        exponent = 0.5 * (self.freedom + self.count)
        spread = np.maximum(square, 0.0) / self.freedom
        return np.asarray(-0.5 * log_det - exponent * np.log1p(spread))

    def noise(self, square: Array) -> Array:
        """Variance of the noise over that measured: the harmonic mean of its posterior."""
        return np.asarray((self.freedom + np.maximum(square, 0.0)) / (self.freedom + self.count))


@dataclass(frozen=True)
class Group:
    """Columns of one effect at one set of its shapes.

    Parameters
    ----------
    columns : tuple of int
    positive : float
        Prior probability that the size is above zero; one or zero where only one side is physical.
    """

    columns: tuple[int, ...]
    positive: float = 0.5


def effect_evidence(
    parts: Reduced, likelihood: Likelihood, groups: Sequence[Group], sizes: Array
) -> Array:
    """Log evidence of one effect at each size, shape (P, groups, sizes).

    Parameters
    ----------
    parts : Reduced
    likelihood : Likelihood
    groups : sequence of Group
        Effects, each as the only one.
    sizes : ndarray, shape (T,)
        ``tau``, in units of the columns.
    """
    rough = rough_evidence(parts, likelihood, groups, sizes)
    return rough.exact(np.ones(rough.value.shape, dtype=bool))


def rough_evidence(
    parts: Reduced, likelihood: Likelihood, groups: Sequence[Group], sizes: Array
) -> Rough:
    """The same but for likely sides and correlations of moments."""
    value = np.empty((len(parts.square), len(groups), sizes.size))
    single = np.array([k for k, g in enumerate(groups) if len(g.columns) == 1], dtype=int)
    several = [k for k, g in enumerate(groups) if len(g.columns) > 1]
    found = []
    if single.size:
        found.append((single, _singly(parts, likelihood, [groups[k] for k in single], sizes)))
    found += [(np.array([k]), _together(parts, likelihood, groups[k], sizes)) for k in several]
    moments = []
    for index, (density, moment) in found:
        value[:, index] = density + moment.even()
        moments.append((index, density, moment))
    return Rough(value, moments)


def moment_power(sizes: Array, columns: int | Array) -> Array:
    """Variances of the normal part of a moment density, by its root mean square: the mean square of
    all of ``n`` amplitudes under ``b' b N(b; 0, v I)`` is ``(n + 2) v``."""
    return np.asarray(sizes**2 / (columns + 2))


def log_moment(positive: Array | float, distance: Array | float) -> Array:
    """Logarithm of the mean of ``(b / s)^2`` over a normal density of ``b`` with standard deviation
    ``s``, where a prior is higher on one side of zero, by the distance of its mean from zero in
    standard deviations."""
    away = np.asarray(distance, dtype=float)
    shares = np.broadcast_to(np.asarray(positive, dtype=float), away.shape)
    # Both parts together, whatever the distance: most effects have no likely side.
    found = np.array(np.log1p(away**2))
    uneven = shares != 0.5
    if uneven.any():
        found[uneven] = _uneven_moment(shares[uneven], away[uneven])
    return found


def _uneven_moment(positive: Array, distance: Array) -> Array:
    """The same with a likely side of zero."""
    size = np.abs(distance)
    likely = np.where(distance > 0, positive, 1.0 - positive)
    with np.errstate(divide="ignore"):  # one side may be impossible
        found = np.log1p(size**2) + np.log(2.0 * likely)
        # The other side counts where it is near, or is the only one.
        both = (size < NEAR) | (likely == 0.0)
        size, likely = size[both], likely[both]
        near = np.minimum(size, FAR)
        # Its part is (d^2 + 1) Phi(-d) - d phi(d). Both terms nearly cancel: exp(-d^2 / 2) is taken
        # out. Beyond, the first term of the series, 2 phi(d) / d^3.
        scaled = 0.5 * (near**2 + 1.0) * erfcx(near / np.sqrt(2.0)) - near / np.sqrt(2.0 * np.pi)
        beyond = np.log(scaled) - 0.5 * size**2 - 3.0 * np.log(np.maximum(size, FAR) / FAR)
        here = np.log1p(size**2 - np.exp(beyond))
        found[both] = np.logaddexp(np.log(likely) + here, np.log1p(-likely) + beyond) + _LOG_2
    return np.asarray(found)


@dataclass(frozen=True)
class Moments:
    """What the product of effects' moments follows from, see :func:`log_moments`."""

    counts: Sequence[int]
    positive: Sequence[Array | float]
    mean: Sequence[Array]
    upper: Sequence[Sequence[Array]]

    def even(self) -> Array:
        """Logarithm, if there were no likely sides and no correlations of effects."""
        found, start = np.asarray(0.0), 0
        for count in self.counts:
            place = range(start, start + count)
            found = found + np.log(sum(self.mean[c] ** 2 + self.upper[c][0] for c in place) / count)
            start += count
        return np.asarray(found)

    def at(self, where: NDArray[np.bool_]) -> Array:
        """Logarithm at some elements of the whole shape, in their order."""

        def chosen(values: Array | float) -> Array | float:
            if np.ndim(values) == 0:
                return values
            return np.asarray(np.broadcast_to(values, where.shape)[where])

        mean = [np.asarray(chosen(one)) for one in self.mean]
        upper = [[np.asarray(chosen(one)) for one in row] for row in self.upper]
        return log_moments(self.counts, [chosen(one) for one in self.positive], mean, upper)


@dataclass(frozen=True)
class Rough:
    """Log evidence of effects but for likely sides and correlations of their moments.

    Parameters
    ----------
    value : ndarray, shape (P, groups, ...)
    moments : sequence of (index, density, Moments)
        Those of some of the groups, beside the density without them, of shape
        (P, groups of the index, ...).
    """

    value: Array
    moments: Sequence[tuple[Integers, Array, Moments]]

    def exact(self, where: NDArray[np.bool_]) -> Array:
        """The same, exact at some elements."""
        found = self.value.copy()
        for index, density, moments in self.moments:
            here = where[:, index]
            if here.any():
                some = found[:, index]
                some[here] = density[here] + moments.at(here)
                found[:, index] = some
        return found


def exact_where_it_counts(rough: Sequence[Rough], labels: Integers) -> Array:
    """Log evidence of effects, with rough values where they are nothing of the whole.

    Parameters
    ----------
    rough : sequence of Rough, length m
        Of the same groups, for instance by size of an anchor's own effects.
    labels : ndarray of int, shape (groups,)
        Effect of each group; each effect counts by itself, and without and with something outside.

    Returns
    -------
    ndarray, shape (P, m, groups, ...)
    """
    each = np.stack([one.value for one in rough], axis=1)
    best = _best_of(each, labels)
    # Where a side is impossible the best of the rough values may be nothing: look once more.
    found, done = each, np.zeros(each.shape, dtype=bool)
    for _ in range(2):
        near = (each > best - SMALL_SHARE) & ~done
        if near.any():
            exact = np.stack([one.exact(near[:, k]) for k, one in enumerate(rough)], axis=1)
            found, done = np.where(near, exact, found), done | near
        best = _best_of(np.where(done, found, -np.inf), labels)
    return found


def _best_of(values: Array, labels: Integers) -> Array:
    """Largest of each effect's values, without and with something outside, to be compared."""
    rest = tuple(range(3, values.ndim))
    by_group = values.max(axis=(1, *rest))  # (P, groups)
    found = np.empty_like(by_group)
    for part in (slice(0, 1), slice(1, None)):
        if not by_group[part].size:
            continue
        top = by_group[part].max(axis=0)
        for label in np.unique(labels):
            found[part, labels == label] = top[labels == label].max()
    return np.expand_dims(found, (1, *rest))


def log_moments(
    counts: Sequence[int],
    positive: Sequence[Array | float],
    mean: Sequence[Array],
    upper: Sequence[Sequence[Array]],
) -> Array:
    """Logarithm of the mean of the product of effects' moments, each the mean square of its
    amplitudes.

    That of two effects is exact where one of them at most has a likely side. Of more effects, and
    of two likely sides, correlations count by pairs.

    Parameters
    ----------
    counts : sequence of int
        Amplitudes of each effect.
    positive : sequence of float or ndarray
        Prior probability that its size is above zero.
    mean : sequence of ndarray
        Of each amplitude.
    upper : sequence of sequence of ndarray
        Rows of their covariance, each from the diagonal on.
    """
    ends = np.cumsum(counts)
    members = [range(end - count, end) for end, count in zip(ends, counts, strict=True)]
    squares = [sum(mean[c] ** 2 + upper[c][0] for c in k) / len(k) for k in members]

    def shared(a: int, b: int) -> Array:
        return upper[min(a, b)][abs(a - b)]

    product, sided = np.asarray(1.0), np.asarray(0.0)
    distances: dict[int, Array] = {}  # of effects with a likely side
    for k, (place, side, square) in enumerate(zip(members, positive, squares, strict=True)):
        product = product * square
        if len(place) == 1 and np.any(np.not_equal(side, 0.5)):
            distances[k] = mean[place[0]] / np.sqrt(upper[place[0]][0])
            sided = sided + log_moment(side, distances[k]) - np.log1p(distances[k] ** 2)
    for i, j in combinations(range(len(counts)), 2):
        likely = [(k, other) for k, other in ((i, j), (j, i)) if k in distances]
        for k, other in likely:
            (a,) = members[k]
            root = np.sqrt(upper[a][0])
            given = [(mean[b], shared(a, b) / root, upper[b][0]) for b in members[other]]
            ratio = _square_given(positive[k], distances[k], given) / squares[other]
            sided = sided + np.log(ratio) / len(likely)
        if not likely:
            # E[x^2 y^2] - E[x^2] E[y^2] of normal x and y.
            between = sum(
                shared(a, b) * (shared(a, b) + 2.0 * mean[a] * mean[b])
                for a in members[i]
                for b in members[j]
            )
            size = 0.5 * counts[i] * counts[j]
            product = product * (1.0 + between / (size * squares[i] * squares[j]))
    return np.asarray(np.log(product) + sided)


def _square_given(
    positive: Array | float, distance: Array, given: Sequence[tuple[Array, Array, Array]]
) -> Array:
    """Mean square of amplitudes under the moment of another one ``u``, which has a likely side.

    An amplitude is a straight line in ``u`` but for a rest that is independent of it, so that the
    means of ``u^3`` and ``u^4`` over that of ``u^2`` are all that is needed.

    Parameters
    ----------
    positive : float or ndarray
    distance : ndarray
        Mean of ``u``, whose standard deviation is one.
    given : sequence of (mean, slope, variance)
        Of each amplitude; the slope is its covariance with ``u``.
    """
    third, fourth = _higher_moments(positive, distance)
    total = np.asarray(0.0)
    for mean, slope, variance in given:
        start = mean - slope * distance
        rest = np.maximum(variance - slope**2, 0.0)
        total = total + start**2 + rest + 2.0 * start * slope * third + slope**2 * fourth
    return np.asarray(total / len(given))


def _higher_moments(positive: Array | float, distance: Array) -> tuple[Array, Array]:
    """Means of ``u^3`` and ``u^4`` over that of ``u^2``, of a normal ``u`` with unit variance whose
    sides of zero have different weights."""
    square = distance**2
    third = np.array(distance * (square + 3.0) / (square + 1.0))
    fourth = np.array(((square + 6.0) * square + 3.0) / (square + 1.0))
    above = np.broadcast_to(np.asarray(positive, dtype=float), distance.shape)
    # The other side counts where it is near, or is the only one.
    only = np.where(distance > 0, above, 1.0 - above) == 0.0
    both = (above != 0.5) & ((np.abs(distance) < NEAR) | only)
    if both.any():
        up, down = (_half_moments(sign * distance[both]) for sign in (1.0, -1.0))
        weight = above[both]
        second, cube, power = (
            weight * a + sign * (1.0 - weight) * b
            for sign, a, b in zip((1.0, -1.0, 1.0), up, down, strict=True)
        )
        third[both], fourth[both] = cube / second, power / second
    return third, fourth


def _half_moments(distance: Array) -> tuple[Array, Array, Array]:
    """Means of ``u^2``, ``u^3`` and ``u^4`` over ``u > 0``, divided by the normal density at the
    distance of its mean from zero."""
    # Beyond, the terms of the far side cancel; the ratios hardly depend on the distance there.
    d = np.clip(distance, -FARTHEST, FARTHEST)
    tail = np.sqrt(0.5 * np.pi) * erfcx(-d / np.sqrt(2.0))
    square = d * d
    return (
        (square + 1.0) * tail + d,
        d * (square + 3.0) * tail + square + 2.0,
        ((square + 6.0) * square + 3.0) * tail + d * (square + 5.0),
    )


def _singly(
    parts: Reduced, likelihood: Likelihood, groups: Sequence[Group], sizes: Array
) -> tuple[Array, Moments]:
    """Log density of effects with one unknown each, shape (P, groups, sizes), and its moments."""
    index = np.array([group.columns[0] for group in groups], dtype=int)
    positive = np.array([group.positive for group in groups])[:, None]
    power = moment_power(sizes, 1)
    slope = parts.slope[:, index, None]
    grown = 1.0 + power * np.maximum(parts.gram[:, index, index, None], 0.0)
    gain = power * slope**2 / grown
    logs = parts.log_det[:, None, None] + np.log(grown)
    square = parts.square[:, None, None] - gain
    value, noise = likelihood(square, logs), likelihood.noise(square)
    mean, variance = power * slope / grown, power / grown
    if parts.own is None:
        moment = Moments([1], [positive], [mean / np.sqrt(noise)], [[variance]])
    else:
        posterior = mean[None], variance[None, None], noise
        moment = parts.own.beside(index[:, None], positive, *posterior)
    return np.asarray(value - np.log(power)), moment


def _together(
    parts: Reduced, likelihood: Likelihood, group: Group, sizes: Array
) -> tuple[Array, Moments]:
    """Log density of an effect with several unknowns, shape (P, 1, sizes), and its moments."""
    index = np.array(group.columns)
    values, vectors = np.linalg.eigh(parts.gram[:, index[:, None], index])
    turned = (np.swapaxes(vectors, 1, 2) @ parts.slope[:, index, None])[:, None, :, 0]
    power = moment_power(sizes, index.size)[:, None]
    spread = power / (1.0 + power * np.maximum(values, 0.0)[:, None])  # (P, sizes, unknowns)
    gain = np.sum(spread * turned**2, axis=2)
    logs = parts.log_det[:, None] - np.log(spread / power).sum(axis=2)
    square = parts.square[:, None] - gain
    value, noise = likelihood(square, logs) - np.log(power[:, 0]), likelihood.noise(square)
    if parts.own is None:
        # Turned amplitudes are independent; the mean of their squares is that of the others.
        means = np.moveaxis(spread * turned / np.sqrt(noise[:, :, None]), 2, 0)[:, :, None]
        upper = [[row[:, None]] for row in np.moveaxis(spread, 2, 0)]
        return value[:, None], Moments([index.size], [0.5], list(means), upper)
    mean = np.einsum("pab,ptb->apt", vectors, spread * turned)
    covariance = np.einsum("pab,ptb,pcb->acpt", vectors, spread, vectors)
    posterior = mean[:, :, None], covariance[:, :, :, None], noise[:, None]
    return value[:, None], parts.own.beside(index[None], 0.5, *posterior)


def pair_evidence(
    parts: Reduced, likelihood: Likelihood, one: Group, others: Sequence[Group], sizes: Array
) -> Array:
    """Log evidence of an effect together with each of others, of one unknown each.

    Returns
    -------
    ndarray, shape (P, others, sizes, sizes)
    """
    rough = rough_pairs(parts, likelihood, one, others, sizes)
    return rough.exact(np.ones(rough.value.shape, dtype=bool))


def rough_pairs(
    parts: Reduced, likelihood: Likelihood, one: Group, others: Sequence[Group], sizes: Array
) -> Rough:
    """The same but for likely sides and correlations of moments."""
    (i,), index = one.columns, np.array([group.columns[0] for group in others], dtype=int)
    root = np.sqrt(moment_power(sizes, 1))

    def wide(values: Array) -> Array:
        """With axes for the sizes of both."""
        return np.asarray(values[..., None, None])

    # Slopes and products in units of the prior: rows for the sizes of one, columns for the others.
    first = root[:, None] * wide(parts.slope[:, i, None])
    second = root * wide(parts.slope[:, index])
    own = 1.0 + root[:, None] ** 2 * wide(np.maximum(parts.gram[:, i, i, None], 0.0))
    its = 1.0 + root**2 * wide(np.maximum(parts.gram[:, index, index], 0.0))
    mixed = np.multiply.outer(root, root) * wide(parts.gram[:, i, index])
    det = np.maximum(own * its - mixed**2, 1e-12 * own * its)
    gain = (its * first**2 + own * second**2 - 2.0 * mixed * first * second) / det
    square = wide(parts.square[:, None]) - gain
    found = likelihood(square, wide(parts.log_det[:, None]) + np.log(det))
    noise = np.sqrt(likelihood.noise(square))
    means = (its * first - mixed * second) / det, (own * second - mixed * first) / det
    upper = [[its / det, -mixed / det], [own / det]]
    positive = np.array([group.positive for group in others])[:, None, None]
    moments = Moments([1, 1], [one.positive, positive], [m / noise for m in means], upper)
    return Rough(found + moments.even(), [(np.arange(len(others)), found, moments)])


def mean_of(logs: Array) -> float:
    """Logarithm of the mean of what logarithms are given of."""
    flat = np.ravel(logs)
    return float(logsumexp(flat) - np.log(flat.size))


def sizes_between(largest: float, samples: int, count: int = SIZES) -> Array:
    """Sizes, equally many in each decade, from the smallest visible change to the signal's.

    Parameters
    ----------
    largest : float
        Root mean square of the signal in units of the noise of a sample.
    samples : int
        Of all runs and outputs.
    count : int
    """
    least = VISIBLE / np.sqrt(samples)
    return np.geomspace(least, max(largest, 10 * least), count)


def fewer(sizes: Array, count: int = LAW_SIZES) -> Array:
    """Fewer sizes over the same range."""
    return np.geomspace(sizes[0], sizes[-1], count)
