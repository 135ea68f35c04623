"""Compiled integrator: steps of chosen or given lengths, switches and derivatives.

A start or restart computes rates, modes and admissibility. A step is tried, judged by its error,
differentiated and taken; a step that meets a switch is shortened to end there, and the mode is
exchanged. The integrator is compiled once for all models: kernels come as addresses, so that the
compiled loop is kept on disk and a new model costs its own kernels only.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from bayesoleo._compiled import inner, is_compiled, jit
from bayesoleo._types import Array, Flags, Integers
from bayesoleo.solvers._elimination import eliminate
from bayesoleo.solvers._radau_step import (
    SINGULAR,
    SOLVED,
    UNDEFINED,
    Method,
    Workspace,
    copy_to,
    differentiate_step,
    end_of_step,
    evaluate_kernel,
    local_error,
    solve_stages,
    stretch,
)
from bayesoleo.solvers._switching import (
    InputSignal,
    first_switch,
    jump_of_derivatives,
    rows_at,
    slope_of_switch,
    step_to_switch,
)

#: How a step ended, and a march with it.
FINISHED, LOST, OUTSIDE, NOT_A_NUMBER, DEGENERATE = range(5)
#: On given steps the error may exceed the tolerance this many times before they are chosen anew.
GENEROSITY = 8.0
#: Entries of ``Front.pace``: length to be tried, that of the polynomial known (zero for none),
#: length and error of the last step accepted, and whether this one was rejected before.
LENGTH, KNOWN, LAST_LENGTH, LAST_ERROR, REJECTED = range(5)
#: More ways for a march to end than a step's. ``COARSE``: given steps miss the tolerance; ``FULL``:
#: out of memory given.
CHATTERS, COARSE, FULL = 5, 6, 7


@inner
def rate_at_start(state: Array, top: Array, t: float, system: System, work: Workspace) -> bool:
    """Highest derivatives ``top (d,)`` at one time; false where there are none."""
    orders, p = system.orders, system.p
    d, row, first = orders.size, 0, 0
    rows_at(system.signal, t, 0.0, np.zeros(1), work.u1)
    for j in range(d):
        for k in range(orders[j]):
            work.z1[row + k, 0] = state[first + k]
        row += orders[j] + 1
        first += orders[j]
    matrix = np.empty((d, d))
    for iteration in range(20):
        row = -1
        for j in range(d):
            row += orders[j] + 1
            work.z1[row, 0] = top[j]
        evaluate_kernel(system.kernels.jacobian, work.z1, work.u1, p, work.g1, 1)
        for e in range(d):
            work.small[e, 0] = -work.g1[e, 0]
            row = d + e * (d + state.size) - 1
            for j in range(d):
                row += orders[j] + 1
                matrix[e, j] = work.g1[row, 0]
        if not eliminate(matrix, work.small, 1e-14):
            return False
        change = size = 0.0
        for j in range(d):
            top[j] += work.small[j, 0]
            change = max(change, abs(work.small[j, 0]))
            size = max(size, abs(top[j]))
        if not np.isfinite(size):
            return False
        if iteration > 0 and change <= 1e-10 * size + 1e-200:
            break
    return True


@inner
def is_inside(z: Array, u: Array, count: int, system: System, work: Workspace) -> bool:
    """Whether all points lie in the admissible region."""
    if system.conditions == 0:
        return True
    evaluate_kernel(system.kernels.admissible, z, u, system.p, work.a, count)
    for k in range(system.conditions):
        for i in range(count):
            if not (work.a[k, i] > 0.0):
                return False
    return True


@inner
def starts(front: Front, t: float, h: float, system: System, work: Workspace) -> bool:
    """Rates and modes at the start; false if there are none or it is not admissible."""
    for _ in range(2 if system.modes.size > 0 else 1):
        # Modes depend on the rates only where a state starts on a switch.
        if not rate_at_start(front.state, front.rate, t, system, work):
            return False
        _initial_modes(front.state, front.rate, t, h, system, work)
    rows_at(system.signal, t, 0.0, np.zeros(1), work.u1)
    return is_inside(work.z1, work.u1, 1, system, work)


@inner
def _initial_modes(
    state: Array, top: Array, t: float, h: float, system: System, work: Workspace
) -> None:
    """Modes by the signs of the switching functions at the start, or just after it."""
    orders, modes, p = system.orders, system.modes, system.p
    if modes.size == 0:
        return
    for part in (0.0, 1e-6):
        row = first = 0
        rows_at(system.signal, t, part * h, np.ones(1), work.u1)
        for j in range(orders.size):
            for k in range(orders[j]):
                rate = state[first + 1] if orders[j] == 2 and k == 0 else top[j]
                work.z1[row + k, 0] = state[first + k] + part * h * rate
            work.z1[row + orders[j], 0] = top[j]
            row += orders[j] + 1
            first += orders[j]
        evaluate_kernel(system.kernels.switches, work.z1, work.u1, p, work.y, 1)
        for k in range(modes.size):
            if part == 0.0 or p[modes[k]] == 0.5:
                value = work.y[k, 0]
                p[modes[k]] = 1.0 if value > 0.0 else (0.5 if value == 0.0 else 0.0)
    for k in range(modes.size):
        if p[modes[k]] == 0.5:
            p[modes[k]] = 1.0


@inner
def first_sizes(state: Array, rate: Array, scale: Array, orders: Integers, h: float) -> None:
    """From rest, a state is as large as its rates make it in the first step."""
    first = 0
    for j in range(orders.size):
        last = first + orders[j] - 1
        change = h * abs(rate[j])
        scale[last] = max(scale[last], change)
        if orders[j] == 2:
            change = h * (abs(state[last]) + change)
            scale[first] = max(scale[first], change)
        first += orders[j]


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


@inner
def find_switch(
    enough: float, system: System, front: Front, t: float, h: float, work: Workspace
) -> tuple[int, float, float]:
    """Switch in the solved step, or -1, with the length up to it and the switching function's
    slope there; the step is solved again to end there. A negative length is a failure, zero a
    switch where the step begins.
    """
    orders, method, signal, p = system.orders, system.method, system.signal, system.p
    jacobian, switches = system.kernels.jacobian, system.kernels.switches
    position, switch = first_switch(
        switches, t, front.state, front.stages, h, system.modes, front.largest, method, orders,
        signal, p, work,
    )  # fmt: skip
    if switch < 0:
        return -1, h, 1.0
    if position <= 1e-13:
        return switch, 0.0, 1.0
    length = step_to_switch(
        jacobian, switches, switch, position, t, front.state, front.stages, h, front.scale,
        enough, front.largest, method, orders, signal, p, work,
    )  # fmt: skip
    slope = slope_of_switch(
        switches, switch, t, front.state, front.stages, length, method, orders, signal, p, work
    )
    return switch, length, slope


@inner
def exchange(
    system: System, front: Front, switch: int, slope: float, length: float, t: float,
    work: Workspace,
) -> bool:  # fmt: skip
    """Exchange a mode: rates are new, and derivatives jump where they do; false without rates."""
    mode = system.modes[switch]
    system.p[mode] = 1.0 - system.p[mode]
    front.pace[KNOWN] = 0.0
    if not rate_at_start(front.state, front.rate, t, system, work):
        return False
    if length > 0.0 and front.columns.shape[1] > 0:
        jump_of_derivatives(
            system.kernels.slopes, switch, slope, front.stages_by, front.before, front.rate,
            front.columns, system.method.c.size, system.modes.size, system.orders, system.p, work,
            system.active,
        )  # fmt: skip
    return True


class MarchTask(NamedTuple):
    """The task of one march.

    Parameters
    ----------
    nodes : ndarray, shape (M + 1,)
        Times to step to, s. With ``adaptive`` only the first and the last count.
    cut : ndarray of bool, shape (M,)
        Steps that are expected to end at a switch before they get there; the next node may then
        lie before theirs.
    adaptive : bool
        Choose the lengths of steps.
    tolerance : float
        Local error of a step, over the size of the state component.
    enough : float
        Stages are solved until what is left is below this, over that size.
    first_step : float
        Length of the first step to be tried, s.
    longest : float
        Longest step, s.
    capacity : int
        Number of steps there is room for.
    dense : bool
        Keep derivatives at all steps, not at the end only.
    """

    nodes: Array
    cut: Flags
    adaptive: bool
    tolerance: float
    enough: float
    first_step: float
    longest: float
    capacity: int
    dense: bool


class Path(NamedTuple):
    """Steps taken: ``states (n + 1, D)`` at ``times (n + 1,)``, ``tops (n, s, d)`` and ``modes
    (n, ns)`` within; with derivatives ``by (n + 1, D, C)`` and ``tops_by (n, s d, C)`` of these.
    ``switched (n,)`` marks steps that end at a switch, ``aims (n,)`` where they were to end.
    """

    times: Array
    states: Array
    tops: Array
    modes: Array
    switched: Flags
    aims: Array
    by: Array
    tops_by: Array


class Addresses(NamedTuple):
    """Compiled kernels of the equations: where they stand in memory.

    Residuals with their derivatives by ``z``, derivatives by parameters, switching functions, their
    derivatives, and conditions on the admissible region.
    """

    jacobian: int
    parameters: int
    switches: int
    slopes: int
    admissible: int


class System(NamedTuple):
    """The initial value problem that is integrated.

    Parameters
    ----------
    kernels : Addresses
        Of the equations.
    orders : ndarray of int, shape (d,)
        Of the dofs.
    method : Method
        Radau IIA.
    signal : InputSignal
        Inputs.
    p : ndarray, shape (np + ns,)
        Constants, then modes, which a march exchanges.
    modes : ndarray of int, shape (ns,)
        Where in ``p`` the modes are.
    active : int
        Number of derivatives by parameters among those carried.
    conditions : int
        Number of conditions on the admissible region.
    """

    kernels: Addresses
    orders: Integers
    method: Method
    signal: InputSignal
    p: Array
    modes: Integers
    active: int
    conditions: int


def march(
    task: MarchTask, start: Array, columns: Array, scale: Array, system: System, work: Workspace
) -> tuple[Path, int, int, int]:
    """Integrate one lane from ``start (D,)`` through ``task.nodes``.

    ``columns (D, C)`` are derivatives at the start, ``system.active`` of them by parameters, and at
    the end on return; ``scale (D,)`` are sizes of the state components, enlarged as they are met.
    Returns a path, its number of steps, the outcome and the number of points evaluated.
    """
    front = front_of(start, columns, scale, system.method.c.size, system.orders.size,
                     system.modes.size, task.first_step)  # fmt: skip
    path = _room(task, front)
    run: Any = _walk  # mypy takes what Numba returns for a function without arguments
    return path, *run(task, system, front, path, work)


def is_march_compiled() -> bool:
    """Whether the march is on disk: to compile it takes ten seconds and more."""
    return is_compiled(_walk)


def _room(task: MarchTask, front: Front) -> Path:
    n, kept = task.capacity, task.capacity if task.dense else 0
    s, d = front.stages.shape
    D, columns = front.columns.shape
    return Path(
        np.empty(n + 1),
        np.empty((n + 1, D)),
        np.empty((n, s, d)),
        np.empty((n, front.largest.size)),
        np.zeros(n, dtype=np.bool_),
        np.empty(n),
        np.empty((kept + 1, D, columns)),
        np.empty((kept, s * d, columns)),
    )


@jit
def _walk(
    task: MarchTask, system: System, front: Front, path: Path, work: Workspace
) -> tuple[int, int, int]:
    """Step after step to the last node: number of steps, outcome, points."""
    t, end, s = task.nodes[0], task.nodes[-1], system.method.c.size
    shortest = 1e-14 * (end - t + abs(t))
    # Of one type throughout, or all is compiled twice; annotated because it is not Python's int.
    node: Any = np.int64(1)
    n: Any = np.int64(0)
    points, flips, reason = 1, 0, LOST
    if not starts(front, t, task.first_step, system, work):
        inside = is_inside(work.z1, work.u1, 1, system, work)
        return 0, NOT_A_NUMBER if inside else OUTSIDE, points
    first_sizes(front.state, front.rate, front.scale, system.orders, task.first_step)
    _keep(task.dense, front.state, front.columns, path, n, t)
    while t < end:
        if n >= task.capacity:
            return n, FULL, points
        node, aim = _aim(task, front.pace[LENGTH], node, t, shortest)
        h = aim - t
        if h < shortest and aim < end:
            return n, reason, points
        outcome, size, iterations = attempt(
            task.adaptive, task.tolerance, task.enough, system, front, t, h, work
        )
        points += s * (iterations + 1)
        if outcome != FINISHED:
            if not task.adaptive:
                return n, COARSE, points
            reason = outcome
            continue
        switch, length, slope = -1, h, 1.0
        if system.modes.size > 0:
            switch, length, slope = find_switch(task.enough, system, front, t, h, work)
            flips = flips + 1 if switch >= 0 and not (length > 1e-12 * abs(t)) else 0
            if flips > 2 * system.modes.size + 4:
                return n, CHATTERS, points
            if length < 0.0:
                return n, LOST, points
        if length > 0.0:
            if not advance(task.dense, system, front, path, n, length, work):
                return n, DEGENERATE, points
            path.switched[n], path.aims[n] = switch >= 0, aim
            t, n = (aim if switch < 0 else t + length), n + 1
        if switch >= 0:
            if not exchange(system, front, switch, slope, length, t, work):
                return n, NOT_A_NUMBER, points
        elif task.adaptive:
            next_length(front.pace, size, h, s)
        if length > 0.0:
            _keep(task.dense, front.state, front.columns, path, n, t)
            if switch < 0 or (not task.adaptive and task.cut[node - 1]):
                node += 1
    return n, FINISHED, points


@inner
def _aim(task: MarchTask, length: float, node: int, t: float, shortest: float) -> tuple[int, float]:
    """Number of the node ahead and time at which the next step is to end."""
    if not task.adaptive:
        while task.nodes[node] <= t + shortest:
            node += 1
        return node, task.nodes[node]
    h, end = min(length, task.longest), task.nodes[-1]
    return node, end if t + 1.01 * h >= end else t + h


@inner
def _keep(dense: bool, state: Array, columns: Array, path: Path, n: int, t: float) -> None:
    path.times[n] = t
    for j in range(state.size):
        path.states[n, j] = state[j]
    if dense:
        copy_to(columns, path.by[n])
