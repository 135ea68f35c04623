"""The compiled loop of the integrator: steps of chosen or of given lengths, switches, derivatives.

Compiled once for all models: kernels come as function pointers (``numba.types.FunctionType``), so
that the compiled loop is kept on disk and a new model costs its own kernels only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayesoleo.solvers.march_start import is_inside, rate_at_start, starts
from bayesoleo.solvers.radau_step import (
    SINGULAR,
    SOLVED,
    UNDEFINED,
    Method,
    copy_to,
    differentiate_step,
    end_of_step,
    local_error,
    solve_stages,
    stretch,
)
from bayesoleo.solvers.signals import Signal, rows_at
from bayesoleo.solvers.sweep import jit
from bayesoleo.solvers.switching import (
    first_switch,
    jump_of_derivatives,
    slope_of_switch,
    step_to_switch,
)

Array = NDArray[np.float64]

#: How a march ended. ``COARSE``: given steps miss the tolerance; ``FULL``: out of memory given.
FINISHED, LOST, OUTSIDE, NOT_A_NUMBER, DEGENERATE, CHATTERS, COARSE, FULL = range(8)
#: On given steps the error may exceed the tolerance this many times before they are chosen anew.
GENEROSITY = 8.0


class Task(NamedTuple):
    """What one march does.

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
    cut: NDArray[np.bool_]
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
    switched: NDArray[np.bool_]
    aims: Array
    by: Array
    tops_by: Array


class System(NamedTuple):
    """What is integrated, beside its kernels.

    Parameters
    ----------
    orders : ndarray of int, shape (d,)
        Of the dofs.
    method : Method
        Radau IIA.
    signal : Signal
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

    orders: NDArray[np.int64]
    method: Method
    signal: Signal
    p: Array
    modes: NDArray[np.int64]
    active: int
    conditions: int


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


#: Entries of ``Front.pace``: length to be tried, that of the polynomial known (zero for none),
#: length and error of the last step accepted, and whether this one was rejected before.
LENGTH, KNOWN, LAST_LENGTH, LAST_ERROR, REJECTED = range(5)


@jit
def _front(system, task, start, columns, scale):
    D, d, s, count = start.size, system.orders.size, system.method.c.size, columns.shape[1]
    pace = np.zeros(5)
    pace[LENGTH] = pace[LAST_LENGTH] = task.first_step
    pace[LAST_ERROR] = 1.0
    return Front(
        start.copy(), start.copy(), np.zeros(d), np.zeros(d), np.zeros((s, d)), np.zeros((s, d)),
        np.zeros(D), columns, columns.copy(), np.zeros((s * d, count)), scale, start,
        np.zeros(system.modes.size), pace,
    )  # fmt: skip


@jit
def _room(task, D, d, s, ns, columns):
    n, kept = task.capacity, task.capacity if task.dense else 0
    return Path(
        np.empty(n + 1),
        np.empty((n + 1, D)),
        np.empty((n, s, d)),
        np.empty((n, ns)),
        np.zeros(n, dtype=np.bool_),
        np.empty(n),
        np.empty((kept + 1, D, columns)),
        np.empty((kept, s * d, columns)),
    )


@jit
def march(
    jacobian, parameters, switches, slopes, admissible, task, start, columns, scale, system, work
):  # fmt: skip
    """Integrate one lane from ``start (D,)`` through ``task.nodes``.

    The kernels come first, as function pointers. ``columns (D, C)`` are derivatives at the start,
    ``system.active`` of them by parameters, and at the end on return; ``scale (D,)`` are sizes of
    the state components, enlarged as they are met. Returns a path, its number of steps, the outcome
    and the number of points evaluated.
    """
    sizes = (start.size, system.orders.size, system.method.c.size)
    path = _room(task, sizes[0], sizes[1], sizes[2], system.modes.size, columns.shape[1])
    front = _front(system, task, start, columns, scale)
    n, outcome, points = _walk(
        jacobian, parameters, switches, slopes, admissible, task, system, front, path, work
    )
    return path, n, outcome, points


@jit
def _walk(
    jacobian, parameters, switches, slopes, admissible, task, system, front, path, work
):  # fmt: skip
    """Step after step to the last node: number of steps, outcome, points."""
    t, end, s = task.nodes[0], task.nodes[-1], system.method.c.size
    shortest = 1e-14 * (end - t + abs(t))
    node, n, points, flips, reason = 1, 0, 1, 0, LOST
    if not starts(jacobian, switches, admissible, front, t, task.first_step, system, work):
        inside = is_inside(admissible, work.z1, work.u1, 1, system, work)
        return 0, NOT_A_NUMBER if inside else OUTSIDE, points
    _first_sizes(front, system.orders, task.first_step)
    _keep(task, front, path, 0, t)
    while t < end:
        if n >= task.capacity:
            return n, FULL, points
        node, aim = _aim(task, front, node, t, shortest)
        h = aim - t
        if h < shortest and aim < end:
            return n, reason, points
        outcome, size, iterations = _attempt(jacobian, admissible, task, system, front, t, h, work)
        points += s * (iterations + 1)
        if outcome != FINISHED:
            if not task.adaptive:
                return n, COARSE, points
            reason = outcome
            continue
        switch, length, slope = -1, h, 1.0
        if system.modes.size > 0:
            switch, length, slope = _find_switch(
                jacobian, switches, task.enough, system, front, t, h, work
            )
            flips = flips + 1 if switch >= 0 and not (length > 1e-12 * abs(t)) else 0
            if flips > 2 * system.modes.size + 4:
                return n, CHATTERS, points
            if length < 0.0:
                return n, LOST, points
        if length > 0.0:
            if not _advance(jacobian, parameters, task, system, front, path, n, length, work):
                return n, DEGENERATE, points
            path.switched[n], path.aims[n] = switch >= 0, aim
            t, n = (aim if switch < 0 else t + length), n + 1
        if switch >= 0:
            if not _exchange(jacobian, slopes, system, front, switch, slope, length, t, work):
                return n, NOT_A_NUMBER, points
        elif task.adaptive:
            _next_length(front, size, h, s)
        if length > 0.0:
            _keep(task, front, path, n, t)
            if switch < 0 or (not task.adaptive and task.cut[node - 1]):
                node += 1
    return n, FINISHED, points


@jit
def _first_sizes(front, orders, h):
    """From rest, a state is as large as its rates make it in the first step."""
    first = 0
    for j in range(orders.size):
        last = first + orders[j] - 1
        change = h * abs(front.rate[j])
        front.scale[last] = max(front.scale[last], change)
        if orders[j] == 2:
            change = h * (abs(front.state[last]) + change)
            front.scale[first] = max(front.scale[first], change)
        first += orders[j]


@jit
def _aim(task, front, node, t, shortest):
    """Number of the node ahead and time at which the next step is to end."""
    if not task.adaptive:
        while task.nodes[node] <= t + shortest:
            node += 1
        return node, task.nodes[node]
    h, end = min(front.pace[LENGTH], task.longest), task.nodes[-1]
    return node, end if t + 1.01 * h >= end else t + h


@jit
def _attempt(jacobian, admissible, task, system, front, t, h, work):
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
        jacobian, front.state, front.stages, h, front.scale, task.enough, method, system.orders,
        system.p, work,
    )  # fmt: skip
    inside = is_inside(admissible, work.z, work.u, s, system, work)
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
        / task.tolerance
    )
    if size > (1.0 if task.adaptive else GENEROSITY):
        pace[LENGTH], pace[REJECTED] = h * max(0.1, 0.9 * size ** (-1.0 / (s + 1))), 1.0
        return LOST, size, iterations
    return FINISHED, size, iterations


@jit
def _find_switch(jacobian, switches, enough, system, front, t, h, work):
    """Switch in the solved step, or -1, with the length up to it and the switching function's
    slope there; the step is solved again to end there. A negative length is a failure, zero a
    switch where the step begins.
    """
    orders, method, signal, p = system.orders, system.method, system.signal, system.p
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


@jit
def _advance(jacobian, parameters, task, system, front, path, n, length, work):
    """Differentiate the step, keep its stages and go to its end; false if it is singular."""
    s, d = front.stages.shape
    if front.columns.shape[1] > 0:
        if not differentiate_step(
            jacobian, parameters, front.columns, front.stages_by, front.columns_after, length,
            system.method, system.orders, system.p, work, system.active,
        ):  # fmt: skip
            return False
        copy_to(front.columns_after, front.columns)
        if task.dense:
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


@jit
def _exchange(jacobian, slopes, system, front, switch, slope, length, t, work):
    """Exchange a mode: rates are new, and derivatives jump where they do; false without rates."""
    mode = system.modes[switch]
    system.p[mode] = 1.0 - system.p[mode]
    front.pace[KNOWN] = 0.0
    if not rate_at_start(jacobian, front.state, front.rate, t, system, work):
        return False
    if length > 0.0 and front.columns.shape[1] > 0:
        jump_of_derivatives(
            slopes, switch, slope, front.stages_by, front.before, front.rate, front.columns,
            system.method.c.size, system.modes.size, system.orders, system.p, work, system.active,
        )  # fmt: skip
    return True


@jit
def _next_length(front, size, h, stages):
    """Predictive control of the step's length (Hairer and Wanner 1996, eq. IV.8.25)."""
    pace, small = front.pace, max(size, 1e-12)
    factor = 0.9 * small ** (-1.0 / (stages + 1))
    trend = (pace[LAST_ERROR] / small) ** (1.0 / (stages + 1))
    factor = min(factor, factor * h / pace[LAST_LENGTH] * trend)
    factor = min(max(factor, 0.2), 1.0 if pace[REJECTED] > 0.0 else 8.0)
    # A factorisation is not kept, but a polynomial extrapolates best to its own length.
    pace[LENGTH] = h if 1.0 <= factor < 1.2 else h * factor
    pace[LAST_ERROR], pace[LAST_LENGTH], pace[REJECTED] = max(size, 1e-2), h, 0.0


@jit
def _keep(task, front, path, n, t):
    path.times[n] = t
    for j in range(front.state.size):
        path.states[n, j] = front.state[j]
    if task.dense:
        copy_to(front.columns, path.by[n])
