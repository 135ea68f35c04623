"""The thesis's discretisation: second-order backward differences on an equidistant mesh (Verbeek 1993, eqs. 4.21-4.23).

``q'_m = (3 q_m - 4 q_{m-1} + q_{m-2}) / (2 h)`` and ``q''_m = (2 q_m - 5 q_{m-1} + 4 q_{m-2} - q_{m-3}) / h**2``, indices modulo n. The unknowns are
the dofs at the nodes, ``x (L, n, d)``; three past blocks are the state that the closure carries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo.solvers.sweep import close_and_sweep, eliminate, jit

Array = NDArray[np.float64]

FIRST = np.array([1.5, -2.0, 0.5, 0.0])
SECOND = np.array([2.0, -5.0, 4.0, -1.0])


@dataclass(frozen=True)
class CubicPlan:
    """Four nodes and their weights for each of N phases, shapes (4, N)."""

    nodes: NDArray[np.int64]
    weights: Array


@dataclass(frozen=True)
class BackwardDifferences:
    """Backward differences for dofs of given orders (1 or 2 each)."""

    orders: tuple[int, ...]
    order = 2

    @property
    def state_size(self) -> int:
        """Size by which rows are counted: value and velocity of each dof."""
        return sum(self.orders)

    @property
    def width(self) -> int:
        """Unknowns at a node."""
        return len(self.orders)

    def phases(self, n: int) -> Array:
        """Phases in cycles of the nodes, where the equations hold, shape (n,)."""
        return np.arange(n) / n

    def from_motion(self, rows_at_nodes: Array, rows_at_points: Array) -> Array:
        """Unknowns that represent a given motion (see ``Collocation.from_motion``)."""
        starts = np.cumsum([0, *(order + 1 for order in self.orders[:-1])])
        return np.ascontiguousarray(np.moveaxis(rows_at_nodes[:, starts], 1, 2))

    def rows(self, x: Array, lanes: NDArray[np.int64], step: float, z: Array) -> None:
        """Fill ``z (L, nz, N)`` with values and differences at the nodes."""
        z[lanes] = self._node_rows(x[lanes, :, :, None], step)[:, :, 0]

    def _node_rows(self, x: Array, step: float) -> Array:
        """Values and differences at the nodes, shape (L, nz, C, n)."""
        rows = []
        for j, order in enumerate(self.orders):
            past = [np.moveaxis(np.roll(x[:, :, j], k, axis=1), 1, 2) for k in range(4)]
            rows.append(past[0])
            rows.append(sum(weight * q for weight, q in zip(FIRST, past, strict=True)) / step)
            if order == 2:
                rows.append(sum(weight * q for weight, q in zip(SECOND, past, strict=True)) / step**2)
        return np.stack(rows, axis=1)

    def plan(self, phase: Array, n: int) -> CubicPlan:
        """Nodes around given phases (cycles) and the weights of the cubic through them."""
        scaled = (phase % 1.0) * n
        index = np.floor(scaled).astype(np.int64)
        t = scaled - index
        weights = np.stack(
            [
                -t * (t - 1) * (t - 2) / 6,
                (t + 1) * (t - 1) * (t - 2) / 2,
                -(t + 1) * t * (t - 2) / 2,
                (t + 1) * t * (t - 1) / 6,
            ]
        )
        return CubicPlan((index + np.arange(-1, 3)[:, None]) % n, weights)

    def sample(self, x: Array, plan: CubicPlan, step: float) -> Array:
        """Values and derivatives at planned phases by cubic interpolation between nodes, shape (L, nz, C, N)."""
        rows = self._node_rows(x, step)
        total = np.zeros((*rows.shape[:3], plan.weights.shape[1]))
        for nodes, weights in zip(plan.nodes, plan.weights, strict=True):
            total += weights * rows[..., nodes]
        return total

    def linear(
        self,
        gz: Array,
        right: Array,
        x: Array | None,
        lanes: NDArray[np.int64],
        step: float,
        *,
        initial: bool = False,
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Solve ``G dx = -right`` with the periodic closure (see ``Collocation.linear``); the monodromy is that of the recursion."""
        count, d, n = gz.shape[0], len(self.orders), gz.shape[3]
        dx = np.zeros((count, n, d, right.shape[2]))
        monodromy = np.zeros((count, 3 * d, 3 * d))
        ok = np.ones(count, dtype=np.bool_)
        orders = np.array(self.orders, dtype=np.int64)
        _linear(gz, right, lanes, step, orders, FIRST, SECOND, initial, dx, monodromy, ok)
        return dx, monodromy, ok


@jit
def _linear(gz, right, lanes, h, orders, first, second, initial, dx, monodromy, ok):
    d, n, k = orders.size, gz.shape[3], right.shape[2]
    D = 3 * d
    transfer = np.empty((n, D, D + k))
    states = np.empty((n, D, k))
    for lane in lanes:
        good = True
        for m in range(n):
            good = _condense(gz[lane], right[lane], m, h, orders, first, second, transfer[m])
            if not good:
                break
        if good:
            good = close_and_sweep(transfer, monodromy[lane], states, initial)
        ok[lane] = good
        if good:
            for m in range(n):
                for j in range(d):
                    for column in range(k):
                        # The state before step m + 1 leads with the unknowns of node m.
                        dx[lane, m, j, column] = states[(m + 1) % n, j, column]


@jit
def _condense(gz, right, m, h, orders, first, second, transfer):
    """Unknowns of node ``m`` from the three nodes before it, as a companion matrix ``(3 d, 3 d + k)``."""
    d = orders.size
    D, k = 3 * d, right.shape[1]
    matrix = np.zeros((d, d))
    solution = np.zeros((d, D + k))
    for e in range(d):
        row = 0
        for j in range(d):
            low, mid = gz[e, row, m], gz[e, row + 1, m] / h
            top = gz[e, row + 2, m] / (h * h) if orders[j] == 2 else 0.0
            matrix[e, j] = low + first[0] * mid + second[0] * top
            for past in range(1, 4):
                solution[e, (past - 1) * d + j] = -(first[past] * mid + second[past] * top)
            row += orders[j] + 1
        for column in range(k):
            solution[e, D + column] = -right[e, column, m]
    good = eliminate(matrix, solution)
    transfer[:] = 0.0
    transfer[:d] = solution
    for i in range(2 * d):
        transfer[d + i, i] = 1.0
    return good
