"""Normal, chi-square, F and t distributions as functions of SciPy's special functions.

They are what ``scipy.stats`` computes, called as there: :data:`norm`, :data:`chi2`, :data:`f` and
:data:`t` have functions ``sf``, ``isf``, ``cdf``, ``ppf``. A search would wait until all of
``scipy.stats`` is loaded, and each call there checks its arguments at length. Numbers give a number
and arrays an array. Degrees of freedom are finite; those that are not positive give NaN, but for
densities, and so do probabilities below zero or above one.

Shapes of samples are here for the same reason.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

_LOG_ROOT: Final = float(np.log(np.sqrt(2 * np.pi)))


class _Normal:
    """Standard normal distribution."""

    def pdf(self, x: ArrayLike) -> Any:
        """Density."""
        return np.exp(-(np.asarray(x) ** 2) / 2.0) / np.sqrt(2 * np.pi)

    def logpdf(self, x: ArrayLike) -> Any:
        """Logarithm of the density."""
        return -(np.asarray(x) ** 2) / 2.0 - _LOG_ROOT

    def cdf(self, x: ArrayLike) -> Any:
        """Probability of a value up to this one."""
        return special.ndtr(x)

    def sf(self, x: ArrayLike) -> Any:
        """Probability of a greater value."""
        return special.ndtr(-np.asarray(x))

    def ppf(self, p: ArrayLike) -> Any:
        """Value that is exceeded with probability ``1 - p``."""
        return special.ndtri(p)

    def isf(self, p: ArrayLike) -> Any:
        """Value that is exceeded with this probability."""
        return -special.ndtri(p)


class _ChiSquare:
    """Chi-square distribution with ``df`` degrees of freedom."""

    def cdf(self, x: ArrayLike, df: ArrayLike) -> Any:
        """Probability of a value up to this one."""
        return special.chdtr(_positive(df), np.maximum(x, 0.0))

    def sf(self, x: ArrayLike, df: ArrayLike) -> Any:
        """Probability of a greater value."""
        return special.chdtrc(_positive(df), np.maximum(x, 0.0))

    def logsf(self, x: ArrayLike, df: ArrayLike) -> Any:
        """Logarithm of that probability, minus infinity where that is smaller than any number."""
        above = self.sf(x, df)
        with np.errstate(divide="ignore"):
            # A probability near one has fewer digits than what it lacks.
            return np.where(above > 0.5, np.log1p(-self.cdf(x, df)), np.log(above))[()]

    def ppf(self, p: ArrayLike, df: ArrayLike) -> Any:
        """Value that is exceeded with probability ``1 - p``."""
        return 2 * special.gammaincinv(_positive(df) / 2, p)

    def isf(self, p: ArrayLike, df: ArrayLike) -> Any:
        """Value that is exceeded with this probability."""
        return special.chdtri(_positive(df), p)


class _F:
    """F distribution with ``dfn`` degrees of freedom above and ``dfd`` below."""

    def cdf(self, x: ArrayLike, dfn: ArrayLike, dfd: ArrayLike) -> Any:
        """Probability of a value up to this one."""
        # The special function has no value at infinity.
        return special.fdtr(dfn, dfd, np.clip(x, 0.0, _LARGEST))

    def sf(self, x: ArrayLike, dfn: ArrayLike, dfd: ArrayLike) -> Any:
        """Probability of a greater value."""
        return special.fdtrc(dfn, dfd, np.maximum(x, 0.0))

    def ppf(self, p: ArrayLike, dfn: ArrayLike, dfd: ArrayLike) -> Any:
        """Value that is exceeded with probability ``1 - p``."""
        # The special function has no value at zero.
        zero = 0.0 * _positive(dfn) * _positive(dfd)
        return np.where(np.asarray(p) == 0, zero, special.fdtri(dfn, dfd, p))[()]

    def isf(self, p: ArrayLike, dfn: ArrayLike, dfd: ArrayLike) -> Any:
        """Value that is exceeded with this probability.

        It has all digits for probabilities that cannot be told from zero beside one, where
        ``scipy.stats`` has none, down to some 1e-50.
        """
        n, m = _positive(dfn) / 2, _positive(dfd) / 2
        # Shares of both in a sum of squares; the smaller one has all digits.
        above, below = special.betainccinv(n, m, p), special.betaincinv(m, n, p)
        with np.errstate(divide="ignore", over="ignore"):
            ratio = np.where(above < below, above / (1 - above), (1 - below) / below)
        return (m / n * ratio)[()]


class _StudentT:
    """Student's t distribution with ``df`` degrees of freedom."""

    def logpdf(self, x: ArrayLike, df: float) -> Any:
        """Logarithm of the density."""
        constant = np.log(special.poch(0.5 * df, 0.5)) - 0.5 * (np.log(df) + np.log(np.pi))
        return constant - (df + 1) / 2 * np.log1p(np.asarray(x) ** 2 / df)

    def cdf(self, x: ArrayLike, df: ArrayLike) -> Any:
        """Probability of a value up to this one."""
        return special.stdtr(df, x)

    def sf(self, x: ArrayLike, df: ArrayLike) -> Any:
        """Probability of a greater value."""
        return special.stdtr(df, -np.asarray(x))

    def ppf(self, p: ArrayLike, df: ArrayLike) -> Any:
        """Value that is exceeded with probability ``1 - p``."""
        return -self.isf(p, df)

    def isf(self, p: ArrayLike, df: ArrayLike) -> Any:
        """Value that is exceeded with this probability."""
        # The special function gives plus infinity at both ends.
        value = special.stdtrit(df, p)
        return -np.where(np.asarray(p) == 0, -value, value)[()]


_LARGEST: Final = float(np.finfo(float).max)

norm: Final = _Normal()
chi2: Final = _ChiSquare()
f: Final = _F()
t: Final = _StudentT()


def _positive(df: ArrayLike) -> Any:
    return np.where(np.asarray(df) > 0, df, np.nan)


def skewness(values: ArrayLike, axis: int = -1) -> Any:
    """Third central moment over the variance to the power 3/2; NaN where nothing scatters."""
    return _standardised(values, 3, axis)


def kurtosis(values: ArrayLike, axis: int = -1) -> Any:
    """Fourth central moment over the squared variance, 3 of a normal; NaN where nothing scatters.

    Parameters
    ----------
    values : array_like
        Real numbers.
    axis : int, optional
        Of the sample.
    """
    return _standardised(values, 4, axis)


def _standardised(values: ArrayLike, order: int, axis: int) -> Any:
    values = np.asarray(values, dtype=float)
    mean = values.mean(axis=axis, keepdims=True)
    away = values - mean
    variance = np.mean(away**2, axis=axis)
    # Of equal values rounding alone is left.
    scatters = variance > (np.finfo(float).eps * mean.squeeze(axis)) ** 2
    variance = np.where(scatters, variance, np.nan)
    return (np.mean(away**order, axis=axis) / variance ** (order / 2))[()]
