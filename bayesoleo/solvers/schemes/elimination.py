"""Compiled elimination of small systems: one with exchange of rows, many at once without.

Compiled once for every model: the sizes are run-time numbers.
"""

from __future__ import annotations

import numba
import numpy as np

from bayesoleo._types import Array

jit = numba.njit(nogil=True, cache=True, error_model="numpy")


@jit
def eliminate(matrix: Array, right: Array, least: float) -> bool:
    """Solve ``matrix @ x = right`` in place by elimination with row scaling and partial pivoting.

    ``matrix (m, m)`` is destroyed, ``right (m, k)`` becomes the solution. Returns False where a
    pivot is not above ``least``, over the largest entry of its row, or not finite.
    """
    m, k = right.shape
    for i in range(m):
        largest = 0.0
        for j in range(m):
            largest = max(largest, abs(matrix[i, j]))
        if not (largest > 0.0 and largest < np.inf):
            return False
        # Rows are equations in different units; scaled alike, their entries can be compared as
        # pivots.
        for j in range(m):
            matrix[i, j] /= largest
        for j in range(k):
            right[i, j] /= largest
    for column in range(m):
        pivot = column
        for i in range(column + 1, m):
            if abs(matrix[i, column]) > abs(matrix[pivot, column]):
                pivot = i
        if not (abs(matrix[pivot, column]) > least):
            return False
        if pivot != column:
            for j in range(m):
                matrix[column, j], matrix[pivot, j] = matrix[pivot, j], matrix[column, j]
            for j in range(k):
                right[column, j], right[pivot, j] = right[pivot, j], right[column, j]
        inverse = 1.0 / matrix[column, column]
        for i in range(column + 1, m):
            factor = matrix[i, column] * inverse
            if factor != 0.0:
                for j in range(column + 1, m):
                    matrix[i, j] -= factor * matrix[column, j]
                for j in range(k):
                    right[i, j] -= factor * right[column, j]
    for i in range(m - 1, -1, -1):
        inverse = 1.0 / matrix[i, i]
        for j in range(k):
            total = right[i, j]
            for other in range(i + 1, m):
                total -= matrix[i, other] * right[other, j]
            right[i, j] = total * inverse
    return True


#: Part of its digits that a pivot may lose, to cancellation or beside a large multiple of another
#: row, before the elimination that exchanges rows is asked for.
SMALL_PIVOT = 1e-4


@jit
def eliminate_together(work: Array, scale: Array, count: int, m: int) -> bool:
    """Solve ``count`` systems at once, without exchanging rows: ``work (m, m + k, block)`` holds
    ``[matrix | right]``, systems last.

    The right-hand columns become the solutions. Returns False, with ``work`` spoilt, where a pivot
    is too small for that: against the sizes of what made it, which does not depend on the units of
    rows and columns. ``scale (2, m, block)`` is work space.
    """
    width = work.shape[1]
    for i in range(m):
        for t in range(count):
            scale[0, i, t] = scale[1, i, t] = abs(work[i, i, t])
    for column in range(m):
        bad = 0
        for t in range(count):
            pivot, size = abs(work[column, column, t]), SMALL_PIVOT * scale[1, column, t]
            bad += not (pivot > size and size <= scale[0, column, t] and pivot < np.inf)
        if bad > 0:
            return False
        for t in range(count):
            work[column, column, t] = 1.0 / work[column, column, t]
        for i in range(column + 1, m):
            for t in range(count):
                work[i, column, t] *= work[column, column, t]
                scale[1, i, t] += abs(work[i, column, t] * work[column, i, t])
            for j in range(column + 1, width):
                for t in range(count):
                    work[i, j, t] -= work[i, column, t] * work[column, j, t]
    for i in range(m - 1, -1, -1):
        for j in range(m, width):
            for other in range(i + 1, m):
                for t in range(count):
                    work[i, j, t] -= work[i, other, t] * work[other, j, t]
            for t in range(count):
                work[i, j, t] *= work[i, i, t]
    return True


@jit
def eliminate_each(work: Array, count: int, m: int) -> bool:
    """The same system by system, with exchange of rows; returns False where one is singular."""
    width = work.shape[1]
    matrix, right = np.empty((m, m)), np.empty((m, width - m))
    for t in range(count):
        for i in range(m):
            for j in range(m):
                matrix[i, j] = work[i, j, t]
            for j in range(m, width):
                right[i, j - m] = work[i, j, t]
        if not eliminate(matrix, right, 1e-300):
            return False
        for i in range(m):
            for j in range(m, width):
                work[i, j, t] = right[i, j - m]
    return True
