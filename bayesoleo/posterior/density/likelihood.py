"""Log-likelihood of sums of squares: independent normal errors with one variance for each output.

Another error model is another function from a misfit to one log-likelihood for each run.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array


def log_likelihood_by_run(
    sum_of_squares: Array, counts: NDArray[np.int64], log_variance: Array
) -> Array:
    """Normalised log-likelihood of every run.

    Parameters
    ----------
    sum_of_squares : ndarray, shape (L, N, s)
        Sums of squared residuals by parameter vector, run and output.
    counts : ndarray of int, shape (N, s)
        Number of samples by run and output.
    log_variance : ndarray, shape (L, s)
        Natural logarithm of each output's error variance.

    Returns
    -------
    ndarray, shape (L, N)
        ``-1/2 sum_b [n_b (ln 2 pi + ln v_b) + M_bb / v_b]`` of each run.

    References
    ----------
    Verbeek (1993), eq. 2.29 without the prior; the constant is added so that models with other data
    compare.
    """
    vectors, runs, outputs = sum_of_squares.shape
    total = np.zeros((vectors, runs))
    # Outputs are added one after the other: a reduction by NumPy may change its order with the
    # number of rows.
    for b in range(outputs):
        log_v = np.ascontiguousarray(log_variance[:, b])
        precision = np.exp(-log_v)
        total -= 0.5 * counts[:, b] * (np.log(2 * np.pi) + log_v)[:, None]
        total -= 0.5 * sum_of_squares[:, :, b] * precision[:, None]
    return total
