"""Residuals of a problem at one vector, and what they tell of its unknowns under an error model."""

from __future__ import annotations

from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models import ErrorModel
from bayesoleo.errors import InputError
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.estimation.problems.residuals import ResidualProblem
from bayesoleo.solvers.status import Status


def residuals_at(problem: Problem, errors: ErrorModel, theta: Array) -> list[Array]:
    """Residuals (s, n) of every run; where sums are enough, columns of equal squares.

    Raises
    ------
    InputError
        If they cannot be computed.
    """
    parts, status = [], Status.CONVERGED
    if errors.by_sums:
        misfit = problem.misfit(theta[None])
        status = Status(int(misfit.status[0]))
        if status.ok:
            counts = np.asarray(problem.counts)
            sizes = np.sqrt(misfit.sum_of_squares[0] / counts)
            for row, n in zip(sizes, counts, strict=True):
                parts.append(np.repeat(row[:, None], n[0], axis=1))
    else:
        for run in range(len(problem.runs)):
            residual, found = cast(ResidualProblem, problem).residuals(theta[None], run)
            status = max(status, Status(int(found[0])))
            parts.append(residual[0])
    if not status.ok:
        raise InputError(f"a start cannot be evaluated: {status.message}", value=theta.tolist())
    return parts


def information_at(problem: Problem, errors: ErrorModel, theta: Array, eta: Array) -> Array:
    """``sum J' V^-1 J`` over runs and outputs, shape (l, l); zero where it cannot be computed.

    Parameters
    ----------
    problem : Problem
        Its ``evaluate`` is called once.
    errors : ErrorModel
        Gives ``V``.
    theta : ndarray, shape (l,)
        Unknowns in their units.
    eta : ndarray, shape (m,)
        Coordinates of the error model.

    References
    ----------
    Verbeek (1993), eq. 3.19: ``A``.
    """
    total = np.zeros((len(theta), len(theta)))
    evaluation = problem.evaluate(theta)
    if not evaluation.status.ok:
        return total
    counts = np.asarray(problem.counts)
    ends = np.cumsum(counts, axis=0)
    for run, (first, last) in enumerate(zip(ends - counts, ends, strict=True)):
        columns = zip(evaluation.sensitivity, first, last, strict=True)
        total += errors.products(run, [j[a:b].T for j, a, b in columns], eta)
    return total
