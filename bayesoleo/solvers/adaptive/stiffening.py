"""Reach a solution at a stiff parameter by walking there from a soft one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.adaptive.refine import (
    AdaptiveSolution,
    AdaptiveStart,
    solve_adaptive,
)
from bayesoleo.solvers.adaptive.switched import Motion, PeriodicProblem
from bayesoleo.solvers.adaptive.warp import SAME, extrapolate
from bayesoleo.solvers.status import Status

#: How much softer each trial is until one succeeds, and how many there are.
SOFTER, TRIALS = 0.01, 8
#: Factor of the first step, and the largest and smallest one.
FIRST_STEP, LARGEST_STEP, SMALLEST_STEP = 1.2, 100.0, 1.001
#: Error on the way.
ROUGH = 1e-3


def solve_stiffening(
    problem: PeriodicProblem,
    p: Array,
    start: Motion | AdaptiveStart,
    index: int,
    *,
    method: str = "radau3",
    tolerance: float = 1e-6,
    max_steps: int = 20_000,
) -> AdaptiveSolution:
    """Solve directly or, where that fails, by continuation in a stiffness.

    Parameters
    ----------
    problem, p, start
        As for :func:`~bayesoleo.solvers.adaptive.refine.solve_adaptive`, the stiffness at its full
        value.
    index : int
        Of the stiffness among the constants.
    method, tolerance, max_steps
        As there; on the way errors of 1e-3 are enough.

    Returns
    -------
    AdaptiveSolution
        ``orbit.evaluations`` counts all that was spent on the way. Where the walk ends before the
        full stiffness, the direct solution and its status.
    """
    way = _Continuation(problem, p, index, method, max_steps)
    direct = way.solve(p[index], start, tolerance)
    if direct.orbit.status is Status.CONVERGED or not p[index] > 0.0:
        return direct
    spent, rough = direct.orbit.evaluations, max(tolerance, ROUGH)
    for k in range(1, TRIALS + 1):
        here = way.solve(p[index] * SOFTER**k, start, rough)
        spent += here.orbit.evaluations
        if here.orbit.status is Status.CONVERGED:
            break
    else:
        return _spent(direct, spent)
    here, walked = way.walk(here, rough)
    spent += walked
    if here.p[index] != p[index]:
        return _spent(direct, spent)
    last = way.solve(p[index], here.start(), tolerance)
    return _spent(last, spent + last.orbit.evaluations)


def _spent(solution: AdaptiveSolution, evaluations: int) -> AdaptiveSolution:
    return replace(solution, orbit=replace(solution.orbit, evaluations=evaluations))


@dataclass(frozen=True, eq=False)
class _Continuation:
    """Solutions at any value of the stiffness."""

    problem: PeriodicProblem
    p: Array
    index: int
    method: str
    max_steps: int

    def solve(
        self, value: float, start: Motion | AdaptiveStart, tolerance: float
    ) -> AdaptiveSolution:
        p = self.p.copy()
        p[self.index] = value
        return solve_adaptive(
            self.problem, p, start,
            method=self.method, tolerance=tolerance, max_steps=self.max_steps,
        )  # fmt: skip

    def walk(self, here: AdaptiveSolution, tolerance: float) -> tuple[AdaptiveSolution, int]:
        """As far towards the full stiffness as steps succeed, and the evaluations it took."""
        step, spent, full = np.log(FIRST_STEP), 0, self.p[self.index]
        before: AdaptiveSolution | None = None
        while here.p[self.index] < full and step > np.log(SMALLEST_STEP):
            now = here.p[self.index]
            value, warp = min(full, now * np.exp(step)), SAME
            if before is not None:
                length = np.log(value / now) / np.log(now / before.p[self.index])
                warp = extrapolate(before.level.kinks, here.level.kinks, length)
            trial = self.solve(value, here.start(warp), tolerance)
            spent += trial.orbit.evaluations
            if trial.orbit.status is Status.CONVERGED:
                before, here, step = here, trial, min(2 * step, np.log(LARGEST_STEP))
            else:
                step /= 3
        return here, spent
