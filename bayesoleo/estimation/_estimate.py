"""Entry points of estimation: ``estimate`` fits a problem, ``polish`` finds the posterior mode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo._parallel import single_blas_thread
from bayesoleo._types import Array
from bayesoleo.error_models._fitting import (
    RANK,
    LinearisedResidual,
    inverse_gram,
    masked,
    pseudo_inverse_gram,
)
from bayesoleo.error_models._independent import (
    ProfiledCommonErrors,
    ProfiledIndependentErrors,
    output_counts,
    staged_variance,
    sums_of_squares,
)
from bayesoleo.errors import InputError
from bayesoleo.estimation._bayesian_estimators import Step, method as find_method
from bayesoleo.estimation._iteration import Iteration, Outcome, iterate
from bayesoleo.estimation._least_squares import PriorScale, on_limit
from bayesoleo.estimation._nuisance import with_measured, without_measured
from bayesoleo.estimation._objectives import Objective, objective_of
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import (
    EstimationProblem,
    jumps_of,
    measured_of,
    stability_changes_of,
)
from bayesoleo.estimation._scipy_methods import MOST_ITERATIONS, PREFIX, run_scipy
from bayesoleo.prediction._stability import Stability
from bayesoleo.solvers._orbit import added

# Residuals below this part of the largest sample are rounding errors of a sum of hundreds of terms,
# or of samples that were written with thirteen digits.
_ROUNDING = 1e-13
Progress = Callable[[Iteration], None]
Method = str | Step[Any]
#: MBE needs a prior that scales its steps; Levenberg-Marquardt converges without one.
DEFAULT_METHODS: tuple[Method, ...] = ("mbe", "levenberg-marquardt")


def summarise(
    problem: EstimationProblem,
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


def _exact(problem: EstimationProblem, variance: Array) -> tuple[str, ...]:
    """Outputs whose residuals are at the rounding level of their known samples."""
    data = getattr(problem, "data", None)
    if data is None:
        return ()
    sizes = [_ROUNDING * float(np.abs(values).max(initial=0.0)) for values in data]
    columns = zip(problem.outputs, sizes, np.sqrt(variance), strict=True)
    return tuple(name for name, size, sd in columns if sd <= size)


def _stability(problem: EstimationProblem, outcome: Outcome) -> Stability | None:
    """Stability of the runs' periodic solutions at the estimate; None where there are none."""
    matrices = outcome.evaluation.monodromy
    if not any(matrix is not None for matrix in matrices):
        return None
    return Stability.of(problem.runs, matrices, np.zeros(len(matrices), dtype=np.int64))


def _diagonal(covariance: Array) -> Array:
    return np.diag(covariance) if covariance.ndim == 2 else covariance


def _error_covariance(
    problem: EstimationProblem, outcome: Outcome, objective: Objective, bias_corrected: bool
) -> Array:
    """Covariance of the outputs' errors at the estimate, (s, s)."""
    counts, errors = output_counts(problem.counts), objective.errors
    if isinstance(errors, ProfiledCommonErrors):  # equal weights give no information on the errors
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
    """Linearised covariance of the unknowns with and without the prior, each (l, l).

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


def estimate(
    problem: EstimationProblem,
    method: Method | Sequence[Method] = DEFAULT_METHODS,
    *,
    objective: str | Objective = "diagonal",
    error_covariance: object = None,
    start: ArrayLike | None = None,
    tolerance: float = 1e-8,
    max_iterations: int | None = None,
    resolution: float = 0.0,
    bias_corrected: bool = False,
    progress: Progress | None = None,
) -> PointEstimate:
    """Estimate the unknowns of a problem.

    Parameters
    ----------
    problem : EstimationProblem
        Problem to fit.
    method : str or Step, or sequence of them, optional
        ``"be"``, ``"mve"``, ``"mmve"``, ``"mbe"``, ``"gauss-newton"``, ``"levenberg-marquardt"``,
        ``"newton"``, or ``"scipy:"`` and the name of one of SciPy's optimisers. Several are
        tried in order, each from the start, until one converges. ``"be"``, ``"newton"`` and SciPy's
        find a mode of the posterior where the objective has a prior. The others find the
        maximum-likelihood point and use the prior only to scale the steps: they hold nuisance
        parameters and constants known to a tolerance at the start, and carry their uncertainty into
        the covariance. Unknowns with a log-normal prior are stepped in their logarithm, but the
        mode is that of the density per unit of the unknown itself.
    objective : str or Objective, optional
        Objective to maximise: ``"diagonal"`` (the thesis's standard), ``"full"``, ``"given"``,
        ``"likelihood"``, ``"determinant"``, ``"weighted"`` or ``"unweighted"``; see
        :data:`bayesoleo.estimation.OBJECTIVES`.
    error_covariance : array_like or sequence of array_like, optional
        Known errors for ``"given"`` and ``"weighted"``: a variance for each output, (s,); an array
        of variances by sample for each output; a covariance, (s, s), or one by sample, (n, s, s).
        By default the noise that was measured in a campaign's records.
    start : array_like, shape (l,), optional
        By default the problem's own.
    tolerance : float, optional
        Relative step: converged when every step is below this part of the unknown, or of its
        linearised standard deviation where that is larger.
    max_iterations : int, optional
        By default 100, and 1000 for Levenberg-Marquardt and for SciPy's optimisers, which take
        many small steps where the others would stop.
    resolution : float, optional
        Converged also where the optimum is nearer than this many standard deviations, because the
        data cannot resolve smaller differences. Zero requires the relative step.
    bias_corrected : bool, optional
        Divide the sums of squares by ``n - l/s`` instead of ``n``.
    progress : callable, optional
        Called with each :class:`~bayesoleo.estimation.Iteration`.

    Returns
    -------
    PointEstimate
        A numerical failure is its ``status``, never an exception.

    Raises
    ------
    InputError
        If an output has no sample, the start does not fit or lies outside a prior's support, or the
        method is unknown.

    References
    ----------
    Verbeek (1993), section 2.3, eqs. 2.25-2.35 (objectives), sections 3.2 and 3.3, eqs. 3.17-3.23
    (estimators).
    """
    _check_samples(problem)
    scale = PriorScale.of(problem.priors, problem.names)
    begin = checked_start(problem.names, scale, problem.start if start is None else start)
    wanted = objective_of(problem, objective, error_covariance)
    limits = _Limits(tolerance, max_iterations, resolution, bias_corrected, progress)
    found: list[PointEstimate] = []
    jumps, changes = jumps_of(problem), stability_changes_of(problem)
    for each in [method] if isinstance(method, str | Step) else method:
        found.append(_one(problem, each, begin, wanted, limits))
        if found[-1].status.ok:
            break
    best = found[-1] if found[-1].status.ok else max(found, key=_height)
    return replace(
        best,
        evaluations=sum(point.evaluations for point in found),
        failures=added(point.failures for point in found),
        stability=best.stability
        and best.stability.with_jumps(
            jumps_of(problem) - jumps, stability_changes_of(problem) - changes
        ),
    )


def _one(
    problem: EstimationProblem, method: Method, start: Array, objective: Objective, limits: _Limits
) -> PointEstimate:
    """Estimate by one method; one that disregards priors holds the nuisance parameters."""
    measured = measured_of(problem)
    if measured.any() and not _counts_prior(method, objective):
        section = without_measured(problem, start, measured)
        point = _one(section, method, start[~measured], objective, limits)
        return with_measured(point, problem, start, measured)
    scale = PriorScale.of(problem.priors, problem.names)
    name, outcome = limits.run(problem, method, start, objective)
    return summarise(problem, scale, name, start, outcome, objective, limits.bias_corrected)


def _counts_prior(method: Method, objective: Objective) -> bool:
    """Whether the prior belongs to an estimator's objective."""
    by_scipy = isinstance(method, str) and method.startswith(PREFIX)
    return objective.prior and (by_scipy or find_method(method).fixed_prior)


@dataclass(frozen=True)
class _Limits:
    """Stopping rule of an estimator, and its progress callback."""

    tolerance: float
    max_iterations: int | None
    resolution: float
    bias_corrected: bool
    progress: Progress | None

    def run(
        self, problem: EstimationProblem, method: Method, start: Array, objective: Objective
    ) -> tuple[str, Outcome]:
        """Name of the estimator, and its outcome."""
        common: dict[str, Any] = {
            "tolerance": self.tolerance,
            "bias_corrected": self.bias_corrected,
            "max_iterations": self.max_iterations,
        }
        if isinstance(method, str) and method.startswith(PREFIX):
            name = method.removeprefix(PREFIX)
            common["max_iterations"] = self.max_iterations or MOST_ITERATIONS
            return method, run_scipy(problem, name, start, objective, **common)
        step = find_method(method)
        if step.name == "be" and not objective.prior:
            raise InputError(
                f"the objective {objective.name!r} has no prior, which BE would weigh",
                key="method",
                value="be",
                hint="use mbe, levenberg-marquardt, gauss-newton or newton",
            )
        common["max_iterations"] = self.max_iterations or step.most
        common |= {"resolution": self.resolution, "progress": self.progress}
        return step.name, iterate(problem, step, start, objective, **common)


def _height(point: PointEstimate) -> float:
    """Log-likelihood that a failed estimate reached, to compare failures."""
    with np.errstate(divide="ignore"):
        return -float(np.nan_to_num(np.log(point.variance), nan=np.inf).sum())


def polish(
    problem: EstimationProblem,
    point: PointEstimate,
    *,
    method: str | Step[Any] = "be",
    objective: str | Objective = "diagonal",
    error_covariance: object = None,
    tolerance: float = 1e-8,
    max_iterations: int | None = None,
    resolution: float = 0.0,
    progress: Progress | None = None,
) -> PointEstimate:
    """Move from an estimate, usually MBE's, to the posterior's mode by the Bayesian estimator.

    The staged variance maximises the objective at fixed parameters, so the fixed point is the joint
    mode in the parameters and the variances.

    Parameters
    ----------
    problem : EstimationProblem
    point : PointEstimate
        Where to begin.
    method : str or Step, optional
        An estimator that goes to a mode.
    objective, error_covariance, tolerance, max_iterations, resolution, progress
        As in :func:`estimate`.

    Returns
    -------
    PointEstimate
    """
    return estimate(
        problem,
        method,
        objective=objective,
        error_covariance=error_covariance,
        start=point.theta,
        tolerance=tolerance,
        max_iterations=max_iterations,
        resolution=resolution,
        progress=progress,
    )


def _check_samples(problem: EstimationProblem) -> None:
    """Raise where an output was not measured in any run."""
    for name, count in zip(problem.outputs, output_counts(problem.counts), strict=True):
        if count == 0:
            raise InputError("there is no sample to estimate from", column=name)


def checked_start(names: Sequence[str], scale: PriorScale, start: ArrayLike) -> Array:
    """The start as an array, or an :class:`InputError` that names what does not fit."""
    theta = np.array(start, dtype=float)
    if theta.shape != scale.mean.shape or not np.isfinite(theta).all():
        raise InputError(
            "start must be one finite number per unknown",
            key="start",
            value=theta.tolist(),
            hint=f"the unknowns are {', '.join(names)}",
        )
    inside = scale.inside(theta)
    columns = (names, theta, scale.low, scale.high, inside)
    for name, value, low, high, fits in zip(*columns, strict=True):
        if not fits:
            raise InputError(
                "start lies outside the prior's support",
                key=name,
                value=float(value),
                hint=f"use a value between {low:g} and {high:g}",
            )
    return theta
