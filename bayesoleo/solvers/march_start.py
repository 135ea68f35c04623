"""What a march needs to know where it starts, or starts again: rates, modes, admissibility."""

from __future__ import annotations

import numpy as np

from bayesoleo.solvers.signals import rows_at
from bayesoleo.solvers.sweep import eliminate, jit


@jit
def rate_at_start(jacobian, state, top, t, system, work):
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
def is_inside(admissible, z, u, count, system, work):
    """Whether all points lie in the admissible region."""
    if system.conditions == 0:
        return True
    admissible(z.ctypes, u.ctypes, system.p.ctypes, work.a.ctypes, count)
    for k in range(system.conditions):
        for i in range(count):
            if not (work.a[k, i] > 0.0):
                return False
    return True


@jit
def starts(jacobian, switches, admissible, front, t, h, system, work):
    """Rates and modes at the start; false if there are none or it is not admissible."""
    for _ in range(2 if system.modes.size > 0 else 1):
        # Modes depend on the rates only where a state starts on a switch.
        if not rate_at_start(jacobian, front.state, front.rate, t, system, work):
            return False
        _initial_modes(switches, front.state, front.rate, t, h, system, work)
    rows_at(system.signal, t, 0.0, np.zeros(1), work.u1)
    return is_inside(admissible, work.z1, work.u1, 1, system, work)


@jit
def _initial_modes(switches, state, top, t, h, system, work):
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
        switches(work.z1.ctypes, work.u1.ctypes, p.ctypes, work.y.ctypes, 1)
        for k in range(modes.size):
            if part == 0.0 or p[modes[k]] == 0.5:
                value = work.y[k, 0]
                p[modes[k]] = 1.0 if value > 0.0 else (0.5 if value == 0.0 else 0.0)
    for k in range(modes.size):
        if p[modes[k]] == 0.5:
            p[modes[k]] = 1.0
