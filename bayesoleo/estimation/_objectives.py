"""Objective functions by name, their second derivatives, and Newton's method.

An objective is an error model, with or without the prior. Its derivatives are with respect to
``phi = (theta, v)``: parameters first, then the error variances.

Newton's method is written as least-squares equations. With ``v`` eliminated at every step, the
step of the parameters is that of the joint problem in ``(theta, v)``: the Hessian loses the Schur
complement ``H_tv H_vv^-1 H_vt``. The part of the Hessian that Gauss-Newton omits,
``sum e_tt v^-1 e``, comes from central differences of the sensitivities along each unknown,
contracted with the residual. That takes ``2 l`` evaluations and no second derivative of a model; a
periodic orbit would need ``l (l + 1) / 2`` more linear solves for each run, with new kernels.

References
----------
Verbeek (1993), eqs. 2.25-2.35, and Appendix A, which minimises ``-Phi_B``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import ProfiledErrorModel
from bayesoleo.error_models._full import GivenErrors
from bayesoleo.error_models._independent import log_likelihood, output_counts, sums_of_squares
from bayesoleo.error_models._registry import profiled_error_model
from bayesoleo.errors import InputError
from bayesoleo.estimation._least_squares import PriorScale, WhitenedEquations
from bayesoleo.estimation._problem import EstimationProblem, Evaluation
from bayesoleo.model._correlated_priors import Correlated, log_density_of, scaled_root
from bayesoleo.model._priors import Normal, Prior

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
# A step of this part of a conditional standard deviation: the third derivative costs its square,
# and a solver's tolerance of 1e-10 is divided by it once.
_STEP = 0.02
_PRIOR_STEP = 1e-3
# Of the prior's standard deviation, for its own curvature.
_NEWTON_PRIOR_STEP = 1e-4
# Smallest eigenvalue that is kept, as a part of the largest, after scaling to a unit diagonal.
_FLOOR = 1e-12


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
    problem: EstimationProblem, name: str | Objective, error_covariance: object = None
) -> Objective:
    """The objective of this name for a problem.

    Parameters
    ----------
    problem : EstimationProblem
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
    counts: Integers,
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


def curvature(
    problem: EstimationProblem,
    theta: Array,
    variance: Array,
    *,
    prior: bool = True,
    exact: bool = False,
) -> Array:
    """Negative Hessian ``H`` of the objective, shape (l + s, l + s).

    Parameters
    ----------
    problem : EstimationProblem
    theta : ndarray, shape (l,)
    variance : ndarray, shape (s,)
    prior : bool, optional
        Whether the prior counts: ``Phi_B`` (eq. 2.29), otherwise the likelihood (eq. 2.31).
    exact : bool, optional
        With the residual's second derivatives, by central differences of the sensitivities at ``2
        l`` points; otherwise as Gauss and Newton.

    Returns
    -------
    ndarray, shape (l + s, l + s)
        In reciprocal units of the unknowns.

    Raises
    ------
    InputError
        If the problem cannot be evaluated there.

    References
    ----------
    Verbeek (1993), Appendix A: ``H_tt = A + sum e_tt v^-1 e + w^-1``, ``H_vt = -sum e_t e / v**2``,
    ``H_vv = -n / (2 v**2) + sum e**2 / v**3``.
    """
    evaluation = evaluated(problem, theta)
    size = len(theta)
    sums, counts = sums_of_squares(evaluation), output_counts(problem.counts)
    top = _second(problem, theta, variance, evaluation) if exact else _gram(evaluation, variance)
    if prior:
        top = top + prior_precision(problem.priors, theta)
    whole = np.zeros((size + len(variance), size + len(variance)))
    whole[:size, :size] = top
    for b, v in enumerate(variance):
        cross = evaluation.sensitivity[b].T @ evaluation.residual[b] / v**2
        whole[:size, size + b] = whole[size + b, :size] = cross
        whole[size + b, size + b] = -counts[b] / (2 * v**2) + sums[b] / v**3
    return whole


def noise_of_gradient(problem: EstimationProblem, theta: Array, variance: Array) -> Array:
    """``sum Phi_phi,y V Phi_phi,y'``: covariance of the objective's slope, shape (l + s, l + s).

    References
    ----------
    Verbeek (1993), eqs. 2.36-2.41.
    """
    evaluation = evaluated(problem, theta)
    size = len(theta)
    sums = sums_of_squares(evaluation)
    whole = np.zeros((size + len(variance), size + len(variance)))
    whole[:size, :size] = _gram(evaluation, variance)
    for b, v in enumerate(variance):
        cross = evaluation.sensitivity[b].T @ evaluation.residual[b] / v**2
        whole[:size, size + b] = whole[size + b, :size] = cross
        whole[size + b, size + b] = sums[b] / v**3
    return whole


def evaluated(problem: EstimationProblem, theta: Array) -> Evaluation:
    """The problem at parameters where it must have a solution.

    Raises
    ------
    InputError
        If it has none.
    """
    evaluation = problem.evaluate(np.array(theta, dtype=float))
    if not evaluation.status.ok:
        raise InputError(
            f"cannot be evaluated: {evaluation.status.message}",
            key="theta",
            value=np.asarray(theta).tolist(),
            hint="give an estimate that converged",
        )
    return evaluation


def prior_precision(priors: Sequence[Prior], theta: Array) -> Array:
    """Negative Hessian of the log prior, shape (l, l)."""
    sd = np.array([prior.sd for prior in priors])
    root = scaled_root(priors, sd) / sd
    precision = root.T @ root
    for k, (prior, value) in enumerate(zip(priors, theta, strict=True)):
        if not isinstance(prior, Correlated):
            precision[k, k] = _precision(prior, float(value))
    return cast(Array, precision)


def inverse_scaled(matrix: Array) -> Array:
    """Inverse of a symmetric matrix whose entries range over decades; NaN where it is singular."""
    scale = np.sqrt(np.abs(np.diag(matrix)))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    if values.size == 0 or np.abs(values).min() <= 1e-14 * np.abs(values).max():
        return np.full_like(matrix, np.nan)
    return cast(Array, (vectors / values) @ vectors.T / np.outer(scale, scale))


def _gram(evaluation: Evaluation, variance: Array) -> Array:
    parts = zip(evaluation.sensitivity, variance, strict=True)
    return np.asarray(sum(jacobian.T @ (jacobian / v) for jacobian, v in parts))


def _slope(evaluation: Evaluation, variance: Array) -> Array:
    parts = zip(evaluation.sensitivity, evaluation.residual, variance, strict=True)
    return np.asarray(sum(jacobian.T @ (residual / v) for jacobian, residual, v in parts))


def _second(problem: EstimationProblem, theta: Array, variance: Array, here: Evaluation) -> Array:
    gram = _gram(here, variance)
    steps = _STEP / np.sqrt(np.diag(gram))
    columns = []
    for k, step in enumerate(steps):
        change = np.zeros(len(theta))
        change[k] = step
        ahead = _slope(evaluated(problem, theta + change), variance)
        behind = _slope(evaluated(problem, theta - change), variance)
        columns.append((behind - ahead) / (2 * step))
    problem.evaluate(theta)  # a campaign's solver starts the next solution from the last one
    matrix = np.array(columns)
    return cast(Array, 0.5 * (matrix + matrix.T))


def _precision(prior: Prior, value: float) -> float:
    if isinstance(prior, Normal):
        return prior.spread**-2
    step = _PRIOR_STEP * prior.sd
    ends = prior.log_density(np.array([value - step, value, value + step]))
    if not np.isfinite(ends).all():  # next to a limit nothing is known of the other side
        return 0.0
    return float(max(-(ends[0] - 2 * ends[1] + ends[2]) / step**2, 0.0))


def newton_equations(
    problem: EstimationProblem,
    errors: ProfiledErrorModel,
    scale: PriorScale,
    theta: Array,
    evaluation: Evaluation,
    variance: Array,
    equations: WhitenedEquations,
    *,
    prior: bool,
) -> WhitenedEquations:
    """Equations whose step is Newton's.

    Parameters
    ----------
    problem : EstimationProblem
    errors : ProfiledErrorModel
    scale : PriorScale
    theta : ndarray, shape (l,)
    evaluation : Evaluation
        At ``theta``.
    variance : ndarray, shape (s,) or (s, s)
        Staged there.
    equations : WhitenedEquations
        Of Gauss and Newton; their slope is that of the prior, if it counts.
    prior : bool
        Whether it does.

    Returns
    -------
    WhitenedEquations
        With the triangular factor of the Hessian as Jacobian. Where the Hessian is not positive
        definite, the directions in which it is not are taken with the opposite sign, so that the
        step climbs.
    """
    unit, gradient = scale.unit(theta), equations.gradient
    hessian = equations.jacobian.T @ equations.jacobian
    hessian = hessian - errors.eliminated(evaluation, unit, variance, output_counts(problem.counts))
    weighted = errors.weighted(evaluation.residual, variance)
    hessian = hessian - _differences(problem, scale, theta, weighted, equations.sd())
    if prior:
        hessian = hessian + _prior_curvature(scale, theta)
    root = _positive_root(hessian)
    pull = np.linalg.solve(root.T, gradient)
    nothing = np.zeros(theta.size)
    none = np.zeros((0, theta.size))
    return replace(equations, jacobian=root, residual=pull, slope=nothing, root=none)


def _differences(
    problem: EstimationProblem,
    scale: PriorScale,
    theta: Array,
    weighted: Sequence[Array],
    sd: Array,
) -> Array:
    """``d (J' V^-1 e) / dz`` with the residual held, in scaled unknowns, (l, l)."""
    columns = []
    for k in range(theta.size):
        step = np.zeros(theta.size)
        step[k] = _STEP * sd[k]
        ends = [
            _prior_slope(problem, scale, scale.moved(theta, sign * step), weighted)
            for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]) / (2 * step[k]))
    matrix = np.array(columns)
    # next to where the model ends there is no second derivative to be had: Gauss and Newton's
    return cast(Array, np.nan_to_num(0.5 * (matrix + matrix.T), nan=0.0, posinf=0.0, neginf=0.0))


def _prior_slope(
    problem: EstimationProblem, scale: PriorScale, theta: Array, weighted: Sequence[Array]
) -> Array:
    sensitivity = problem.evaluate(theta).sensitivity
    parts = [j.T @ w for j, w in zip(sensitivity, weighted, strict=True)]
    return np.asarray(scale.unit(theta) * np.sum(parts, axis=0))


def _prior_curvature(scale: PriorScale, theta: Array) -> Array:
    """Negative Hessian of the log prior in scaled unknowns, (l, l)."""
    steps = _NEWTON_PRIOR_STEP * np.eye(theta.size)
    ahead = scale.slope(scale.moved(theta, steps))
    behind = scale.slope(scale.moved(theta, -steps))
    matrix = (behind - ahead) / (2 * _NEWTON_PRIOR_STEP)
    return np.asarray(0.5 * (matrix + matrix.T))


def _positive_root(hessian: Array) -> Array:
    """Triangle ``R`` with ``R'R`` the matrix, its negative eigenvalues turned positive."""
    diagonal = np.sqrt(np.maximum(np.abs(np.diag(hessian)), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(hessian / np.outer(diagonal, diagonal))
    values = np.maximum(np.abs(values), _FLOOR * np.abs(values).max())
    rows = np.sqrt(values)[:, None] * vectors.T * diagonal
    return np.asarray(np.linalg.qr(rows, mode="r"))
