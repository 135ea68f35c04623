"""Leading periods that have not settled yet."""

from __future__ import annotations

import numpy as np
from scipy import stats

from bayesoleo._types import Array
from bayesoleo.autocovariance import lagged_products
from bayesoleo.data.transforms import HarmonicBasis

#: Chance of dropping the first period of a settled channel whose noise is stationary.
FALSE_ALARM = 1e-4

#: Least excess of a first period's mean square over the noise's. Less than this, 0.7 standard
#: deviations of the noise, costs less than the period is worth.
LEAST_EXCESS = 0.5


def whole_periods(samples: int, step: float) -> int:
    """Number of whole periods in a record.

    Parameters
    ----------
    samples : int
        Number of samples.
    step : float
        Cycles per sample.
    """
    # A record from 0 to P T without its end point may miss the P-th period by a rounding of the
    # frequency.
    return int(np.floor(samples * step + 1e-3))


def sample_count(periods: int, step: float) -> int:
    """Number of samples with ``0 <= phase < periods``, to a hundredth of a sample.

    Parameters
    ----------
    periods : int
        Whole periods.
    step : float
        Cycles per sample.
    """
    return int(np.floor(periods / step + 0.01))


def settled_start(values: Array, step: float, level: float = FALSE_ALARM) -> tuple[int, int]:
    """First sample of the settled whole periods at the end of a record.

    The first period is compared with what the later ones predict for it. While it differs by more
    than the noise and more than any later period does, it is left out; three periods are kept at
    least (two where there are three).

    Parameters
    ----------
    values : ndarray, shape (C, N)
        Channels.
    step : float
        Cycles per sample.
    level : float
        Chance of a false alarm in a settled record, over all channels.

    Returns
    -------
    first : int
        Index of the first sample to keep.
    dropped : int
        Whole periods left out before it; a leading fraction of a period is not counted.
    """
    samples = values.shape[1]
    periods = whole_periods(samples, step)
    least = 3 if periods > 3 else 2
    dropped = 0
    while periods - dropped > least:
        first = samples - sample_count(periods - dropped, step)
        later = samples - sample_count(periods - dropped - 1, step)
        if not _differs(values[:, first:], later - first, step, level / values.shape[0]):
            break
        dropped += 1
    return max(0, samples - sample_count(periods - dropped, step)), dropped


def _differs(values: Array, length: int, step: float, level: float) -> bool:
    """Whether the first ``length`` samples depart from the average of the others in any channel."""
    later = values[:, length:]
    basis = HarmonicBasis(later.shape[1], step)
    coefficients = basis.coefficients(later)
    residual = later - basis.evaluate(coefficients)
    before = coefficients * np.exp(-2j * np.pi * basis.orders * length * step)
    predicted = HarmonicBasis(length, step, basis.highest).evaluate(before)
    share = basis.size / basis.samples
    first = np.mean((values[:, :length] - predicted) ** 2, axis=1) / (1.0 + share)
    return any(
        _exceeds(power, rest / np.sqrt(1.0 - share), length, share, level)
        for power, rest in zip(first, residual, strict=True)
    )


def _exceeds(power: float, rest: Array, length: int, share: float, level: float) -> bool:
    """One-sided F-test, degrees of freedom cut by correlated noise; no later period as bad."""
    usual = float(np.mean(rest**2))
    together = _samples_per_degree(rest)
    free = rest.size * (1.0 - share)
    bound = stats.f.isf(level, max(length / together, 1.0), max(free / together, 1.0))
    others = rest[: rest.size // length * length].reshape(-1, length)
    worst = float(np.max(np.mean(others**2, axis=1)))
    return power > max(bound, 1.0 + LEAST_EXCESS) * usual and power > worst


def _samples_per_degree(rest: Array) -> float:
    """Samples per degree of freedom of a mean square: ``1 + 2 sum rho**2``."""
    covariance = lagged_products(rest[None])[: rest.size // 10]
    correlation = covariance[1:] / max(float(covariance[0]), 1e-300)
    # Chance correlations of white noise have variance 1/N; without them white noise keeps all its
    # samples.
    return 1.0 + 2.0 * float(np.sum(np.maximum(correlation**2 - 4.0 / rest.size, 0.0)))
