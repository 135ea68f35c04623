r"""Estimators that forget priors hold what was measured beside the data, and carry its uncertainty.

The maximum of the likelihood knows nothing of a tolerance: it would move a constant known to 1 % by
half of it to fit the noise. Such unknowns keep their value, and the others are estimated given it.
With sensitivities :math:`J` and :math:`B` of the outputs to both, an error :math:`\delta` of the
held values moves the estimate by :math:`S\delta = -(J'WJ)^{-1} J'WB\,\delta`, so that its
covariance is :math:`(J'WJ)^{-1} + S \Sigma S'` with the tolerances' covariance :math:`\Sigma`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.error_models.linearise import LinearisedResidual, least_squares
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.estimation.problems.held import Held
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.model.correlated import scaled_root


def without_measured(problem: Problem, theta: Array, measured: NDArray[np.bool_]) -> Problem:
    """The same problem in the other unknowns.

    Parameters
    ----------
    problem : Problem
    theta : ndarray, shape (l,)
        All unknowns, which start or stay here.
    measured : ndarray of bool, shape (l,)
        Which are held.
    """
    holding = getattr(problem, "holding", None)
    if holding is None:
        return Held(problem, theta, [int(k) for k in np.flatnonzero(measured)])
    pairs = zip(problem.names, theta, measured, strict=True)
    held: Problem = holding({name: float(value) for name, value, is_held in pairs if is_held})
    return held


def with_measured(
    point: PointEstimate, problem: Problem, theta: Array, measured: NDArray[np.bool_]
) -> PointEstimate:
    """An estimate of some unknowns as one of all.

    Parameters
    ----------
    point : PointEstimate
        Of the unknowns that were not held.
    problem : Problem
        In all unknowns.
    theta : ndarray, shape (l,)
        Holds the others.
    measured : ndarray of bool, shape (l,)
        Which were held.

    Returns
    -------
    PointEstimate
        The covariance carries the uncertainty of what was held; the one without priors is that
        given the held values, and NaN for these.
    """
    own, names = np.flatnonzero(~measured), problem.names

    def vectors(values: Array) -> Array:
        full = np.repeat(np.asarray(theta, dtype=float)[None], len(values), axis=0)
        full[:, own] = values
        return full

    found = vectors(point.theta[None])[0]
    likelihood = np.full((len(names), len(names)), np.nan)
    likelihood[np.ix_(own, own)] = point.covariance_likelihood
    return replace(
        point,
        names=tuple(names),
        theta=found,
        start=vectors(point.start[None])[0],
        covariance=_carried(point, problem, found, measured),
        covariance_likelihood=likelihood,
        history=vectors(point.history),
        known=tuple(name for name, held in zip(names, measured, strict=True) if held),
    )


def _carried(
    point: PointEstimate, problem: Problem, theta: Array, measured: NDArray[np.bool_]
) -> Array:
    """Covariance of all unknowns, (l, l): the held ones have that of their priors."""
    own, held = np.flatnonzero(~measured), np.flatnonzero(measured)
    priors = [problem.priors[k] for k in held]
    sd = np.array([prior.sd for prior in priors])
    root = np.linalg.inv(scaled_root(priors, sd)) * sd[:, None]
    sigma = root @ root.T
    full = np.full((measured.size, measured.size), np.nan)
    full[np.ix_(held, held)] = sigma
    shift = _shift(problem, theta, point.variance, own, held)
    if not own.size or shift is None:
        return full
    full[np.ix_(own, own)] = point.covariance + shift @ sigma @ shift.T
    full[np.ix_(own, held)] = shift @ sigma
    full[np.ix_(held, own)] = full[np.ix_(own, held)].T
    return full


def _shift(
    problem: Problem,
    theta: Array,
    variance: Array,
    own: NDArray[np.int64],
    held: NDArray[np.int64],
) -> Array | None:
    """Change of the estimate by that of a held value, (own, held); None where there is none."""
    evaluation = problem.evaluate(theta)
    if not evaluation.status.ok or not (np.isfinite(variance) & (variance > 0)).all():
        return None
    unit = np.array([problem.priors[k].sd for k in range(len(theta))])
    rows = LinearisedResidual.of(evaluation, unit).whitened(variance)[0]
    # As in the covariance, the prior bounds what the data leave open.
    prior = scaled_root([problem.priors[k] for k in own], unit[own])
    weighted = np.vstack((rows[:, own], prior))
    target = np.vstack((rows[:, held], np.zeros((len(own), len(held)))))
    return cast(Array, -unit[own, None] * least_squares(weighted, target) / unit[held])
