"""What draws are worth, whether ensembles agree, and what a point estimate did not say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bayesoleo._types import Array
from bayesoleo.autocovariance import lagged_products


def autocorrelation_time(draws: Array) -> Array:
    """Integrated autocorrelation time of every quantity.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws, d)
        Walkers of all ensembles.

    Returns
    -------
    ndarray, shape (d,)
        In draws; NaN for a quantity that never moves.

    Notes
    -----
    As ``emcee.autocorr``, but deviations are from the mean of all walkers: a walker that stays in
    one of two modes then counts as correlated, where deviations from its own mean would look like
    noise.

    References
    ----------
    Sokal (1996), "Monte Carlo methods in statistical mechanics", section 3 (window of five times).
    Goodman and Weare (2010), "Ensemble samplers with affine invariance", *CAMCoS* 5, section 5.
    """
    centred = draws - draws.mean(axis=(0, 1))
    length = draws.shape[1]
    covariance = lagged_products(centred, 2 * length)
    # The sum at lag t has length - t terms; dividing by that number makes short chains unbiased.
    covariance /= np.arange(length, 0, -1)[:, None]
    times = np.full(draws.shape[2], np.nan)
    for a in np.flatnonzero(covariance[0] > 0):
        sums = 2.0 * np.cumsum(covariance[:, a] / covariance[0, a]) - 1.0
        times[a] = sums[_window(sums)]
    return times


def _window(sums: Array) -> int:
    """First lag that is five times as long as the sum up to it.

    ``emcee.autocorr.auto_window`` answers zero where there is none, and so calls a walker that
    never leaves its mode independent; here it is half the chain, and the time as long as that.
    """
    long_enough = np.flatnonzero(np.arange(len(sums)) >= 5 * sums)
    return int(long_enough[0]) if long_enough.size else len(sums) // 2


def effective_size(draws: Array) -> Array:
    """Effective number of independent draws of every quantity: the smallest of the estimates.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws, d)
        Walkers of all ensembles.

    Returns
    -------
    ndarray, shape (d,)
        Zero for a quantity that never moves.

    References
    ----------
    Vehtari et al. (2021), "Rank-normalization, folding, and localization: an improved R-hat",
    *Bayesian Analysis* 16, section 3 (bulk and tail); and all draws over
    :func:`autocorrelation_time`.
    """
    import arviz_stats as az

    size = draws.shape[0] * draws.shape[1]
    times = autocorrelation_time(draws)
    out = np.zeros(draws.shape[2])
    for a in np.flatnonzero(np.isfinite(times)):
        ranked = [
            float(az.ess(draws[:, :, a], chain_axis=0, draw_axis=1, method=method, prob=prob))
            for method, prob in (("bulk", None), ("tail", (0.05, 0.95)))
        ]
        # Anticorrelated draws are not credited: the estimate of a time below one is mostly noise.
        out[a] = np.nan_to_num(min(*ranked, size / max(times[a], 1.0)), nan=0.0)
    return out


def nested_rhat(draws: Array, ensemble: NDArray[np.int64]) -> Array:
    """Agreement between ensembles of every quantity; one means that they agree.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws, d)
        Walkers of all ensembles.
    ensemble : ndarray of int, shape (chains,)
        Which ensemble a walker belongs to.

    Returns
    -------
    ndarray, shape (d,)
        Infinite for a quantity that never moves.

    References
    ----------
    Margossian et al. (2024), "Nested R-hat: assessing the convergence of Markov chain Monte Carlo
    when running many short chains", *Bayesian Analysis*.
    """
    import arviz_stats as az

    out = np.full(draws.shape[2], np.inf)
    for a in range(draws.shape[2]):
        if np.ptp(draws[:, :, a]) > 0:
            out[a] = az.rhat_nested(
                draws[:, :, a], superchain_ids=ensemble, chain_axis=0, draw_axis=1
            )
    return out


def rhat_limit(ensembles: int, size: float) -> float:
    """Largest nested R-hat that ensembles in agreement reach with so many effective draws.

    Parameters
    ----------
    ensembles : int
        Number of ensembles.
    size : float
        Effective draws of all together.

    Returns
    -------
    float
        At least 1.01. The squared R-hat exceeds one by chi-square / (ensembles - 1) over the
        effective draws of one ensemble; the limit is that variable's 99.9 % quantile.
    """
    spread = stats.chi2.ppf(0.999, ensembles - 1) / (ensembles - 1)
    return float(max(1.01, np.sqrt(1 + spread * ensembles / size)))


@dataclass(frozen=True)
class Comparison:
    """A point estimate beside the posterior, each field an array of shape (l,).

    Parameters
    ----------
    shift : ndarray
        Posterior mean minus point, in the point's standard deviations.
    sd_ratio : ndarray
        Posterior standard deviation over the point's.
    skewness : ndarray
        Third standardised moment of the posterior.
    """

    shift: Array
    sd_ratio: Array
    skewness: Array


def compare_with_point(theta: Array, point: Array, sd: Array) -> Comparison:
    """Compare draws with a point estimate and its linearised standard deviations.

    Parameters
    ----------
    theta : ndarray, shape (chains, draws, l)
        Draws in natural units.
    point, sd : ndarray, shape (l,)
        Estimate and standard deviation, in the same units.

    Returns
    -------
    Comparison

    References
    ----------
    Verbeek (1993), eq. 2.36-2.41 (the linearised standard deviation).
    """
    flat = theta.reshape(-1, theta.shape[-1])
    return Comparison(
        shift=(flat.mean(axis=0) - point) / sd,
        sd_ratio=flat.std(axis=0, ddof=1) / sd,
        skewness=np.asarray(stats.skew(flat, axis=0)),
    )
