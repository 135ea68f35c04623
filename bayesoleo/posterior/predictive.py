"""Draws for a posterior predictive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesoleo.posterior.samples import Samples

Array = NDArray[np.float64]


def choose_draws(
    samples: Samples, size: int, *, seed: int, run: str | None = None
) -> tuple[Array, Array]:
    """Pick draws at random, none twice.

    Parameters
    ----------
    samples : Samples
        Draws of the posterior.
    size : int
        How many; all of them if there are fewer.
    seed : int
        Seeds the choice.
    run : str, optional
        Whose variances to take where the errors have one of each run's own.

    Returns
    -------
    theta : ndarray, shape (K, l)
        Parameters in their units.
    variance : ndarray, shape (K, s)
        Error variances of the outputs, in squared units.
    """
    theta = samples.theta.reshape(-1, samples.theta.shape[-1])
    log_variance = samples.log_variance_of(run).reshape(len(theta), -1)
    rng = np.random.default_rng(seed)
    picks = rng.choice(len(theta), size=min(size, len(theta)), replace=False)
    return theta[picks], np.exp(log_variance[picks])
