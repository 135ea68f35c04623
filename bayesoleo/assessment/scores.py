"""How well a prediction foresaw what was measured: log score and probability integral transform.

Both need a prediction with its uncertainty: a mean and a standard deviation, or draws. They reward
intervals that are as wide as the errors are, no wider.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from bayesoleo._types import Array, Float
from bayesoleo.errors import InputError


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
    return _score(stats.norm.logpdf(y, centre, spread), stats.norm.cdf(y, centre, spread), level)


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
    log_density = stats.norm.logpdf(y, many, spread)
    mixture = np.logaddexp.reduce(log_density, axis=0) - np.log(len(many))
    return _score(mixture, stats.norm.cdf(y, many, spread).mean(axis=0), level)


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


def _score(log_density: Array, pit: Array, level: float) -> PredictiveScore:
    tail = (1 - level) / 2
    inside = (pit >= tail) & (pit <= 1 - tail)
    return PredictiveScore(
        log_score=float(np.mean(log_density)),
        pit=pit,
        coverage=float(inside.mean()),
        level=level,
        distance=float(stats.kstest(pit, "uniform").statistic),
    )
