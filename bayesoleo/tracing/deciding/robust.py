"""Variance of an estimate from the scatter between a few stretches of the data.

References
----------
Bell and McCaffrey (2002), Bias reduction in standard errors for linear regression with multi-stage
samples, Survey Methodology 28(2), 169-181; Pustejovsky and Tipton (2018), J. Business and Economic
Statistics 36(4), 672-683.
"""

from __future__ import annotations

import numpy as np

from bayesoleo._types import Array


def clustered_variance(pulls: Array, sizes: Array, overlap: Array) -> tuple[float, float]:
    """Variance of one estimate and its degrees of freedom.

    The estimate moves by ``a @ e`` with the noise ``e``; stretch ``g`` of the data pulls it by
    ``a_g @ r_g``, where the residual ``r = (I - H) e`` is smaller than the noise because the
    estimate has followed it. Each squared pull is divided by the part of it that white noise would
    have left, which makes the sum unbiased there; and the sum is known as well as a chi-square
    variate of the same mean and variance (Satterthwaite 1946).

    Parameters
    ----------
    pulls : ndarray, shape (G,)
        ``a_g @ r_g`` by stretch.
    sizes : ndarray, shape (G,)
        ``a_g @ a_g``.
    overlap : ndarray, shape (G, G)
        ``a_g @ H_gh @ a_h``.
    """
    left = np.diag(sizes) - overlap
    own = np.diag(left)
    used = own > 1e-9 * sizes
    if used.sum() < 2:
        return float(np.sum(pulls**2)), 0.0
    # A stretch that is fitted exactly says nothing; the others speak for it.
    factor = np.where(used, sizes / np.where(used, own, 1.0), 0.0)
    factor *= sizes.sum() / sizes[used].sum()
    expected = float(factor @ own)
    scatter = float(factor @ left**2 @ factor)
    return float(factor @ pulls**2), expected**2 / scatter
