"""Limit cycles of autonomous systems, whose period and phase are unknown.

The closure is bordered by the period and by a phase condition: the first state stays in the plane
through the guess, perpendicular to the motion.

References
----------
Seydel, R. (2010). Practical Bifurcation and Stability Analysis, 3rd ed., section 7.1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from bayesoleo._types import Array, Float
from bayesoleo.solvers._branches import (
    BorderedSolution,
    Family,
    PhaseCondition,
    end_states,
    solve_bordered,
)
from bayesoleo.solvers._orbit import Orbit, Status
from bayesoleo.solvers._periodic import Boundary

_LANE = np.zeros(1, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class LimitCycle:
    """A cycle of an autonomous system.

    Parameters
    ----------
    solution : BorderedSolution
        Its value is the period, s.
    orbit : Orbit
    period_theta : ndarray, shape (na,)
        Derivatives of the period by the active parameters; NaN where the solve failed.
    """

    solution: BorderedSolution
    orbit: Orbit
    period_theta: Float[Array, " active"]

    @property
    def own(self) -> complex:
        """The multiplier along the motion: one, but for the errors of the solution."""
        values = self.orbit.multipliers
        return complex(values[np.argmin(np.abs(values - 1.0))])

    @property
    def stable(self) -> bool:
        """Whether all multipliers but the motion's own lie inside the unit circle."""
        values = self.orbit.multipliers
        others = np.delete(values, np.argmin(np.abs(values - 1.0)))
        return self.orbit.status.solved and bool(np.all(np.abs(others) < 1.0))

    def __repr__(self) -> str:
        status = self.orbit.status
        if not status.solved:
            return f"limit cycle, {status.name.lower().replace('_', ' ')}"
        kind = "stable" if self.stable else "unstable"
        return f"{kind} limit cycle of period {self.solution.value:.8g} s"


def solve_limit_cycle(problem: Boundary, p: Array, x: Array, period: float) -> LimitCycle:
    """Solve for a cycle and its period.

    Parameters
    ----------
    problem : Boundary
        With constant inputs; its own period does not count.
    p : ndarray, shape (np,)
        Constants.
    x : ndarray, shape (n, w)
        Where the scheme's unknowns start: a motion near the cycle. At a rest position the condition
        on the phase is void, and the status says that it is singular.
    period : float
        Where the period starts, s.

    Returns
    -------
    LimitCycle
        Without an estimate of its error; see :func:`with_error`.
    """

    def family(value: float) -> tuple[Boundary, Array]:
        return replace(problem, period=value), p

    D, method = problem.scheme.state_size, problem.scheme
    plan = method.plan(np.zeros(1), len(x))
    rows = method.sample(x[None, :, :, None], plan, period / len(x))[0, :, 0, 0]
    first = np.cumsum([0, *(order + 1 for order in method.orders)])
    moving = rows[[first[j] + k + 1 for j, o in enumerate(method.orders) for k in range(o)]]
    condition = PhaseCondition(np.append(moving, 0.0), float(moving @ x[0, :D]))
    solution = solve_bordered(family, x, period, condition)
    orbit = Orbit(
        phases=np.arange(len(x)) / len(x),
        states=solution.x[:, :D],
        period=solution.value,
        monodromy=solution.monodromy,
        status=Status.NO_ERROR_ESTIMATE if solution.status.ok else solution.status,
        error=np.nan,
        evaluations=4 * solution.iterations * problem.inputs.shape[1],
    )
    return LimitCycle(solution, orbit, _period_theta(family, solution, condition))


def with_error(cycle: LimitCycle, problem: Boundary, finer: LimitCycle) -> LimitCycle:
    """A cycle with its error, by the same cycle on steps half as long.

    Parameters
    ----------
    cycle : LimitCycle
        Of :func:`solve_limit_cycle`.
    problem : Boundary
        As solved.
    finer : LimitCycle
        On twice as many steps of equal length, started from it.

    Returns
    -------
    LimitCycle
        Its error is the larger of those of a state over its swing and of the period over itself.
        Where the finer one failed there is none, as its status says.
    """
    if not (cycle.solution.status.ok and finer.solution.status.ok):
        return cycle
    scheme, x, states = problem.scheme, cycle.solution.x, finer.orbit.states
    plan, step = scheme.plan(finer.orbit.phases, len(x)), cycle.solution.value / len(x)
    rows = scheme.sample(x[None, :, :, None], plan, step)[0, :, 0]
    first = np.cumsum([0, *(order + 1 for order in scheme.orders)])
    kept = [int(first[j]) + k for j, o in enumerate(scheme.orders) for k in range(o)]
    swing = np.maximum(np.ptp(states, axis=0), 1e-300)
    away = float((np.abs(rows[kept].T - states).max(axis=0) / swing).max())
    late = abs(finer.solution.value / cycle.solution.value - 1.0)
    orbit = replace(cycle.orbit, status=Status.CONVERGED, error=max(away, late))
    return replace(cycle, orbit=orbit)


def _period_theta(family: Family, solution: BorderedSolution, condition: PhaseCondition) -> Array:
    problem, p = family(solution.value)
    if not solution.status.ok:
        return np.full(problem.active, np.nan)
    method, x = problem.scheme, solution.x
    D, d, points, step = (
        method.state_size,
        len(method.orders),
        problem.inputs.shape[1],
        problem.step(len(x)),
    )
    z, g = np.zeros((1, D + d, points)), np.zeros((1, d, points))
    gz, gp = np.zeros((1, d, D + d, points)), np.zeros((1, d, problem.active, points))
    method.rows(x[None], _LANE, step, z)
    problem.equations.jacobian(z, problem.inputs, p[None], _LANE, g, gz)
    problem.equations.parameters(z, problem.inputs, p[None], _LANE, gp)
    dx, _, _ = method.linear(gz, gp, None, _LANE, step, initial=True)
    border = np.block(
        [[np.eye(D) - solution.monodromy, -solution.by_value[:, None]], [condition.row[None]]]
    )
    right = np.concatenate([end_states(problem, dx[0]), np.zeros((1, problem.active))])
    return cast(Array, np.linalg.solve(border, right)[D])
