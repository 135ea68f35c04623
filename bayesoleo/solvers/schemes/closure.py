"""Closure of a period: the state from which the product of all steps leads back to itself.

Each step of the mesh maps the state at its left end to that at its right end. Eliminating a step's
own unknowns leaves ``delta_{m+1} = M_m delta_m + r_m``; the product of all ``M_m`` closes the
period with one small system (Verbeek 1993, section 4.3.1, with one state in place of three past
blocks).

Whether a closure is singular, or its recursion has grown too much to be trusted, must not depend on
the units of the states: where a matrix looks bad as it is, it is balanced and looked at again.
"""

from __future__ import annotations

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.schemes.elimination import eliminate, jit

#: What cancellation in the product of a period's steps leaves of an exact zero, over the size of
#: what cancels.
ROUND_OFF = 1e-12
#: Growth of the recursion over a period beyond which half of the digits are lost.
LARGEST_GROWTH = 1e8
#: Two suffice for units alone; loops of several states take a few more.
_SWEEPS = 20


@jit
def balance(matrix: Array, size: int, scale: Array) -> None:
    """Make rows as large as columns by a change of units: ``S^-1 matrix S`` in place, in powers of
    two, which round nothing; ``scale (size,)`` becomes the diagonal of S.

    Osborne's iteration (J. ACM 7, 338, 1960); where each state acts on the others, its end does not
    depend on the units at the beginning but by these powers.
    """
    for i in range(size):
        scale[i] = 1.0
    changed, sweeps = True, 0
    while changed and sweeps < _SWEEPS:
        changed, sweeps = False, sweeps + 1
        for i in range(size):
            row = column = 0.0
            for k in range(size):
                if k != i:
                    row += abs(matrix[i, k])
                    column += abs(matrix[k, i])
            if 0.0 < row < np.inf and 0.0 < column < np.inf:
                factor = 2.0 ** np.rint(0.5 * (np.log2(row) - np.log2(column)))
                if factor != 1.0:
                    changed = True
                    scale[i] *= factor
                    for k in range(size):
                        matrix[i, k] /= factor
                    for k in range(size):
                        matrix[k, i] *= factor


@jit
def close(product: Array, right: Array, closure: Array) -> tuple[bool, float]:
    """Solve ``(I - product) x = right`` in place, ``product (D, >= D)``, ``right (D, k)``.

    Returns whether it is regular, and the product's norm. ``closure (D, D)`` is work space.
    """
    D, growth = closure.shape[0], 0.0
    for i in range(D):
        largest, size = 0.0, 1.0
        for k in range(D):
            closure[i, k] = (1.0 if i == k else 0.0) - product[i, k]
            largest = max(largest, abs(closure[i, k]))
            size += abs(product[i, k])
        growth = max(growth, size)
        if not largest > ROUND_OFF * size:
            return False, growth
    return eliminate(closure, right, ROUND_OFF), growth


@jit
def close_balanced(
    product: Array, right: Array, closure: Array, scale: Array
) -> tuple[bool, float]:
    """As :func:`close`, in balanced units; ``product`` is balanced in place."""
    D, width = right.shape
    balance(product, D, scale)
    for i in range(D):
        for k in range(width):
            right[i, k] /= scale[i]
    regular, growth = close(product, right, closure)
    for i in range(D):
        for k in range(width):
            right[i, k] *= scale[i]
    return regular, growth


@jit
def close_and_sweep(transfer: Array, monodromy: Array, states: Array, initial: bool) -> bool:
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
    state = np.zeros((D, k))
    for i in range(D):
        for j in range(D):
            monodromy[i, j] = product[i, j]
    if not initial:
        closure, scale = np.empty((D, D)), np.empty(D)
        state[:] = product[:, D:]
        if not close(product, state, closure)[0]:
            state[:] = product[:, D:]
            if not close_balanced(product, state, closure, scale)[0]:
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
