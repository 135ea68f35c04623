"""One step of a Radau IIA method on implicit equations, with its error and its derivatives.

As in ``_collocation.py`` a step's unknowns are the highest derivatives ``top (s, d)`` at the
stages, and the other quantities are linear in them; here steps follow one another, each with its
own length. The last stage is the end of the step, so that a step's end is among its unknowns.

Functions that only compiled code calls are compiled without wrappers, and take the address of each
kernel instead of a function. This cuts compilation to a fraction of the time, because each of them
takes many arrays.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from bayesoleo._compiled import BLOCK, call_kernel, inner, pointer
from bayesoleo._types import Array, Integers
from bayesoleo.solvers._elimination import eliminate
from bayesoleo.solvers._mesh import tableau

#: Outcomes of the stages' iteration.
SOLVED, DIVERGED, SINGULAR, UNDEFINED = 0, 1, 2, 3
MAXIMUM_ITERATIONS = 8
#: Changes of stages over the sizes of the states that round-off can make.
ROUND_OFF = 1e-10


@inner
def evaluate_kernel(kernel: int, z: Array, u: Array, p: Array, out: Array, count: int) -> None:
    """Call the kernel at an address for ``count`` points in rows of ``z``, ``u`` and ``out``."""
    call_kernel(kernel, (pointer(z, 0), pointer(u, 0), pointer(p, 0), pointer(out, 0), count))


class Method(NamedTuple):
    """A Radau IIA method with ``s`` stages, as compiled code takes it.

    Parameters
    ----------
    c : ndarray, shape (s,)
        Positions of the stages; the last is 1.
    a, aa : ndarray, shape (s, s)
        Weights that integrate stage values once and twice.
    lagrange : ndarray, shape (s, s)
        Coefficients of the Lagrange polynomials, by stage and power.
    error : ndarray, shape (s,)
        Weights of the stages' rates in the error estimate.
    gamma : float
        Weight in it of the rate at the start, and of the Jacobian that damps it.
    """

    c: Array
    a: Array
    aa: Array
    lagrange: Array
    error: Array
    gamma: float


@cache
def radau_method(stages: int) -> Method:
    """Radau IIA with an odd number of stages: order ``2 s - 1``, error estimate of order ``s``.

    References
    ----------
    Hairer, E. and Wanner, G. (1996). Solving Ordinary Differential Equations II, 2nd ed., section
    IV.8.
    """
    table = tableau(f"radau{stages}")
    values = np.linalg.eigvals(table.a)
    gamma = float(values[np.argmin(np.abs(values.imag))].real)
    powers = np.vander(table.c, increasing=True).T
    moments = 1.0 / np.arange(1, stages + 1)
    moments[0] -= gamma
    error = np.linalg.solve(powers, moments) - table.b
    return Method(table.c, table.a, table.a @ table.a, table.polynomials, error, gamma)


class Workspace(NamedTuple):
    """Arrays of one lane's march, allocated once: blocks of points as kernels take them.

    ``z`` and ``u`` go into a kernel; of the stages come ``g`` (equations, then their derivatives by
    ``z``), ``gp`` (by parameters), ``a`` (conditions) and ``y`` (switching functions). Those with
    a ``1`` serve single points.
    """

    z: Array
    u: Array
    g: Array
    gp: Array
    a: Array
    y: Array
    slopes: Array
    z1: Array
    u1: Array
    g1: Array
    matrix: Array
    right: Array
    small: Array


def workspace(
    stages: int, orders: tuple[int, ...], inputs: int, active: int, conditions: int, switches: int
) -> Workspace:
    """Arrays for a method and equations of given sizes."""
    d, D = len(orders), sum(orders)
    nz, size = D + d, stages * d

    def rows(count: int) -> Array:
        return np.zeros((max(count, 1), BLOCK))  # a pointer must point to something

    return Workspace(
        rows(nz), rows(inputs), rows(d + d * nz), rows(d * active), rows(conditions),
        rows(switches), rows(switches * (nz + active)), rows(nz), rows(inputs), rows(d + d * nz),
        np.zeros((size, size)), np.zeros((size, 1)), np.zeros((d, 1)),
    )  # fmt: skip


@inner
def copy_to(source: Array, target: Array) -> None:
    """Copy a table; compiles in a fraction of the time of an assignment, which checks shapes."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@inner
def rows_of_stages(
    state: Array, top: Array, h: float, method: Method, orders: Integers, z: Array
) -> None:
    """Values and derivatives ``z (nz, s)`` at the stages."""
    s = method.c.size
    row = first = 0
    for j in range(orders.size):
        for i in range(s):
            once = twice = 0.0
            for k in range(s):
                once += method.a[i, k] * top[k, j]
                twice += method.aa[i, k] * top[k, j]
            if orders[j] == 1:
                z[row, i] = state[first] + h * once
                z[row + 1, i] = top[i, j]
            else:
                z[row, i] = state[first] + h * (method.c[i] * state[first + 1] + h * twice)
                z[row + 1, i] = state[first + 1] + h * once
                z[row + 2, i] = top[i, j]
        row += orders[j] + 1
        first += orders[j]


@inner
def assemble(g: Array, h: float, method: Method, orders: Integers, matrix: Array) -> None:
    """Derivatives of the stages' equations by the stages' unknowns, ``(s d, s d)``."""
    d, s = orders.size, method.c.size
    nz = d + orders.sum()
    for i in range(s):
        for e in range(d):
            line, row = i * d + e, d + e * nz
            for j in range(d):
                low, middle = g[row, i], g[row + 1, i]
                for k in range(s):
                    total = h * method.a[i, k] * (low if orders[j] == 1 else middle)
                    if orders[j] == 2:
                        total += h * h * method.aa[i, k] * low
                    if i == k:
                        total += middle if orders[j] == 1 else g[row + 2, i]
                    matrix[line, k * d + j] = total
                row += orders[j] + 1


@inner
def solve_stages(
    jacobian: int, state: Array, top: Array, h: float, scale: Array, enough: float, method: Method,
    orders: Integers, p: Array, work: Workspace,
) -> tuple[int, int]:  # fmt: skip
    """Newton's method for the stages' unknowns, from ``top (s, d)`` as given.

    ``scale (D,)`` are the sizes of the state components; iterations end when what they would still
    change is below ``enough`` of these. Returns the outcome and the number of iterations; on
    success ``work.z`` holds the stages' rows.
    """
    d, s = orders.size, method.c.size
    before = np.inf
    for iteration in range(MAXIMUM_ITERATIONS):
        rows_of_stages(state, top, h, method, orders, work.z)
        evaluate_kernel(jacobian, work.z, work.u, p, work.g, s)
        assemble(work.g, h, method, orders, work.matrix)
        for i in range(s):
            for e in range(d):
                work.right[i * d + e, 0] = -work.g[e, i]
                if not np.isfinite(work.g[e, i]):
                    return UNDEFINED, iteration
        if not eliminate(work.matrix, work.right, 1e-300):
            return SINGULAR, iteration
        size, last = 0.0, -1
        for j in range(d):
            last += orders[j]
            for i in range(s):
                top[i, j] += work.right[i * d + j, 0]
                size = max(size, abs(h * work.right[i * d + j, 0]) / scale[last])
        if not np.isfinite(size):
            return UNDEFINED, iteration
        contraction = size / before
        # Quadratic convergence squares the contraction from step to step; without any contraction
        # left, what is left is round-off.
        done = size < enough or (size < ROUND_OFF and contraction > 0.1)
        if done or (iteration > 0 and size * contraction * contraction < enough):
            rows_of_stages(state, top, h, method, orders, work.z)
            return SOLVED, iteration + 1
        if iteration > 1 and contraction > 2.0:
            return DIVERGED, iteration
        before = size
    return DIVERGED, MAXIMUM_ITERATIONS


@inner
def end_of_step(work: Workspace, s: int, orders: Integers, state: Array) -> None:
    """State at the last stage, from ``work.z``."""
    row = first = 0
    for j in range(orders.size):
        for k in range(orders[j]):
            state[first + k] = work.z[row + k, s - 1]
        row += orders[j] + 1
        first += orders[j]


@inner
def local_error(
    state: Array, top0: Array, h: float, scale: Array, method: Method, orders: Integers,
    work: Workspace, error: Array,
) -> float:  # fmt: skip
    """Largest filtered error ``(D,)`` of a solved step over ``scale``; ``top0 (d,)`` at its start.

    Hairer and Wanner (1996), eq. IV.8.19, for implicit equations: the unfiltered difference of two
    quadratures, damped by ``(I - h gamma J)^-1`` with the Jacobian of the last stage.
    """
    d, s = orders.size, method.c.size
    nz = d + state.size
    reach = h * method.gamma
    row = first = 0
    for j in range(d):
        for k in range(orders[j]):
            rate = top0[j] if k + 1 == orders[j] else state[first + 1]
            total = method.gamma * rate
            for i in range(s):
                total += method.error[i] * work.z[row + k + 1, i]
            error[first + k] = h * total
        row += orders[j] + 1
        first += orders[j]
    matrix = np.empty((d, d))
    for e in range(d):
        row, first, total = d + e * nz, 0, 0.0
        for j in range(d):
            low, middle = work.g[row, s - 1], work.g[row + 1, s - 1]
            if orders[j] == 1:
                matrix[e, j] = middle + reach * low
                total += low * error[first]
            else:
                matrix[e, j] = work.g[row + 2, s - 1] + reach * (middle + reach * low)
                total += low * (error[first] + reach * error[first + 1])
                total += middle * error[first + 1]
            row += orders[j] + 1
            first += orders[j]
        work.small[e, 0] = -total
    if not eliminate(matrix, work.small, 1e-300):
        return np.inf
    largest, first = 0.0, 0
    for j in range(d):
        last = first + orders[j] - 1
        error[last] += reach * work.small[j, 0]
        if orders[j] == 2:
            error[first] += reach * error[last]
        for k in range(orders[j]):
            largest = max(largest, abs(error[first + k]) / scale[first + k])
        first += orders[j]
    return largest if np.isfinite(largest) else np.inf


@inner
def differentiate_step(
    jacobian: int, parameters: int, before: Array, top_by: Array, after: Array, h: float,
    method: Method, orders: Integers, p: Array, work: Workspace, active: int,
) -> bool:  # fmt: skip
    """Exact derivatives of a solved step: ``after (D, C)`` at its end from ``before (D, C)``.

    The last ``active`` of the C columns are derivatives by parameters, to which the step adds its
    own. ``top_by (s d, C)`` receives those of the stages' unknowns. Returns False if singular.
    """
    d, s, columns = orders.size, method.c.size, before.shape[1]
    nz = d + before.shape[0]
    evaluate_kernel(jacobian, work.z, work.u, p, work.g, s)
    assemble(work.g, h, method, orders, work.matrix)
    if active > 0:
        evaluate_kernel(parameters, work.z, work.u, p, work.gp, s)
    for i in range(s):
        for e in range(d):
            for column in range(columns):
                total, row, first = 0.0, d + e * nz, 0
                for j in range(d):
                    total += work.g[row, i] * before[first, column]
                    if orders[j] == 2:
                        slope = h * method.c[i] * work.g[row, i] + work.g[row + 1, i]
                        total += slope * before[first + 1, column]
                    row += orders[j] + 1
                    first += orders[j]
                if column >= columns - active:
                    total += work.gp[e * active + column - columns + active, i]
                top_by[i * d + e, column] = -total
    if not eliminate(work.matrix, top_by, 1e-300):
        return False
    first = 0
    for j in range(d):
        last = first + orders[j] - 1
        for column in range(columns):
            once = twice = 0.0
            for k in range(s):
                once += method.a[s - 1, k] * top_by[k * d + j, column]
                twice += method.aa[s - 1, k] * top_by[k * d + j, column]
            after[last, column] = before[last, column] + h * once
            if orders[j] == 2:
                after[first, column] = before[first, column] + h * (
                    before[last, column] + h * twice
                )
        first += orders[j]
    return True


@inner
def interpolate(
    state: Array, top: Array, h: float, position: float, method: Method, orders: Integers, z: Array
) -> None:
    """Rows ``z (nz, 1)`` at a position in the step, in units of its length, or beyond it."""
    d, s = orders.size, method.c.size
    row = first = 0
    for j in range(d):
        value = once = twice = 0.0
        for i in range(s):
            power = 1.0
            for k in range(s):
                weight = method.lagrange[i, k] * top[i, j] * power
                value += weight
                once += weight * position / (k + 1)
                twice += weight * position * position / ((k + 1) * (k + 2))
                power *= position
        if orders[j] == 1:
            z[row, 0] = state[first] + h * once
            z[row + 1, 0] = value
        else:
            z[row, 0] = state[first] + h * (position * state[first + 1] + h * twice)
            z[row + 1, 0] = state[first + 1] + h * once
            z[row + 2, 0] = value
        row += orders[j] + 1
        first += orders[j]


@inner
def stretch(top: Array, ratio: float, method: Method, following: Array) -> None:
    """Stage unknowns of the next step, ``ratio`` times as long, by extrapolation.

    With ``ratio`` negative: of a step from the same start that is ``-ratio`` times as long.
    """
    s, d = top.shape
    for i in range(s):
        position = 1.0 + ratio * method.c[i] if ratio > 0 else -ratio * method.c[i]
        for j in range(d):
            following[i, j] = 0.0
        for k in range(s):
            weight, power = 0.0, 1.0
            for m in range(s):
                weight += method.lagrange[k, m] * power
                power *= position
            for j in range(d):
                following[i, j] += weight * top[k, j]
