"""One-step collocation, as linear maps between unknowns, stage values and samples.

The unknowns of a step are the state at its left node (value, and velocity of a second-order dof)
and the highest derivative of each dof at each stage: ``x (L, n, w)`` with ``w = D + s d``.
Everything else - stage values, samples between nodes, sensitivities - is linear in them, so the
same maps serve solutions and their derivatives. Steps are of one length unless a mesh says
otherwise; ``step`` is the mean length throughout, period over number of steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.solvers.schemes import collocation_kernels as kernels
from bayesoleo.solvers.schemes import sparse
from bayesoleo.solvers.schemes.mesh import Mesh
from bayesoleo.solvers.schemes.tableau import Tableau
from bayesoleo.solvers.schemes.unrolled import program as unrolled


@dataclass(frozen=True)
class SamplePlan:
    """Steps of the mesh, positions in them and interpolation weights, each (s, N), of N phases.

    Positions and weights contain the length of their step over the mean length.
    """

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

    def rows(self, x: Array, lanes: NDArray[np.int64], step: float, z: Array) -> None:
        """Fill ``z (L, nz, N)`` with values and derivatives at the points."""
        method = self.method
        h = self.lengths(x.shape[1], step)
        kernels.rows(x, lanes, h, method.a, method.a @ method.a, method.c, self._orders, z)

    def plan(self, phase: Array, n: int, *, initial: bool = False) -> SamplePlan:
        """Where in the mesh given phases lie; worth keeping for fixed samples.

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

    def plan_in(self, index: NDArray[np.int64], position: Array) -> SamplePlan:
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
        kernels.sample(
            x, everyone, plan.index, plan.position, plan.w0, plan.w1, plan.w2, step, self._orders, z
        )
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
        jumps: Array | None = None,
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
        present = np.zeros((1, 1, 1)) if x is None else x
        added = np.zeros((1, 1, 1, 0)) if jumps is None else jumps
        method = self.method
        h = self.lengths(n, step)
        kernels.linear(
            gz, right, present, x is not None, added, lanes, h, method.a, method.a @ method.a,
            method.b, method.b @ method.a, method.c, self._orders, initial, dx, monodromy, ok,
        )  # fmt: skip
        for lane in lanes if not initial else ():
            if sparse.needs_factorisation(bool(ok[lane]), monodromy[lane]):
                ends = np.zeros((self.state_size, right.shape[2], n))
                if x is not None:
                    ends[:, 0] += self._jumps(x[lane], h)
                if jumps is not None:
                    ends += jumps[lane]
                found = sparse.collocation_step(gz[lane], right[lane], ends, method, self.orders, h)
                ok[lane] = found is not None
                dx[lane] = 0.0 if found is None else found
        return dx, monodromy, ok

    def _jumps(self, x: Array, h: Array) -> Array:
        """From each step's end to the next node, shape (D, n), of unknowns ``x (n, w)``."""
        _, end = sparse.step_maps(self.method, self.orders, h)
        following = np.roll(x[:, : self.state_size], -1, axis=0)
        return np.asarray((np.einsum("mdw,mw->md", end, x) - following).T)

    @property
    def _orders(self) -> NDArray[np.int64]:
        return np.array(self.orders, dtype=np.int64)
