"""One-step collocation on an equidistant mesh, as linear maps between unknowns, stage values and samples.

The unknowns of a step are the state at its left node (value, and velocity of a second-order dof) and the highest derivative of each
dof at each stage: ``x (L, n, w)`` with ``w = D + s d``. Everything else - stage values, samples between nodes, sensitivities - is linear
in them, so the same maps serve solutions and their derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo.solvers.sweep import close_and_sweep, eliminate, jit
from bayesoleo.solvers.tableau import Tableau

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SamplePlan:
    """Steps of the mesh, positions inside them and interpolation weights of N phases."""

    index: NDArray[np.int64]
    position: Array
    w0: Array
    w1: Array
    w2: Array


@dataclass(frozen=True)
class Collocation:
    """A collocation scheme for dofs of given orders.

    Parameters
    ----------
    method : Tableau
        Stages and weights.
    orders : tuple of int
        Order (1 or 2) of each dof.
    """

    method: Tableau
    orders: tuple[int, ...]

    @property
    def state_size(self) -> int:
        """Number D of state components."""
        return sum(self.orders)

    @property
    def width(self) -> int:
        """Unknowns in a step, w."""
        return self.state_size + self.method.stages * len(self.orders)

    @property
    def order(self) -> int:
        """Order of the error at the nodes."""
        return self.method.order

    def phases(self, n: int) -> Array:
        """Phases in cycles of the ``N = n s`` points at which equations hold, shape (N,)."""
        return ((np.arange(n)[:, None] + self.method.c) / n).ravel()

    def from_motion(self, rows_at_nodes: Array, rows_at_points: Array) -> Array:
        """Unknowns that represent a given motion.

        Parameters
        ----------
        rows_at_nodes, rows_at_points : ndarray, shapes (L, nz, n) and (L, nz, N)
            Values and derivatives of all dofs.

        Returns
        -------
        ndarray, shape (L, n, w)
        """
        lanes, _, n = rows_at_nodes.shape
        x = np.zeros((lanes, n, self.width))
        stages = rows_at_points.reshape(lanes, rows_at_points.shape[1], n, self.method.stages)
        row = state = 0
        d = len(self.orders)
        for j, order in enumerate(self.orders):
            x[:, :, state : state + order] = np.moveaxis(rows_at_nodes[:, row : row + order], 1, 2)
            x[:, :, self.state_size + j :: d] = stages[:, row + order]
            row, state = row + order + 1, state + order
        return x

    def rows(self, x: Array, lanes: NDArray[np.int64], step: float, z: Array) -> None:
        """Fill ``z (L, nz, N)`` with values and derivatives at the points."""
        n = x.shape[1]
        index = np.repeat(np.arange(n), self.method.stages)
        weights = (np.tile(w, (n, 1)) for w in self.method.weights(self.method.c))
        _sample(x[..., None], lanes, index, np.tile(self.method.c, n), *weights, step, self._orders, z[:, :, None])

    def plan(self, phase: Array, n: int) -> SamplePlan:
        """Where in the mesh given phases (cycles) lie, with their interpolation weights; worth keeping for fixed samples."""
        scaled = (phase % 1.0) * n
        index = np.minimum(scaled.astype(np.int64), n - 1)
        position = scaled - index
        return SamplePlan(index, position, *self.method.weights(position))

    def sample(self, x: Array, plan: SamplePlan, step: float) -> Array:
        """Values and derivatives at planned phases.

        Parameters
        ----------
        x : ndarray, shape (L, n, w, C)
            Unknowns, or their derivatives, in C columns.
        plan : SamplePlan
            Of N phases.
        step : float
            Length of a step of the mesh, s.

        Returns
        -------
        ndarray, shape (L, nz, C, N)
        """
        nz = self.state_size + len(self.orders)
        z = np.empty((x.shape[0], nz, x.shape[3], plan.index.size))
        everyone = np.arange(x.shape[0])
        _sample(x, everyone, plan.index, plan.position, plan.w0, plan.w1, plan.w2, step, self._orders, z)
        return z

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
        """Solve ``G dx = -right`` with the periodic closure.

        Parameters
        ----------
        gz : ndarray, shape (L, d, nz, N)
            Partial derivatives of the equations at the points.
        right : ndarray, shape (L, d, k, N)
            Residuals, or derivatives with respect to k parameters.
        x : ndarray, shape (L, n, w), optional
            Present unknowns; given, their jumps from step to step are removed too (a Newton step).
        lanes : ndarray of int
            Which of the L to solve.
        step : float
            Length of a step, s.
        initial : bool
            Hold the first state instead of closing the period.

        Returns
        -------
        dx : ndarray, shape (L, n, w, k)
        monodromy : ndarray, shape (L, D, D)
        ok : ndarray of bool, shape (L,)
        """
        count, n = gz.shape[0], gz.shape[3] // self.method.stages
        dx = np.zeros((count, n, self.width, right.shape[2]))
        monodromy = np.zeros((count, self.state_size, self.state_size))
        ok = np.ones(count, dtype=np.bool_)
        present = np.zeros((1, 1, 1)) if x is None else x
        method = self.method
        _linear(
            gz, right, present, x is not None, lanes, step, method.a, method.a @ method.a, method.b,
            method.b @ method.a, method.c, self._orders, initial, dx, monodromy, ok,
        )  # fmt: skip
        return dx, monodromy, ok

    @property
    def _orders(self) -> NDArray[np.int64]:
        return np.array(self.orders, dtype=np.int64)


@jit
def _sample(x, lanes, index, position, w0, w1, w2, h, orders, z):
    """``z (L, nz, C, N)`` at positions inside steps from the unknowns ``x (L, n, w, C)``."""
    d, s = orders.size, w0.shape[1]
    D = orders.sum()
    for lane in lanes:
        for column in range(x.shape[3]):
            row = state = 0
            for j in range(d):
                for i in range(index.size):
                    m = index[i]
                    top = once = twice = 0.0
                    for stage in range(s):
                        value = x[lane, m, D + stage * d + j, column]
                        top += w0[i, stage] * value
                        once += w1[i, stage] * value
                        twice += w2[i, stage] * value
                    low = x[lane, m, state, column]
                    if orders[j] == 1:
                        z[lane, row, column, i] = low + h * once
                        z[lane, row + 1, column, i] = top
                    else:
                        rate = x[lane, m, state + 1, column]
                        z[lane, row, column, i] = low + h * (position[i] * rate + h * twice)
                        z[lane, row + 1, column, i] = rate + h * once
                        z[lane, row + 2, column, i] = top
                row += orders[j] + 1
                state += orders[j]


@jit
def _linear(gz, right, x, newton, lanes, h, a, aa, b, ba, c, orders, initial, dx, monodromy, ok):
    """Eliminate every step's stages, close the period, and recover the stages."""
    d, s = orders.size, b.size
    D, n, k = orders.sum(), dx.shape[1], right.shape[2]
    stages = np.empty((n, s * d, D + k))
    transfer = np.empty((n, D, D + k))
    states = np.empty((n, D, k))
    for lane in lanes:
        good = True
        for m in range(n):
            good = _condense(gz[lane], right[lane], m, h, a, aa, c, orders, stages[m])
            if not good:
                break
            _transfer(stages[m], h, b, ba, orders, transfer[m])
            if newton:
                _add_jump(x[lane], m, h, b, ba, orders, transfer[m])
        if good:
            good = close_and_sweep(transfer, monodromy[lane], states, initial)
        ok[lane] = good
        if good:
            _recover(stages, states, dx[lane])


@jit
def _condense(gz, right, m, h, a, aa, c, orders, solution):
    """Stage unknowns of step ``m`` as an affine function of its left state: ``solution (s d, D + k)``."""
    d, s = orders.size, c.size
    D, k = orders.sum(), right.shape[1]
    matrix = np.zeros((s * d, s * d))
    solution[:] = 0.0
    for i in range(s):
        point = m * s + i
        for e in range(d):
            line = i * d + e
            row = state = 0
            for j in range(d):
                low, mid = gz[e, row, point], gz[e, row + 1, point]
                if orders[j] == 1:
                    for stage in range(s):
                        matrix[line, stage * d + j] += h * a[i, stage] * low
                    matrix[line, i * d + j] += mid
                    solution[line, state] -= low
                else:
                    for stage in range(s):
                        matrix[line, stage * d + j] += h * (h * aa[i, stage] * low + a[i, stage] * mid)
                    matrix[line, i * d + j] += gz[e, row + 2, point]
                    solution[line, state] -= low
                    solution[line, state + 1] -= h * c[i] * low + mid
                row += orders[j] + 1
                state += orders[j]
            for column in range(k):
                solution[line, D + column] = -right[e, column, point]
    return eliminate(matrix, solution)


@jit
def _transfer(solution, h, b, ba, orders, transfer):
    """State at the right end of a step from that at the left: ``transfer (D, D + k)``."""
    d, s = orders.size, b.size
    transfer[:] = 0.0
    state = 0
    for j in range(d):
        last = state + orders[j] - 1
        transfer[last, last] = 1.0
        if orders[j] == 2:
            transfer[state, state] = 1.0
            transfer[state, last] = h
        for stage in range(s):
            for column in range(transfer.shape[1]):
                value = solution[stage * d + j, column]
                transfer[last, column] += h * b[stage] * value
                if orders[j] == 2:
                    transfer[state, column] += h * h * ba[stage] * value
        state += orders[j]


@jit
def _add_jump(x, m, h, b, ba, orders, transfer):
    """Add the jump between the end of step ``m`` and the next node, periodically, to the right-hand side (one column)."""
    d, s, n = orders.size, b.size, x.shape[0]
    D = orders.sum()
    following = (m + 1) % n
    state = 0
    for j in range(d):
        once = twice = 0.0
        for stage in range(s):
            value = x[m, D + stage * d + j]
            once += b[stage] * value
            twice += ba[stage] * value
        last = state + orders[j] - 1
        transfer[last, D] += x[m, last] + h * once - x[following, last]
        if orders[j] == 2:
            transfer[state, D] += x[m, state] + h * (x[m, last] + h * twice) - x[following, state]
        state += orders[j]


@jit
def _recover(stages, states, dx):
    """Stage unknowns from the node states: ``dx (n, w, k)``."""
    n, D, k = states.shape
    for m in range(n):
        for column in range(k):
            for i in range(D):
                dx[m, i, column] = states[m, i, column]
            for line in range(stages.shape[1]):
                total = stages[m, line, D + column]
                for i in range(D):
                    total += stages[m, line, i] * states[m, i, column]
                dx[m, D + line, column] = total
