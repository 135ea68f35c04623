"""Common mean and spread of estimates with known covariances, in units of order one.

References
----------
Jackson, Riley and White (2011), "Multivariate meta-analysis: potential and promise", *Statistics in
Medicine* 30, eqs. 2-5 (the likelihood). Viechtbauer (2007), "Confidence intervals for the amount of
heterogeneity in meta-analysis", *Statistics in Medicine* 26 (the interval of a spread).
"""

from __future__ import annotations

import numpy as np
from scipy import optimize, stats

from bayesoleo._types import Array


def generalised_mean(y: Array, S: Array, T: Array) -> tuple[Array, Array, Array]:
    """Mean (l,), its covariance (l, l) and the weights ``(S + T)^-1`` (N, l, l)."""
    W = np.linalg.inv(S + T)
    C = np.linalg.inv(W.sum(axis=0))
    return C @ np.einsum("nij,nj->i", W, y), C, W


def restricted_maximum_likelihood(y: Array, S: Array) -> Array:
    """Spread T, shape (l, l), through its Cholesky factor, so that it is no negative variance."""
    n = y.shape[1]
    rows, columns = np.tril_indices(n)

    def spread(x: Array) -> tuple[Array, Array]:
        L = np.zeros((n, n))
        L[rows, columns] = x
        return L @ L.T, L

    def negative(x: Array) -> tuple[float, Array]:
        T, L = spread(x)
        mean, C, W = generalised_mean(y, S, T)
        Wr = np.einsum("nij,nj->ni", W, y - mean)
        value = np.sum((y - mean) * Wr) - np.linalg.slogdet(W)[1].sum() - np.linalg.slogdet(C)[1]
        slope = W.sum(axis=0) - Wr.T @ Wr - np.einsum("nij,jk,nkl->il", W, C, W)
        return 0.5 * float(value), (slope @ L)[rows, columns]

    # From far too much spread and from little: none at all is a stationary point.
    starts = [factor * np.eye(n)[rows, columns] for factor in (1.0, 0.1)]
    found = [optimize.minimize(negative, x, jac=True, method="BFGS") for x in starts]
    return spread(min(found, key=lambda item: item.fun).x)[0]


def spread_interval(y: Array, variance: Array, level: float) -> tuple[tuple[float, float], float]:
    """Interval of one parameter's spread by Q-profile, and the probability of Cochran's Q."""
    freedom = y.size - 1

    def q(spread_squared: float) -> float:
        w = 1.0 / (variance + spread_squared)
        return float(np.sum(w * (y - np.sum(w * y) / w.sum()) ** 2))

    def crossing(target: float) -> float:
        if q(0.0) <= target:
            return 0.0
        high = 1.0
        while q(high) > target:
            high *= 4.0
        return float(np.sqrt(optimize.brentq(lambda t: q(t) - target, 0.0, high, xtol=1e-14)))

    low, high = (stats.chi2.ppf(p, freedom) for p in (0.5 + 0.5 * level, 0.5 - 0.5 * level))
    return (crossing(low), crossing(high)), float(stats.chi2.sf(q(0.0), freedom))
