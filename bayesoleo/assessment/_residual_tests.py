"""Residual tests and prediction scores, as pure functions.

Each test takes a residual and returns a statistic and the probability of such a value by chance.
Samples are denser than the correlation of the model error or the noise, so that thousands of them
may hold the information of dozens. Where the distribution of a test depends on this, it uses the
autocorrelation time of the residual.

The prediction scores are the log score and the probability integral transform. Both need a
predictive distribution: a mean and a standard deviation, or draws. They reward intervals that are
as wide as the errors, no wider.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array, Float
from bayesoleo.data._fourier import integrated_time, lagged_products
from bayesoleo.errors import InputError

#: Bins of a variable at most.
BINS = 24


@dataclass(frozen=True)
class PredictiveScore:
    """How well data were foreseen.

    Parameters
    ----------
    log_score : float
        Mean log density of a sample; higher is better. In nats, for data in their own unit.
    pit : ndarray, shape (n,)
        Probability that the prediction gave to less than what was measured; uniform on 0 to 1 where
        the prediction is calibrated.
    coverage : float
        Part of the samples inside the two-sided interval at ``level``.
    level : float
    distance : float
        Greatest distance of the distribution of ``pit`` from the uniform one (Kolmogorov).
    """

    log_score: float
    pit: Float[Array, " samples"]
    coverage: float
    level: float
    distance: float


def score_normal(
    measured: ArrayLike, mean: ArrayLike, sd: ArrayLike, *, level: float = 0.95
) -> PredictiveScore:
    """Score a normal prediction.

    Parameters
    ----------
    measured, mean : array_like, shape (n,)
        SI.
    sd : array_like, shape (n,) or a number
        Of the prediction together with the noise of a sample.
    level : float, optional
        Of the interval whose coverage is told.

    Raises
    ------
    InputError
        If lengths disagree or a standard deviation is not positive.

    References
    ----------
    Gneiting and Raftery (2007); Dawid (1984).
    """
    y, centre, spread = _aligned(measured, mean, sd)
    log_density, pit = _normal(y, centre, spread)
    return _score(log_density, pit, level)


def score_draws(
    measured: ArrayLike, draws: ArrayLike, sd: ArrayLike, *, level: float = 0.95
) -> PredictiveScore:
    """Score a prediction by draws, each with the noise of a sample about it.

    Parameters
    ----------
    measured : array_like, shape (n,)
        SI.
    draws : array_like, shape (m, n)
        Predictions, for example one for each draw of a posterior.
    sd : array_like, shape (m,), (m, 1), (n,) or a number
        Noise of a sample, one for all, for each draw or for each sample.
    level : float, optional
        Of the interval whose coverage is told.
    """
    y, many = np.asarray(measured, dtype=float), np.asarray(draws, dtype=float)
    if many.ndim != 2 or many.shape[1:] != y.shape:
        raise InputError(
            "draws must be one row a draw, as long as what was measured",
            key="draws", value=many.shape, hint=f"give an array of shape (draws, {y.size})",
        )  # fmt: skip
    noise = np.asarray(sd, dtype=float)
    if noise.shape == (len(many),) and len(many) != y.size:
        noise = noise[:, None]
    _, _, spread = _aligned(np.broadcast_to(y, many.shape), many, noise)
    log_density, pit = _normal(y, many, spread)
    mixture = np.logaddexp.reduce(log_density, axis=0) - np.log(len(many))
    return _score(mixture, pit.mean(axis=0), level)


def _aligned(measured: ArrayLike, mean: ArrayLike, sd: ArrayLike) -> tuple[Array, Array, Array]:
    y, centre, spread = (np.asarray(item, dtype=float) for item in (measured, mean, sd))
    try:
        y, centre, spread = np.broadcast_arrays(y, centre, spread)
    except ValueError as error:
        raise InputError(
            "measured, mean and sd disagree in length", value=(y.shape, centre.shape, spread.shape)
        ) from error
    if not (spread > 0).all():
        raise InputError(
            "a standard deviation must be positive", key="sd", value=float(spread.min()),
            hint="add the noise of a sample to that of the prediction",
        )  # fmt: skip
    return y, centre, spread


def _normal(y: Array, centre: Array, spread: Array) -> tuple[Array, Array]:
    """Logarithm of the density and distribution function of normal values."""
    z = (y - centre) / spread
    return distributions.norm.logpdf(z) - np.log(spread), distributions.norm.cdf(z)


def _score(log_density: Array, pit: Array, level: float) -> PredictiveScore:
    from scipy import stats  # a search, which asks for no score, would wait until it is loaded

    tail = (1 - level) / 2
    inside = (pit >= tail) & (pit <= 1 - tail)
    return PredictiveScore(
        log_score=float(np.mean(log_density)),
        pit=pit,
        coverage=float(inside.mean()),
        level=level,
        distance=float(stats.kstest(pit, "uniform").statistic),
    )


@dataclass(frozen=True)
class ResidualTest:
    """A test's statistic and the probability of one as extreme if nothing is wrong."""

    statistic: float
    p_value: float


NOTHING = ResidualTest(float("nan"), float("nan"))


def runs_of_signs(residual: Array) -> ResidualTest:
    """Test on runs of signs (Bard 1974, section 7.9; Wald and Wolfowitz 1940).

    Parameters
    ----------
    residual : ndarray, shape (n,)
        In the order of time, or of any variable.

    Returns
    -------
    ResidualTest
        Standard normal where signs come in random order; negative where they cluster, as they do
        where the model misses something. Two-sided.
    """
    signs = np.sign(residual[residual != 0])
    above = int((signs > 0).sum())
    below = signs.size - above
    if signs.size < 10:
        return NOTHING
    if min(above, below) == 0:  # as many of each were to be expected, and one run came
        z = -np.sqrt(signs.size - 1)
        return ResidualTest(float(z), float(2 * distributions.norm.sf(-z)))
    runs = 1 + int((np.diff(signs) != 0).sum())
    mean = 1 + 2 * above * below / signs.size
    variance = (mean - 1) * (mean - 2) / (signs.size - 1)
    if variance <= 0:
        return NOTHING
    z = (runs - mean) / np.sqrt(variance)
    return ResidualTest(float(z), float(2 * distributions.norm.sf(abs(z))))


def autocorrelation(values: Array, lags: int) -> Array:
    """Autocorrelation about the mean at lags 0 to ``lags``, each over its own overlap.

    Parameters
    ----------
    values : ndarray, shape (n,)
    lags : int
        Below ``n``.

    Returns
    -------
    ndarray, shape (lags + 1,)
    """
    centred = values - values.mean()
    sums = lagged_products(centred[None])[: lags + 1]
    overlap = values.size - np.arange(lags + 1)
    return cast(Array, sums / overlap / max(sums[0] / values.size, np.finfo(float).tiny))


def autocorrelation_time(values: Array, power: int = 1) -> float:
    """Samples that hold the information of one: the integrated autocorrelation time, at least one.

    Summed over a window of five times itself (Sokal 1997).

    Parameters
    ----------
    values : ndarray, shape (n,)
    power : {1, 2}, optional
        Information on the mean, or on the variance, which the square of the autocorrelation tells.
    """
    if values.size < 20:
        return 1.0
    return integrated_time(autocorrelation(values, values.size // 4), power)


def normality(residual: Array) -> tuple[float, float, ResidualTest]:
    """Skewness, excess kurtosis, and whether they may be those of a normal process.

    The test of Lobato and Velasco (2004): that of Jarque and Bera with variances of the moments
    that the autocorrelation ``rho`` implies, ``6 sum rho**3`` and ``24 sum rho**4``.

    Parameters
    ----------
    residual : ndarray, shape (n,)

    Returns
    -------
    skewness, kurtosis : float
    ResidualTest
        Chi-square with two degrees of freedom.
    """
    n = residual.size
    skewness = float(distributions.skewness(residual))
    kurtosis = float(distributions.kurtosis(residual)) - 3
    if n < 20 or not np.isfinite(skewness):
        return skewness, kurtosis, NOTHING
    rho = autocorrelation(residual, n - 1)
    rho = rho * (n - np.arange(n)) / n  # the biased estimate, whose sums converge
    third = 1 + 2 * float(np.sum(rho[1:] ** 3))
    fourth = 1 + 2 * float(np.sum(rho[1:] ** 4))
    statistic = n * (skewness**2 / (6 * max(third, 1e-3)) + kurtosis**2 / (24 * fourth))
    return skewness, kurtosis, ResidualTest(statistic, float(distributions.chi2.sf(statistic, 2)))


def intraclass_correlation(repeating: float, sigma: float, samples: int, number: int) -> float:
    """Correlation of residuals of the same phase in different periods.

    The intraclass correlation: the part of the variance that repeats. Where a model's error repeats
    with the motion, more periods do not make residuals independent.

    Parameters
    ----------
    repeating, sigma : float
        Root mean square of the average over periods, and standard deviation about it.
    samples, number : int
        Of the record, and of the coefficients of the average.
    """
    # The average contains its own share of the noise.
    signal = repeating**2 - sigma**2 * number / samples
    return float(np.clip(signal / (signal + sigma**2), -1.0, 1.0)) if sigma > 0 else 1.0


def lack_of_fit(
    repeating: float,
    sigma: float,
    samples: int,
    number: int,
    input_noise: float = 0.0,
    effective: float = 1.0,
) -> ResidualTest:
    """What repeats of a residual against the noise of that average: pure error between periods.

    Parameters
    ----------
    repeating, sigma, samples, number
        As in :func:`intraclass_correlation`.
    input_noise : float, optional
        Noise of the inputs in the average; it repeats, and is not the model's.
    effective : float, optional
        Samples of the noise that tell of its variance what one does,
        ``autocorrelation_time(noise, 2)``: of coloured noise some
        harmonics hold most, so that fewer count.

    Returns
    -------
    ResidualTest
        Ratio of mean squares, F-distributed with ``number`` and ``samples - number`` degrees of
        freedom, each over ``effective``; the root of it is the loop's ratio to the noise.
    """
    noise = sigma**2 * number / samples + input_noise**2
    if noise <= 0:
        return NOTHING
    ratio = repeating**2 / noise
    free = number / effective, (samples - number) / effective
    return ResidualTest(float(ratio), float(distributions.f.sf(ratio, *free)))


def outliers(values: Array, level: float = 0.05) -> tuple[Array, NDArray[np.int64], float]:
    """Samples too far out for normal noise, by a scale that they cannot inflate.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Noise: what does not repeat.
    level : float, optional
        Probability of naming any sample of normal noise.

    Returns
    -------
    scores : ndarray, shape (n,)
        Distance from the median in robust standard deviations.
    places : ndarray of int
        Outliers, the farthest first.
    limit : float
        Score beyond which a sample is one.
    """
    centre = float(np.median(values))
    # The median absolute deviation of a standard normal is 0.6745.
    spread = float(np.median(np.abs(values - centre))) / 0.6744897501960817
    limit = float(distributions.norm.isf(level / (2 * values.size)))
    if spread == 0:
        return np.zeros(values.size), np.zeros(0, dtype=np.int64), limit
    scores = (values - centre) / spread
    far = np.flatnonzero(np.abs(scores) > limit)
    return scores, far[np.argsort(-np.abs(scores[far]))], limit


@dataclass(frozen=True)
class Dependence:
    """How a residual depends on a variable.

    Parameters
    ----------
    centres, means, errors : ndarray, shape (bins,)
        Mean of the variable, mean of the residual and its standard error by bin of equally many
        samples.
    share : float
        Part of the residual's variance that the variable explains, beyond what chance does.
    outcome : ResidualTest
        F-test of the bins, samples counted by their autocorrelation time.
    """

    centres: Float[Array, " bins"]
    means: Float[Array, " bins"]
    errors: Float[Array, " bins"]
    share: float
    outcome: ResidualTest


def dependence(residual: Array, variable: Array, effective: float, bins: int = BINS) -> Dependence:
    """Mean residual by bins of a variable.

    Parameters
    ----------
    residual, variable : ndarray, shape (n,)
    effective : float
        Samples that hold the information of one, see :func:`autocorrelation_time`.
    bins : int, optional
        At most; each holds the information of ten samples or more.
    """
    n = residual.size
    count = int(np.clip(n / (10 * max(effective, 1.0)), 2, bins))
    parts = np.array_split(np.argsort(variable, kind="stable"), count)
    centres = np.array([variable[part].mean() for part in parts])
    means = np.array([residual[part].mean() for part in parts])
    sizes = np.array([part.size for part in parts])
    within = float(sum(np.sum((residual[p] - m) ** 2) for p, m in zip(parts, means, strict=True)))
    between = float(np.sum(sizes * (means - residual.mean()) ** 2))
    free = n / max(effective, 1.0) - count
    total = between + within
    if free <= 0 or total <= 0:
        return Dependence(centres, means, np.full(count, np.nan), 0.0, NOTHING)
    # Scatter within bins, of as many independent samples as there are.
    scatter = within / (n - count * effective) if n > count * effective else within / n
    errors = np.sqrt(scatter * max(effective, 1.0) / sizes)
    ratio = between / (count - 1) / max(scatter * max(effective, 1.0), np.finfo(float).tiny)
    share = max(0.0, 1 - (within / free) / (total / (free + count - 1)))
    return Dependence(
        centres,
        means,
        errors,
        share,
        ResidualTest(ratio, float(distributions.f.sf(ratio, count - 1, free))),
    )
