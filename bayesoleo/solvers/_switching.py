"""Location and crossing of switches during integration, and inputs in compiled code.

Equations with kinks or jumps are given as analytic pieces: a *mode* of each switching function
``sigma_k(z, u, p)``, one where it is positive and zero where it is negative, is among the constants
``p``. Inside a step modes are held, so that every step sees an analytic vector field, beyond the
switch as well. A step in which ``sigma_k`` leaves the sign of its mode is shortened to end there,
the mode is exchanged, and the derivatives are carried across the switch.

Inputs are a Fourier series, a piecewise cubic in time, or their sum.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesoleo._compiled import inner, jit
from bayesoleo._types import Array, Integers
from bayesoleo.solvers._radau_step import (
    SOLVED,
    Method,
    Workspace,
    copy_to,
    evaluate_kernel,
    interpolate,
    solve_stages,
    stretch,
)

#: A switching function beyond zero by less than this, over its largest value, has not switched:
#: with analytic pieces the difference is of that size.
SLACK = 1e-13


class InputSignal(NamedTuple):
    """Rows of inputs, each with its derivatives as rows of their own.

    ``u(t) = sum_k cosine[:, k] cos(k w t) + sine[:, k] sin(k w t)`` plus, between ``knots[m]`` and
    ``knots[m + 1]``, the cubic ``sum_j pieces[m, :, j] (t - knots[m])**j``; beyond the knots the
    nearest cubic goes on.

    Parameters
    ----------
    rate : float
        Fundamental angular frequency ``w``, rad/s.
    cosine, sine : ndarray, shape (nu, K)
        Coefficients of the harmonics 0, 1, ..., K - 1.
    knots : ndarray, shape (M + 1,) or (0,)
        Seconds, rising.
    pieces : ndarray, shape (M, nu, 4)
        Coefficients of the cubics.
    """

    rate: float
    cosine: Array
    sine: Array
    knots: Array
    pieces: Array


def periodic_signal(frequency: float, cosine: Array, sine: Array) -> InputSignal:
    """A signal of harmonics only; ``cosine`` and ``sine`` are ``(nu, K)``."""
    count = cosine.shape[0]
    return InputSignal(
        2 * np.pi * frequency,
        np.array(cosine, dtype=float, order="C"),
        np.array(sine, dtype=float, order="C"),
        np.zeros(0),
        np.zeros((0, count, 4)),
    )


def evaluate(signal: InputSignal, times: Array) -> Array:
    """Rows at times ``(N,)`` in s, shape (nu, N)."""
    u = np.empty((signal.cosine.shape[0], times.size))
    rows_at(signal, 0.0, 1.0, np.ascontiguousarray(times, dtype=float), u)
    return u


@jit
def rows_at(signal: InputSignal, start: float, step: float, positions: Array, u: Array) -> None:
    """Fill ``u (nu, N)`` with the rows at ``start + step * positions``."""
    for i in range(positions.size):
        t = start + step * positions[i]
        u[:, i] = 0.0
        _add_harmonics(signal, t, u, i)
        if signal.knots.size > 0:
            _add_piece(signal, t, u, i)


@jit
def _add_harmonics(signal: InputSignal, t: float, u: Array, i: int) -> None:
    """Cosines and sines of all harmonics by rotation: round-off grows with the order only."""
    count, harmonics = signal.cosine.shape
    if harmonics == 0:
        return
    turn, lift = np.cos(signal.rate * t), np.sin(signal.rate * t)
    c, s = 1.0, 0.0
    for k in range(harmonics):
        for row in range(count):
            u[row, i] += signal.cosine[row, k] * c + signal.sine[row, k] * s
        c, s = c * turn - s * lift, c * lift + s * turn


@jit
def _add_piece(signal: InputSignal, t: float, u: Array, i: int) -> None:
    pieces = signal.pieces.shape[0]
    m = int(np.searchsorted(signal.knots, t, side="right")) - 1
    m = min(max(m, 0), pieces - 1)
    x = t - signal.knots[m]
    for row in range(u.shape[0]):
        b = signal.pieces[m, row]
        u[row, i] += b[0] + x * (b[1] + x * (b[2] + x * b[3]))


@inner
def sigma_at(
    switches: int, k: int, t: float, state: Array, top: Array, h: float, position: float,
    method: Method, orders: Integers, signal: InputSignal, p: Array, work: Workspace,
) -> float:  # fmt: skip
    """Switching function ``k`` on the step's polynomial."""
    interpolate(state, top, h, position, method, orders, work.z1)
    rows_at(signal, t, h, np.full(1, position), work.u1)
    evaluate_kernel(switches, work.z1, work.u1, p, work.y, 1)
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
    evaluate_kernel(switches, work.z, work.u, p, work.y, s)
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
    evaluate_kernel(slopes, work.z, work.u, p, work.slopes, s)
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
