"""The linearised equations of a whole period at once, by a sparse factorisation with pivoting.

Sweeping through a period multiplies the maps of its steps. Where a motion is so unstable that the
product grows beyond the digits there are, or a step's own unknowns cannot be eliminated where they
stand, the equations may be regular all the same: a factorisation that exchanges rows of different
steps solves them, at many times the cost (20 times in Verbeek 1993, section 4.3.1).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from bayesoleo._types import Array
from bayesoleo.solvers.schemes.closure import LARGEST_GROWTH, balance
from bayesoleo.solvers.schemes.tableau import Tableau

#: Weights by how many nodes they lie behind.
Stencil = dict[int, float]

#: A pivot this small against its row's largest entry is round-off of zero.
SMALLEST_PIVOT = 1e-13


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
