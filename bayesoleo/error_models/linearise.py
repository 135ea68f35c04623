"""Residuals and sensitivities compressed to the few numbers that a step needs.

The QR factors of ``[sensitivity, residual]`` hold everything that the normal equations hold, at
half their loss of digits: forming ``A`` squares the condition number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.error_models.base import Residuals

# Rows of one block of a tall matrix.
_BLOCK = 1024
#: Singular values below this part of the largest are zero but for the derivatives' rounding, which
#: reaches 1e-13 of a column where they are differences. Certified sets need down to 1e-9.
RANK = 1e-11
# Part of an unknown, its column of unit length, that lies in directions without a singular value:
# those are known to the derivatives' rounding over the least singular value that counts.
_TAKES_PART = 1e-3


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
    """Triangular factor of a tall matrix: blocks that stay in the cache first, then their factors.

    Orthogonal whatever the cut, and small enough for a linear algebra library to start no threads.
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

    Columns are brought to unit length first, so that the rank is judged without regard to units.

    Parameters
    ----------
    rows : ndarray, shape (k, l)
    target : ndarray, shape (k,) or (k, m)
    rank : float, optional
        Singular values below this part of the largest are taken for zero; by default those that the
        factorisation's own rounding would leave.

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


def masked(covariance: Array, undetermined: NDArray[np.bool_]) -> Array:
    """A covariance (l, l) with NaN in the rows and columns of some unknowns, shape (l,)."""
    return np.where(undetermined | undetermined[:, None], np.nan, covariance)


def pseudo_inverse_gram(rows: Array, rank: float | None = None) -> tuple[Array, NDArray[np.bool_]]:
    """Moore and Penrose's inverse of ``rows' rows``, and which unknowns have none of their own.

    Columns are brought to unit length first, as in :func:`least_squares`: a rank must not depend on
    units.

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
    # A column of 1e-160 has a variance beyond all numbers: the rows do not determine its unknown.
    endless = ~np.isfinite(np.diag(inverse))
    return inverse, (open_part > _TAKES_PART) | endless
