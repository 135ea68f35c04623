"""One step of a march: tried, judged by its error, differentiated and taken."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.shooting.inner import inner
from bayesoleo.solvers.shooting.march_start import is_inside
from bayesoleo.solvers.shooting.radau_step import (
    SINGULAR,
    SOLVED,
    UNDEFINED,
    Workspace,
    copy_to,
    differentiate_step,
    end_of_step,
    local_error,
    solve_stages,
    stretch,
)
from bayesoleo.solvers.shooting.signals import rows_at

if TYPE_CHECKING:
    from bayesoleo.solvers.shooting.march import Path, System


#: How a step ended, and a march with it.
FINISHED, LOST, OUTSIDE, NOT_A_NUMBER, DEGENERATE = range(5)
#: On given steps the error may exceed the tolerance this many times before they are chosen anew.
GENEROSITY = 8.0
#: Entries of ``Front.pace``: length to be tried, that of the polynomial known (zero for none),
#: length and error of the last step accepted, and whether this one was rejected before.
LENGTH, KNOWN, LAST_LENGTH, LAST_ERROR, REJECTED = range(5)


class Front(NamedTuple):
    """Where a march is: the state at the start of a step ``(D,)`` and at its end, the highest
    derivatives at its start ``(d,)``, those of its stages ``(s, d)`` and of the last step's, the
    derivatives carried ``(D, C)``, sizes, and what determines the next length.
    """

    state: Array
    following: Array
    rate: Array
    before: Array
    stages: Array
    last_stages: Array
    error: Array
    columns: Array
    columns_after: Array
    stages_by: Array
    scale: Array
    range_from: Array
    largest: Array
    pace: Array


def front_of(
    start: Array, columns: Array, scale: Array, s: int, d: int, switches: int, first_step: float
) -> Front:
    """A march at its start, with ``s`` stages of ``d`` dofs; ``columns`` and ``scale`` are its
    own."""
    count = columns.shape[1]
    pace = np.zeros(5)
    pace[LENGTH] = pace[LAST_LENGTH] = first_step
    pace[LAST_ERROR] = 1.0
    return Front(
        start.copy(), start.copy(), np.zeros(d), np.zeros(d), np.zeros((s, d)), np.zeros((s, d)),
        np.zeros(start.size), columns, columns.copy(), np.zeros((s * d, count)), scale, start,
        np.zeros(switches), pace,
    )  # fmt: skip


@inner
def attempt(
    adaptive: bool, tolerance: float, enough: float, system: System, front: Front, t: float,
    h: float, work: Workspace,
) -> tuple[int, float, int]:  # fmt: skip
    """Solve a step: outcome, error over tolerance, iterations. Shorten the next one if it fails."""
    s, pace, method = system.method.c.size, front.pace, system.method
    rows_at(system.signal, t, h, method.c, work.u)
    # What is known of the last step does not reach far beyond a failure.
    if pace[KNOWN] > 0.0 and h > 0.01 * pace[KNOWN]:
        stretch(front.last_stages, h / pace[KNOWN], method, front.stages)
    else:
        for i in range(s):
            for j in range(front.rate.size):
                front.stages[i, j] = front.rate[j]
    for j in range(front.scale.size):
        front.scale[j] = max(front.scale[j], 1e-3 * abs(front.state[j]))
    outcome, iterations = solve_stages(
        system.kernels.jacobian, front.state, front.stages, h, front.scale, enough, method,
        system.orders, system.p, work,
    )  # fmt: skip
    inside = is_inside(work.z, work.u, s, system, work)
    pace[LENGTH] = h
    if outcome != SOLVED or not inside:
        pace[LENGTH], pace[REJECTED] = 0.25 * h, 1.0
        if not inside:
            return OUTSIDE, np.inf, iterations
        reason = NOT_A_NUMBER if outcome == UNDEFINED else LOST
        return DEGENERATE if outcome == SINGULAR else reason, np.inf, iterations
    size = (
        local_error(
            front.state, front.rate, h, front.scale, method, system.orders, work, front.error
        )
        / tolerance
    )
    if size > (1.0 if adaptive else GENEROSITY):
        pace[LENGTH], pace[REJECTED] = h * max(0.1, 0.9 * size ** (-1.0 / (s + 1))), 1.0
        return LOST, size, iterations
    return FINISHED, size, iterations


@inner
def advance(
    dense: bool, system: System, front: Front, path: Path, n: int, length: float, work: Workspace
) -> bool:
    """Differentiate the step, keep its stages and go to its end; false if it is singular."""
    s, d = front.stages.shape
    if front.columns.shape[1] > 0:
        if not differentiate_step(
            system.kernels.jacobian, system.kernels.parameters, front.columns, front.stages_by,
            front.columns_after, length, system.method, system.orders, system.p, work,
            system.active,
        ):  # fmt: skip
            return False
        copy_to(front.columns_after, front.columns)
        if dense:
            copy_to(front.stages_by, path.tops_by[n])
    end_of_step(work, s, system.orders, front.state)
    for k in range(system.modes.size):
        path.modes[n, k] = system.p[system.modes[k]]
    for j in range(front.state.size):
        front.scale[j] = max(front.scale[j], abs(front.state[j] - front.range_from[j]))
    for i in range(s):
        for j in range(d):
            path.tops[n, i, j] = front.last_stages[i, j] = front.stages[i, j]
            front.rate[j] = front.before[j] = front.stages[i, j]
    front.pace[KNOWN] = length
    return True


@inner
def next_length(pace: Array, size: float, h: float, stages: int) -> None:
    """Predictive control of the step's length (Hairer and Wanner 1996, eq. IV.8.25)."""
    small = max(size, 1e-12)
    factor = 0.9 * small ** (-1.0 / (stages + 1))
    trend = (pace[LAST_ERROR] / small) ** (1.0 / (stages + 1))
    factor = min(factor, factor * h / pace[LAST_LENGTH] * trend)
    factor = min(max(factor, 0.2), 1.0 if pace[REJECTED] > 0.0 else 8.0)
    # A factorisation is not kept, but a polynomial extrapolates best to its own length.
    pace[LENGTH] = h if 1.0 <= factor < 1.2 else h * factor
    pace[LAST_ERROR], pace[LAST_LENGTH], pace[REJECTED] = max(size, 1e-2), h, 0.0
