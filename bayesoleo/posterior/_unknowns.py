"""Unknowns of a problem as unbounded coordinates, and their prior in these coordinates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from bayesoleo._types import Array, Float
from bayesoleo.model._correlated_priors import log_density_of, sample_of
from bayesoleo.model._priors import Prior, Transforms

#: Finite-difference step in prior standard deviations.
STEP = 0.25


class Unknowns(ABC):
    """Map of ``p`` coordinates to the ``l`` unknowns of a problem, with their prior."""

    #: Parameters that scatter between runs.
    scattering: tuple[str, ...] = ()

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the ``p`` quantities, the problem's first."""

    @abstractmethod
    def theta(self, block: Float[Array, "walkers coordinates"]) -> Float[Array, "walkers unknowns"]:
        """Unknowns of the problem in their units, shape (W, l), from coordinates (W, p)."""

    @abstractmethod
    def natural(
        self, block: Float[Array, "walkers coordinates"]
    ) -> Float[Array, "walkers coordinates"]:
        """All quantities in their units from coordinates, both of shape (W, p)."""

    @abstractmethod
    def coordinates(
        self, natural: Float[Array, "walkers coordinates"]
    ) -> Float[Array, "walkers coordinates"]:
        """Coordinates of quantities in their units, both of shape (W, p)."""

    @abstractmethod
    def log_prior(self, block: Float[Array, "walkers coordinates"]) -> Float[Array, " walkers"]:
        """Log prior density of the coordinates, Jacobian included, shape (W,)."""

    @abstractmethod
    def natural_log_prior(
        self, natural: Float[Array, "walkers coordinates"]
    ) -> dict[str, Float[Array, " walkers"]]:
        """Log prior density of each quantity, shape (W,), over quantities in their units (W, p)."""

    @abstractmethod
    def sample_prior(self, rng: np.random.Generator, size: int) -> Float[Array, "size coordinates"]:
        """Draws of the quantities, shape (size, p)."""

    @abstractmethod
    def start(self, theta: Float[Array, " unknowns"]) -> Float[Array, " coordinates"]:
        """Coordinates, shape (p,), of a parameter vector, shape (l,)."""

    @abstractmethod
    def jacobian(self, block: Float[Array, " coordinates"]) -> Float[Array, "unknowns coordinates"]:
        """Derivatives of the unknowns with respect to the coordinates at (p,), shape (l, p)."""

    @abstractmethod
    def precision(
        self, block: Float[Array, " coordinates"]
    ) -> Float[Array, "coordinates coordinates"]:
        """Rough curvature of the log prior over the coordinates at (p,): (p, p), positive."""


@dataclass(frozen=True)
class PlainUnknowns(Unknowns):
    """Each unknown is a coordinate of its own.

    Parameters
    ----------
    labels : tuple of str, length l
    priors : tuple of Prior, length l
    """

    labels: tuple[str, ...]
    priors: tuple[Prior, ...]

    @cached_property
    def transforms(self) -> Transforms:
        """From coordinates to units."""
        return Transforms.of(self.priors)

    @property
    def names(self) -> tuple[str, ...]:
        return self.labels

    def theta(self, block: Array) -> Array:
        return self.transforms.natural(block)

    def natural(self, block: Array) -> Array:
        return self.transforms.natural(block)

    def coordinates(self, natural: Array) -> Array:
        return self.transforms.unbounded(natural)

    def log_prior(self, block: Array) -> Array:
        with np.errstate(invalid="ignore"):
            theta = self.transforms.natural(block)
            return self.transforms.log_jacobian(block) + log_density_of(self.priors, theta)

    def natural_log_prior(self, natural: Array) -> dict[str, Array]:
        columns = zip(self.labels, self.priors, natural.T, strict=True)
        return {name: prior.log_density(column) for name, prior, column in columns}

    def sample_prior(self, rng: np.random.Generator, size: int) -> Array:
        return sample_of(self.priors, rng, size)

    def start(self, theta: Array) -> Array:
        return cast(Array, self.transforms.unbounded(np.asarray(theta, dtype=float)[None])[0])

    def jacobian(self, block: Array) -> Array:
        return np.diag(self.transforms.derivative(block[None])[0])

    def precision(self, block: Array) -> Array:
        return np.diag(prior_curvature(self.priors, self.transforms, block))


def prior_curvature(priors: Sequence[Prior], transforms: Transforms, u: Array) -> Array:
    """Negative second derivatives of log prior plus log Jacobian, one for each coordinate."""
    precision = np.empty(len(u))
    for a, (prior, transform) in enumerate(zip(priors, transforms.each, strict=True)):
        step = STEP * prior.sd / abs(float(transform.derivative(u[a : a + 1])[0]))
        # A quarter of the prior's width in u; at most 1/4 where u is a logarithm, whose unit is a
        # factor e.
        step = step if transform.low == -np.inf and transform.high == np.inf else min(step, STEP)
        points = u[a] + step * np.array([-1.0, 0.0, 1.0])
        values = prior.log_density(transform.natural(points)) + transform.log_jacobian(points)
        curvature = -(values[0] - 2 * values[1] + values[2]) / step**2
        floor = 1e-3 / step**2  # flat or convex: wide, but not improper
        precision[a] = max(curvature, floor) if np.isfinite(curvature) else floor
    return precision
