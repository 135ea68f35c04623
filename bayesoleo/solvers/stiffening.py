"""Reach a solution at a stiff parameter by walking there from a soft one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesoleo.solvers.adaptive import (
    AdaptiveSolution,
    Motion,
    PeriodicProblem,
    Start,
    solve_adaptive,
)
from bayesoleo.solvers.status import Status
from bayesoleo.solvers.warp import SAME, extrapolate

Array = NDArray[np.float64]

#: How much softer each trial is until one succeeds, and how many there are.
SOFTER, TRIALS = 0.01, 8
#: Factor of the first step, and the largest and smallest one.
FIRST_STEP, LARGEST_STEP, SMALLEST_STEP = 1.2, 100.0, 1.001
#: Error on the way.
ROUGH = 1e-3


def solve_stiffening(
    problem: PeriodicProblem,
    p: Array,
    index: int,
    start: Motion,
    *,
    tolerance: float = 1e-6,
    **options: Any,
) -> AdaptiveSolution:
    """Solve directly or, where that fails, by continuation in a stiffness.

    Parameters
    ----------
    problem : PeriodicProblem
        Equations and inputs.
    p : ndarray, shape (np,)
        Constants, the stiffness at its full value.
    index : int
        Of the stiffness among the constants.
    start : callable
        A guess of the motion, as for :func:`~bayesoleo.solvers.adaptive.solve_adaptive`.
    tolerance : float
        As there; on the way errors of 1e-3 are enough.
    **options
        As there.

    Returns
    -------
    AdaptiveSolution
        ``orbit.evaluations`` counts all that was spent on the way.
    """
    direct = solve_adaptive(problem, p, start, tolerance=tolerance, **options)
    if direct.orbit.status is Status.CONVERGED or not p[index] > 0.0:
        return direct
    way = _Way(problem, p, index, max(tolerance, ROUGH), options)
    spent = direct.orbit.evaluations
    for k in range(1, TRIALS + 1):
        here = way.solve(p[index] * SOFTER**k, start)
        spent += here.orbit.evaluations
        if here.orbit.status is Status.CONVERGED:
            break
    else:
        return _spent(direct, spent)
    here, walked = way.walk(here)
    spent += walked
    if here.p[index] == p[index]:
        here = solve_adaptive(problem, p, here.start(), tolerance=tolerance, **options)
        spent += here.orbit.evaluations
        return _spent(here, spent)
    return _spent(direct, spent)


def _spent(solution: AdaptiveSolution, evaluations: int) -> AdaptiveSolution:
    return replace(solution, orbit=replace(solution.orbit, evaluations=evaluations))


@dataclass(frozen=True, eq=False)
class _Way:
    problem: PeriodicProblem
    p: Array
    index: int
    tolerance: float
    options: dict[str, Any]

    def solve(self, value: float, start: Motion | Start) -> AdaptiveSolution:
        p = self.p.copy()
        p[self.index] = value
        return solve_adaptive(self.problem, p, start, tolerance=self.tolerance, **self.options)

    def walk(self, here: AdaptiveSolution) -> tuple[AdaptiveSolution, int]:
        """As far towards the full stiffness as steps succeed."""
        step, spent, full = np.log(FIRST_STEP), 0, self.p[self.index]
        before: AdaptiveSolution | None = None
        while here.p[self.index] < full and step > np.log(SMALLEST_STEP):
            now = here.p[self.index]
            value = min(full, now * np.exp(step))
            warp = SAME
            if before is not None:
                length = np.log(value / now) / np.log(now / before.p[self.index])
                warp = extrapolate(before.level.kinks, here.level.kinks, length)
            trial = self.solve(value, here.start(warp))
            spent += trial.orbit.evaluations
            if trial.orbit.status is Status.CONVERGED:
                before, here, step = here, trial, min(2 * step, np.log(LARGEST_STEP))
            else:
                step /= 3
        return here, spent
