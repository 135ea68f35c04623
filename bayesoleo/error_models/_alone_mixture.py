"""A mixture of normal distributions, of which each part but one has one effect acting alone.

That effect moves the mean along one direction and widens the covariance along the same. So the
moments of thousands of parts are sums over directions, and no part needs a covariance of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array


@dataclass(frozen=True)
class Components:
    """Posterior of ``l`` unknowns without an effect, and with each of ``q`` effects at ``m`` sizes.

    Parameters
    ----------
    heights : ndarray, shape (1 + q m,)
        Log evidence: of none first, then of each effect at all its sizes.
    mean, covariance : ndarray, shapes (l,) and (l, l)
        Without an effect, the covariance for noise of unit variance.
    variance : float
        Of the noise then.
    directions : ndarray, shape (l, q)
        Along which an effect moves the unknowns.
    moved, widened, variances : ndarray, shape (q, m)
        With an effect the mean lies ``moved`` times its direction before the one without; the
        covariance is larger by ``widened`` times that direction's outer product, all times the
        noise's variance.
    """

    heights: Array
    mean: Array
    covariance: Array
    variance: float
    directions: Array
    moved: Array
    widened: Array
    variances: Array


def moments_of(found: Sequence[Components], weights: Array) -> tuple[float, Array, Array]:
    """Weight, mean (l,) and covariance (l, l) of a mixture, with weights of shape (f, 1 + q m)."""
    total, size = max(float(weights.sum()), 1e-300), found[0].mean.size
    none = weights[:, 0] / total
    alone = [w[1:].reshape(one.moved.shape) / total for w, one in zip(weights, found, strict=True)]
    shares = [first + w.sum() for first, w in zip(none, alone, strict=True)]
    # What effects take from the mean of their own size of the remainder.
    taken = [
        one.directions @ np.sum(w * one.moved, axis=1) for w, one in zip(alone, found, strict=True)
    ]
    centre, spread = np.zeros(size), np.zeros((size, size))
    for one, share, less in zip(found, shares, taken, strict=True):
        centre += share * one.mean - less
    for k, one in enumerate(found):
        away = one.mean - centre
        within = none[k] * one.variance + np.sum(alone[k] * one.variances)
        cross = np.outer(away, taken[k])
        outer = np.sum(alone[k] * (one.widened * one.variances + one.moved**2), axis=1)
        half = one.directions * np.sqrt(outer)
        spread += within * one.covariance + shares[k] * np.outer(away, away)
        # Taken off one after the other, the two would round to no symmetric matrix.
        spread += half @ half.T - (cross + cross.T)
    return float(weights.sum()), centre, spread
