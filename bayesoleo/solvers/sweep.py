"""Compiled linear algebra of one Newton step: small blocks, one forward sweep, a periodic closure.

Each step of the mesh maps the state at its left end to that at its right end. Eliminating a step's own unknowns leaves
``delta_{m+1} = M_m delta_m + r_m``; the product of all ``M_m`` closes the period with one small system (Verbeek 1993, section 4.3.1,
with one state in place of three past blocks). Compiled once for every model: the sizes are run-time numbers.
"""

from __future__ import annotations

import numba
import numpy as np

jit = numba.njit(nogil=True, cache=True, error_model="numpy")


@jit
def eliminate(matrix, right):
    """Solve ``matrix @ x = right`` in place by elimination with row scaling and partial pivoting.

    ``matrix (m, m)`` is destroyed, ``right (m, k)`` becomes the solution. Returns False where a pivot vanishes or is not finite.
    """
    m, k = right.shape
    for i in range(m):
        largest = 0.0
        for j in range(m):
            largest = max(largest, abs(matrix[i, j]))
        if not (largest > 0.0 and largest < np.inf):
            return False
        # Rows are equations in different units; scaled alike, their entries can be compared as pivots.
        for j in range(m):
            matrix[i, j] /= largest
        for j in range(k):
            right[i, j] /= largest
    for column in range(m):
        pivot = column
        for i in range(column + 1, m):
            if abs(matrix[i, column]) > abs(matrix[pivot, column]):
                pivot = i
        if not (abs(matrix[pivot, column]) > 1e-300):
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
            for l in range(i + 1, m):
                total -= matrix[i, l] * right[l, j]
            right[i, j] = total * inverse
    return True


@jit
def close_and_sweep(transfer, monodromy, states, initial):
    """Close the period and run through it once more.

    Parameters: ``transfer (n, D, D + k)`` holds ``[M_m | r_m]``; on return ``monodromy (D, D)`` is the product of all ``M_m`` and
    ``states (n, D, k)`` the solution at the nodes. With ``initial`` true the first state is held (an initial value problem)
    instead of being closed. Returns False if the closure is singular.
    """
    n, D, width = transfer.shape
    k = width - D
    product = np.zeros((D, width))
    for i in range(D):
        product[i, i] = 1.0
    for m in range(n):
        product = _advance(transfer[m], product, D)
    monodromy[:] = product[:, :D]
    first = np.zeros((D, k))
    if not initial:
        closure = np.eye(D) - product[:, :D]
        first[:] = product[:, D:]
        if not eliminate(closure, first):
            return False
    for m in range(n):
        states[m] = first
        following = np.empty((D, k))
        for i in range(D):
            for j in range(k):
                total = transfer[m, i, D + j]
                for l in range(D):
                    total += transfer[m, i, l] * first[l, j]
                following[i, j] = total
        first = following
    return True


@jit
def _advance(step, product, D):
    """``[M | r]`` of one step applied to the accumulated ``[P | c]``."""
    width = product.shape[1]
    result = np.empty((D, width))
    for i in range(D):
        for j in range(width):
            total = step[i, j] if j >= D else 0.0
            for l in range(D):
                total += step[i, l] * product[l, j]
            result[i, j] = total
    return result
