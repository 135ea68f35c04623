"""Draws for a posterior predictive, and the errors that come with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.posterior.sampling.samples import Samples


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
    picks = _picks(samples, size, seed)
    log_variance = samples.log_variance_of(run).reshape(samples.log_density.size, -1)
    return _flat(samples.theta)[picks], np.exp(log_variance[picks])


def choose_all(samples: Samples, size: int, *, seed: int) -> tuple[Array, Array]:
    """The draws of :func:`choose_draws`, with all that the error model says of them.

    Parameters
    ----------
    samples, size, seed
        See :func:`choose_draws`.

    Returns
    -------
    theta : ndarray, shape (K, l)
        Parameters in their units.
    errors : ndarray, shape (K, m)
        Quantities of the error model in theirs.
    """
    picks = _picks(samples, size, seed)
    return _flat(samples.theta)[picks], _flat(samples.of_errors)[picks]


def _picks(samples: Samples, size: int, seed: int) -> NDArray[np.int64]:
    count = samples.log_density.size
    return np.random.default_rng(seed).choice(count, size=min(size, count), replace=False)


def _flat(draws: Array) -> Array:
    return draws.reshape(-1, draws.shape[-1])


def sd_of_averages(errors: Array, phase: Array, bins: int) -> Array:
    """Standard deviation of errors that are averaged over periods, in bins of phase.

    Parameters
    ----------
    errors : ndarray, shape (W, s, n)
        Drawn at all samples of a run.
    phase : ndarray, shape (n,)
        In cycles.
    bins : int
        Of one cycle, equally long.

    Returns
    -------
    ndarray, shape (W, s)
        Root mean square over the bins: errors of a run are alike at any phase.
    """
    index = np.minimum((phase % 1.0 * bins).astype(int), bins - 1)
    order = np.argsort(index, kind="stable")
    _, first, count = np.unique(index[order], return_index=True, return_counts=True)
    means = np.add.reduceat(errors[:, :, order], first, axis=2) / count
    return np.asarray(np.sqrt(np.mean(means**2, axis=2)))
