"""One-step collocation as linear maps between unknowns, stage values and samples, compiled.

The unknowns of a step are the state at its left node (value, and velocity of a second-order dof)
and the highest derivative of each dof at each stage: ``x (L, n, w)`` with ``w = D + s d``. Stage
values, samples between nodes and sensitivities are linear in them, so the same maps serve solutions
and their derivatives.

Steps have the lengths ``h (n,)``, which are equal unless a mesh says otherwise; ``step`` is the
mean length, period over number of steps. ``a``, ``b`` and ``c`` are the weights of the method,
``aa`` and ``ba`` those of the second integral.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import carray

from bayesoleo._compiled import BLOCK as POINTS, inner, jit, pointer
from bayesoleo._types import Array, Flags, Integers
from bayesoleo.errors import InputError
from bayesoleo.solvers import _elimination as sparse, _unrolled_program as unrolled
from bayesoleo.solvers._mesh import Mesh, Tableau
from bayesoleo.solvers._period_arrangement import can_sweep
from bayesoleo.solvers._swept_columns import swept_columns


@jit
def sample(
    x: Array, lanes: Integers, index: Integers, position: Array, w0: Array, w1: Array, w2: Array,
    h: float, orders: Integers, z: Array,
) -> None:  # fmt: skip
    """``z (L, nz, C, N)`` at positions inside steps from the unknowns ``x (L, n, w, C)``."""
    d, s = orders.size, w0.shape[0]
    D = orders.sum()
    for lane in lanes:
        for column in range(x.shape[3]):
            now = x[lane, :, :, column]
            row = state = 0
            for j in range(d):
                value, rate = z[lane, row, column], z[lane, row + 1, column]
                last = state + orders[j] - 1
                for i in range(index.size):
                    value[i] = now[index[i], state]
                    rate[i] = 0.0
                if orders[j] == 2:
                    top = z[lane, row + 2, column]
                    for i in range(index.size):
                        value[i] += h * position[i] * now[index[i], last]
                        rate[i] = now[index[i], last]
                        top[i] = 0.0
                for stage in range(s):
                    own = D + stage * d + j
                    if orders[j] == 1:
                        for i in range(index.size):
                            highest = now[index[i], own]
                            value[i] += h * w1[stage, i] * highest
                            rate[i] += w0[stage, i] * highest
                    else:
                        for i in range(index.size):
                            highest = now[index[i], own]
                            value[i] += h * h * w2[stage, i] * highest
                            rate[i] += h * w1[stage, i] * highest
                            z[lane, row + 2, column, i] += w0[stage, i] * highest
                row += orders[j] + 1
                state += orders[j]


@inner
def sample_block(
    x: Array, lane: int, block: int, first: Integers, position: Array, w0: Array, w1: Array,
    w2: Array, h: float, orders: Integers, needed: Flags, near: Array, z: Array,
) -> None:  # fmt: skip
    """The same for one lane and one block of samples, with plans cut into blocks: ``first (blocks,
    POINTS)`` is the number of a step's first unknown in its lane, weights are ``(blocks, s,
    POINTS)``. Fills the rows of ``z (nz, POINTS)`` that are ``needed``; without a view of any
    array, which would cost more than what it is for.

    The unknowns of each sample's step are fetched first, into ``near (2 + s, POINTS)``: from places
    without a sign, and once for all rows. Indices that may be negative, and products that make
    them, would cost more than the interpolation.
    """
    d, s = orders.size, w0.shape[1]
    D = orders.sum()
    size = x.shape[1] * x.shape[2]
    own = carray(pointer(x, lane * size), (size,))
    row = state = 0
    for j in range(d):
        order = orders[j]
        top = row + order
        wanted = needed[row] or needed[row + 1] or needed[top]
        for k in range(order if wanted else 0):
            place = np.uint64(state + k)
            for i in range(POINTS):
                near[k, i] = own[first[block, i] + place]
        for stage in range(s if wanted else 0):
            place = np.uint64(D + stage * d + j)
            for i in range(POINTS):
                near[2 + stage, i] = own[first[block, i] + place]
        if order == 1 and needed[row]:
            for i in range(POINTS):
                z[row, i] = near[0, i]
            for stage in range(s):
                for i in range(POINTS):
                    z[row, i] += h * w1[block, stage, i] * near[2 + stage, i]
        if order == 2 and needed[row]:
            for i in range(POINTS):
                z[row, i] = near[0, i] + h * position[block, i] * near[1, i]
            for stage in range(s):
                for i in range(POINTS):
                    z[row, i] += h * h * w2[block, stage, i] * near[2 + stage, i]
        if order == 2 and needed[row + 1]:
            for i in range(POINTS):
                z[row + 1, i] = near[1, i]
            for stage in range(s):
                for i in range(POINTS):
                    z[row + 1, i] += h * w1[block, stage, i] * near[2 + stage, i]
        if needed[top]:
            for i in range(POINTS):
                z[top, i] = 0.0
            for stage in range(s):
                for i in range(POINTS):
                    z[top, i] += w0[block, stage, i] * near[2 + stage, i]
        row, state = top + 1, state + order


@jit
def rows(
    x: Array, lanes: Integers, h: Array, a: Array, aa: Array, c: Array, orders: Integers, z: Array
) -> None:
    """``z (L, nz, n s)`` at the stages, with steps of the lengths ``h (n,)``."""
    d, s, n = orders.size, c.size, x.shape[1]
    D = orders.sum()
    low, rate, once, twice = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    own = np.empty((s, n))
    for lane in lanes:
        row = state = 0
        for j in range(d):
            for m in range(n):
                low[m] = x[lane, m, state]
                rate[m] = x[lane, m, state + orders[j] - 1]
            for stage in range(s):
                for m in range(n):
                    own[stage, m] = x[lane, m, D + stage * d + j]
            for i in range(s):
                _integrals(own, h, a[i], aa[i], once, twice)
                top = z[lane, row + orders[j]]
                for m in range(n):
                    top[m * s + i] = own[i, m]
                below = z[lane, row + orders[j] - 1]
                for m in range(n):
                    below[m * s + i] = rate[m] + once[m]
                if orders[j] == 2:
                    for m in range(n):
                        z[lane, row, m * s + i] = low[m] + (h[m] * c[i] * rate[m] + twice[m])
            row += orders[j] + 1
            state += orders[j]


@inner
def _integrals(
    own: Array, h: Array, first: Array, second: Array, once: Array, twice: Array
) -> None:
    """First and second integrals over steps of stage values ``own (s, n)``."""
    s, n = own.shape
    once[:] = 0.0
    twice[:] = 0.0
    for stage in range(s):
        for m in range(n):
            once[m] += first[stage] * own[stage, m]
            twice[m] += second[stage] * own[stage, m]
    for m in range(n):
        once[m] *= h[m]
        twice[m] *= h[m] * h[m]


@dataclass(frozen=True)
class SamplePlan:
    """Steps of the mesh, positions in them and interpolation weights, each (s, N), of N phases.

    Positions and weights contain the length of their step over the mean length.
    """

    index: Integers
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
    mesh : Mesh, optional
        Steps of different lengths; then the number of steps ``n`` is the mesh's. Otherwise any
        number of equal steps.
    """

    method: Tableau
    orders: tuple[int, ...]
    mesh: Mesh | None = None

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

    @property
    def program(self) -> unrolled.Program | None:
        """Compiled pieces of a Newton step, where there is code for these orders."""
        return unrolled.collocation(self.method, self.orders)

    def phases(self, n: int) -> Array:
        """Phases in cycles of the ``N = n s`` points at which equations hold, shape (N,)."""
        if self.mesh is not None:
            return self._mesh_of(n).points(self.method.c)
        return ((np.arange(n)[:, None] + self.method.c) / n).ravel()

    def nodes(self, n: int) -> Array:
        """Phases in cycles at which the steps begin, shape (n,)."""
        return np.arange(n) / n if self.mesh is None else self._mesh_of(n).edges[:-1]

    def _mesh_of(self, n: int) -> Mesh:
        assert self.mesh is not None
        if self.mesh.steps != n:
            raise InputError(
                "wrong number of steps", value=n, hint=f"the mesh has {self.mesh.steps}"
            )
        return self.mesh

    def lengths(self, n: int, step: float) -> Array:
        """Length of each step, s, shape (n,)."""
        return np.full(n, step) if self.mesh is None else step * self._mesh_of(n).relative

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

    def rows(self, x: Array, lanes: Integers, step: float, z: Array) -> None:
        """Fill ``z (L, nz, N)`` with values and derivatives at the points."""
        method = self.method
        h = self.lengths(x.shape[1], step)
        rows(x, lanes, h, method.a, method.a @ method.a, method.c, self._orders, z)

    def plan(self, phase: Array, n: int, *, initial: bool = False) -> SamplePlan:
        """Places in the mesh of given phases; worth keeping for fixed samples.

        Parameters
        ----------
        phase : ndarray, shape (N,)
            Cycles, of which only the fraction counts; of a transient (``initial``) parts of its
            time, from 0 to 1.
        n : int
            Steps of the mesh.
        initial : bool
            Whether the phases are a transient's.

        Returns
        -------
        SamplePlan
        """
        inside = phase if initial else phase % 1.0
        if self.mesh is None:
            scaled = inside * n
            index = np.minimum(scaled.astype(np.int64), n - 1)
            return self.plan_in(index, scaled - index)
        return self.plan_in(*self._mesh_of(n).locate(inside))

    def plan_in(self, index: Integers, position: Array) -> SamplePlan:
        """Given steps ``(N,)`` and positions in them, from 0 to 1: on one side of an edge."""
        w0, w1, w2 = (np.ascontiguousarray(weights.T) for weights in self.method.weights(position))
        if self.mesh is not None:
            relative = self.mesh.relative[index]
            position, w1, w2 = relative * position, relative * w1, relative**2 * w2
        return SamplePlan(index, position, w0, w1, w2)

    def sample(self, x: Array, plan: SamplePlan, step: float) -> Array:
        """Values and derivatives at planned phases.

        Parameters
        ----------
        x : ndarray, shape (L, n, w, C)
            Unknowns, or their derivatives, in C columns.
        plan : SamplePlan
            Of N phases.
        step : float
            Mean length of a step, s.

        Returns
        -------
        ndarray, shape (L, nz, C, N)
        """
        nz = self.state_size + len(self.orders)
        z = np.empty((x.shape[0], nz, x.shape[3], plan.index.size))
        everyone = np.arange(x.shape[0])
        sample(
            x, everyone, plan.index, plan.position, plan.w0, plan.w1, plan.w2, step, self._orders, z
        )
        return z

    def linear(
        self,
        gz: Array,
        right: Array,
        x: Array | None,
        lanes: Integers,
        step: float,
        *,
        initial: bool = False,
        jumps: Array | None = None,
    ) -> tuple[Array, Array, Flags]:
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
            Mean length of a step, s.
        initial : bool
            Hold the first state instead of closing the period.
        jumps : ndarray, shape (L, D, k, n), optional
            Added to the state at the end of each step.

        Returns
        -------
        dx : ndarray, shape (L, n, w, k)
        monodromy : ndarray, shape (L, D, D)
        ok : ndarray of bool, shape (L,)
        """
        count, n = gz.shape[0], gz.shape[3] // self.method.stages
        dx = np.zeros((count, n, self.width, right.shape[2]))
        monodromy = np.full((count, self.state_size, self.state_size), np.nan)
        ok = np.ones(count, dtype=np.bool_)
        h = self.lengths(n, step)
        program, left = self.program, lanes
        if program is not None and can_sweep(program, n):
            swept_columns(program, gz, right, x, jumps, lanes, h, initial, (dx, monodromy, ok))
            left = lanes[~ok[lanes]]
        # Steps by themselves all at once; of lanes of many steps one, whose matrices take memory.
        for some in left[None] if n == 1 and left.size else left[:, None]:
            self._with_exchange(gz, right, x, some, h, initial, jumps, (dx, monodromy, ok))
        return dx, monodromy, ok

    def _with_exchange(
        self,
        gz: Array,
        right: Array,
        x: Array | None,
        lanes: Integers,
        h: Array,
        initial: bool,
        jumps: Array | None,
        results: tuple[Array, Array, Flags],
    ) -> None:
        """Solve lanes whose rows may have to be exchanged, into the results."""
        dx, monodromy, ok = results
        D, n, columns = self.state_size, dx.shape[1], right.shape[2]
        stages, end = sparse.step_maps(self.method, self.orders, h)
        own, regular = sparse.eliminate_steps(gz[lanes], right[lanes], stages)
        transfer = end[:, :, D:] @ own
        transfer[..., :D] += end[:, :, :D]
        if jumps is not None:
            transfer[..., D:] += np.moveaxis(jumps[lanes], 3, 1)
        if initial and n == 1:
            monodromy[lanes], ok[lanes] = transfer[:, 0, :, :D], regular
            dx[lanes, :, D:] = np.where(regular[:, None, None, None], own[..., D:], 0.0)
            return
        for i, lane in enumerate(lanes):
            if x is not None:
                transfer[i, ..., D] += self._jumps(x[lane], h).T
            states = np.zeros((D, columns, n))
            ok[lane] = regular[i] and sparse.close_and_sweep(
                np.ascontiguousarray(np.moveaxis(transfer[i], 0, 2)), monodromy[lane], states,
                initial,
            )  # fmt: skip
            if ok[lane]:
                at_nodes = np.moveaxis(states, 2, 0)
                dx[lane, :, :D] = at_nodes
                dx[lane, :, D:] = own[i, ..., D:] + own[i, ..., :D] @ at_nodes
        for lane in lanes if not initial else ():
            if sparse.needs_factorisation(bool(ok[lane]), monodromy[lane]):
                ends = np.zeros((self.state_size, right.shape[2], n))
                if x is not None:
                    ends[:, 0] += self._jumps(x[lane], h)
                if jumps is not None:
                    ends += jumps[lane]
                found = sparse.collocation_step(
                    gz[lane], right[lane], ends, self.method, self.orders, h
                )
                ok[lane] = found is not None
                dx[lane] = 0.0 if found is None else found

    def _jumps(self, x: Array, h: Array) -> Array:
        """From each step's end to the next node, shape (D, n), of unknowns ``x (n, w)``."""
        _, end = sparse.step_maps(self.method, self.orders, h)
        following = np.roll(x[:, : self.state_size], -1, axis=0)
        return np.asarray((np.einsum("mdw,mw->md", end, x) - following).T)

    @property
    def _orders(self) -> Integers:
        return np.array(self.orders, dtype=np.int64)
