"""Autocovariance by the fast Fourier transform (Wiener and Khinchin's theorem)."""

from __future__ import annotations

import numpy as np
from scipy import fft

from bayesoleo._types import Array


def lagged_products(rows: Array, length: int | None = None) -> Array:
    """Sums of the products of samples that are so many samples apart, averaged over rows.

    Parameters
    ----------
    rows : ndarray, shape (k, n) or (k, n, d)
        Deviations from whatever mean is meant, of ``k`` records.
    length : int, optional
        Of the transform, at least ``2 n - 1``; by default one that is fast.

    Returns
    -------
    ndarray, shape (n,) or (n, d)
        At lags 0 to ``n - 1``; the sum at lag ``t`` has ``n - t`` terms.
    """
    length = length or fft.next_fast_len(2 * rows.shape[1])
    power = np.mean(np.abs(fft.rfft(rows, length, axis=1)) ** 2, axis=0)
    return np.asarray(fft.irfft(power, length, axis=0)[: rows.shape[1]])
