"""Prior densities of single parameters.

The kinds are those of Verbeek (1993), section 2.2.4 - uniform within absolute bounds, normal, and
normal read as a 99 % band - and the log-normal and truncated normal that positive quantities ask
for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from bayesoleo.errors import ModelError

#: chi-square quantile with one degree of freedom at 99 %: "theta +- delta at 99 %" means a variance
#: of delta**2 / 6.635.
CHI_SQUARE_99 = float(stats.chi2.ppf(0.99, 1))


@runtime_checkable
class Prior(Protocol):
    """What every prior density offers; all functions take and return arrays of any shape."""

    @property
    def mean(self) -> float:
        """Expected value, in the parameter's unit; the centre that an estimator starts from."""

    @property
    def sd(self) -> float:
        """Standard deviation, in the parameter's unit; it scales an estimator's steps."""

    @property
    def support(self) -> tuple[float, float]:
        """Lowest and highest value with positive density; infinite where unbounded."""

    def log_density(self, value: ArrayLike) -> NDArray[np.float64]:
        """Natural logarithm of the normalised density; minus infinity outside the support."""

    def sample(self, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
        """Independent draws, shape (size,)."""


class _FromScipy:
    """Shared behaviour of priors that a frozen SciPy distribution describes."""

    @property
    def _frozen(self) -> stats.rv_frozen:
        raise NotImplementedError

    @property
    def mean(self) -> float:
        return float(self._frozen.mean())

    @property
    def sd(self) -> float:
        return float(self._frozen.std())

    @property
    def support(self) -> tuple[float, float]:
        low, high = self._frozen.support()
        return float(low), float(high)

    def log_density(self, value: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(self._frozen.logpdf(np.asarray(value, dtype=float)))

    def sample(self, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
        return np.asarray(self._frozen.rvs(size=size, random_state=rng), dtype=float)


def _positive(name: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ModelError(f"prior needs a positive, finite {name}", value=value)


@dataclass(frozen=True)
class Normal(_FromScipy):
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
    def _frozen(self) -> stats.rv_frozen:
        return stats.norm(self.centre, self.spread)


@dataclass(frozen=True)
class Uniform(_FromScipy):
    """Uniform prior between ``low`` and ``high``."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ModelError("uniform prior needs low < high", value=(self.low, self.high))

    @property
    def _frozen(self) -> stats.rv_frozen:
        return stats.uniform(self.low, self.high - self.low)


@dataclass(frozen=True)
class LogNormal(_FromScipy):
    """Log-normal: ``log(value)`` is normal about ``log(median)``, spread ``log_spread``."""

    median: float
    log_spread: float

    def __post_init__(self) -> None:
        _positive("median", self.median)
        _positive("logarithmic standard deviation", self.log_spread)

    @property
    def _frozen(self) -> stats.rv_frozen:
        return stats.lognorm(self.log_spread, scale=self.median)


@dataclass(frozen=True)
class TruncatedNormal(_FromScipy):
    """Normal prior restricted to ``low < value < high``; either bound may be infinite."""

    centre: float
    spread: float
    low: float = -np.inf
    high: float = np.inf

    def __post_init__(self) -> None:
        _positive("standard deviation", self.spread)
        if not self.low < self.high:
            raise ModelError("truncated prior needs low < high", value=(self.low, self.high))

    @property
    def _frozen(self) -> stats.rv_frozen:
        low, high = (self.low - self.centre) / self.spread, (self.high - self.centre) / self.spread
        return stats.truncnorm(low, high, self.centre, self.spread)
