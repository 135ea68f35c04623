"""Discretisation schemes by name: collocation, backward and central differences.

Backward differences of second order on an equidistant mesh are the thesis's discretisation (Verbeek
1993, eqs. 4.21-4.23). ``q'_m = (3 q_m - 4 q_{m-1} + q_{m-2}) / (2 h)`` and
``q''_m = (2 q_m - 5 q_{m-1} + 4 q_{m-2} - q_{m-3}) / h**2``, indices modulo n. The unknowns are the
dofs at the nodes, ``x (L, n, d)``; three past blocks are the state that the closure carries.

Central differences, and their combinations with backward ones, were tried by Verbeek (1993),
section 4.3.1, before choosing backward differences for both derivatives. They are here for
comparison, not for use. A motion that alternates from node to node has no central first difference.
An oscillator resists it with ``-4 m/h**2 + k`` if both differences are central, and with
``12 m/h**2 + 4 c/h + k`` if they are backward. Central differences therefore leave it undamped by
damping and friction, and decouple odd and even nodes of a first-order equation. With a backward
velocity the equations are singular where a friction's slope times the step equals the mass.
Equations that depend on nodes before and behind also need the slower sparse factorisation instead
of one sweep.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from bayesoleo._compiled import jit
from bayesoleo._types import Array, Flags, Integers
from bayesoleo.errors import InputError
from bayesoleo.solvers import _elimination as sparse, _unrolled_program as unrolled
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._elimination import (
    Stencil,
    close_and_sweep,
    eliminate_each,
    eliminate_together,
)
from bayesoleo.solvers._mesh import Mesh, tableau
from bayesoleo.solvers._unrolled_program import Program

FIRST = np.array([1.5, -2.0, 0.5, 0.0])
SECOND = np.array([2.0, -5.0, 4.0, -1.0])
#: Nodes whose equations are solved together, innermost in memory.
BLOCK = 32
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
#: Three-stage Radau IIA: order five, and stiff components (steep friction) decay instead of
#: ringing.
DEFAULT_SCHEME = "radau3"
#: Solvers of periodic motions: all unknowns of a period at once on equal steps, the same on a mesh
#: with error control, shooting, shooting with derivatives on a mesh of its steps, and shooting with
#: SciPy's LSODA.
COLLOCATION = "collocation"
SOLVERS = (COLLOCATION, "adaptive", "shooting", "hybrid", "library")


class Scheme(Protocol):
    """A discretisation of a period as linear maps (see ``_collocation.py``)."""

    @property
    def orders(self) -> tuple[int, ...]: ...
    @property
    def state_size(self) -> int: ...
    @property
    def width(self) -> int: ...
    @property
    def program(self) -> Program | None: ...
    def lengths(self, n: int, step: float) -> Array: ...
    def phases(self, n: int) -> Array: ...
    def from_motion(self, rows_at_nodes: Array, rows_at_points: Array) -> Array: ...
    def rows(self, x: Array, lanes: Integers, step: float, z: Array) -> None: ...
    def plan(self, phase: Array, n: int) -> Any: ...
    def sample(self, x: Array, plan: Any, step: float) -> Array: ...
    def linear(
        self,
        gz: Array,
        right: Array,
        x: Array | None,
        lanes: Integers,
        step: float,
        *,
        initial: bool = False,
    ) -> tuple[Array, Array, Flags]: ...


@dataclass(frozen=True)
class CubicPlan:
    """Four nodes and their weights for each of N phases, shapes (4, N)."""

    nodes: Integers
    weights: Array


@dataclass(frozen=True)
class _EqualSteps:
    """Differences on equal steps: the equations hold at the nodes, whose dofs are the unknowns."""

    orders: tuple[int, ...]

    @property
    def state_size(self) -> int:
        """Size by which rows are counted: value and velocity of each dof."""
        return sum(self.orders)

    @property
    def width(self) -> int:
        """Unknowns at a node."""
        return len(self.orders)

    def lengths(self, n: int, step: float) -> Array:
        """Length of each step, s, shape (n,)."""
        return np.full(n, step)

    def phases(self, n: int) -> Array:
        """Phases in cycles of the nodes, where the equations hold, shape (n,)."""
        return np.arange(n) / n

    def from_motion(self, rows_at_nodes: Array, rows_at_points: Array) -> Array:
        """Unknowns that represent a given motion (see ``Collocation.from_motion``)."""
        starts = np.cumsum([0, *(order + 1 for order in self.orders[:-1])])
        return np.ascontiguousarray(np.moveaxis(rows_at_nodes[:, starts], 1, 2))

    def _node_rows(self, x: Array, step: float) -> Array:
        """Values and differences at the nodes of columns ``x (L, n, d, C)``: (L, nz, C, n)."""
        raise NotImplementedError

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
        """Values and derivatives at planned phases by cubic interpolation, shape (L, nz, C, N)."""
        rows = self._node_rows(x, step)
        total = np.zeros((*rows.shape[:3], plan.weights.shape[1]))
        for nodes, weights in zip(plan.nodes, plan.weights, strict=True):
            total += weights * rows[..., nodes]
        return total


@dataclass(frozen=True)
class BackwardDifferences(_EqualSteps):
    """Backward differences for dofs of given orders (1 or 2 each)."""

    order = 2

    @property
    def program(self) -> unrolled.Program | None:
        """Compiled pieces of a Newton step, where there is code for these orders."""
        return unrolled.differences(self.orders, tuple(FIRST.tolist()), tuple(SECOND.tolist()))

    def rows(self, x: Array, lanes: Integers, step: float, z: Array) -> None:
        """Fill ``z (L, nz, N)`` with values and differences at the nodes."""
        _rows(x, lanes, step, np.array(self.orders, dtype=np.int64), FIRST, SECOND, z)

    def _node_rows(self, x: Array, step: float) -> Array:
        """Values and differences at the nodes, shape (L, nz, C, n)."""
        rows = []
        for j, order in enumerate(self.orders):
            past = [np.moveaxis(np.roll(x[:, :, j], k, axis=1), 1, 2) for k in range(4)]
            rows.append(past[0])
            rows.append(sum(weight * q for weight, q in zip(FIRST, past, strict=True)) / step)
            if order == 2:
                rows.append(
                    sum(weight * q for weight, q in zip(SECOND, past, strict=True)) / step**2
                )
        return np.stack(rows, axis=1)

    def linear(
        self,
        gz: Array,
        right: Array,
        x: Array | None,
        lanes: Integers,
        step: float,
        *,
        initial: bool = False,
    ) -> tuple[Array, Array, Flags]:
        """Solve ``G dx = -right`` as ``Collocation.linear``; the monodromy is the recursion's."""
        count, d, n = gz.shape[0], len(self.orders), gz.shape[3]
        dx = np.zeros((count, n, d, right.shape[2]))
        monodromy = np.full((count, 3 * d, 3 * d), np.nan)
        ok = np.ones(count, dtype=np.bool_)
        orders = np.array(self.orders, dtype=np.int64)
        _linear(gz, right, lanes, step, orders, FIRST, SECOND, initial, dx, monodromy, ok)
        for lane in lanes if not initial else ():
            if sparse.needs_factorisation(bool(ok[lane]), monodromy[lane]):
                found = sparse.difference_step(gz[lane], right[lane], self._stencils(step))
                ok[lane] = found is not None
                dx[lane] = 0.0 if found is None else found
        return dx, monodromy, ok

    def _stencils(self, step: float) -> list[sparse.Stencil]:
        """How values and differences follow from the nodes, in the order of the rows."""
        value: sparse.Stencil = {0: 1.0}
        first = {past: float(weight) / step for past, weight in enumerate(FIRST[:3])}
        second = {past: float(weight) / step**2 for past, weight in enumerate(SECOND)}
        return [item for order in self.orders for item in (value, first, second)[: order + 1]]


@jit
def _rows(
    x: Array, lanes: Integers, h: float, orders: Integers, first: Array, second: Array, z: Array
) -> None:
    """``z (L, nz, n)``: values and differences; indices below zero count from the period's end."""
    n = x.shape[1]
    for lane in lanes:
        row = 0
        for j in range(orders.size):
            for m in range(n):
                rate = bend = 0.0
                for past in range(4):
                    value = x[lane, m - past, j]
                    rate += first[past] * value
                    bend += second[past] * value
                z[lane, row, m] = x[lane, m, j]
                z[lane, row + 1, m] = rate / h
                if orders[j] == 2:
                    z[lane, row + 2, m] = bend / (h * h)
            row += orders[j] + 1


@jit
def _linear(
    gz: Array, right: Array, lanes: Integers, h: float, orders: Integers, first: Array,
    second: Array, initial: bool, dx: Array, monodromy: Array, ok: Flags,
) -> None:  # fmt: skip
    d, n, k = orders.size, gz.shape[3], right.shape[2]
    D = 3 * d
    work, scale = np.empty((d, d + D + k, BLOCK)), np.empty((2, d, BLOCK))
    transfer = np.zeros((D, D + k, n))
    for i in range(2 * d):
        transfer[d + i, i] = 1.0
    states = np.empty((D, k, n))
    for lane in lanes:
        good = True
        for begin in range(0, n, BLOCK):
            count = min(BLOCK, n - begin)
            _assemble(gz[lane], right[lane], begin, count, h, orders, first, second, work)
            if not eliminate_together(work, scale, count, d):
                _assemble(gz[lane], right[lane], begin, count, h, orders, first, second, work)
                good = good and eliminate_each(work, count, d)
            for j in range(d):
                for column in range(D + k):
                    for t in range(count):
                        transfer[j, column, begin + t] = work[j, d + column, t]
        if good:
            good = close_and_sweep(transfer, monodromy[lane], states, initial)
        ok[lane] = good
        if good:
            for m in range(n):
                after = m + 1 if m + 1 < n else 0
                for j in range(d):
                    for column in range(k):
                        # The state before step m + 1 leads with the unknowns of node m.
                        dx[lane, m, j, column] = states[j, column, after]


@jit
def _assemble(
    gz: Array, right: Array, begin: int, count: int, h: float, orders: Integers, first: Array,
    second: Array, work: Array,
) -> None:  # fmt: skip
    """Equations of ``count`` nodes: ``work (d, 4 d + k, block)``, [node, three before | right]."""
    d, k = orders.size, right.shape[1]
    for e in range(d):
        row = 0
        for j in range(d):
            for past in range(4):
                sign = 1.0 if past == 0 else -1.0
                value, rate = sign if past == 0 else 0.0, sign * first[past] / h
                bend = sign * second[past] / (h * h)
                for t in range(count):
                    m = begin + t
                    total = value * gz[e, row, m] + rate * gz[e, row + 1, m]
                    work[e, past * d + j, t] = total + (
                        bend * gz[e, row + 2, m] if orders[j] == 2 else 0.0
                    )
            row += orders[j] + 1
        for column in range(k):
            for t in range(count):
                work[e, 4 * d + column, t] = -right[e, column, begin + t]


@dataclass(frozen=True)
class Differences(_EqualSteps):
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

    name: str

    @property
    def order(self) -> int:
        """Order of the error at the nodes."""
        return 1 if self.name == "central-euler" else 2

    @property
    def program(self) -> None:
        """No compiled Newton step."""
        return

    def rows(self, x: Array, lanes: Integers, step: float, z: Array) -> None:
        """Fill ``z (L, nz, N)`` with values and differences at the nodes."""
        z[lanes] = self._node_rows(x[lanes, :, :, None], step)[:, :, 0]

    def _stencils(self, order: int, step: float) -> list[Stencil]:
        """Stencils of the value and the derivatives of a dof of that order."""
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

    def linear(
        self,
        gz: Array,
        right: Array,
        x: Array | None,
        lanes: Integers,
        step: float,
        *,
        initial: bool = False,
    ) -> tuple[Array, Array, Flags]:
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


def scheme(name: str, orders: tuple[int, ...], mesh: Mesh | None = None) -> Scheme:
    """A scheme for dofs of the given orders.

    Parameters
    ----------
    name : str
        ``radau2``, ``radau3``, ``gauss2``, ``gauss3``, or ``thesis`` for second-order backward
        differences; ``central`` and its combinations
        (:mod:`~bayesoleo.solvers._schemes`) to see why they were not chosen. Gauss points do
        not damp what is infinitely stiff: not for a dof ruled by an algebraic equation (a drive
        through a compliance of zero).
    orders : tuple of int
        Order of each dof.
    mesh : Mesh, optional
        Steps of different lengths, for collocation only.

    Raises
    ------
    InputError
        If there is no such scheme, or if it cannot have steps of different lengths.
    """
    if name != "thesis" and name not in COMBINATIONS:
        return Collocation(tableau(name), orders, mesh)
    if mesh is not None:
        raise InputError("differences need equal steps", value=name, hint="use radau3 or gauss3")
    return BackwardDifferences(orders) if name == "thesis" else Differences(orders, name)
