"""What of a smooth function the data know beside the present parameters.

A function is a sum of splines. Some of them the data do not see, and some combinations of the
others the present parameters can do as well. What is left are directions of its own; those splines
that they do not need depend on the others, so that no prior has to hold apart what the data cannot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from bayesoleo._types import Array
from bayesoleo.tracing.scoring.base import Base
from bayesoleo.tracing.scoring.projection import coefficients


@dataclass(frozen=True)
class CurveDirections:
    """What of a function the data know beside the present parameters.

    Parameters
    ----------
    weights : ndarray, shape (K, r)
        All coefficients from the ``r`` free ones.
    expected : ndarray, shape (r,)
        Of the free coefficients, in the unit of the balance.
    coefficients : ndarray, shape (K,)
        All expected ones.
    fall : float
        Fall of the weighted sum of squares.
    """

    weights: Array
    expected: Array
    coefficients: Array
    fall: float


def known_beside(base: Base, own: Array, cross: Array, score: Array) -> CurveDirections | None:
    """Take out what is not visible, and what the present parameters can do.

    In coordinates in which ``C' W C`` is one, the eigenvalues of ``C_perp' W C_perp`` are the parts
    of each direction that the present parameters cannot do.

    Parameters
    ----------
    base : Base
        What is scored against; its ``J' W J`` is ``(l, l)``.
    own : ndarray, shape (K, K)
        ``C' W C`` of the splines.
    cross : ndarray, shape (l, K)
        ``J' W C``.
    score : ndarray, shape (K,)
        ``C' W e``.

    Returns
    -------
    CurveDirections or None
        None where nothing is visible, or nothing is left beside the present parameters.
    """
    policy = base.policy
    project = coefficients(base.gram, cross)
    information = own - cross.T @ project
    rest = score - project.T @ base.gradient
    size = np.sqrt(np.clip(np.diag(own), 0.0, None))
    seen = size > policy.resolved_spline * size.max(initial=0.0)
    if not seen.any() or not np.isfinite(information).all():
        return None
    scaled = own[np.ix_(seen, seen)] / np.outer(size[seen], size[seen])
    values, vectors = np.linalg.eigh(scaled)
    clear = values > policy.distinct_spline * values.max()
    unit = (vectors[:, clear] / np.sqrt(values[clear])) / size[seen][:, None]
    inner = unit.T @ information[np.ix_(seen, seen)] @ unit
    parts, turned = np.linalg.eigh(0.5 * (inner + inner.T))
    free = parts > policy.own_direction
    if not free.any():
        return None
    directions = unit @ turned[:, free]
    pull = directions.T @ rest[seen]
    own_seen = own[np.ix_(seen, seen)]
    found = directions @ (pull / parts[free])
    weights, chosen = _weights(directions, own_seen)
    full = np.zeros((own.shape[0], weights.shape[1]))
    full[seen] = weights
    everything = np.zeros(own.shape[0])
    everything[seen] = found
    return CurveDirections(full, found[chosen], everything, float(pull @ (pull / parts[free])))


def _weights(directions: Array, own: Array) -> tuple[Array, NDArray[np.int64]]:
    """Coefficients from as many of themselves as there are directions, and which these are.

    All combinations of ``directions (K, r)``: the splines that the others depend on are chosen by
    pivoting, so that none of the weights is large.
    """
    size = np.sqrt(np.diag(own))
    _, _, order = linalg.qr((directions * size[:, None]).T, mode="economic", pivoting=True)
    chosen = np.sort(order[: directions.shape[1]])
    weights = directions @ np.linalg.inv(directions[chosen])
    weights[chosen] = np.eye(chosen.size)
    weights[np.abs(weights) < 1e-12] = 0.0
    return weights, chosen
