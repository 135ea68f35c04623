"""What a march needs to know where it starts, or starts again: rates, modes, admissibility."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesoleo._types import Array, Integers
from bayesoleo.solvers.schemes.elimination import eliminate
from bayesoleo.solvers.shooting.inner import evaluate, inner
from bayesoleo.solvers.shooting.radau_step import Workspace
from bayesoleo.solvers.shooting.signals import rows_at

if TYPE_CHECKING:
    from bayesoleo.solvers.shooting.march import System
    from bayesoleo.solvers.shooting.march_step import Front


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
        evaluate(system.kernels.jacobian, work.z1, work.u1, p, work.g1, 1)
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
    evaluate(system.kernels.admissible, z, u, system.p, work.a, count)
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
        evaluate(system.kernels.switches, work.z1, work.u1, p, work.y, 1)
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
