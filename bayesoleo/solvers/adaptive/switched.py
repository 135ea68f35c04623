"""A periodic problem that no mesh has been chosen for, and its solution on one.

Equations with kinks or jumps are given in analytic pieces: the *mode* of each switching function,
one where it is positive and zero where it is negative, is a row of the inputs. Modes either follow
the trial motion, or are held between edges of the mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.solvers.adaptive.crossings import Crossings, find_crossings
from bayesoleo.solvers.periodic.solve import Boundary, Equations
from bayesoleo.solvers.schemes.collocation import Collocation
from bayesoleo.solvers.schemes.mesh import Mesh
from bayesoleo.solvers.schemes.tableau import Tableau
from bayesoleo.solvers.status import Status

#: Values and derivatives of all dofs, shape (nz, N), at phases in cycles, shape (N,).
Motion = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Switches:
    """Where equations in analytic pieces change their formula.

    Parameters
    ----------
    values : callable
        ``(z (nz, N), u (nu, N), p (np,))`` to switching functions, shape (ns, N).
    slopes : callable
        The same to their derivatives by ``z``, shape (ns, nz, N).
    rows : tuple of int
        Rows of the inputs that hold the modes.
    """

    values: Callable[[Array, Array, Array], Array]
    slopes: Callable[[Array, Array, Array], Array]
    rows: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class PeriodicProblem:
    """A periodic boundary-value problem that no mesh has been chosen for.

    Parameters
    ----------
    equations : Equations
        Residuals and partial derivatives.
    orders : tuple of int
        Order (1 or 2) of each dof.
    period : float
        Seconds.
    inputs_at : callable
        Inputs and their derivatives, shape (nu, N), at phases in cycles, shape (N,).
    conditions : int
        Number of conditions on the admissible region.
    active : int
        Number of parameters with derivatives.
    switches : Switches, optional
        Without them kinks are found by ever shorter steps.
    """

    equations: Equations
    orders: tuple[int, ...]
    period: float
    inputs_at: Callable[[Array], Array]
    conditions: int = 0
    active: int = 0
    switches: Switches | None = None

    def on(self, method: Tableau, mesh: Mesh, kinks: Crossings | None = None) -> Boundary:
        """The problem on a mesh; without kinks, modes follow the trial motion."""
        scheme = Collocation(method, self.orders, mesh)
        inputs, equations = self.inputs_at(scheme.phases(mesh.steps)), self.equations
        if self.switches is not None:
            if kinks is None:
                equations = _Switching(self.equations, self.switches)
            else:
                middle = 0.5 * (mesh.edges[:-1] + mesh.edges[1:])
                modes = np.repeat(kinks.modes(middle), method.stages, axis=1)
                inputs[list(self.switches.rows)] = modes
        return Boundary(equations, scheme, self.period, inputs, self.conditions, self.active)

    def held(self, phase: Array, u: Array) -> Array:
        """Inputs at phases, with the modes of other inputs, shape (nu, N)."""
        inputs = self.inputs_at(phase)
        if self.switches is not None:
            inputs[list(self.switches.rows)] = u[list(self.switches.rows)]
        return inputs


@dataclass(frozen=True, eq=False)
class _Switching:
    """Equations whose modes are those of the motion at which they are evaluated."""

    equations: Equations
    switches: Switches

    def jacobian(self, z: Array, u: Array, p: Array, lanes: NDArray[np.int64], *out: Any) -> None:
        for lane in lanes:
            own = switched(self.switches, z[lane], u, p[lane])
            self.equations.jacobian(z, own, p, np.array([lane]), *out)

    def residual(self, z: Array, u: Array, p: Array, lanes: NDArray[np.int64], *out: Any) -> None:
        for lane in lanes:
            own = switched(self.switches, z[lane], u, p[lane])
            self.equations.residual(z, own, p, np.array([lane]), *out)

    def parameters(self, z: Array, u: Array, p: Array, lanes: NDArray[np.int64], *out: Any) -> None:
        for lane in lanes:
            own = switched(self.switches, z[lane], u, p[lane])
            self.equations.parameters(z, own, p, np.array([lane]), *out)

    @property
    def admissible(self) -> Callable[..., Any]:
        return cast(Callable[..., Any], self.equations.admissible)


def switched(switches: Switches, z: Array, u: Array, p: Array) -> Array:
    """Inputs with the modes of a motion, shape (nu, N)."""
    own = u.copy()
    # What stands inside another switch comes before it, so that this many rounds settle all.
    for _ in switches.rows:
        before = own[list(switches.rows)]
        own[list(switches.rows)] = 0.5 + 0.5 * np.sign(switches.values(z, own, p))
        if np.array_equal(before, own[list(switches.rows)]):
            break
    return own


@dataclass(frozen=True, eq=False)
class Level:
    """A problem solved on one mesh.

    Parameters
    ----------
    boundary : Boundary
        Discretised; its scheme has the mesh.
    x : ndarray, shape (n, w)
        Unknowns.
    status : Status
    kinks : Crossings or None
        Edges at which modes change; None where modes followed the motion.
    evaluations : int
        Points at which the equations were evaluated.
    """

    boundary: Boundary
    x: Array
    status: Status
    kinks: Crossings | None
    evaluations: int

    @property
    def scheme(self) -> Collocation:
        """The collocation scheme."""
        assert isinstance(self.boundary.scheme, Collocation)
        return self.boundary.scheme

    @property
    def mesh(self) -> Mesh:
        """The mesh."""
        assert self.scheme.mesh is not None
        return self.scheme.mesh

    @property
    def placed(self) -> Crossings:
        """Kinks on which edges stand."""
        assert self.kinks is not None
        return self.kinks

    def motion(self, phase: Array) -> Array:
        """Values and derivatives of all dofs, shape (nz, N), at phases in cycles, shape (N,)."""
        n = self.x.shape[0]
        plan = self.scheme.plan(phase, n)
        return self.scheme.sample(self.x[None, :, :, None], plan, self.boundary.step(n))[0, :, 0]

    def inside(self, step: NDArray[np.int64], position: Array) -> Array:
        """The same at positions, from 0 to 1, in given steps."""
        plan, mean = self.scheme.plan_in(step, position), self.boundary.step(self.x.shape[0])
        return self.scheme.sample(self.x[None, :, :, None], plan, mean)[0, :, 0]

    def rows(self) -> Array:
        """Values and derivatives of all dofs at the scheme's points, shape (nz, N)."""
        n, size = self.mesh.steps, self.scheme.state_size + len(self.scheme.orders)
        z = np.empty((1, size, n * self.scheme.method.stages))
        self.scheme.rows(self.x[None], np.array([0]), self.boundary.step(n), z)
        return cast(Array, z[0])

    def gaps(self) -> Array:
        """From each step's end to the state at the next node, shape (D, n)."""
        n, kept = self.mesh.steps, state_rows(self.scheme.orders)
        ends = self.inside(np.arange(n), np.ones(n))[kept]
        return ends - np.roll(self.x[:, : len(kept)], -1, axis=0).T


def kinks_of(problem: PeriodicProblem, level: Level, p: Array) -> Crossings | None:
    """Where along a motion the equations switch."""
    found = crossings_of(problem, level.motion, level.mesh, p)
    # Edges that were moved there are where they should be; found again, they scatter by round-off.
    same = found is not None and level.kinks is not None and level.kinks.alike(found)
    return level.kinks if same else found


def crossings_of(
    problem: PeriodicProblem, motion: Motion, mesh: Mesh, p: Array
) -> Crossings | None:
    """The same of any motion, looked for in the steps of a mesh; None where nothing switches."""
    switches = problem.switches
    if switches is None:
        return None

    def values(phase: Array) -> Array:
        z, u = motion(phase), problem.inputs_at(phase)
        return switches.values(z, switched(switches, z, u, p), p)

    return find_crossings(values, mesh)


def state_rows(orders: tuple[int, ...]) -> list[int]:
    """Rows, of values and derivatives of all dofs, that belong to the state."""
    rows: list[int] = []
    first = 0
    for order in orders:
        rows += range(first, first + order)
        first += order + 1
    return rows
