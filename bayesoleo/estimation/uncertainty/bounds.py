"""What noise of a known size does to an estimate, by linearisation.

All matrices are formed with columns of unit length: physical parameters range over twelve decades.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesoleo._types import Array
from bayesoleo.estimation.uncertainty.redraw import NoiseBlock


def cramer_rao(blocks: Sequence[NoiseBlock]) -> Array:
    """Least covariance that an unbiased estimator can have, shape (l, l); NaN where singular.

    The information is ``sum J' S^-1 J`` with ``S = diag(sd**2) + C C'`` the covariance of the noise
    of a run, in which ``C`` comes from the measured inputs.

    Parameters
    ----------
    blocks : sequence of NoiseBlock
        Independent of each other.

    References
    ----------
    Rao (1945); Verbeek (1993), section 2.3.
    """
    length = _length(blocks)
    information = np.zeros((length.size, length.size))
    for block in blocks:
        rows = block.sensitivity / length / block.sd[:, None]
        common = block.columns / block.sd[:, None]
        # Woodbury: the noise that a run's samples share takes its own directions out.
        shared = np.eye(common.shape[1]) + common.T @ common
        cross = common.T @ rows
        information += rows.T @ rows - cross.T @ np.linalg.solve(shared, cross)
    return _inverse(information) / np.outer(length, length)


def propagated(
    blocks: Sequence[NoiseBlock], variance: Array, precision: Array | None = None
) -> Array:
    """Covariance of a weighted least-squares estimate under the noise that there is, shape (l, l).

    ``H^-1 [sum J' W S W J] H^-1`` with ``W`` the estimator's weights and ``H = sum J' W J`` plus
    the precision: the noise of the data propagated to the estimate. It equals the
    Cramér-Rao bound where ``W = S^-1`` and no prior pulls.

    Parameters
    ----------
    blocks : sequence of NoiseBlock
    variance : ndarray, shape (s,)
        Error variances by which the estimator weights the outputs.
    precision : ndarray, shape (l, l), optional
        Of the prior, where it counts.

    References
    ----------
    Verbeek (1993), eqs. 2.36-2.41.
    """
    length = _length(blocks)
    normal = np.zeros((length.size, length.size))
    noise = np.zeros_like(normal)
    for block in blocks:
        rows = block.sensitivity / length
        weighted = rows / variance[block.output][:, None]
        normal += rows.T @ weighted
        own = weighted * block.sd[:, None]
        common = weighted.T @ block.columns
        noise += own.T @ own + common @ common.T
    if precision is not None:
        normal += precision / np.outer(length, length)
    inverse = _inverse(normal)
    return inverse @ noise @ inverse / np.outer(length, length)


def _length(blocks: Sequence[NoiseBlock]) -> Array:
    """Length of each column of the sensitivities over all blocks, shape (l,)."""
    squares = [np.sum(block.sensitivity**2, axis=0) for block in blocks]
    length = np.sqrt(np.sum(squares, axis=0))
    return np.where(length > 0, length, 1.0)


def _inverse(matrix: Array) -> Array:
    values, vectors = np.linalg.eigh(matrix)
    if values.size == 0 or values[0] <= np.finfo(float).eps * values.size * values[-1]:
        return np.full_like(matrix, np.nan)
    return (vectors / values) @ vectors.T
