"""Linearised residuals, and the most likely values of an error model's quantities.

The QR factors of ``[sensitivity, residual]`` hold the same information as the normal equations at
half the loss of digits: forming ``A`` squares the condition number. The quantities of an error
model are maximised over with the residuals held, with gradient and Hessian of the density from one
batch of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array, Flags
from bayesoleo.error_models._base import Residuals

#: Finite-difference step in standard deviations: log density changes by 0.03, far above rounding
#: and solver noise.
STEP = 0.25
# Finite-difference step, in coordinates of about unit spread.
_SCALE = 0.2
# Tolerance of the maximum; a walker need not start exactly there.
_GAIN, _ITERATIONS = 1e-3, 40
# Longest step, and largest distance from the first guess; beyond it a share is practically 0 or 1.
_RADIUS, _REACH = 3.0, 12.0
# Least curvature that a step divides by.
_FLAT = 1e-2
# Rows of one block of a tall matrix.
_BLOCK = 1024
#: Singular values below this part of the largest count as zero. Rounding of derivatives reaches
#: 1e-13 of a column where they are differences; certified data sets need values down to 1e-9.
RANK = 1e-11
# Share of an unknown, with its column of unit length, in undetermined directions, above which it
# counts as undetermined. Directions are known to the rounding of derivatives over the least
# singular value that counts.
_TAKES_PART = 1e-3


def derivatives(
    height: Callable[[Array], Array], phi: Array, factor: Array
) -> tuple[float, Array, Array]:
    """Value, gradient and Hessian by central differences in ``z`` of ``phi + factor @ z``.

    Parameters
    ----------
    height : callable
        Log density (W,) of rows (W, d). Called once, with ``d^2 + d + 1`` rows.
    phi : ndarray, shape (d,)
    factor : ndarray, shape (d, d)
        Scales ``z`` to about standard deviations.

    Returns
    -------
    height : float
    gradient : ndarray, shape (d,)
    hessian : ndarray, shape (d, d)
    """
    d, h = len(phi), STEP
    unit = h * np.eye(d)
    pairs = [(i, j) for i in range(d) for j in range(i)]
    both = np.array([unit[i] + unit[j] for i, j in pairs]).reshape(-1, d)
    rows = np.concatenate([np.zeros((1, d)), unit, -unit, both, -both])
    values = height(phi + rows @ factor.T)
    centre, up, down = values[0], values[1 : d + 1], values[d + 1 : 2 * d + 1]
    with np.errstate(invalid="ignore"):
        gradient = (up - down) / (2 * h)
        hessian = np.diag((up - 2 * centre + down) / h**2)
        diagonal = up + down - 2 * centre
        twice = values[2 * d + 1 : 2 * d + 1 + len(pairs)] + values[2 * d + 1 + len(pairs) :]
        for (i, j), sum_of_two in zip(pairs, twice, strict=True):
            mixed = (sum_of_two - 2 * centre - diagonal[i] - diagonal[j]) / (2 * h**2)
            hessian[i, j] = hessian[j, i] = mixed
    return float(centre), gradient, hessian


def climb(height: Callable[[Array], Array], guesses: Sequence[Array]) -> Array:
    """Highest of the maxima that are reached from some guesses.

    Newton's method evaluates all rows of an iteration in one call. For three coordinates a
    library's minimiser, which evaluates one row at a time, would be dominated by its overhead.

    Parameters
    ----------
    height : callable
        Log density (W,) of coordinates (W, m); values that are not finite count as very low.
    guesses : sequence of ndarray, shape (m,)

    Returns
    -------
    ndarray, shape (m,)
    """

    def finite(rows: Array) -> Array:
        return np.nan_to_num(height(rows), nan=-1e12, neginf=-1e12)

    return max((_top(finite, guess) for guess in guesses), key=lambda found: found[0])[1]


def _top(height: Callable[[Array], Array], guess: Array) -> tuple[float, Array]:
    """Value and position of the maximum next to a guess."""
    eta, lengths = np.array(guess, dtype=float), 0.5 ** np.arange(10)
    scale = _SCALE * np.eye(eta.size)
    before = float(height(eta[None])[0])
    for _ in range(_ITERATIONS):
        _, gradient, hessian = derivatives(height, eta, scale)
        step = _SCALE * _uphill(gradient, hessian, _FLAT * _SCALE**2)
        step *= min(1.0, _RADIUS / max(float(np.linalg.norm(step)), 1e-300))
        trials = np.clip(eta + lengths[:, None] * step, guess - _REACH, guess + _REACH)
        values = height(trials)
        best = int(np.argmax(values))
        if not values[best] > before:
            break
        gain, before, eta = values[best] - before, float(values[best]), trials[best]
        if gain < _GAIN:
            break
    return before, eta


def _uphill(gradient: Array, hessian: Array, flat: float) -> Array:
    """Newton's step with all curvatures made negative, so that it leads away from saddles."""
    curvature, axes = np.linalg.eigh(hessian)
    return axes @ ((axes.T @ gradient) / np.maximum(np.abs(curvature), flat))


@dataclass(frozen=True)
class LinearisedResidual:
    """Least-squares equations of one linearisation, in scaled unknowns.

    Parameters
    ----------
    factors : tuple of ndarray, each shape (k, l + 1)
        Of each output: the triangular factor of ``[sensitivity * scale, residual]``.
    """

    factors: tuple[Array, ...]

    @classmethod
    def of(cls, evaluation: Residuals, scale: Array) -> LinearisedResidual:
        """Compress an evaluation whose unknowns are measured in ``scale``, shape (l,)."""
        return cls(
            tuple(
                triangle(np.column_stack((sensitivity * scale, residual)))
                for residual, sensitivity in zip(
                    evaluation.residual, evaluation.sensitivity, strict=True
                )
            )
        )

    def whitened(self, variance: Array) -> tuple[Array, Array]:
        """Rows ``J`` (k, l) and ``e`` (k,) of ``A = J'J`` and ``b = -J'e``, for v (s,)."""
        rows = [factor / np.sqrt(v) for factor, v in zip(self.factors, variance, strict=True)]
        stacked = triangle(np.vstack(rows))
        return stacked[:, :-1], stacked[:, -1]


def triangle(matrix: Array) -> Array:
    """Triangular factor of a tall matrix: blocks that fit the cache first, then their factors.

    The blocks are small enough for a linear algebra library to start no threads.
    """
    height, width = matrix.shape
    if height <= width:
        return matrix
    blocks = height // _BLOCK
    if blocks > 1 and 4 * width <= _BLOCK:
        cut = blocks * _BLOCK
        heads = np.linalg.qr(matrix[:cut].reshape(blocks, _BLOCK, width), mode="r")
        return triangle(np.vstack((heads.reshape(-1, width), matrix[cut:])))
    return np.linalg.qr(matrix, mode="r")


def least_squares(rows: Array, target: Array, rank: float | None = None) -> Array:
    """Solution of ``rows @ x = target`` in the least-squares sense, of minimum norm if not unique.

    Columns are brought to unit length first, so that the rank does not depend on units.

    Parameters
    ----------
    rows : ndarray, shape (k, l)
    target : ndarray, shape (k,) or (k, m)
    rank : float, optional
        Singular values below this part of the largest count as zero; by default the rounding level
        of the factorisation.

    Returns
    -------
    ndarray, shape (l,) or (l, m)

    Raises
    ------
    numpy.linalg.LinAlgError
        If the singular values do not converge.
    """
    length = np.linalg.norm(rows, axis=0)
    length[length == 0] = 1.0
    solution = np.linalg.lstsq(rows / length, target, rcond=rank)[0]
    return solution / (length if solution.ndim == 1 else length[:, None])


def inverse_gram(rows: Array, rank: float | None = None) -> Array:
    """``(rows' rows)^-1``, NaN for the unknowns that the rows do not determine.

    Parameters
    ----------
    rows : ndarray, shape (k, l)
    rank : float, optional
        As in :func:`least_squares`.

    Returns
    -------
    ndarray, shape (l, l)
        Rows and columns of undetermined unknowns are NaN; the others are as if those were held.
    """
    return masked(*pseudo_inverse_gram(rows, rank))


def masked(covariance: Array, undetermined: Flags) -> Array:
    """A covariance (l, l) with NaN in the rows and columns of some unknowns, shape (l,)."""
    return np.where(undetermined | undetermined[:, None], np.nan, covariance)


def pseudo_inverse_gram(rows: Array, rank: float | None = None) -> tuple[Array, Flags]:
    """Moore-Penrose inverse of ``rows' rows``, and the unknowns that are undetermined.

    Columns are brought to unit length first, as in :func:`least_squares`.

    Parameters
    ----------
    rows : ndarray, shape (k, l)
    rank : float, optional
        As in :func:`least_squares`.

    Returns
    -------
    inverse : ndarray, shape (l, l)
        In the unknowns' units.
    undetermined : ndarray of bool, shape (l,)
        Unknowns that take part in a direction along which the rows do not change.
    """
    unknowns = rows.shape[1]
    length = np.linalg.norm(rows, axis=0)
    if unknowns == 0 or not np.isfinite(length).all():
        return np.zeros((unknowns, unknowns)), np.ones(unknowns, dtype=bool)
    unit = np.where(length > 0, length, 1.0)
    _, singular, directions = np.linalg.svd(triangle(rows / unit))
    limit = np.finfo(float).eps * max(rows.shape) if rank is None else rank
    count = int(np.sum(singular > limit * singular[0])) if singular.size else 0
    root = directions[:count].T / singular[:count] / unit[:, None]
    open_part = np.sqrt(np.sum(directions[count:] ** 2, axis=0))
    with np.errstate(over="ignore", invalid="ignore"):
        inverse = root @ root.T
    # A column of 1e-160 has a variance that overflows: the rows do not determine its unknown.
    endless = ~np.isfinite(np.diag(inverse))
    return inverse, (open_part > _TAKES_PART) | endless
