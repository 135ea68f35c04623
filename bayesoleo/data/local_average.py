"""What a transient's residual keeps over neighbouring samples, and its noise.

A transient repeats nothing that could be averaged over periods. What the model lacks is smooth on
the scale of the samples and noise is not, so that averages over a few neighbours say the same: they
are the noise's standard error where nothing is missing, and larger where something is.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.data.smoothing import HIGHEST_DIFFERENCE, innovation_noise

#: Averages of a run, and samples in one at least.
MOST_AVERAGES, FEWEST_SAMPLES = 200, 4


@dataclass(frozen=True)
class LocalAverage:
    """Averages over blocks of neighbouring samples, in the terms of a periodic average.

    Parameters
    ----------
    values : ndarray, shape (N,)
        The average of each sample's block, in the signal's unit.
    samples, number : int
        Number N of samples and M of blocks.
    repeating : float
        Root mean square of ``values``.
    sigma : float
        Standard deviation of a single sample's noise, from differences of neighbours.
    noise : float
        Standard error of a block's average, root mean square over the blocks.
    """

    values: Array
    samples: int
    number: int
    repeating: float
    sigma: float
    noise: float

    @property
    def ratio(self) -> float:
        """``repeating / noise``: about one where nothing is left but noise."""
        return self.repeating / self.noise

    @property
    def free(self) -> float:
        """Degrees of freedom of ``sigma`` squared: neighbouring differences share samples.

        Those of order d are correlated so that their mean square varies as that of
        ``1 / (binomial(4 d, 2 d) / binomial(2 d, d)**2)`` as many independent ones.
        """
        order = HIGHEST_DIFFERENCE
        shared = comb(4 * order, 2 * order) / comb(2 * order, order) ** 2
        return max(self.samples / shared, 1.0)

    def on_phase(self, points: int) -> Array:
        """A transient has no phase: not a number, shape (points,)."""
        return np.full(points, np.nan)


def local_average(values: Array, sigma: float | None = None) -> LocalAverage:
    """Average a signal over neighbouring samples.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times.
    sigma : float, optional
        Standard deviation of a sample's noise, where it is known; by default from differences of
        neighbours.
    """
    signal = np.asarray(values, dtype=float)
    number = int(_blocks(signal.size)[-1]) + 1
    means = local_means(signal)
    if sigma is None:
        sigma = innovation_noise(signal)
    return LocalAverage(
        values=means,
        samples=signal.size,
        number=number,
        repeating=float(np.sqrt(np.mean(means**2))),
        sigma=sigma,
        noise=sigma * float(np.sqrt(number / signal.size)),
    )


def local_means(values: Array) -> Array:
    """Mean over each sample's block of neighbours.

    Parameters
    ----------
    values : ndarray, shape (..., N)

    Returns
    -------
    ndarray, shape (..., N)
    """
    block = _blocks(values.shape[-1])
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    sums = np.add.reduceat(values, starts, axis=-1)
    means: Array = (sums / np.bincount(block))[..., block]
    return means


def _blocks(samples: int) -> NDArray[np.int64]:
    """Number of the block that each sample lies in, shape (N,)."""
    size = max(FEWEST_SAMPLES, samples // MOST_AVERAGES)
    number = max(samples // size, 1)
    return np.minimum(np.arange(samples) // size, number - 1)
