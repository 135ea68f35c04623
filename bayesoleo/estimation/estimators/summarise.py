"""From where an estimator ended to a point estimate with its linearised covariance."""

from __future__ import annotations

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models.independent import (
    ProfiledCommonErrors,
    ProfiledIndependentErrors,
    output_counts,
    staged_variance,
    sums_of_squares,
)
from bayesoleo.error_models.linearise import (
    RANK,
    LinearisedResidual,
    inverse_gram,
    masked,
    pseudo_inverse_gram,
)
from bayesoleo.estimation.estimators.outcome import Outcome
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.estimation.objectives.bounded import on_limit
from bayesoleo.estimation.objectives.objective import Objective
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.estimation.problems.scaling import PriorScale
from bayesoleo.parallel import single_blas_thread
from bayesoleo.prediction.stability import Stability

# Residuals below this part of the largest sample are rounding: of a sum of hundreds of terms, or of
# samples that were written with thirteen digits.
_ROUNDING = 1e-13


def summarise(
    problem: Problem,
    scale: PriorScale,
    name: str,
    start: Array,
    outcome: Outcome,
    objective: Objective,
    bias_corrected: bool,
) -> PointEstimate:
    """Point estimate of an outcome; NaN where the start could not be evaluated."""
    unknowns, outputs, history = len(problem.names), len(problem.outputs), outcome.history
    error = np.full((outputs, outputs), np.nan)
    covariance = likelihood = np.full((unknowns, unknowns), np.nan)
    if history:
        error = _error_covariance(problem, outcome, objective, bias_corrected)
        with single_blas_thread():  # factors are small: threads would take longer to meet
            covariance, likelihood = _covariances(scale, outcome, objective, error)
    held = on_limit(scale.room(outcome.theta))
    return PointEstimate(
        names=tuple(problem.names),
        outputs=tuple(problem.outputs),
        theta=outcome.theta,
        variance=np.diag(error).copy(),
        covariance=covariance,
        covariance_likelihood=likelihood,
        method=name,
        status=outcome.status,
        iterations=max(len(history) - 1, 0),
        halvings=sum(line.halvings for line in history),
        evaluations=outcome.evaluations,
        objective=history[-1].objective if history else np.nan,
        distance=outcome.distance,
        failures=dict(outcome.failures),
        stability=_stability(problem, outcome),
        start=start,
        history=np.array([line.theta for line in history]).reshape(len(history), unknowns),
        history_variance=np.array([_diagonal(line.variance) for line in history]).reshape(
            len(history), outputs
        ),
        history_objective=np.array([line.objective for line in history]),
        history_halvings=np.array([line.halvings for line in history], dtype=np.int64),
        on_limit=tuple(name for name, at in zip(problem.names, held, strict=True) if at),
        objective_name=objective.name,
        error_covariance=error,
        exact=_exact(problem, np.diag(error)),
    )


def _exact(problem: Problem, variance: Array) -> tuple[str, ...]:
    """Outputs whose residuals are as small as the rounding of their samples, where those are
    known."""
    data = getattr(problem, "data", None)
    if data is None:
        return ()
    sizes = [_ROUNDING * float(np.abs(values).max(initial=0.0)) for values in data]
    columns = zip(problem.outputs, sizes, np.sqrt(variance), strict=True)
    return tuple(name for name, size, sd in columns if sd <= size)


def _stability(problem: Problem, outcome: Outcome) -> Stability | None:
    """Of the runs' periodic solutions at the estimate; None where there are none."""
    matrices = outcome.evaluation.monodromy
    if not any(matrix is not None for matrix in matrices):
        return None
    return Stability.of(problem.runs, matrices, np.zeros(len(matrices), dtype=np.int64))


def _diagonal(covariance: Array) -> Array:
    return np.diag(covariance) if covariance.ndim == 2 else covariance


def _error_covariance(
    problem: Problem, outcome: Outcome, objective: Objective, bias_corrected: bool
) -> Array:
    """Covariance of the outputs' errors at the estimate, (s, s)."""
    counts, errors = output_counts(problem.counts), objective.errors
    if isinstance(
        errors, ProfiledCommonErrors
    ):  # what weights all alike says nothing of their errors
        sums = sums_of_squares(outcome.evaluation)
        unknowns = len(problem.names)
        staged = staged_variance(sums, counts, unknowns, bias_corrected=bias_corrected)
    else:
        moments = errors.moments(outcome.evaluation)
        staged = errors.stage(moments, counts, len(problem.names), bias_corrected)
    return staged if staged.ndim == 2 else np.diag(staged)


def _covariances(
    scale: PriorScale, outcome: Outcome, objective: Objective, error: Array
) -> tuple[Array, Array]:
    """LinearisedResidual covariance of the unknowns with and without the prior, each (l, l).

    References
    ----------
    Verbeek (1993), eq. 2.41: ``H^-1 [sum Phi_py V Phi_py'] H^-1``, which is ``A^-1`` where the
    weights are the errors' own.
    """
    unit, errors = scale.unit(outcome.theta), objective.errors
    units = np.outer(unit, unit)
    if isinstance(errors, ProfiledCommonErrors):
        size = len(error)
        rows = errors.rows(outcome.evaluation, unit, np.ones(size))[0]
        plain, undetermined = pseudo_inverse_gram(rows, RANK)
        scores = LinearisedResidual.of(outcome.evaluation, unit).whitened(1 / np.diag(error))[0]
        likelihood = masked(plain @ (scores.T @ scores) @ plain * units, undetermined)
        return likelihood, likelihood
    held = np.diag(error) if isinstance(errors, ProfiledIndependentErrors) else error
    rows = errors.rows(outcome.evaluation, unit, held)[0]
    likelihood = units * inverse_gram(rows, RANK)
    if not objective.prior:
        return likelihood, likelihood
    return units * inverse_gram(np.vstack((rows, scale.root))), likelihood
