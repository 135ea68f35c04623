"""Second derivatives of the objective: Newton's method as least-squares equations.

With ``v`` eliminated at every step, Newton's step for the parameters is that of the joint problem
in ``(theta, v)``: the Hessian loses the Schur complement ``H_tv H_vv^-1 H_vt``. The part of the
Hessian that Gauss and Newton leave out, ``sum e_tt v^-1 e``, comes from central differences of the
sensitivities along each unknown, contracted with the residual. That takes ``2 l`` evaluations and
no second derivative of any model, of which a periodic orbit would need ``l (l + 1) / 2`` more
linear solves for each run, with new kernels.

References
----------
Verbeek (1993), Appendix A, which minimises ``-Phi_B``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models.base import ProfiledErrorModel
from bayesoleo.error_models.independent import output_counts
from bayesoleo.estimation.objectives.equations import WhitenedEquations
from bayesoleo.estimation.problems.problem import Evaluation, Problem
from bayesoleo.estimation.problems.scaling import PriorScale

# Part of a linearised standard deviation: the third derivative costs its square, and a solver's
# tolerance of 1e-10 is divided by it once.
_STEP = 0.02
# Of the prior's standard deviation, for its own curvature.
_PRIOR_STEP = 1e-4
# Smallest eigenvalue that is kept, as a part of the largest, after scaling to a unit diagonal.
_FLOOR = 1e-12


def newton_equations(
    problem: Problem,
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
    problem : Problem
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
    problem: Problem, scale: PriorScale, theta: Array, weighted: Sequence[Array], sd: Array
) -> Array:
    """``d (J' V^-1 e) / dz`` with the residual held, in scaled unknowns, (l, l)."""
    columns = []
    for k in range(theta.size):
        step = np.zeros(theta.size)
        step[k] = _STEP * sd[k]
        ends = [
            _slope(problem, scale, scale.moved(theta, sign * step), weighted)
            for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]) / (2 * step[k]))
    matrix = np.array(columns)
    # next to where the model ends there is no second derivative to be had: Gauss and Newton's
    return cast(Array, np.nan_to_num(0.5 * (matrix + matrix.T), nan=0.0, posinf=0.0, neginf=0.0))


def _slope(problem: Problem, scale: PriorScale, theta: Array, weighted: Sequence[Array]) -> Array:
    sensitivity = problem.evaluate(theta).sensitivity
    parts = [j.T @ w for j, w in zip(sensitivity, weighted, strict=True)]
    return np.asarray(scale.unit(theta) * np.sum(parts, axis=0))


def _prior_curvature(scale: PriorScale, theta: Array) -> Array:
    """Negative Hessian of the log prior in scaled unknowns, (l, l)."""
    steps = _PRIOR_STEP * np.eye(theta.size)
    ahead = scale.slope(scale.moved(theta, steps))
    behind = scale.slope(scale.moved(theta, -steps))
    matrix = (behind - ahead) / (2 * _PRIOR_STEP)
    return np.asarray(0.5 * (matrix + matrix.T))


def _positive_root(hessian: Array) -> Array:
    """Triangle ``R`` with ``R'R`` the matrix, its negative eigenvalues turned positive."""
    diagonal = np.sqrt(np.maximum(np.abs(np.diag(hessian)), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(hessian / np.outer(diagonal, diagonal))
    values = np.maximum(np.abs(values), _FLOOR * np.abs(values).max())
    rows = np.sqrt(values)[:, None] * vectors.T * diagonal
    return np.asarray(np.linalg.qr(rows, mode="r"))
