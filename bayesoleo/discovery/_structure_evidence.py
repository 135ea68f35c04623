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
smallest change that could be seen to the size of the signal itself. The measured noise is itself
uncertain, which makes the density Student's.

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

import numpy as np
from scipy.special import erfcx, log_ndtr, logsumexp

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
#: Standard deviations beyond which a tail is its first asymptotic term, to 5e-4 of it.
FAR = 100.0
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
    """

    gram: Array
    slope: Array
    square: Array
    log_det: Array

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
        )

    def with_effects(self, groups: Sequence[Sequence[int]], sizes: Sequence[float]) -> Reduced:
        """The same with effects that act in the covariance, whose columns come first and are left
        out.

        Parameters
        ----------
        groups : sequence of sequence of int
            Columns of each effect.
        sizes : sequence of float
            Root mean squares of their moment densities. An amplitude's moment is that which the
            data give it beside the other effects, before any further column is added.
        """
        inner = [column for group in groups for column in group]
        counts = np.array([len(group) for group in groups])
        power = np.repeat(moment_power(np.array(sizes), counts), counts)
        root, index = np.sqrt(power), np.array(inner, dtype=int)
        precision = np.eye(index.size) + root[:, None] * self.gram[:, index[:, None], index] * root
        covariance = np.linalg.inv(precision)
        mean = (covariance @ (root * self.slope[:, index])[:, :, None])[:, :, 0]
        square = mean**2 + np.diagonal(covariance, axis1=1, axis2=2)
        place = {column: k for k, column in enumerate(inner)}
        moments = [np.log(square[:, [place[c] for c in group]].mean(axis=1)) for group in groups]
        rest = [k for k in range(self.size) if k not in place]
        found = self.with_columns(inner, power, rest)
        return replace(found, log_det=found.log_det - 2.0 * np.sum(moments, axis=0))

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
    power = moment_power(sizes, 1)
    found = np.empty((len(parts.square), len(groups), sizes.size))
    single = [k for k, group in enumerate(groups) if len(group.columns) == 1]
    index = np.array([groups[k].columns[0] for k in single], dtype=int)
    square, logs = parts.square[:, None, None], parts.log_det[:, None, None]
    if single:
        positive = np.array([groups[k].positive for k in single])[:, None]
        slope = parts.slope[:, index, None]
        grown = 1.0 + power * np.maximum(parts.gram[:, index, index, None], 0.0)
        value = likelihood(square - power * slope**2 / grown, logs + np.log(grown))
        distance = slope * np.sqrt(power / grown)
        found[:, single] = value + log_moment(positive, distance) - np.log(grown)
    for k, group in enumerate(groups):
        if len(group.columns) > 1:
            found[:, k] = _together(parts, likelihood, group, sizes)
    return found


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


def by_side(positive: Array | float, distance: Array | float) -> Array:
    """What a prior adds that is higher on one side of zero, by the distance from zero in standard
    deviations."""
    with np.errstate(divide="ignore"):  # one side may be impossible
        above, below = np.log(positive), np.log1p(-np.asarray(positive))
    sides = np.logaddexp(above + log_ndtr(distance), below + log_ndtr(-np.asarray(distance)))
    return np.asarray(_LOG_2 + sides)


def _together(parts: Reduced, likelihood: Likelihood, group: Group, sizes: Array) -> Array:
    """Log evidence of an effect with several unknowns, shape (P, sizes)."""
    index = np.array(group.columns)
    values, vectors = np.linalg.eigh(parts.gram[:, index[:, None], index])
    turned = (np.swapaxes(vectors, 1, 2) @ parts.slope[:, index, None])[:, None, :, 0] ** 2
    power = moment_power(sizes, index.size)[:, None]
    grown = 1.0 + power * np.maximum(values, 0.0)[:, None]
    gain = np.sum(power * turned / grown, axis=2)
    logs = parts.log_det[:, None] + np.log(grown).sum(axis=2)
    moment = np.mean(power * turned / grown**2 + 1.0 / grown, axis=2)
    return np.asarray(likelihood(parts.square[:, None] - gain, logs) + np.log(moment))


def pair_evidence(
    parts: Reduced, likelihood: Likelihood, one: Group, others: Sequence[Group], sizes: Array
) -> Array:
    """Log evidence of an effect together with each of others, of one unknown each.

    Returns
    -------
    ndarray, shape (P, others, sizes, sizes)
    """
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
    found = likelihood(
        wide(parts.square[:, None]) - gain, wide(parts.log_det[:, None]) + np.log(det)
    )
    # Each amplitude by itself: the two are nearly independent where both are seen.
    here = (its * first - mixed * second) / np.sqrt(its * det)
    there = (own * second - mixed * first) / np.sqrt(own * det)
    positive = np.array([group.positive for group in others])[:, None, None]
    moments = log_moment(one.positive, here) + log_moment(positive, there)
    return np.asarray(found + moments + np.log(own * its / det**2))


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
