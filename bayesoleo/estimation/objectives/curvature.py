"""Second derivatives of the objective at an estimate, and what noise of the data does through them.

Everything is about ``phi = (theta, v)``: parameters first, then the error variances.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models.independent import output_counts, sums_of_squares
from bayesoleo.errors import InputError
from bayesoleo.estimation.problems.problem import Evaluation, Problem
from bayesoleo.model.correlated import Correlated, scaled_root
from bayesoleo.model.priors import Normal, Prior

# A step of this part of a conditional standard deviation: the third derivative costs its square,
# and a solver's tolerance of 1e-10 is divided by it once.
_STEP = 0.02
_PRIOR_STEP = 1e-3


def curvature(
    problem: Problem, theta: Array, variance: Array, *, prior: bool = True, exact: bool = False
) -> Array:
    """Negative Hessian ``H`` of the objective, shape (l + s, l + s).

    Parameters
    ----------
    problem : Problem
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


def noise_of_gradient(problem: Problem, theta: Array, variance: Array) -> Array:
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


def evaluated(problem: Problem, theta: Array) -> Evaluation:
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


def _second(problem: Problem, theta: Array, variance: Array, here: Evaluation) -> Array:
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
