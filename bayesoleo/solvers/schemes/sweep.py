"""Compiled linear algebra of one Newton step: small blocks, one forward sweep, a periodic closure.

Each step of the mesh maps the state at its left end to that at its right end. Eliminating a step's
own unknowns leaves ``delta_{m+1} = M_m delta_m + r_m``; the product of all ``M_m`` closes the
period with one small system (Verbeek 1993, section 4.3.1, with one state in place of three past
blocks). Compiled once for every model: the sizes are run-time numbers.
"""

from __future__ import annotations

import numba
import numpy as np

jit = numba.njit(nogil=True, cache=True, error_model="numpy")


#: What cancellation in the product of a period's steps leaves of an exact zero, over the size of
#: what cancels.
ROUND_OFF = 1e-12
#: Growth of the recursion over a period beyond which half of the digits are lost.
LARGEST_GROWTH = 1e8


@jit
def eliminate(matrix, right, least):
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
def eliminate_together(work, scale, count, m):
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
def eliminate_each(work, count, m):
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


@jit
def close_and_sweep(transfer, monodromy, states, initial):
    """Close the period and run through it once more.

    Parameters: ``transfer (D, D + k, n)`` holds ``[M_m | r_m]``; on return ``monodromy (D, D)`` is
    the product of all ``M_m`` and ``states (D, k, n)`` the solution at the nodes. With ``initial``
    true the first state is held (an initial value problem) instead of being closed. Returns False
    if the closure is singular.
    """
    D, width, n = transfer.shape
    k = width - D
    product, following = np.zeros((D, width)), np.empty((D, width))
    for i in range(D):
        product[i, i] = 1.0
    for m in range(n):
        for i in range(D):
            for j in range(width):
                total = transfer[i, j, m] if j >= D else 0.0
                for other in range(D):
                    total += transfer[i, other, m] * product[other, j]
                following[i, j] = total
        product, following = following, product
    closure, state = np.empty((D, D)), np.zeros((D, k))
    for i in range(D):
        for j in range(D):
            monodromy[i, j] = product[i, j]
            closure[i, j] = (1.0 if i == j else 0.0) - product[i, j]
    if not initial:
        for i in range(D):
            largest, size = 0.0, 1.0
            for j in range(D):
                largest = max(largest, abs(closure[i, j]))
                size += abs(monodromy[i, j])
            if not (largest > ROUND_OFF * size):
                return False
            for j in range(k):
                state[i, j] = product[i, D + j]
        if not eliminate(closure, state, ROUND_OFF):
            return False
    for i in range(D):
        for j in range(k):
            states[i, j, 0] = state[i, j]
    for m in range(n - 1):
        for i in range(D):
            for j in range(k):
                total = transfer[i, D + j, m]
                for other in range(D):
                    total += transfer[i, other, m] * states[other, j, m]
                states[i, j, m + 1] = total
    return True
