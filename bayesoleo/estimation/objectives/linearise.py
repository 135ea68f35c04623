"""Residuals and sensitivities compressed to the few numbers that a step needs.

The QR factors of ``[sensitivity, residual]`` hold everything that the normal equations hold, at
half their loss of digits: forming ``A`` squares the condition number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from bayesoleo.estimation.problems.problem import Array, Evaluation

# Rows of one block of a tall matrix.
_BLOCK = 1024
#: Singular values below this part of the largest are zero but for the derivatives' rounding, which
#: reaches 1e-13 of a column where they are differences. Certified sets need down to 1e-9.
RANK = 1e-11


@dataclass(frozen=True)
class Linearised:
    """Least-squares equations of one linearisation, in scaled unknowns.

    Parameters
    ----------
    factors : tuple of ndarray, each shape (k, l + 1)
        Of each output: the triangular factor of ``[sensitivity * scale, residual]``.
    """

    factors: tuple[Array, ...]

    @classmethod
    def of(cls, evaluation: Evaluation, scale: Array) -> Linearised:
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
    target : ndarray, shape (k,)
    rank : float, optional
        Singular values below this part of the largest are taken for zero; by default those that the
        factorisation's own rounding would leave.

    Returns
    -------
    ndarray, shape (l,)

    Raises
    ------
    numpy.linalg.LinAlgError
        If the singular values do not converge.
    """
    length = np.linalg.norm(rows, axis=0)
    length[length == 0] = 1.0
    solution = np.linalg.lstsq(rows / length, target, rcond=rank)[0]
    return solution / length


def inverse_gram(rows: Array) -> Array:
    """``(rows' rows)^-1``, shape (l, l); NaN where the columns are linearly dependent."""
    length = np.linalg.norm(rows, axis=0)
    unknowns = rows.shape[1]
    if unknowns == 0:
        return np.empty((0, 0))
    missing = np.full((unknowns, unknowns), np.nan)
    if rows.shape[0] < unknowns or not np.isfinite(length).all() or (length == 0).any():
        return missing
    triangle = np.linalg.qr(rows / length, mode="r")
    singular = np.linalg.svd(triangle, compute_uv=False)
    if singular[-1] <= np.finfo(float).eps * max(rows.shape) * singular[0]:
        return missing
    root = solve_triangular(triangle, np.eye(unknowns)) / length[:, None]
    return root @ root.T
