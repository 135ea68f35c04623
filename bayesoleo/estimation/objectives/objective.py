"""The objective functions by name: an error model, and whether the prior counts.

References
----------
Verbeek (1993), eqs. 2.25-2.35.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.error_models import profiled_error_model
from bayesoleo.error_models.base import ProfiledErrorModel
from bayesoleo.error_models.given import GivenErrors
from bayesoleo.error_models.independent import log_likelihood
from bayesoleo.errors import InputError
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.model.correlated import log_density_of
from bayesoleo.model.priors import Prior

#: What each word stands for.
OBJECTIVES = {
    "diagonal": "posterior, one unknown variance for each output (2.29)",
    "full": "posterior, one unknown covariance of the outputs (2.27)",
    "given": "posterior, known covariances (2.25)",
    "likelihood": "likelihood, one unknown variance for each output (2.31)",
    "determinant": "likelihood, one unknown covariance of the outputs (2.28)",
    "weighted": "least squares, weighted by known covariances (2.33)",
    "unweighted": "least squares, all samples alike (2.35)",
}
_KNOWN = ("given", "weighted")
# Error models of the others, where they are not independent.
_ERRORS = {"full": "full", "determinant": "full", "unweighted": "common"}


@dataclass(frozen=True)
class Objective:
    """What an estimate maximises.

    Parameters
    ----------
    name : str
        One of :data:`OBJECTIVES`.
    errors : ProfiledErrorModel
    prior : bool
        Whether the prior is part of it. Estimators that re-centre the prior never count it.
    """

    name: str
    errors: ProfiledErrorModel
    prior: bool


def objective_of(
    problem: Problem, name: str | Objective, error_covariance: object = None
) -> Objective:
    """The objective of this name for a problem.

    Parameters
    ----------
    problem : Problem
    name : str or Objective
    error_covariance : array_like or sequence of array_like, optional
        For ``given`` and ``weighted``: a variance for each output, (s,); one array of variances by
        sample for each output; one covariance, (s, s); or one by sample, (n, s, s). By default the
        noise that was measured in a campaign's records.

    Raises
    ------
    InputError
        If there is no such objective, or it and the covariance do not go together.
    """
    if isinstance(name, Objective):
        return name
    if name not in OBJECTIVES:
        raise InputError(
            "there is no such objective",
            key="objective",
            value=name,
            hint=f"use {', '.join(OBJECTIVES)}",
        )
    if name in _KNOWN:
        if error_covariance is None:
            error_covariance = getattr(problem, "noise_variance", None)
        if error_covariance is None:
            raise InputError(
                "this objective needs known errors",
                key="error_covariance",
                value=None,
                hint='give error_covariance=…, or use objective="diagonal"',
            )
        errors: ProfiledErrorModel = GivenErrors.of(error_covariance, len(problem.outputs))
    elif error_covariance is not None:
        raise InputError(
            "this objective estimates the errors' covariance",
            key="error_covariance",
            hint='leave it out, or use objective="given" or "weighted"',
        )
    else:
        errors = profiled_error_model(_ERRORS.get(name, "independent"))
    errors.check(problem.counts)
    return Objective(name, errors, prior=name in ("diagonal", "full", "given"))


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
