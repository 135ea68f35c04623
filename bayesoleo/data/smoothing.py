"""Noise of a signal that does not repeat: what a local polynomial cannot foresee."""

from __future__ import annotations

from math import comb

import numpy as np

from bayesoleo._types import Array

#: Highest order of differences tried; beyond it white noise would be all that is left of any
#: sensible sampling.
HIGHEST_DIFFERENCE = 8


def innovation_noise(values: Array) -> float:
    """Standard deviation of white noise on a smooth signal (variate differences, Tintner 1940).

    Differences of order d remove a local polynomial of degree d - 1 and leave noise with variance
    ``binomial(2 d, d)`` times that of a sample. The order grows until the estimate stops falling.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times.

    Returns
    -------
    float
        In the signal's unit.
    """
    difference, estimate = np.diff(values, 2), np.inf
    for order in range(2, HIGHEST_DIFFERENCE + 1):
        latest = float(np.sqrt(np.mean(difference**2) / comb(2 * order, order)))
        # Two per cent is within the scatter of the estimate for a few thousand samples.
        if difference.size < 8 or latest > 0.98 * estimate:
            break
        estimate = latest
        difference = np.diff(difference)
    return min(estimate, latest)
