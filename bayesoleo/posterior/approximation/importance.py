"""Weighted draws from a mixture: the posterior at a hundredth of the cost, where it is near one.

Where Laplace's approximation is good, independent draws from it that are weighted by target over
proposal are worth a third of what draws of the target itself would be, and no walker has to warm
up. Whether the approximation *is* good is told by the weights: the largest of them follow a
generalised Pareto distribution whose shape says how many of their moments exist. Below 0.7 sums of
them converge at a practicable rate; above, :func:`~bayesoleo.posterior.sample` is the way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from bayesoleo._types import Array, Float
from bayesoleo.errors import InputError
from bayesoleo.posterior.approximation.mixture import Mixture
from bayesoleo.posterior.density.log_density import Density

#: Largest shape of the weights' tail (Vehtari et al. 2024, section 3.2.4).
LARGEST_SHAPE = 0.7


@dataclass(frozen=True)
class Weighted:
    """Draws of a posterior with weights.

    Parameters
    ----------
    names : tuple of str
        Names of the ``d`` quantities.
    draws : ndarray, shape (M, d)
        In natural units.
    weights : ndarray, shape (M,)
        Smoothed; they sum to one.
    effective_size : float
        Of the draws, ``1 / sum(weights^2)``.
    shape : float
        Of the largest weights' Pareto distribution.
    evaluations : int
        Rows of the log density.
    reached : bool
        Whether the size asked for was reached with a shape below :data:`LARGEST_SHAPE`.
    """

    names: tuple[str, ...]
    draws: Float[Array, "draws quantities"]
    weights: Float[Array, " draws"]
    effective_size: float
    shape: float
    evaluations: int
    reached: bool

    def quantiles(self, probabilities: ArrayLike) -> Array:
        """Quantiles of every quantity, shape (k, d), at probabilities (k,)."""
        wanted = np.asarray(probabilities, dtype=float)
        found = np.empty((wanted.size, len(self.names)))
        for column, values in zip(found.T, self.draws.T, strict=True):
            order = np.argsort(values)
            # A draw's own probability is the middle of its step of the distribution function.
            below = np.cumsum(self.weights[order]) - 0.5 * self.weights[order]
            column[:] = np.interp(wanted, below, values[order])
        return found


def importance_sample(
    log_density: Density,
    start: Mixture,
    *,
    seed: int,
    effective_size: float = 400.0,
    draws: int = 1000,
    rounds: int = 6,
) -> Weighted:
    """Draw from a mixture and weight, adapting the mixture until that is good enough.

    Draws of all rounds are kept and weighted by the mean of all rounds' mixtures, so that no early
    draw in a region that was proposed too rarely then keeps a large weight.

    Parameters
    ----------
    log_density : Density
        Over ``d`` coordinates without bounds.
    start : Mixture
        Laplace approximations at the modes.
    seed : int
    effective_size : float
        At which to stop.
    draws : int
        Of each round.
    rounds : int
        At most.

    Returns
    -------
    Weighted
        With ``reached`` False if the rounds were not enough.

    Raises
    ------
    InputError
        If no draw has a finite log density.

    References
    ----------
    Cornuet, Marin, Mira and Robert (2012), "Adaptive multiple importance sampling", *Scandinavian
    Journal of Statistics* 39, section 2. Vehtari, Simpson, Gelman, Yao and Gabry (2024), "Pareto
    smoothed importance sampling", *Journal of Machine Learning Research* 25.
    """
    rng = np.random.default_rng(seed)
    first = start.defended()
    proposals, phi, height = [first], np.empty((0, first.dimension)), np.empty(0)
    for _ in range(rounds):
        new = proposals[-1].sample(rng, draws)
        phi, height = np.concatenate([phi, new]), np.concatenate([height, log_density(new)[0]])
        weights, shape = _weights(proposals, phi, height)
        size = float(1 / np.sum(weights**2))
        reached = size >= effective_size and shape < LARGEST_SHAPE
        if reached:
            break
        picks = rng.choice(len(phi), size=len(phi), p=weights)
        proposals.append(first.refitted(phi[picks]))
    natural = log_density.natural(phi)
    return Weighted(log_density.names, natural, weights, size, shape, len(phi), reached)


def _weights(proposals: list[Mixture], phi: Array, height: Array) -> tuple[Array, float]:
    """Normalised weights, smoothed, and the shape of their tail."""
    from arviz_stats.base import array_stats

    finite = np.flatnonzero(np.isfinite(height))
    if not finite.size:
        raise InputError(
            "no draw has a finite log density",
            hint="give starts further inside the priors' supports",
        )
    parts = np.stack([proposal.log_density(phi[finite]) for proposal in proposals])
    # It takes the negative of log ratios, as leave-one-out has them.
    smoothed, shape = array_stats.psislw(logsumexp(parts, axis=0) - height[finite])
    weights = np.zeros(len(phi))
    weights[finite] = np.exp(smoothed - logsumexp(smoothed))
    return weights, float(shape)
