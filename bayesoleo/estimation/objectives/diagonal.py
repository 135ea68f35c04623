"""Objective functions of the diagonal error model, and the variances that maximise them.

One variance for each output, shared by all runs. Constants that depend on neither the parameters
nor the variances are dropped, except those inside the priors' normalised densities.

References
----------
Verbeek (1993), eqs. 2.29-2.32, 3.17 and 3.18.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation.problems.problem import Evaluation
from bayesoleo.model.correlated import log_density_of
from bayesoleo.model.priors import Prior

# A model that reproduces its data exactly has no residual variance; its logarithm must stay finite.
_SMALLEST_VARIANCE = 1e-150


def sums_of_squares(evaluation: Evaluation) -> Array:
    """Diagonal ``M_bb`` of the moment matrix, shape (s,), in squared units of the outputs."""
    with np.errstate(over="ignore"):  # a trial step far out; the loop refuses what is not finite
        return np.array([float(np.sum(residual * residual)) for residual in evaluation.residual])


def output_counts(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of samples of each output over all runs, shape (s,), from counts of shape (N, s)."""
    return np.asarray(counts, dtype=np.int64).sum(axis=0)


def staged_variance(
    sums: Array, counts: NDArray[np.int64], unknowns: int = 0, *, bias_corrected: bool = False
) -> Array:
    """Variance of each output that maximises the objective at fixed parameters.

    Parameters
    ----------
    sums : ndarray, shape (s,)
        Sums of squared residuals.
    counts : ndarray of int, shape (s,)
        Number of samples.
    unknowns : int, optional
        Number of estimated parameters, l.
    bias_corrected : bool, optional
        Divide by ``n - l/s`` instead of ``n``.

    Returns
    -------
    ndarray, shape (s,)

    Raises
    ------
    InputError
        If an output has too few samples for the correction.

    References
    ----------
    Verbeek (1993), eq. 3.17, and eq. 3.18 with the correction.
    """
    degrees = counts - unknowns / len(counts) if bias_corrected else counts.astype(float)
    if (degrees <= 0).any():
        raise InputError(
            "an output has too few samples for its variance",
            value=counts.tolist(),
            hint="use more samples or fewer unknowns",
        )
    return np.maximum(sums / degrees, _SMALLEST_VARIANCE)


def log_likelihood(sums: Array, variance: Array, counts: NDArray[np.int64]) -> float:
    """Logarithm of the likelihood (Verbeek 1993, eqs. 2.31-2.32).

    Parameters
    ----------
    sums, variance : ndarray, shape (s,)
        Sums of squared residuals and error variances.
    counts : ndarray of int, shape (s,)
        Number of samples.

    Returns
    -------
    float
        ``-1/2 sum_b (n_b ln v_b + M_bb / v_b)``.
    """
    with np.errstate(over="ignore"):  # a trial step far out, next to a fit without residuals
        return float(-0.5 * np.sum(counts * np.log(variance) + sums / variance))


def log_prior(priors: Sequence[Prior], theta: Array) -> float:
    """Log density of the priors together; minus infinity outside their support."""
    return float(log_density_of(priors, np.asarray(theta, dtype=float)[None])[0])


def log_posterior(
    sums: Array,
    variance: Array,
    counts: NDArray[np.int64],
    priors: Sequence[Prior],
    theta: Array,
) -> float:
    """Objective of the Bayesian estimator, ``Phi_B(theta, v)`` (Verbeek 1993, eq. 2.29).

    Parameters
    ----------
    sums, variance : ndarray, shape (s,)
        Sums of squared residuals and error variances.
    counts : ndarray of int, shape (s,)
        Number of samples.
    priors : sequence of Prior, length l
        Priors of the parameters.
    theta : ndarray, shape (l,)
        Parameters.

    Returns
    -------
    float
    """
    return log_likelihood(sums, variance, counts) + log_prior(priors, theta)
