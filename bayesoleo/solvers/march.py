"""The compiled loop of the integrator: steps of chosen or of given lengths, switches, derivatives.

Compiled once for all models: kernels come as function pointers (``numba.types.FunctionType``), so
that the compiled loop is kept on disk and a new model costs its own kernels only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayesoleo.solvers.radau_step import (
    SINGULAR,
    SOLVED,
    UNDEFINED,
    differentiate_step,
    end_of_step,
    local_error,
    solve_stages,
    stretch,
)
from bayesoleo.solvers.signals import rows_at
from bayesoleo.solvers.sweep import eliminate, jit
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
def _rate_at_start(jacobian, state, top, t, orders, signal, p, work):
    """Highest derivatives ``top (d,)`` at one time; false where there are none."""
    d, row, first = orders.size, 0, 0
    rows_at(signal, t, 0.0, np.zeros(1), work.u1)
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
        jacobian(work.z1.ctypes, work.u1.ctypes, p.ctypes, work.g1.ctypes, 1)
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


@jit
def _is_inside(admissible, conditions, z, u, count, p, work):
    """Whether all points lie in the admissible region."""
    if conditions == 0:
        return True
    admissible(z.ctypes, u.ctypes, p.ctypes, work.a.ctypes, count)
    for k in range(conditions):
        for i in range(count):
            if not (work.a[k, i] > 0.0):
                return False
    return True


@jit
def _starts(
    jacobian, switches, admissible, conditions, state, top, t, h, modes, orders, signal, p, work
):  # fmt: skip
    """Rates and modes at the start; false if there are none or it is not admissible."""
    for _ in range(2 if modes.size > 0 else 1):
        # Modes depend on the rates only where a state starts on a switch.
        if not _rate_at_start(jacobian, state, top, t, orders, signal, p, work):
            return False
        _initial_modes(switches, state, top, t, h, modes, orders, signal, p, work)
    rows_at(signal, t, 0.0, np.zeros(1), work.u1)
    return _is_inside(admissible, conditions, work.z1, work.u1, 1, p, work)


@jit
def _initial_modes(switches, state, top, t, h, modes, orders, signal, p, work):
    """Modes by the signs of the switching functions at the start, or just after it."""
    if modes.size == 0:
        return
    row = first = 0
    for part in (0.0, 1e-6):
        row = first = 0
        rows_at(signal, t, part * h, np.ones(1), work.u1)
        for j in range(orders.size):
            for k in range(orders[j]):
                rate = state[first + 1] if orders[j] == 2 and k == 0 else top[j]
                work.z1[row + k, 0] = state[first + k] + part * h * rate
            work.z1[row + orders[j], 0] = top[j]
            row += orders[j] + 1
            first += orders[j]
        switches(work.z1.ctypes, work.u1.ctypes, p.ctypes, work.y.ctypes, 1)
        for k in range(modes.size):
            if part == 0.0 or p[modes[k]] == 0.5:
                value = work.y[k, 0]
                p[modes[k]] = 1.0 if value > 0.0 else (0.5 if value == 0.0 else 0.0)
    for k in range(modes.size):
        if p[modes[k]] == 0.5:
            p[modes[k]] = 1.0


@jit
def march(
    jacobian, parameters, switches, slopes, admissible,
    task, start, columns, scale, method, orders, signal, p, modes, active, conditions, work,
):  # fmt: skip
    """Integrate one lane from ``start (D,)`` through ``task.nodes``.

    ``columns (D, C)`` are derivatives at the start, ``active`` of them by parameters, and at the
    end on return. ``scale (D,)`` are sizes of the state components, enlarged as they are met.
    Returns a path, its number of steps, the outcome and the number of points evaluated.
    """
    D, d, s = start.size, orders.size, method.c.size
    count = columns.shape[1]
    path = _room(task, D, d, s, modes.size, count)
    nodes, end = task.nodes, task.nodes[-1]
    t, state, following = nodes[0], start.copy(), start.copy()
    top0, top, guess = np.zeros(d), np.zeros((s, d)), np.zeros((s, d))
    before, error = np.zeros(d), np.zeros(D)
    after, top_by = np.empty((D, count)), np.empty((s * d, count))
    largest = np.zeros(modes.size)
    shortest = 1e-14 * (abs(nodes[-1] - nodes[0]) + abs(t))
    h, last_h, last_error, known = task.first_step, 0.0, 1.0, False
    node, n, points, flips = 1, 0, 0, 0
    reason, rejected = LOST, False
    path.times[0], path.states[0] = t, start
    if task.dense:
        path.by[0] = columns
    step_before = h
    if not _starts(
        jacobian, switches, admissible, conditions, state, top0, t, h, modes, orders, signal, p,
        work,
    ):  # fmt: skip
        inside = _is_inside(admissible, conditions, work.z1, work.u1, 1, p, work)
        return path, 0, NOT_A_NUMBER if inside else OUTSIDE, 1
    while t < end:
        if n >= task.capacity:
            return path, n, FULL, points
        while not task.adaptive and nodes[node] <= t + shortest:
            node += 1
        target = end if task.adaptive else nodes[node]
        if not task.adaptive:
            h = target - t
        elif h > task.longest:
            h = task.longest
        lands = t + h >= target - shortest or (task.adaptive and t + 1.01 * h >= target)
        if lands:
            h = target - t
        if h < shortest and not lands:
            return path, n, reason, points
        rows_at(signal, t, h, method.c, work.u)
        if known:
            stretch(top, h / last_h, method, guess)
        else:
            for i in range(s):
                guess[i] = top0
        for j in range(D):
            scale[j] = max(scale[j], 1e-3 * abs(state[j]))
        outcome, iterations = solve_stages(
            jacobian, state, guess, h, scale, task.enough, method, orders, p, work
        )
        points += s * (iterations + 1)
        inside = _is_inside(admissible, conditions, work.z, work.u, s, p, work)
        if outcome != SOLVED or not inside:
            reason = (
                OUTSIDE if not inside
                else NOT_A_NUMBER if outcome == UNDEFINED
                else DEGENERATE if outcome == SINGULAR
                else LOST
            )  # fmt: skip
            if not task.adaptive:
                return path, n, COARSE, points
            h *= 0.25
            if known and h < 0.05 * last_h:
                known = False
            rejected = True
            continue
        size = local_error(state, top0, h, scale, method, orders, work, error) / task.tolerance
        if not task.adaptive and size > GENEROSITY:
            return path, n, COARSE, points
        factor = 0.9 * max(size, 1e-12) ** (-1.0 / (s + 1))
        if task.adaptive and size > 1.0:
            h *= max(0.1, factor)
            reason, rejected = LOST, True
            continue
        switch = -1
        if modes.size > 0:
            position, switch = first_switch(
                switches, t, state, guess, h, modes, largest, method, orders, signal, p, work
            )
        if switch >= 0:
            flips += 1
            if flips > 2 * modes.size + 4:
                return path, n, CHATTERS, points
            before[:] = guess[s - 1]
            slope = 1.0
            if position > 1e-13:
                length = step_to_switch(
                    jacobian, switches, switch, position, t, state, guess, h,
                    scale, task.enough, largest, method, orders, signal, p, work,
                )  # fmt: skip
                if length <= 0.0:
                    return path, n, LOST, points
                points += 4 * s
                before[:] = guess[s - 1]
                slope = slope_of_switch(
                    switches, switch, t, state, guess, length,
                    method, orders, signal, p, work,
                )  # fmt: skip
                if length > 1e-12 * abs(t):
                    flips = 1
            else:
                # The switch is where the step begins: exchange the mode and step again.
                length = 0.0
            taken = length
        else:
            flips, taken = 0, h
        if taken > 0.0:
            end_of_step(work, s, orders, following)
            path.tops[n], path.times[n + 1] = guess, target if lands and switch < 0 else t + taken
            for k in range(modes.size):
                path.modes[n, k] = p[modes[k]]
            path.switched[n], path.aims[n] = switch >= 0, target if lands else t + h
            if count > 0:
                if not differentiate_step(
                    jacobian, parameters, columns, top_by, after, taken, method, orders, p, work,
                    active,
                ):  # fmt: skip
                    return path, n, DEGENERATE, points
                columns[:] = after
                if task.dense:
                    path.tops_by[n] = top_by
            t = path.times[n + 1]
            state[:] = following
            for j in range(D):
                scale[j] = max(scale[j], abs(state[j] - start[j]))
            top[:] = guess
            top0[:] = guess[s - 1]
            last_h, known = taken, True
        if switch >= 0:
            p[modes[switch]] = 1.0 - p[modes[switch]]
            known = False
            if not _rate_at_start(jacobian, state, top0, t, orders, signal, p, work):
                return path, n, NOT_A_NUMBER, points
            points += 2
            if taken > 0.0 and count > 0:
                jump_of_derivatives(
                    slopes,
                    switch,
                    slope,
                    top_by,
                    before,
                    top0,
                    columns,
                    s,
                    modes.size,
                    orders,
                    p,
                    work,
                    active,
                )
        if taken > 0.0:
            path.states[n + 1] = state
            if task.dense:
                path.by[n + 1] = columns
            n += 1
        if switch < 0 or (taken > 0.0 and not task.adaptive and task.cut[node - 1]):
            node += 1
        if switch < 0 and task.adaptive:
            # Predictive control (Hairer and Wanner 1996, eq. IV.8.25).
            if n > 1:
                trend = (last_error / max(size, 1e-12)) ** (1.0 / (s + 1))
                factor = min(factor, factor * h / step_before * trend)
            last_error, step_before = max(size, 1e-2), h
            factor = min(max(factor, 0.2), 1.0 if rejected else 8.0)
            if not (1.0 <= factor < 1.2):
                h *= factor
            rejected = False
    return path, n, FINISHED, points
