"""Columns of effects, reduced over covariances of the noise and of what no effect describes.

What a structure makes of the data depends on products of columns alone: unknowns, effects that act
and a law outside the catalogue are integrated out of them in turn. The model of which these are the
parts is that of :mod:`bayesoleo.discovery._structure_evidence`.

References
----------
Rasmussen and Williams (2006), *Gaussian Processes for Machine Learning*, eqs. A.9-A.10, for the
lemma by which unknowns are integrated out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from bayesoleo._types import Array, Integers
from bayesoleo.discovery._structure_moments import log_moments

#: Sizes of one effect, of the law outside the catalogue, and of the remainder over phase.
SIZES, LAW_SIZES, SMOOTH_SIZES = 10, 5, 5
#: Standard deviations by which the smallest change of interest differs from nothing: about the size
#: at which a score is significant in half of all campaigns, among sixty candidates.
VISIBLE = 4.0
#: Difference of a law from the effect that it resembles, as a part of the effect's size, and the
#: spread of its logarithm.
DIFFERENCE, DIFFERENCE_SPREAD = 0.25, 1.2


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

    def products(self, rows: Array, count: int | None = None) -> tuple[Array, Array]:
        """``X V^-1 X'`` of rows ``X (p, n)`` for each pattern (patterns, p, p), and ``ln det V``
        (patterns,); of the first patterns only, if a count of them is given."""
        patterns = self.patterns[:count]
        grams: dict[tuple[int, int], Array] = {}
        logs: dict[tuple[int, int], float] = {}
        for b in range(len(self.levels)):
            own = self.output_of == b
            chosen = rows[:, own]
            for k in sorted({pattern[b] for pattern in patterns}):
                level = self.levels[b, k - 1] if k else 0.0
                variance = self.variance[own] + level * self.smooth[own]
                white = chosen / np.sqrt(variance)
                grams[b, k] = white @ white.T
                logs[b, k] = float(np.log(variance).sum())
        found = np.zeros((len(patterns), len(rows), len(rows)))
        for q, pattern in enumerate(patterns):
            for place in enumerate(pattern):
                found[q] += grams[place]
        total = [sum(logs[place] for place in enumerate(pattern)) for pattern in patterns]
        return found, np.array(total)


@dataclass(frozen=True)
class Reduced:
    """Columns after the unknowns are integrated out, for ``P`` covariances.

    Parameters
    ----------
    gram : ndarray, shape (P, k, k)
        ``C' V^-1 C`` with ``V`` the covariance of noise, remainder and unknowns, and of no effect:
        few products are asked for beside effects that act, which :meth:`products` gives.
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

    def products(self, rows: Integers, columns: Integers) -> Array:
        """``C' V^-1 C`` of some columns with others, which are given by indices that broadcast,
        shape (P, ...)."""
        found = self.gram[:, rows, columns]
        if self.own is None:
            return found
        white = self.own.white
        return np.asarray(
            found - np.einsum("pm...,pm...->p...", white[:, :, rows], white[:, :, columns])
        )

    def with_effects(self, groups: Sequence[Group], sizes: Sequence[float]) -> Reduced:
        """The same with effects that act in the covariance, whose columns are left out.

        Parameters
        ----------
        groups : sequence of Group
            Of each effect.
        sizes : sequence of float
            Root mean squares of their moment densities.
        """
        return self.by_sizes(groups, [sizes])[0]

    def by_sizes(
        self, groups: Sequence[Group], several: Sequence[Sequence[float]]
    ) -> list[Reduced]:
        """The same for one set of sizes after the other."""
        assert self.own is None  # those of one model, all together
        inner, rest = _inner_and_rest(groups, self.size)
        counts = np.array([len(group.columns) for group in groups])
        power = np.repeat(moment_power(np.array(several), counts), counts, axis=1)
        root = np.sqrt(power)[:, None, :, None]
        along = self.gram[:, inner]
        unit = np.eye(power.shape[1])
        lower = root_of(unit + root * along[:, :, inner] * np.swapaxes(root, 2, 3), 1.0)
        half = np.linalg.solve(lower, unit)
        rows = np.concatenate([self.slope[:, inner, None], along[:, :, rest]], axis=2)
        white = half @ (root * rows)  # (sizes, P, m, 1 + k)
        turned = np.swapaxes(half, 2, 3)
        covariance, moved = turned @ half, turned @ white
        first, others = white[..., 0], white[..., 1:]
        gram, slope = self.gram[:, rest][:, :, rest], self.slope[:, rest]
        slope = slope - np.einsum("tpm,tpmk->tpk", first, others)
        square = self.square - np.sum(first**2, axis=2)
        log_det = self.log_det + 2.0 * np.log(np.diagonal(lower, axis1=2, axis2=3)).sum(axis=2)
        found = []
        for t in range(len(several)):
            mean, gain = moved[t, :, :, 0].T, np.moveaxis(moved[t, :, :, 1:], 0, 1)
            spread = np.moveaxis(covariance[t], 0, 2)
            own = Amplitudes(tuple(groups), mean, spread, gain, others[t])
            found.append(Reduced(gram, slope[t], square[t], log_det[t], own))
        return found

    def log_moment(self, likelihood: Likelihood) -> Array:
        """Logarithm of the moment of effects that act, if nothing else does, shape (P,)."""
        own = self.own
        if own is None:
            return np.zeros(len(self.square))
        mean = own.mean / np.sqrt(likelihood.noise(self.square))
        return log_moments(own.counts, own.positive, mean, own.covariance)

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
        lower = root_of(np.eye(chosen.size) + inner, 1.0)
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


def root_of(matrices: Array, least: float) -> Array:
    """Lower triangular roots of symmetric matrices ``(..., m, m)`` with known least eigenvalues.

    Where columns are nearly the same and far above the noise, round-off is larger than the least
    eigenvalue, and the matrix as computed is not positive definite. Its eigenvalues are then raised
    to what they are at least.

    Parameters
    ----------
    matrices : ndarray, shape (..., m, m)
    least : float
        No eigenvalue is smaller but for round-off.
    """
    try:
        return np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrices)
        sizes = np.sqrt(np.maximum(values, least))
        rows = sizes[..., :, None] * np.swapaxes(vectors, -1, -2)
        triangle = np.linalg.qr(rows, mode="r")
        sign = np.where(np.diagonal(triangle, axis1=-2, axis2=-1) < 0.0, -1.0, 1.0)
        return np.asarray(np.swapaxes(triangle * sign[..., :, None], -1, -2))


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
    white : ndarray, shape (P, m, k)
        Products of these rows with each other are what the effects take from those of the further
        columns.
    """

    groups: tuple[Group, ...]
    mean: Array
    covariance: Array
    gain: Array
    white: Array

    @property
    def counts(self) -> list[int]:
        """Columns of each effect."""
        return [len(group.columns) for group in self.groups]

    @property
    def positive(self) -> list[float]:
        """Prior probabilities that their sizes are above zero."""
        return [group.positive for group in self.groups]

    def of_some(self, parts: Integers, columns: Integers) -> Amplitudes:
        """The same for some covariances and further columns."""
        gain, white = self.gain[:, parts[:, None], columns], self.white[parts][:, :, columns]
        return Amplitudes(
            self.groups, self.mean[:, parts], self.covariance[:, :, parts], gain, white
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
        weights = np.log([w for _, _, w in self.weights[1:]])
        shape = (-1, *(1,) * (logs.ndim - 1))
        return logs[0], log_sum(logs[1:] + weights.reshape(shape))

    def similar(self, logs: Array, sizes: Array) -> Array:
        """Log evidence of a law that resembles an effect, from that of all parts and sizes of the
        effect (parts, ..., sizes): it differs from it by some part of the effect's size."""
        share = np.log([w for _, _, w in self.weights[1:]])[:, None]
        share = share + log_difference(np.sqrt(self.power[1:, None]) / sizes)
        share = share - logsumexp(share, axis=0)
        shape = (len(share), *(1,) * (logs.ndim - 2), sizes.size)
        return log_sum(logs[1:] + share.reshape(shape))


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


def _inner_and_rest(
    groups: Sequence[Group], size: int
) -> tuple[slice | list[int], slice | list[int]]:
    """Columns of some groups, and all others of so many: where the former come first nothing is
    copied."""
    inner = [column for group in groups for column in group.columns]
    if inner == list(range(len(inner))):
        return slice(0, len(inner)), slice(len(inner), None)
    return inner, [k for k in range(size) if k not in inner]


def in_a_row(groups: Sequence[Group], start: int) -> tuple[Group, ...]:
    """Groups with their columns one after the other."""
    found = []
    for group in groups:
        end = start + len(group.columns)
        found.append(Group(tuple(range(start, end)), group.positive))
        start = end
    return tuple(found)


def moment_power(sizes: Array, columns: int | Array) -> Array:
    """Variances of the normal part of a moment density, by its root mean square: the mean square of
    all of ``n`` amplitudes under ``b' b N(b; 0, v I)`` is ``(n + 2) v``."""
    return np.asarray(sizes**2 / (columns + 2))


def log_sum(logs: Array) -> Array:
    """Logarithm of the sum over the first axis of what logarithms are given of; quicker than
    SciPy's function, which also takes complex numbers."""
    top = np.max(logs, axis=0, initial=-np.inf)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):  # there may be nothing
        return np.asarray(np.log(np.sum(np.exp(logs - top), axis=0)) + top)


def log_sum_of(logs: Sequence[float]) -> float:
    """The same of a few numbers, of which arrays would take most of the time."""
    if not all(map(math.isfinite, logs)):
        return float(log_sum(np.array(logs)))
    top = max(logs)
    return top + math.log(sum(math.exp(one - top) for one in logs))


def mean_of(logs: Array) -> float:
    """Logarithm of the mean of what logarithms are given of."""
    flat = np.ravel(logs)
    return float(log_sum(flat) - np.log(flat.size))


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
