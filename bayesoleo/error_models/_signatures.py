"""Signatures of the effects that a model might lack: what each would change in the outputs.

A signature is the derivative of the outputs with respect to an effect's parameter, at the null and
at the estimate. It covers all runs and outputs, because a physical law is the same in all of them.
Signatures are computed once, at the estimate, and kept: the density that uses them is then a
function of the parameters alone.

The second half is the linear algebra of errors that are a sum of noise and of few functions, some
of which runs share. Residuals are projected on an orthogonal basis of the smooth functions of each
run, and on the numerical range of all signatures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dtrtrs

from bayesoleo._compiled import jit
from bayesoleo._types import Array, Flags, Integers

#: Harmonics of the remainder, and lengths in cycles whose spectra it averages.
HARMONICS, LENGTHS = 6, (0.05, 0.1, 0.2)
#: Squared size over all samples, in units of the noise and at size one, below which a direction of
#: the signatures is left out: it changes a standard deviation by less than a twentieth.
NEGLIGIBLE = 0.1
#: Points of one period, or of a transient's length, at which a run's signatures are kept for draws.
POINTS = 256


@dataclass(frozen=True)
class Signatures:
    """What ``k`` effects would change in the outputs, and the noise that they are compared with.

    Parameters
    ----------
    names : tuple of str, length k
        The effects; one that was scanned over shapes has several signatures.
    runs : tuple of str, length N
        The fitted runs.
    columns : tuple of ndarray, each shape (s, k, n), length N
        Signatures at the samples of the fitted runs, in the outputs' units. Their scale is that of
        the prior: at size one, coefficients are independent with unit variance.
    noise : ndarray, shape (s,)
        Standard deviation of a sample's noise; the unit of an effect's size.
    colour : tuple of (float, float), length s
        Correlated share of the noise and its correlation time; a share of zero is white noise.
    curves : mapping of str to ndarray, shape (s, k, POINTS)
        By run, held-out runs included: the same at equidistant points of a period, counted from
        the first sample, or of a transient's length, both ends included.
    share : ndarray, shape (k,)
        Part of each signature's scale that is its share of the prior variance: columns divided by
        its root have the unit size at which one effect acts alone.
    single : ndarray of int, shape (q,)
        Signatures of effects that may act alone, one for those that are nearly alike.
    odds : ndarray, shape (q,)
        Prior probability of each, given that one acts alone; they sum to one.
    origins : mapping of str to float
        By run, cycles from the crest of the run's input to its first sample.
    largest : float
        Largest size that is believed, in units of the noise.
    """

    names: tuple[str, ...]
    runs: tuple[str, ...]
    columns: tuple[Array, ...]
    noise: Array
    colour: tuple[tuple[float, float], ...]
    curves: Mapping[str, Array]
    share: Array
    single: Integers
    odds: Array
    origins: Mapping[str, float]
    largest: float = 30.0

    def without_columns(self) -> Signatures:
        """The same without the samples, which take most of the memory."""
        return replace(self, columns=())

    def keeping(self, kept: Flags) -> Signatures:
        """Some of the signatures, kept (k,)."""
        place = np.cumsum(kept) - 1
        alone = kept[self.single]
        odds = self.odds[alone]
        return replace(
            self,
            names=tuple(name for name, keep in zip(self.names, kept, strict=True) if keep),
            columns=tuple(block[:, kept] for block in self.columns),
            curves={run: block[:, kept] for run, block in self.curves.items()},
            share=self.share[kept],
            single=place[self.single[alone]],
            odds=odds / odds.sum() if odds.size else odds,
        )

    def at(self, run: str, position: Array, periodic: bool) -> Array:
        """Signatures of a run at any times, shape (s, k, m).

        Parameters
        ----------
        run : str
            Label of one of the runs in :attr:`curves`.
        position : ndarray, shape (m,)
            Cycles since the run's first sample, or parts of a transient's length.
        periodic : bool
            Whether the run repeats.
        """
        return interpolated(self.curves[run], position, periodic)


def curves_of(columns: Array, position: Array, periodic: bool) -> Array:
    """Signatures at equidistant points from those at a run's samples.

    Parameters
    ----------
    columns : ndarray, shape (s, k, n)
    position : ndarray, shape (n,)
        Cycles since the first sample, or parts of a transient's length.
    periodic : bool

    Returns
    -------
    ndarray, shape (s, k, POINTS)
    """
    if not periodic:
        return _between(position, columns, np.linspace(0.0, 1.0, POINTS))
    turn = position % 1.0
    # Close to a multiple of one cycle rounding decides between both ends: they are one point.
    order = np.argsort(turn, kind="stable")
    around = np.concatenate([turn[order[-1:]] - 1, turn[order], turn[order[:1]] + 1])
    place = np.concatenate([order[-1:], order, order[:1]])
    return _between(around, columns, np.arange(POINTS) / POINTS, place)


def interpolated(curves: Array, position: Array, periodic: bool) -> Array:
    """Signatures (s, k, m) at positions (m,) from curves (s, k, POINTS)."""
    if not periodic:
        return _between(np.linspace(0.0, 1.0, POINTS), curves, position)
    closed = np.concatenate([curves, curves[..., :1]], axis=-1)
    return _between(np.arange(POINTS + 1) / POINTS, closed, position % 1.0)


def _between(known: Array, values: Array, wanted: Array, place: Integers | None = None) -> Array:
    """Linear interpolation along the last axis; ``known`` ascends, its values are at ``place``."""
    right = np.clip(np.searchsorted(known, wanted, side="right"), 1, known.size - 1)
    left = right - 1
    width = np.maximum(known[right] - known[left], np.finfo(float).tiny)
    part = np.clip((wanted - known[left]) / width, 0.0, 1.0)
    if place is not None:
        left, right = place[left], place[right]
    return np.asarray(values[..., left] * (1 - part) + values[..., right] * part)


def equal_shares(families: Sequence[str], members: Sequence[str]) -> Array:
    """Prior variance of each signature: one for each family, shared equally by its effects.

    An effect's signatures share its variance, so that neither many shapes nor many similar effects
    of one family weigh more.

    Parameters
    ----------
    families, members : sequence of str, length k
        Family and effect of each signature.

    Returns
    -------
    ndarray, shape (k,)
    """
    pairs = list(zip(families, members, strict=True))
    inside = {family: {m for f, m in pairs if f == family} for family in set(families)}
    return np.array([1.0 / (len(inside[pair[0]]) * pairs.count(pair)) for pair in pairs])


def alike(squared: Array, share: Array, most: float) -> tuple[Integers, Array]:
    """One signature for each group of nearly equal ones, and the groups' shares of the variance.

    Parameters
    ----------
    squared : ndarray, shape (k, k)
        Squared cosines between signatures.
    share : ndarray, shape (k,)
    most : float
        Squared cosine above which two are alike.

    Returns
    -------
    single : ndarray of int, shape (q,)
        The first of each group.
    odds : ndarray, shape (q,)
        They sum to one.
    """
    kept, odds = list[int](), list[float]()
    for own, row in enumerate(squared):
        like = row[kept]
        if like.size and like.max() > most:
            odds[int(np.argmax(like))] += share[own]
        else:
            kept.append(own)
            odds.append(float(share[own]))
    weights = np.array(odds)
    return np.array(kept, dtype=np.int64), weights / weights.sum() if odds else weights


# -- bases -----------------------------------------------------------------------------------------


def smooth_variances() -> Array:
    """Variances of the coefficients of 1, cos, sin, cos 2 ..., summing to one at any phase.

    Returns
    -------
    ndarray, shape (2 HARMONICS + 1,)
        Mean over :data:`LENGTHS` of the spectra of squared exponentials.
    """
    order = np.arange(HARMONICS + 1)
    weight = np.zeros(HARMONICS + 1)
    for length in LENGTHS:
        one = np.exp(-0.5 * (2 * np.pi * order * length) ** 2)
        one[1:] *= 2
        weight += one / one.sum() / len(LENGTHS)
    return np.repeat(weight, [1] + [2] * HARMONICS)


def smooth_basis(phase: Array) -> Array:
    """1, cos, sin, cos 2 ... at phases in cycles, times their standard deviations, (n, m)."""
    angle = 2 * np.pi * np.outer(phase % 1.0, np.arange(1, HARMONICS + 1))
    table = np.empty((phase.size, 2 * HARMONICS + 1))
    table[:, 0], table[:, 1::2], table[:, 2::2] = 1.0, np.cos(angle), np.sin(angle)
    return np.asarray(table * np.sqrt(smooth_variances()))


@jit
def project_rows(rows: Array, table: Array, out: Array, squares: Array) -> None:
    """Products of rows ``(L, n)`` with a basis ``(n, R)``, and their sums of squares.

    Four samples at a time halve the traffic of the sums; the order does not depend on the rows.
    """
    lanes, samples = rows.shape
    size, cut = table.shape[1], samples - samples % 4
    for lane in range(lanes):
        squares[lane] = 0.0
        for j in range(size):
            out[lane, j] = 0.0
    for i in range(0, cut, 4):
        for lane in range(lanes):
            a, b = rows[lane, i], rows[lane, i + 1]
            c, d = rows[lane, i + 2], rows[lane, i + 3]
            squares[lane] += (a * a + b * b) + (c * c + d * d)
            for j in range(size):
                out[lane, j] += (a * table[i, j] + b * table[i + 1, j]) + (
                    c * table[i + 2, j] + d * table[i + 3, j]
                )
    for i in range(cut, samples):
        for lane in range(lanes):
            a = rows[lane, i]
            squares[lane] += a * a
            for j in range(size):
                out[lane, j] += a * table[i, j]


@dataclass(frozen=True)
class Sums:
    """Residuals as the density needs them.

    Parameters
    ----------
    rest : ndarray, shape (L, N, s)
        Squared norm beside the smooth functions.
    along : ndarray, shape (L, N, s, m)
        Coefficients along the smooth functions.
    across : ndarray, shape (L, N, s, R)
        Products with the signatures, beside the smooth functions.
    """

    rest: Array
    along: Array
    across: Array


@dataclass(frozen=True)
class Rows:
    """Rows of one output in one run: products beside the smooth functions (k, k), coefficients
    along them (k, m), and products with the signatures beside them (k, R_c)."""

    run: int
    output: int
    gram: Array
    along: Array
    across: Array


@dataclass(frozen=True)
class Shared:
    """What residuals and rows say of the ``R`` coefficients that runs share.

    Parameters
    ----------
    inner : ndarray, shape (R, R)
        Information about them.
    right : ndarray, shape (k, R)
        Products of rows with their columns.
    deviation : ndarray, shape (R,)
        Prior standard deviations.
    factor : ndarray, shape (R, R)
        Cholesky factor of the precision, in units of the prior deviations.
    half : ndarray, shape (k, R)
        ``factor^-1`` times the right sides, in these units.
    """

    inner: Array
    right: Array
    deviation: Array
    factor: Array
    half: Array

    @classmethod
    def of(cls, inner: Array, right: Array, deviation: Array) -> Shared:
        """Factorise; not a number where that fails."""
        matrix = deviation[:, None] * inner * deviation
        matrix[np.diag_indices(len(matrix))] += 1.0
        try:
            factor = np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            factor = np.full_like(matrix, np.nan)
        half = forward(factor, (right * deviation).T).T
        return cls(inner, right, deviation, factor, half)

    @property
    def log_root(self) -> float:
        """Half the logarithm of the precision's determinant, in units of the prior."""
        return float(np.sum(np.log(np.diag(self.factor))))

    def along(self, columns: Array) -> tuple[Array, Array]:
        """Information (q,) about multiples of columns (q, R_c), and scores (k, q) of the rows.

        All other coefficients are integrated out.
        """
        count = columns.shape[1]
        deviation = self.deviation[:count]
        if np.all(deviation > 0):
            # With D inner D + I = L L', the information is D^-1 (I - (L L')^-1) D^-1.
            padded = np.zeros((len(self.factor), len(columns)), order="F")
            padded[:count] = columns.T / deviation[:, None]
            turned = forward(self.factor, padded)
            information = np.sum(padded * padded, axis=0) - np.sum(turned * turned, axis=0)
            return information, self.half @ turned
        seen = self.inner[:, :count] @ columns.T
        turned = forward(self.factor, self.deviation[:, None] * seen)
        information = np.sum(columns.T * seen[:count], axis=0) - np.sum(turned * turned, axis=0)
        return information, self.right[:, :count] @ columns.T - self.half @ turned

    def draw(self, given: Array, rng: np.random.Generator) -> Array:
        """Draw the coefficients (R,), given an addition (R_c,) to those of the signatures."""
        right = self.right[0] - self.inner[:, : given.size] @ given
        half = forward(self.factor, right * self.deviation)
        drawn = solve_triangular(
            self.factor, half + rng.standard_normal(half.size), trans="T", lower=True
        )
        return np.asarray(self.deviation * drawn)


def range_of(gram: Array) -> Array:
    """Coefficients (k, R) of the directions that signatures span, the largest first.

    Parameters
    ----------
    gram : ndarray, shape (k, k)
        Products of the signatures with each other over all runs and outputs, in units of the noise.
    """
    values, vectors = np.linalg.eigh(gram)
    return np.ascontiguousarray(vectors[:, values > NEGLIGIBLE][:, ::-1])


def forward(factor: Array, right: Array) -> Array:
    """Solution of ``factor x = right`` for a lower triangle."""
    # The transpose lies in memory as LAPACK wants it; the wrapper of SciPy would copy it.
    return np.asarray(dtrtrs(factor.T, right, lower=0, trans=1)[0])
