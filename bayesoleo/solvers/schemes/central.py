"""Central differences, and their combinations with backward ones, which Verbeek (1993), section
4.3.1, tried before choosing backward differences for both derivatives.

A motion that alternates from node to node has no central first difference. Against it an
oscillator puts up ``-4 m/h**2 + k`` with both differences central, where backward ones put up
``12 m/h**2 + 4 c/h + k``. So damping and friction do not hold it, odd and even nodes of a
first-order equation are not tied together at all, and with a velocity that looks back the equations
are singular where a friction's slope times the step comes to the mass. What depends on nodes before
and behind cannot be solved in one sweep either, only by the slower sparse factorisation. For
comparison, not for use.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.solvers.schemes import sparse
from bayesoleo.solvers.schemes.backward import BackwardDifferences, CubicPlan
from bayesoleo.solvers.schemes.sparse import Stencil

# Weights of the first derivative times the step, of the second times its square.
CENTRAL_FIRST: Stencil = {-1: 0.5, 1: -0.5}
CENTRAL_SECOND: Stencil = {-1: 1.0, 0: -2.0, 1: 1.0}
EULER_FIRST: Stencil = {0: 1.0, 1: -1.0}
BACKWARD_FIRST: Stencil = {0: 1.5, 1: -2.0, 2: 0.5}
BACKWARD_SECOND: Stencil = {0: 2.0, 1: -5.0, 2: 4.0, 3: -1.0}

#: Velocity and acceleration by the name of the scheme.
COMBINATIONS: dict[str, tuple[Stencil, Stencil]] = {
    "central": (CENTRAL_FIRST, CENTRAL_SECOND),
    "central-velocity": (CENTRAL_FIRST, BACKWARD_SECOND),
    "central-acceleration": (BACKWARD_FIRST, CENTRAL_SECOND),
    "central-euler": (EULER_FIRST, CENTRAL_SECOND),
}


@dataclass(frozen=True)
class Differences:
    """Differences by any stencils on equal steps.

    Parameters
    ----------
    orders : tuple of int
        Order (1 or 2) of each dof.
    name : str
        ``central`` for both derivatives; ``central-velocity`` or ``central-acceleration`` with the
        other one by second-order backward differences; ``central-euler`` with the velocity by
        first-order ones.
    """

    orders: tuple[int, ...]
    name: str

    @property
    def order(self) -> int:
        """Order of the error at the nodes."""
        return 1 if self.name == "central-euler" else 2

    @property
    def state_size(self) -> int:
        """Value and velocity of each dof."""
        return sum(self.orders)

    @property
    def width(self) -> int:
        """Unknowns at a node."""
        return len(self.orders)

    @property
    def program(self) -> None:
        """No compiled Newton step."""
        return

    def lengths(self, n: int, step: float) -> Array:
        """Length of each step, s, shape (n,)."""
        return np.full(n, step)

    def phases(self, n: int) -> Array:
        """Phases in cycles of the nodes, where the equations hold, shape (n,)."""
        return np.arange(n) / n

    def from_motion(self, rows_at_nodes: Array, rows_at_points: Array) -> Array:
        """Unknowns that represent a given motion (see ``Collocation.from_motion``)."""
        return BackwardDifferences(self.orders).from_motion(rows_at_nodes, rows_at_points)

    def rows(self, x: Array, lanes: NDArray[np.int64], step: float, z: Array) -> None:
        """Fill ``z (L, nz, N)`` with values and differences at the nodes."""
        z[lanes] = self._node_rows(x[lanes, :, :, None], step)[:, :, 0]

    def _stencils(self, order: int, step: float) -> list[Stencil]:
        """Of the value and the derivatives of a dof of that order."""
        first, second = COMBINATIONS[self.name]
        scaled = [{k: weight / step for k, weight in first.items()}]
        scaled += [{k: weight / step**2 for k, weight in second.items()}]
        return [{0: 1.0}, *scaled[:order]]

    def _node_rows(self, x: Array, step: float) -> Array:
        """Values and differences at the nodes of columns ``x (L, n, d, C)``: (L, nz, C, n)."""
        rows = []
        for j, order in enumerate(self.orders):
            for stencil in self._stencils(order, step):
                past = (w * np.roll(x[:, :, j], k, axis=1) for k, w in stencil.items())
                rows.append(np.moveaxis(sum(past, np.zeros(())), 1, 2))
        return np.stack(rows, axis=1)

    def plan(self, phase: Array, n: int) -> CubicPlan:
        """Nodes around given phases (cycles) and the weights of the cubic through them."""
        return BackwardDifferences(self.orders).plan(phase, n)

    def sample(self, x: Array, plan: CubicPlan, step: float) -> Array:
        """Values and derivatives at planned phases by cubic interpolation, shape (L, nz, C, N)."""
        rows = self._node_rows(x, step)
        parts = zip(plan.nodes, plan.weights, strict=True)
        return sum((weights * rows[..., nodes] for nodes, weights in parts), np.zeros(()))

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
        """Solve ``G dx = -right`` as ``Collocation.linear``; there is no map from one period to the
        next, and the monodromy is not a number."""
        if initial:
            raise NotImplementedError("central differences need the period's end")
        count, d, n = gz.shape[0], len(self.orders), gz.shape[3]
        dx = np.zeros((count, n, d, right.shape[2]))
        ok = np.ones(count, dtype=np.bool_)
        stencils = [item for order in self.orders for item in self._stencils(order, step)]
        for lane in lanes:
            found = sparse.difference_step(gz[lane], right[lane], stencils)
            ok[lane] = found is not None
            if found is not None:
                dx[lane] = found
        return dx, np.full((count, self.state_size, self.state_size), np.nan), ok
