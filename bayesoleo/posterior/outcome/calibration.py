"""Are posteriors what they say? Ranks of the truth among draws, and whether they are uniform.

Where parameters are drawn from their prior and data from the model, the rank of each parameter
among independent draws of its posterior is uniform. A sampler or a density with a mistake shows as
a slope (bias), a hollow (too narrow) or a hill (too wide) of the ranks.

References
----------
Talts, Betancourt, Simpson, Vehtari and Gelman (2018), "Validating Bayesian inference algorithms
with simulation-based calibration", arXiv:1804.06788. Säilynoja, Bürkner and Vehtari (2022),
"Graphical test for discrete uniformity and its applications in goodness-of-fit evaluation and
multiple sample comparison", *Statistics and Computing* 32, section 2 (the band).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from bayesoleo._types import Array
from bayesoleo.posterior.sampling.samples import Samples

#: Draws that a truth is ranked among: ranks 0 to 99.
DRAWS = 99
# Simulated sets of ranks from which the band's level is found.
_SETS = 4000


def rank_of(samples: Samples, truth: ArrayLike, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rank of each true value, shape (k,), among :data:`DRAWS` draws of its posterior.

    Parameters
    ----------
    samples : Samples
        Of a posterior, with far more effective draws than are ranked among.
    truth : array_like, shape (k,)
        True values of the first ``k`` quantities, in their units.
    rng : numpy.random.Generator
        Picks the draws.
    """
    flat = samples.draws.reshape(-1, samples.draws.shape[-1])
    picks = rng.choice(len(flat), DRAWS, replace=False)
    values = np.asarray(truth, dtype=float)
    return np.sum(flat[picks][:, : values.size] < values, axis=0)


@dataclass(frozen=True)
class Uniformity:
    """The distribution function of ranks against a uniform one's.

    Parameters
    ----------
    places : ndarray, shape (p,)
        Parts of the range of ranks.
    difference : ndarray, shape (p,)
        Part of the ranks up to there, minus that of a uniform variable.
    low, high : ndarray, shape (p,)
        Band that uniform ranks stay inside, everywhere at once, with probability ``level``.
    p_value : float
        Probability that uniform ranks leave such bands as far as these.
    level : float
    """

    places: Array
    difference: Array
    low: Array
    high: Array
    p_value: float
    level: float

    @property
    def inside(self) -> bool:
        """Whether the ranks stay inside the band."""
        return self.p_value >= 1 - self.level


def uniformity(
    ranks: ArrayLike, *, draws: int = DRAWS, level: float = 0.95, seed: int = 0
) -> Uniformity:
    """Compare ranks with a uniform distribution over 0 to ``draws``.

    Parameters
    ----------
    ranks : array_like of int, shape (R,)
        By replication.
    draws : int
        Draws that each truth was ranked among.
    level : float
        Of the simultaneous band.
    seed : int
        Of the simulation that finds it.
    """
    ranks = np.asarray(ranks, dtype=np.int64)
    count, places = ranks.size, np.arange(1, draws + 1) / (draws + 1)
    counts = _counts(ranks[None], draws)
    least = _least_p(counts, _two_sided(count, draws))[0]
    reference = _reference(count, draws, seed)
    gamma = float(np.quantile(reference, 1 - level))
    low, high = (stats.binom.ppf(p, count, places) / count for p in (gamma / 2, 1 - gamma / 2))
    p_value = float((np.searchsorted(reference, least, side="right") + 1) / (_SETS + 1))
    found = counts[0] / count
    return Uniformity(places, found - places, low - places, high - places, p_value, level)


@lru_cache(maxsize=16)
def _two_sided(count: int, draws: int) -> Array:
    """Binomial probabilities of so many ranks or further off, shape (count + 1, draws)."""
    places = np.arange(1, draws + 1) / (draws + 1)
    number = np.arange(count + 1)[:, None]
    below = stats.binom.cdf(number, count, places)
    above = stats.binom.sf(number - 1, count, places)
    return np.asarray(np.minimum(2 * np.minimum(below, above), 1.0))


@lru_cache(maxsize=16)
def _reference(count: int, draws: int, seed: int) -> Array:
    """Smallest probabilities of simulated sets of uniform ranks, ascending."""
    rng = np.random.default_rng(seed)
    sets = rng.integers(0, draws + 1, (_SETS, count))
    return np.sort(_least_p(_counts(sets, draws), _two_sided(count, draws)))


def _counts(ranks: NDArray[np.int64], draws: int) -> NDArray[np.int64]:
    """Ranks below 1, 2 ... draws, shape (S, draws), of sets of ranks, shape (S, R)."""
    table = np.zeros((len(ranks), draws + 1), dtype=np.int64)
    np.add.at(table, (np.arange(len(ranks))[:, None], ranks), 1)
    return np.cumsum(table, axis=1)[:, :-1]


def _least_p(counts: NDArray[np.int64], table: Array) -> Array:
    """Smallest probability over the places, shape (S,), of counts (S, draws)."""
    return np.asarray(table[counts, np.arange(counts.shape[1])].min(axis=1))
