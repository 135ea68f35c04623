"""Mixtures of Student-t densities, for starts of walkers and proposals of the independence move."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from scipy.special import gammaln, logsumexp

from bayesoleo._types import Array, Float
from bayesoleo.errors import InputError

#: Tails heavy enough that the ratio target / proposal stays bounded where a normal approximation
#: would let it grow.
DEGREES_OF_FREEDOM = 6.0
#: Degrees of freedom of a defended mixture's cores, almost normal like most posteriors, and of its
#: tails, and the tails' first share.
CORE, TAIL, SHARE = 50.0, 4.0, 0.1


@dataclass(frozen=True)
class Mixture:
    """Mixture of ``K`` Student-t densities in ``d`` coordinates.

    Parameters
    ----------
    centres : ndarray, shape (K, d)
        Modes of the components.
    covariances : ndarray, shape (K, d, d)
        Scale matrices: the covariance of the normal density that the component has at its centre.
    log_weights : ndarray, shape (K,)
        Logarithms of the weights, up to a constant.
    degrees : float or ndarray, shape (K,)
        Degrees of freedom, of all components or of each.

    Raises
    ------
    InputError
        If shapes disagree, or a scale matrix is not positive definite.
    """

    centres: Float[Array, "components coordinates"]
    covariances: Float[Array, "components coordinates coordinates"]
    log_weights: Float[Array, " components"]
    degrees: float | Float[Array, " components"] = DEGREES_OF_FREEDOM

    def __post_init__(self) -> None:
        components, dimension = np.shape(self.centres)
        each = np.broadcast_to(np.asarray(self.degrees, dtype=float), (components,))
        object.__setattr__(self, "degrees", each)
        shapes = np.shape(self.covariances), np.shape(self.log_weights)
        if shapes != ((components, dimension, dimension), (components,)):
            raise InputError(
                "a mixture needs centres (K, d), covariances (K, d, d) and log weights (K,)",
                value=(np.shape(self.centres), *shapes),
            )
        try:
            _ = self._factors
        except np.linalg.LinAlgError:
            raise InputError("a component's covariance is not positive definite") from None

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return int(self.centres.shape[1])

    @cached_property
    def weights(self) -> Array:
        """Normalised weights, shape (K,)."""
        return cast(Array, np.exp(self.log_weights - logsumexp(self.log_weights)))

    @cached_property
    def _factors(self) -> Array:
        return np.linalg.cholesky(self.covariances)

    @cached_property
    def _whitening(self) -> Array:
        return np.linalg.inv(self._factors)

    def distances(self, phi: Array) -> Array:
        """Squared Mahalanobis distances of rows, shape (W, d), to every component, shape (W, K)."""
        columns = []
        for centre, whiten in zip(self.centres, self._whitening, strict=True):
            columns.append(np.sum(((phi - centre) @ whiten.T) ** 2, axis=1))
        return np.stack(columns, axis=1)

    def log_components(self, phi: Array) -> Array:
        """Log of weight times density of every component, shape (W, K), at rows of shape (W, d)."""
        d, nu = self.dimension, np.asarray(self.degrees)
        log_det = np.sum(np.log(np.diagonal(self._factors, axis1=1, axis2=2)), axis=1)
        constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - 0.5 * d * np.log(nu * np.pi)
        kernel = -0.5 * (nu + d) * np.log1p(self.distances(phi) / nu)
        with np.errstate(divide="ignore"):
            return cast(Array, np.log(self.weights) + constant - log_det + kernel)

    def log_density(self, phi: Float[Array, "points coordinates"]) -> Float[Array, " points"]:
        """Normalised log density, shape (W,), at rows of shape (W, d).

        References
        ----------
        Kotz and Nadarajah (2004), *Multivariate t Distributions*, eq. 1.1.
        """
        return cast(Array, logsumexp(self.log_components(phi), axis=1))

    def sample(self, random: np.random.Generator | np.random.RandomState, size: int) -> Array:
        """Independent draws, shape (size, d)."""
        edges = np.cumsum(self.weights)
        picks = np.searchsorted(edges[:-1], random.uniform(size=size), side="right")
        normal = random.standard_normal((size, self.dimension))
        degrees = np.asarray(self.degrees)[picks]
        stretch = np.sqrt(degrees / random.chisquare(degrees))
        # einsum over each row's own factor: no product whose rounding depends on the other rows
        steps = np.einsum("wij,wj->wi", self._factors[picks], normal)
        return cast(Array, self.centres[picks] + stretch[:, None] * steps)

    def defended(self) -> Mixture:
        """Each component almost normal, with a lighter one of heavy tails about it.

        Most of a posterior is nearly normal, and proposals with heavy tails are refused there; what
        keeps the ratio target / proposal bounded are tails of any weight. The weights follow the
        draws when the mixture is refitted.

        Returns
        -------
        Mixture
            With twice as many components.

        References
        ----------
        Hesterberg (1995), "Weighted average importance sampling and defensive mixture
        distributions", *Technometrics* 37, section 2.
        """
        count = len(self.centres)
        return Mixture(
            np.tile(self.centres, (2, 1)),
            np.tile(self.covariances, (2, 1, 1)),
            np.concatenate(
                [self.log_weights + np.log(1 - SHARE), self.log_weights + np.log(SHARE)]
            ),
            np.repeat([CORE, TAIL], count),
        )

    def refitted(self, phi: Array, *, floor: float = 0.02, rounds: int = 20) -> Mixture:
        """Adapt weights, centres and covariances to draws by expectation-maximisation.

        Parameters
        ----------
        phi : ndarray, shape (M, d)
            Draws.
        floor : float
            Least weight of a component, so that none becomes unreachable.
        rounds : int
            Number of iterations.

        Returns
        -------
        Mixture
            With the same number of components and degrees of freedom.

        References
        ----------
        Peel and McLachlan (2000), "Robust mixture modelling using the t distribution", *Statistics
        and Computing* 10, eq. 22-31.
        """
        fitted = self
        # Each component keeps so many pseudo-draws of its former shape: it stays positive definite
        # when few draws reach it.
        prior_draws = 2.0 * (self.dimension + 1)
        for _ in range(rounds):
            log_parts = fitted.log_components(phi)
            share = np.exp(log_parts - logsumexp(log_parts, axis=1)[:, None])
            degrees = np.asarray(self.degrees)
            pull = share * (degrees + self.dimension) / (degrees + fitted.distances(phi))
            fitted = self._updated(phi, share, pull, prior_draws, floor)
        return fitted

    def _updated(
        self, phi: Array, share: Array, pull: Array, prior_draws: float, floor: float
    ) -> Mixture:
        centres, covariances = np.empty_like(self.centres), np.empty_like(self.covariances)
        mass = share.sum(axis=0)
        for k in range(len(centres)):
            pulled = pull[:, k].sum() + prior_draws
            centres[k] = (pull[:, k] @ phi + prior_draws * self.centres[k]) / pulled
            away, moved = phi - centres[k], self.centres[k] - centres[k]
            scatter = (pull[:, k, None] * away).T @ away + prior_draws * np.outer(moved, moved)
            covariances[k] = (scatter + prior_draws * self.covariances[k]) / (mass[k] + prior_draws)
        weights = np.maximum(mass / mass.sum(), floor)
        return Mixture(centres, covariances, np.log(weights / weights.sum()), self.degrees)
