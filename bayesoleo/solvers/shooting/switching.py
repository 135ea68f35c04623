"""Where the vector field changes its formula: located inside a step, crossed with derivatives.

Equations with kinks or jumps are given as analytic pieces: a *mode* of each switching function
``sigma_k(z, u, p)``, one where it is positive and zero where it is negative, stands among the
constants ``p``. Inside a step modes are held, so that every step sees an analytic vector field,
beyond the switch as well; a step in which ``sigma_k`` leaves the sign of its mode is shortened to
end there, and the mode is exchanged.
"""

from __future__ import annotations

import numpy as np

from bayesoleo._types import Array, Integers
from bayesoleo.solvers.shooting.inner import evaluate, inner
from bayesoleo.solvers.shooting.radau_step import (
    SOLVED,
    Method,
    Workspace,
    copy_to,
    interpolate,
    solve_stages,
    stretch,
)
from bayesoleo.solvers.shooting.signals import InputSignal, rows_at

#: A switching function beyond zero by less than this, over its largest value, has not switched:
#: with analytic pieces the difference is of that size.
SLACK = 1e-13


@inner
def sigma_at(
    switches: int, k: int, t: float, state: Array, top: Array, h: float, position: float,
    method: Method, orders: Integers, signal: InputSignal, p: Array, work: Workspace,
) -> float:  # fmt: skip
    """Switching function ``k`` on the step's polynomial."""
    interpolate(state, top, h, position, method, orders, work.z1)
    rows_at(signal, t, h, np.full(1, position), work.u1)
    evaluate(switches, work.z1, work.u1, p, work.y, 1)
    return float(work.y[k, 0])


@inner
def first_switch(
    switches: int, t: float, state: Array, top: Array, h: float, modes: Integers, largest: Array,
    method: Method, orders: Integers, signal: InputSignal, p: Array, work: Workspace,
) -> tuple[float, int]:  # fmt: skip
    """Position (in the solved step) and number of the first switch, or -1 for none.

    Of a switch that has its mode's sign nowhere before, the position is zero. ``largest (ns,)``
    keeps the largest values of the switching functions.
    """
    s = method.c.size
    evaluate(switches, work.z, work.u, p, work.y, s)
    values = np.empty((modes.size, s))
    copy_to(work.y[: modes.size, :s], values)
    earliest, which = 2.0, -1
    for k in range(modes.size):
        sign = 2.0 * p[modes[k]] - 1.0
        for i in range(s):
            largest[k] = max(largest[k], abs(values[k, i]))
        slack = SLACK * largest[k]
        for i in range(s):
            if sign * values[k, i] < -slack:
                low = method.c[i - 1] if i > 0 else 0.0
                if i == 0:
                    # Just exchanged, it may start at zero: look for its sign inside.
                    for part in (0.0, 0.1, 0.3, 0.6):
                        low = part * method.c[0]
                        value = sigma_at(
                            switches, k, t, state, top, h, low, method, orders, signal, p, work
                        )
                        if sign * value > slack:
                            break
                        low = -1.0
                position = 0.0
                if low >= 0.0:
                    position = _root(
                        switches, k, sign, low, method.c[i],
                        t, state, top, h, method, orders, signal, p, work,
                    )  # fmt: skip
                if position < earliest:
                    earliest, which = position, k
                break
    return earliest, which


@inner
def _root(
    switches: int, k: int, sign: float, low: float, high: float, t: float, state: Array, top: Array,
    h: float, method: Method, orders: Integers, signal: InputSignal, p: Array, work: Workspace,
) -> float:  # fmt: skip
    """Zero of a switching function between two positions, by regula falsi (Illinois)."""
    below = sign * sigma_at(switches, k, t, state, top, h, low, method, orders, signal, p, work)
    above = sign * sigma_at(switches, k, t, state, top, h, high, method, orders, signal, p, work)
    side = 0
    for _ in range(60):
        if high - low < 1e-15 or below == above:
            break
        position = (low * above - high * below) / (above - below)
        if not (low < position < high):
            break
        value = sign * sigma_at(
            switches, k, t, state, top, h, position, method, orders, signal, p, work
        )
        if value == 0.0:
            return position
        if value > 0.0:
            low, below = position, value
            above *= 0.5 if side == 1 else 1.0
            side = 1
        else:
            high, above = position, value
            below *= 0.5 if side == -1 else 1.0
            side = -1
    return low


@inner
def step_to_switch(
    jacobian: int, switches: int, k: int, position: float, t: float, state: Array, top: Array,
    h: float, scale: Array, enough: float, largest: Array, method: Method, orders: Integers,
    signal: InputSignal, p: Array, work: Workspace,
) -> float:  # fmt: skip
    """Solve the step again so that it ends at switch ``k``; returns its length, or -1."""
    guess = np.empty_like(top)
    for _ in range(8):
        stretch(top, -position, method, guess)
        copy_to(guess, top)
        h *= position
        rows_at(signal, t, h, method.c, work.u)
        outcome, _ = solve_stages(jacobian, state, top, h, scale, enough, method, orders, p, work)
        if outcome != SOLVED:
            return -1.0
        end = sigma_at(switches, k, t, state, top, h, 1.0, method, orders, signal, p, work)
        slope = slope_of_switch(switches, k, t, state, top, h, method, orders, signal, p, work)
        if abs(end) <= 0.1 * SLACK * largest[k] or not (abs(slope) > 0.0):
            break
        position = min(max(1.0 - end / (slope * h), 0.5), 1.5)
        if abs(position - 1.0) < 1e-14:
            break
    return h


@inner
def slope_of_switch(
    switches: int, k: int, t: float, state: Array, top: Array, h: float, method: Method,
    orders: Integers, signal: InputSignal, p: Array, work: Workspace,
) -> float:  # fmt: skip
    """Time derivative of a switching function at the end of a step, along its polynomial."""
    ahead = sigma_at(switches, k, t, state, top, h, 1.0 + 1e-4, method, orders, signal, p, work)
    behind = sigma_at(switches, k, t, state, top, h, 1.0 - 1e-4, method, orders, signal, p, work)
    return (ahead - behind) / (2e-4 * h)


@inner
def jump_of_derivatives(
    slopes: int, k: int, slope: float, top_by: Array, before: Array, after: Array, columns: Array,
    s: int, switches: int, orders: Integers, p: Array, work: Workspace, active: int,
) -> None:  # fmt: skip
    """Carry derivatives ``columns (D, C)`` across a switch at the end of the step in ``work``.

    The switch moves by ``dt = -(d sigma)/slope``, and between its old and its new time the state
    goes at the other rate: ``before - after (d,)`` differ in the highest derivatives only. Kinks
    leave no jump.
    """
    d = orders.size
    jump = 0.0
    for j in range(d):
        jump = max(jump, abs(before[j] - after[j]) / (abs(before[j]) + abs(after[j]) + 1e-300))
    if jump < 1e-12:
        return
    nz, count, last = d + columns.shape[0], columns.shape[1], s - 1
    evaluate(slopes, work.z, work.u, p, work.slopes, s)
    for column in range(count):
        change, row, first = 0.0, k * nz, 0
        for j in range(d):
            for i in range(orders[j]):
                change += work.slopes[row + i, last] * columns[first + i, column]
            change += work.slopes[row + orders[j], last] * top_by[last * d + j, column]
            row += orders[j] + 1
            first += orders[j]
        if column >= count - active:
            row = switches * nz + k * active
            change += work.slopes[row + column - count + active, last]
        first = 0
        for j in range(d):
            first += orders[j]
            columns[first - 1, column] -= (before[j] - after[j]) * change / slope
