"""Prior densities of single parameters, and their transforms to unbounded coordinates.

The kinds are those of Verbeek (1993), section 2.2.4 - uniform within absolute bounds, normal, and
normal read as a 99 % band - and, for positive quantities, the log-normal and the truncated normal.
All are written out, since an estimator and a sampler evaluate them thousands of times and building
a SciPy distribution costs a hundred times more than the density itself.

In unbounded coordinates a sampler never meets a bound and needs no rejection there. The logarithm
of the Jacobian corrects the density for the transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, expit, log_ndtr, ndtri_exp

from bayesoleo._types import Array
from bayesoleo.errors import ModelError

#: chi-square quantile with one degree of freedom at 99 %: "theta +- delta at 99 %" means a variance
#: of delta**2 / 6.635.
CHI_SQUARE_99 = float(chdtri(1, 0.01))

_LOG_SQRT_2_PI = 0.5 * float(np.log(2 * np.pi))
# Gauss-Legendre nodes on [0, 1]: 48 integrate a Gaussian cut off at exp(-40) to rounding.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1), 0.5 * _WEIGHTS
# Where a density has fallen by exp(-40) from its peak, what lies beyond is below rounding.
_CUT = 40.0


@runtime_checkable
class Prior(Protocol):
    """Interface of prior densities; all functions take and return arrays of any shape."""

    @property
    def mean(self) -> float:
        """Expected value, in the parameter's unit; the centre that an estimator starts from."""

    @property
    def sd(self) -> float:
        """Standard deviation, in the parameter's unit; it scales an estimator's steps."""

    @property
    def support(self) -> tuple[float, float]:
        """Lowest and highest value with positive density; infinite where unbounded."""

    def log_density(self, value: ArrayLike) -> Array:
        """Natural logarithm of the normalised density; minus infinity outside the support."""

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Independent draws, shape (size,)."""


def _positive(name: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ModelError(f"prior needs a positive, finite {name}", value=value)


@dataclass(frozen=True)
class Normal:
    """Normal with mean ``centre`` and standard deviation ``spread`` (Verbeek 1993, eq. 2.29)."""

    centre: float
    spread: float

    def __post_init__(self) -> None:
        _positive("standard deviation", self.spread)

    @classmethod
    def band(cls, centre: float, half_width: float) -> Normal:
        """Read ``centre +- half_width`` as a 99 % band (Verbeek 1993, section 2.2.4)."""
        return cls(centre, half_width / np.sqrt(CHI_SQUARE_99))

    @property
    def mean(self) -> float:
        return float(self.centre)

    @property
    def sd(self) -> float:
        return float(self.spread)

    @property
    def support(self) -> tuple[float, float]:
        return -np.inf, np.inf

    def log_density(self, value: ArrayLike) -> Array:
        with np.errstate(over="ignore"):
            scaled = (np.asarray(value, dtype=float) - self.centre) / self.spread
            return np.asarray(-0.5 * scaled * scaled - (_LOG_SQRT_2_PI + np.log(self.spread)))

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        return self.centre + self.spread * rng.standard_normal(size)


@dataclass(frozen=True)
class Uniform:
    """Uniform prior between ``low`` and ``high``."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ModelError("uniform prior needs low < high", value=(self.low, self.high))

    @property
    def mean(self) -> float:
        return float(0.5 * (self.low + self.high))

    @property
    def sd(self) -> float:
        return float((self.high - self.low) / np.sqrt(12.0))

    @property
    def support(self) -> tuple[float, float]:
        return float(self.low), float(self.high)

    def log_density(self, value: ArrayLike) -> Array:
        value = np.asarray(value, dtype=float)
        inside = np.where(np.isnan(value), np.nan, -np.log(self.high - self.low))
        return np.where((value < self.low) | (value > self.high), -np.inf, inside)

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        return rng.uniform(self.low, self.high, size)


@dataclass(frozen=True)
class LogUniform:
    """Uniform in the logarithm between ``low`` and ``high``, both positive."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0 < self.low < self.high:
            raise ModelError("log-uniform prior needs 0 < low < high", value=(self.low, self.high))

    @property
    def mean(self) -> float:
        return float((self.high - self.low) / np.log(self.high / self.low))

    @property
    def sd(self) -> float:
        square = (self.high**2 - self.low**2) / (2 * float(np.log(self.high / self.low)))
        return float(np.sqrt(square - self.mean**2))

    @property
    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def log_density(self, value: ArrayLike) -> Array:
        x = np.asarray(value, dtype=float)
        inside = (x >= self.low * (1 - 1e-12)) & (x <= self.high * (1 + 1e-12))
        with np.errstate(divide="ignore", invalid="ignore"):
            height = -np.log(x) - np.log(np.log(self.high / self.low))
        return np.where(inside, height, -np.inf)

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        return self.low * (self.high / self.low) ** rng.uniform(size=size)


@dataclass(frozen=True)
class LogNormal:
    """Log-normal: ``log(value)`` is normal about ``log(median)``, spread ``log_spread``."""

    median: float
    log_spread: float

    def __post_init__(self) -> None:
        _positive("median", self.median)
        _positive("logarithmic standard deviation", self.log_spread)

    @property
    def mean(self) -> float:
        return float(self.median * np.exp(0.5 * self.log_spread**2))

    @property
    def sd(self) -> float:
        return float(self.mean * np.sqrt(np.expm1(self.log_spread**2)))

    @property
    def support(self) -> tuple[float, float]:
        return 0.0, np.inf

    def log_density(self, value: ArrayLike) -> Array:
        # A copy without strides: NumPy may round the logarithm of a strided array differently.
        value = np.array(value, dtype=float)
        outside = value <= 0
        logarithm = np.log(np.where(outside, self.median, value))
        scaled = (logarithm - np.log(self.median)) / self.log_spread
        with np.errstate(over="ignore"):
            inside = -0.5 * scaled * scaled - (_LOG_SQRT_2_PI + np.log(self.log_spread)) - logarithm
        return np.where(outside, -np.inf, inside)

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        return self.median * np.exp(self.log_spread * rng.standard_normal(size))


@dataclass(frozen=True)
class TruncatedNormal:
    """Normal prior restricted to ``low < value < high``; either bound may be infinite.

    Density and moments are taken from its peak ``m``, the point of the interval next to
    ``centre``: with ``u = (x - m)/spread`` and ``c = (m - centre)/spread`` the density is
    proportional to ``exp(-u (u/2 + c))``. Its integrals are well-scaled in any tail and in any
    narrow interval, where differences of the normal distribution function cancel.
    """

    centre: float
    spread: float
    low: float = -np.inf
    high: float = np.inf

    def __post_init__(self) -> None:
        _positive("standard deviation", self.spread)
        if not self.low < self.high:
            raise ModelError("truncated prior needs low < high", value=(self.low, self.high))

    @property
    def _peak(self) -> float:
        return float(min(max(self.centre, self.low), self.high))

    @property
    def _steepness(self) -> float:
        """``c``: zero where the centre lies inside, positive above it."""
        return (self._peak - self.centre) / self.spread

    @cached_property
    def _moments(self) -> tuple[float, float, float]:
        """Integral, mean and standard deviation of ``exp(-u (u/2 + c))`` over the interval."""
        steepness = self._steepness
        # where u (u/2 + |c|) reaches the cut, written without cancellation
        reach = 2 * _CUT / (abs(steepness) + float(np.hypot(steepness, np.sqrt(2 * _CUT))))
        below = -min(reach, (self._peak - self.low) / self.spread)
        above = min(reach, (self.high - self._peak) / self.spread)
        u = np.concatenate((below * _NODES, above * _NODES))
        weight = np.concatenate((-below * _WEIGHTS, above * _WEIGHTS))
        weight *= np.exp(-u * (0.5 * u + steepness))
        integral = float(weight.sum())
        mean = float(weight @ u) / integral
        return integral, mean, float(np.sqrt(weight @ (u - mean) ** 2 / integral))

    @property
    def mean(self) -> float:
        return self._peak + self.spread * self._moments[1]

    @property
    def sd(self) -> float:
        return self.spread * self._moments[2]

    @property
    def support(self) -> tuple[float, float]:
        return float(self.low), float(self.high)

    def log_density(self, value: ArrayLike) -> Array:
        value = np.asarray(value, dtype=float)
        with np.errstate(over="ignore"):
            u = (value - self._peak) / self.spread
            inside = -u * (0.5 * u + self._steepness) - np.log(self._moments[0] * self.spread)
        return np.where((value < self.low) | (value > self.high), -np.inf, inside)

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        part = rng.uniform(size=size)
        with np.errstate(divide="ignore"):  # the logarithm of zero is minus infinity, as it should
            return self._between(np.log1p(-part), np.log(part))

    def quantile(self, part: ArrayLike) -> Array:
        """Value below which a part of the distribution lies, any shape."""
        part = np.asarray(part, dtype=float)
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = np.log1p(-part), np.log(part)
        return self._between(*(parts if self._sign > 0 else parts[::-1]))

    @property
    def _sign(self) -> float:
        """Minus one where the interval is turned over, into the left tail: there the distribution
        function is a small number known to full precision."""
        return -1.0 if self._steepness > 0 else 1.0

    def _between(self, log_low: Array, log_high: Array) -> Array:
        """Values from the logarithms of the shares that both bounds have, the more negative bound
        first after the interval is turned."""
        sign = self._sign
        bounds = (self.low - self.centre) / self.spread, (self.high - self.centre) / self.spread
        low, high = sorted(sign * bound for bound in bounds)
        logarithm = np.logaddexp(log_ndtr(low) + log_low, log_ndtr(high) + log_high)
        value = self.centre + self.spread * sign * ndtri_exp(logarithm)
        return cast(Array, np.clip(value, self.low, self.high))


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
