"""Linear algebra of a step and of a whole period: elimination, periodic closure, sparse factors.

Small systems are eliminated in two ways: one at a time with row exchange, or many at once without.
Both are compiled once for every model, since sizes are run-time numbers.

Each step of the mesh maps the state at its left end to that at its right end. Eliminating a step's
own unknowns leaves ``delta_{m+1} = M_m delta_m + r_m``; the product of all ``M_m`` closes the
period with one small system (Verbeek 1993, section 4.3.1, with one state in place of three past
blocks). Whether a closure is singular, or its recursion has grown too much to be trusted, must not
depend on the units of the states: a matrix that appears ill-conditioned is balanced and tested
again.

The product fails where a motion is so unstable that it grows beyond the available digits, or where
a step's own unknowns cannot be eliminated locally. The equations may still be regular. A sparse
factorisation of the whole period, which exchanges rows of different steps, solves them at many
times the cost (20 times in Verbeek 1993, section 4.3.1).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from bayesoleo._compiled import inner, jit
from bayesoleo._types import Array, Flags
from bayesoleo.solvers._mesh import Tableau

#: Part of its digits that a pivot may lose, to cancellation or beside a large multiple of another
#: row, before the elimination that exchanges rows is asked for.
SMALL_PIVOT = 1e-4
#: What cancellation in the product of a period's steps leaves of an exact zero, over the size of
#: what cancels.
ROUND_OFF = 1e-12
#: Growth of the recursion over a period beyond which half of the digits are lost.
LARGEST_GROWTH = 1e8
#: Two suffice for units alone; loops of several states take a few more.
_SWEEPS = 20
#: Weights by how many nodes they lie behind.
Stencil = dict[int, float]
#: A pivot this small against its row's largest entry is round-off of zero.
SMALLEST_PIVOT = 1e-13


@inner
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


@inner
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


@inner
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


@inner
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


@inner
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


@inner
def _copy_columns(source: Array, first: int, target: Array) -> None:
    """Copy columns from the first on: an assignment of slices compiles the text of its error too,
    which takes as long as all else in this file."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, first + j]


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
        _copy_columns(product, D, state)
        if not close(product, state, closure)[0]:
            _copy_columns(product, D, state)
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


def needs_factorisation(ok: bool, monodromy: Array) -> bool:
    """Whether what a sweep made of a lane cannot be used: it failed, or too many digits were lost
    in its ``monodromy (D, D)``."""
    if not ok or np.abs(monodromy).sum(axis=1).max() < LARGEST_GROWTH:
        return not ok
    balanced = monodromy.copy()
    balance(balanced, balanced.shape[0], np.empty(balanced.shape[0]))
    return not np.abs(balanced).sum(axis=1).max() < LARGEST_GROWTH


def solve(matrix: csc_array, right: Array) -> Array | None:
    """Solve ``matrix @ x = right`` for right-hand sides ``(N, k)``.

    Returns
    -------
    ndarray, shape (N, k), or None
        None where the matrix is singular to working precision, or not finite.
    """
    # Rows are equations in different units; an empty one is caught below as singular.
    scale = 1.0 / np.maximum(abs(matrix).max(axis=1).toarray().ravel(), 1e-300)
    scaled = csc_array(matrix.multiply(scale[:, None]))
    if not (np.isfinite(scaled.data).all() and np.isfinite(right).all()):
        return None
    try:
        factors = splu(scaled)
    except RuntimeError:  # exactly singular
        return None
    if not np.abs(factors.U.diagonal()).min() > SMALLEST_PIVOT:
        return None
    return np.asarray(factors.solve(right * scale[:, None]))


def difference_step(gz: Array, right: Array, stencils: Sequence[Stencil]) -> Array | None:
    """Solve ``G dx = -right`` of equations at nodes, for differences.

    Parameters
    ----------
    gz : ndarray, shape (d, nz, n)
        Partial derivatives of the equations by values and differences.
    right : ndarray, shape (d, k, n)
        Right-hand sides.
    stencils : sequence of dict, length nz
        How values and differences follow from the nodes; the first of each dof is its value.

    Returns
    -------
    ndarray, shape (n, d, k), or None
    """
    d, k, n = right.shape
    node, dof = np.arange(n), -1
    values, lines, columns = [], [], []
    for row, stencil in enumerate(stencils):
        dof += len(stencil) == 1
        for behind, weight in stencil.items():
            for e in range(d):
                values.append(weight * gz[e, row])
                lines.append(node * d + e)
                columns.append((node - behind) % n * d + dof)
    matrix = _matrix(values, lines, columns, n * d)
    found = solve(matrix, -np.moveaxis(right, 2, 0).reshape(n * d, k))
    return None if found is None else found.reshape(n, d, k)


def collocation_step(
    gz: Array, right: Array, ends: Array, method: Tableau, orders: Sequence[int], h: Array
) -> Array | None:
    """Solve ``G dx = -right`` of collocation, with ``dx_{m+1} = end of step m + ends``.

    Parameters
    ----------
    gz : ndarray, shape (d, nz, n s)
        Partial derivatives of the equations at the points.
    right : ndarray, shape (d, k, n s)
        Right-hand sides of the equations.
    ends : ndarray, shape (D, k, n)
        What is added to the state at the end of each step.
    method : Tableau
        Of ``s`` stages.
    orders : sequence of int
        Of the dofs.
    h : ndarray, shape (n,)
        Lengths of the steps, s.

    Returns
    -------
    ndarray, shape (n, w, k), or None
    """
    s, d, D, n, k = method.stages, len(orders), sum(orders), h.size, right.shape[1]
    stages, end = step_maps(method, orders, h)
    w = D + s * d
    points = gz.reshape(d, gz.shape[1], n, s)
    own = np.einsum("ezms,mszw->mesw", points, stages).reshape(n, d * s, w)
    block = np.concatenate([own, end], axis=1)
    line, column = np.mgrid[:w, :w]
    step = np.arange(n)[:, None]
    following = (np.arange(n) + 1)[:, None] % n * w + np.arange(D)
    values = [block.reshape(n, -1).ravel(), np.full(n * D, -1.0)]
    lines = [(step * w + line.ravel()).ravel(), (step * w + d * s + np.arange(D)).ravel()]
    columns = [(step * w + column.ravel()).ravel(), following.ravel()]
    target = np.concatenate([right.reshape(d, k, n, s).transpose(2, 0, 3, 1).reshape(n, d * s, k),
                             ends.transpose(2, 0, 1)], axis=1)  # fmt: skip
    found = solve(_matrix(values, lines, columns, n * w), -target.reshape(n * w, k))
    return None if found is None else found.reshape(n, w, k)


def eliminate_steps(gz: Array, right: Array, stages: Array) -> tuple[Array, Flags]:
    """Solve each step's equations for its own unknowns, with exchange of rows.

    Parameters
    ----------
    gz, right : ndarray, shapes (L, d, nz, n s) and (L, d, k, n s)
        Partial derivatives of the equations at the points, and right-hand sides.
    stages : ndarray, shape (n, s, nz, w)
        Of :func:`step_maps`.

    Returns
    -------
    own : ndarray, shape (L, n, s d, D + k)
        The unknowns of the stages by the state at the step's left end, and of the right-hand sides.
    regular : ndarray of bool, shape (L,)
        Whether all steps of a lane can be solved; else its unknowns are not numbers.
    """
    lanes, d, k, _ = right.shape
    n, s, nz, w = stages.shape
    size, D = d * s, w - d * s
    points = gz.reshape(lanes, d, nz, n, s)
    whole = np.einsum("lezms,mszw->lmesw", points, stages).reshape(lanes, n, size, w)
    columns = np.moveaxis(right.reshape(lanes, d, k, n, s), (3, 1, 4, 2), (1, 2, 3, 4))
    target = -np.concatenate([whole[..., :D], columns.reshape(lanes, n, size, k)], axis=3)
    with np.errstate(all="ignore"):
        # Rows are equations in different units; scaled alike, their entries are compared as pivots.
        scale = 1.0 / np.abs(whole[..., D:]).max(axis=3, keepdims=True)
        own = _solved(scale * whole[..., D:], scale * target)
    return own, np.isfinite(own[..., :D]).all(axis=(1, 2, 3))


def _solved(matrices: Array, right: Array) -> Array:
    """Solutions of systems ``(..., m, m)``, not numbers where one is singular."""
    try:
        return np.linalg.solve(matrices, right)
    except np.linalg.LinAlgError:
        if matrices.ndim == 2:
            return np.full_like(right, np.nan)
        return np.stack([_solved(*one) for one in zip(matrices, right, strict=True)])


def step_maps(method: Tableau, orders: Sequence[int], h: Array) -> tuple[Array, Array]:
    """How rows at the stages ``(n, s, nz, w)`` and the state at the end ``(n, D, w)`` of each step
    follow from its unknowns."""
    s, d, D, n = method.stages, len(orders), sum(orders), h.size
    stages, end = np.zeros((n, s, D + d, D + s * d)), np.zeros((n, D, D + s * d))
    h1, aa, ba = h[:, None, None], method.a @ method.a, method.b @ method.a
    row = first = 0
    for j, order in enumerate(orders):
        top, rate, last = slice(D + j, None, d), row + order - 1, first + order - 1
        stages[:, :, row + order, top] = np.eye(s)
        stages[:, :, rate, last] = end[:, last, last] = 1.0
        stages[:, :, rate, top] = h1 * method.a
        end[:, last, top] = h[:, None] * method.b
        if order == 2:
            stages[:, :, row, first] = end[:, first, first] = 1.0
            stages[:, :, row, last] = h[:, None] * method.c
            stages[:, :, row, top] = h1**2 * aa
            end[:, first, last] = h
            end[:, first, top] = h[:, None] ** 2 * ba
        row, first = row + order + 1, first + order
    return stages, end


def _matrix(
    values: Sequence[Array], lines: Sequence[Array], columns: Sequence[Array], size: int
) -> csc_array:
    place = np.concatenate(lines), np.concatenate(columns)
    return csc_array((np.concatenate(values), place), shape=(size, size))
