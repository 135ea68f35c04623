"""Compiled bookkeeping of a batched Newton iteration: sizes of residuals and steps, lane by lane in
a fixed order.

Library reductions would change their order of summation with the shape of the batch, and with it
the last bits of a solution.
"""

from __future__ import annotations

import numpy as np

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.solvers.schemes.elimination import jit


@jit
def total(row: Array) -> float:
    """Sum in eight interleaved partial sums: in fixed order, without waiting for each addition."""
    a = b = c = d = e = f = g = h = 0.0
    whole = row.size - row.size % 8
    for i in range(0, whole, 8):
        a += row[i]
        b += row[i + 1]
        c += row[i + 2]
        d += row[i + 3]
        e += row[i + 4]
        f += row[i + 5]
        g += row[i + 6]
        h += row[i + 7]
    for i in range(whole, row.size):
        a += row[i]
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@jit
def measure(z: Array, g: Array, gz: Array, lanes: Integers, squares: Array, terms: Array) -> None:
    """Mean squares of residuals and of terms, both ``(L, d)``; not finite where anything is not."""
    d, nz, points = gz.shape[1:]
    row = np.empty(points)
    for lane in lanes:
        for e in range(d):
            for i in range(points):
                row[i] = g[lane, e, i] * g[lane, e, i]
            squares[lane, e] = total(row) / points
            for k in range(nz):
                for i in range(points):
                    term = gz[lane, e, k, i] * z[lane, k, i]
                    row[i] += term * term
            terms[lane, e] = total(row) / points


@jit
def positive(a: Array, lanes: Integers, inside: Flags, defined: Flags) -> None:
    """Whether no condition ``a (L, nc, N)`` is broken; whether all are numbers: both (L,)."""
    for lane in lanes:
        outside = odd = 0
        for k in range(a.shape[1]):
            for i in range(a.shape[2]):
                outside += a[lane, k, i] <= 0.0
                odd += a[lane, k, i] != a[lane, k, i]
        inside[lane] = outside == 0
        defined[lane] = odd == 0


#: Motion about a level that is smaller than this part of it is measured by the level: the digits of
#: a step are lost against it.
LEAST_MOTION = 1e-6


@jit
def unit(motion: float, level: float, change: float) -> float:
    """What a change of a state is small against: its motion about a level, not the level itself.

    A preload or an ambient temperature says nothing of how far a solution is from its own motion.
    The change itself bounds it: there is no step longer than the motion that it makes.
    """
    return max(motion, LEAST_MOTION * abs(level), change)


@jit
def step_size(
    x: Array, dx: Array, lanes: Integers, state_size: int, size: Array, least: Array
) -> None:
    """Largest change of a state over its :func:`unit`, and over its largest value, both of shape
    (L,); NaN where one is not finite."""
    n, w = x.shape[1:]
    for lane in lanes:
        spoilt = 0.0
        for m in range(n):
            for j in range(w):
                spoilt += dx[lane, m, j, 0] * 0.0
        size[lane] = least[lane] = spoilt
        for j in range(min(state_size, w)):
            level, motion, change = x[lane, 0, j], 0.0, 0.0
            for m in range(n):
                motion = max(motion, abs(x[lane, m, j] - level))
                change = max(change, abs(dx[lane, m, j, 0]))
            if spoilt == 0.0 and change > 0.0:
                size[lane] = max(size[lane], change / unit(motion, level, change))
                least[lane] = max(least[lane], change / max(motion + abs(level), change))


@jit
def take(base: Array, dx: Array, lanes: Integers, fractions: Array, x: Array) -> None:
    """``x = base + fraction * dx`` in the chosen lanes."""
    n, w = x.shape[1:]
    for k in range(lanes.size):
        lane = lanes[k]
        for m in range(n):
            for j in range(w):
                x[lane, m, j] = base[lane, m, j] + fractions[k] * dx[lane, m, j, 0]


@jit
def keep(source: Array, lanes: Integers, target: Array) -> None:
    """Copy the chosen lanes."""
    n, w = source.shape[1:]
    for lane in lanes:
        for m in range(n):
            for j in range(w):
                target[lane, m, j] = source[lane, m, j]
