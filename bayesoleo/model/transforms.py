"""Maps between parameters in natural units and coordinates without bounds.

A sampler that never meets a bound needs no rejection at it. What the map stretches is paid back by
the logarithm of its Jacobian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import cast

import numpy as np
from scipy.special import expit

from bayesoleo._types import Array
from bayesoleo.model.priors import Prior


class Shape(Enum):
    """Which map a support asks for."""

    IDENTITY = "identity"
    ABOVE = "log above the lower bound"
    BELOW = "log below the upper bound"
    BETWEEN = "logit between the bounds"


@dataclass(frozen=True)
class Transform:
    """Map of one parameter from a coordinate ``u`` without bounds.

    Parameters
    ----------
    low, high : float
        The parameter's support, in its unit; infinite where unbounded.

    References
    ----------
    Gelman et al. (2013), *Bayesian Data Analysis*, third edition, section 1.8 (transformation of
    variables).
    """

    low: float
    high: float

    @property
    def shape(self) -> Shape:
        """Identity, logarithm or logit, from which bounds are finite."""
        bounded = (np.isfinite(self.low), np.isfinite(self.high))
        return {
            (False, False): Shape.IDENTITY,
            (True, False): Shape.ABOVE,
            (False, True): Shape.BELOW,
            (True, True): Shape.BETWEEN,
        }[(bool(bounded[0]), bool(bounded[1]))]

    def natural(self, u: Array) -> Array:
        """Parameter at the coordinate, in its unit; same shape."""
        with np.errstate(over="ignore"):
            match self.shape:
                case Shape.IDENTITY:
                    return np.array(u, dtype=float)
                case Shape.ABOVE:
                    return self.low + np.exp(u)
                case Shape.BELOW:
                    return self.high - np.exp(u)
                case Shape.BETWEEN:
                    return cast(Array, self.low + (self.high - self.low) * expit(u))

    def unbounded(self, value: Array) -> Array:
        """Coordinate of a parameter; infinite or NaN on and outside the bounds."""
        value = np.asarray(value, dtype=float)
        with np.errstate(divide="ignore", invalid="ignore"):
            match self.shape:
                case Shape.IDENTITY:
                    return np.array(value)
                case Shape.ABOVE:
                    return np.log(value - self.low)
                case Shape.BELOW:
                    return np.log(self.high - value)
                case Shape.BETWEEN:
                    return np.log(value - self.low) - np.log(self.high - value)

    def log_jacobian(self, u: Array) -> Array:
        """Logarithm of the derivative's size, ``ln |d value / d u|``; same shape."""
        match self.shape:
            case Shape.IDENTITY:
                return np.zeros(np.shape(u))
            case Shape.ABOVE | Shape.BELOW:
                return np.array(u, dtype=float)
            case Shape.BETWEEN:
                return cast(
                    Array,
                    np.log(self.high - self.low) - np.logaddexp(0.0, u) - np.logaddexp(0.0, -u),
                )

    def derivative(self, u: Array) -> Array:
        """Derivative of the parameter with respect to the coordinate, with its sign; same shape."""
        sign = -1.0 if self.shape is Shape.BELOW else 1.0
        return sign * np.exp(self.log_jacobian(u))


@dataclass(frozen=True)
class Transforms:
    """Maps of all parameters, each column on its own.

    Parameters
    ----------
    each : tuple of Transform
        One map a parameter, in the problem's order.
    """

    each: tuple[Transform, ...]

    @classmethod
    def of(cls, priors: Sequence[Prior]) -> Transforms:
        """Choose every map from the support of the prior."""
        return cls(tuple(Transform(*prior.support) for prior in priors))

    def natural(self, u: Array) -> Array:
        """Parameters in their units, shape (L, l), from coordinates, shape (L, l)."""
        return self._by_column("natural", u)

    def unbounded(self, theta: Array) -> Array:
        """Coordinates, shape (L, l), from parameters, shape (L, l)."""
        return self._by_column("unbounded", theta)

    def derivative(self, u: Array) -> Array:
        """Derivatives ``d theta / d u``, shape (L, l)."""
        return self._by_column("derivative", u)

    def log_jacobian(self, u: Array) -> Array:
        """Logarithm of the absolute Jacobian determinant, shape (L,)."""
        u = np.asarray(u, dtype=float)
        total = np.zeros(u.shape[0])
        for column, transform in zip(u.T, self.each, strict=True):
            total += transform.log_jacobian(np.ascontiguousarray(column))
        return total

    def _by_column(self, what: str, values: Array) -> Array:
        # Contiguous columns: NumPy's exp and log may take another code path, and round differently,
        # for a strided one.
        values = np.asarray(values, dtype=float)
        columns = zip(values.T, self.each, strict=True)
        out = np.empty_like(values, order="C")
        for a, (column, transform) in enumerate(columns):
            out[:, a] = getattr(transform, what)(np.ascontiguousarray(column))
        return out
