"""Periodic orbits with one more unknown and one more condition: a parameter, or the period.

All unknowns of a period are reduced to the state at its start: linearised, the state at its end is
``M`` times that at its start plus what the other unknown adds, with ``M`` the monodromy matrix. The
closure, bordered by the condition, is regular where the closure alone is not: at a fold, and for an
autonomous system, whose own multiplier is one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array, Float
from bayesoleo.solvers.periodic.solve import Boundary
from bayesoleo.solvers.schemes.collocation import Collocation
from bayesoleo.solvers.status import Status

#: ``value -> (discretised problem, constants (np,))``: what depends on the other unknown.
Family = Callable[[float], tuple[Boundary, Array]]

#: Relative step of the central difference by the other unknown: the cube root of round-off balances
#: its errors. Newton's direction needs no more; the solution does not depend on it.
DIFFERENCE = 6e-6
#: Newton's error is about the square of the last step.
LAST_STEP = 1e-8

_LANE = np.zeros(1, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class BorderedSweep:
    """A period linearised with its first state held.

    Parameters
    ----------
    x : ndarray, shape (n, w)
        Unknowns after one Newton step of the initial value problem.
    gap : ndarray, shape (D,)
        State at the end less that at the start.
    monodromy : ndarray, shape (D, D)
    """

    x: Array
    gap: Array
    monodromy: Array


@dataclass(frozen=True, eq=False)
class PhaseCondition:
    """The additional equation ``row @ (state, value) = target``, linear in the first state.

    Parameters
    ----------
    row : ndarray, shape (D + 1,)
    target : float
    """

    row: Array
    target: float


@dataclass(frozen=True, eq=False)
class BorderedSolution:
    """A closed motion with the value of the other unknown.

    Parameters
    ----------
    x : ndarray, shape (n, w)
        The scheme's unknowns.
    value : float
    monodromy : ndarray, shape (D, D)
    by_value : ndarray, shape (D,)
        Derivative of the gap by the value.
    status : Status
    iterations : int
    """

    x: Float[Array, "steps width"]
    value: float
    monodromy: Float[Array, "states states"]
    by_value: Float[Array, " states"]
    status: Status
    iterations: int


def sweep(family: Family, x: Array, value: float) -> tuple[BorderedSweep | None, Status]:
    """Linearise a period about unknowns ``x (n, w)``; None with the reason where it cannot be."""
    problem, p = family(value)
    method = _one_step(problem)
    D, d = method.state_size, len(method.orders)
    points, step = problem.inputs.shape[1], problem.step(len(x))
    z, g = np.zeros((1, D + d, points)), np.zeros((1, d, points))
    gz, a = np.zeros((1, d, D + d, points)), np.ones((1, problem.conditions, points))
    with np.errstate(all="ignore"):
        method.rows(x[None], _LANE, step, z)
        problem.equations.jacobian(z, problem.inputs, p[None], _LANE, g, gz)
        if problem.conditions:
            problem.equations.admissible(z, problem.inputs, p[None], _LANE, a)
    if not (np.isfinite(g).all() and np.isfinite(gz).all()):
        return None, Status.NOT_FINITE
    if not (a > 0).all():
        return None, Status.INADMISSIBLE
    dx, monodromy, ok = method.linear(gz, g[:, :, None], x[None], _LANE, step, initial=True)
    if not (ok[0] and np.isfinite(dx).all() and np.isfinite(monodromy).all()):
        return None, Status.SINGULAR
    moved = x + dx[0, :, :, 0]
    end = end_states(problem, moved[..., None])[:, 0]
    return BorderedSweep(moved, end - moved[0, :D], monodromy[0]), Status.CONVERGED


def end_states(problem: Boundary, columns: Array) -> Array:
    """States ``(D, C)`` at the end of the period from unknowns, or changes, ``(n, w, C)``."""
    method = _one_step(problem)
    last = method.plan(np.ones(1), len(columns), initial=True)
    rows = method.sample(columns[None], last, problem.step(len(columns)))[0, :, :, 0]
    first = np.cumsum([0, *(order + 1 for order in method.orders)])
    return rows[[first[j] + k for j, o in enumerate(method.orders) for k in range(o)]]


def solve_bordered(
    family: Family, x: Array, value: float, condition: PhaseCondition, *, max_iterations: int = 25
) -> BorderedSolution:
    """Newton's method for a closed motion that fulfils one more condition.

    Parameters
    ----------
    family : callable
        See :data:`Family`; its scheme is a one-step collocation.
    x : ndarray, shape (n, w)
        Where the unknowns of the period start.
    value : float
        Where the other unknown starts.
    condition : PhaseCondition
    max_iterations : int

    Returns
    -------
    BorderedSolution
    """
    status, iterations, D = Status.NO_CONVERGENCE, 0, condition.row.size - 1
    monodromy, by_value = np.full((D, D), np.nan), np.full(D, np.nan)
    for number in range(1, max_iterations + 1):
        iterations = number
        here, reason = sweep(family, x, value)
        slope = _gap_by_value(family, x, value)
        if here is None or slope is None:
            status = reason if here is None else Status.NOT_FINITE
            break
        monodromy, by_value = here.monodromy, slope
        border = np.block([[np.eye(D) - monodromy, -by_value[:, None]], [condition.row[None]]])
        left = condition.target - condition.row @ np.append(x[0, :D], value)
        change = _solve(border, np.append(here.gap, left))
        if change is None:
            status = Status.SINGULAR
            break
        moved = x.copy()
        moved[0, :D] += change[:D]
        after, reason = sweep(family, moved, value + change[D])
        if after is None:
            status = reason
            break
        spread = np.abs(x[:, :D]).max(axis=0) + np.finfo(float).tiny
        size = float((np.abs(after.x - x)[:, :D] / spread).max())
        x, value = after.x, float(value + change[D])
        if size < LAST_STEP:
            status = Status.CONVERGED
            break
    return BorderedSolution(x, value, monodromy, by_value, status, iterations)


def _gap_by_value(family: Family, x: Array, value: float) -> Array | None:
    width = DIFFERENCE * max(abs(value), DIFFERENCE)
    ahead, _ = sweep(family, x, value + width)
    behind, _ = sweep(family, x, value - width)
    if ahead is None or behind is None:
        return None
    return (ahead.gap - behind.gap) / (2 * width)


def _solve(matrix: Array, right: Array) -> Array | None:
    """Solution with rows and columns brought to one size, None where it is singular."""
    scale = np.abs(matrix).max(axis=1, keepdims=True)
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        return None
    try:
        answer = np.linalg.solve(matrix / scale, right / scale[:, 0])
    except np.linalg.LinAlgError:
        return None
    return answer if np.isfinite(answer).all() else None


def _one_step(problem: Boundary) -> Collocation:
    assert isinstance(problem.scheme, Collocation)  # its state closes a period; differences' do not
    return problem.scheme
