"""Periodic problems whose equations switch, and the phases at which they do.

Such a problem has no mesh until one is chosen for it. Equations with kinks or jumps are given in
analytic pieces: the *mode* of each switching function, one where it is positive and zero where it
is negative, is a row of the inputs. Modes either follow the trial motion, or are held between edges
of the mesh. Kinks of a motion are the zeros of its switching functions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.optimize.elementwise import find_root

from bayesoleo._compiled import ImplicitEquations
from bayesoleo._types import Array, Integers
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._mesh import Mesh, Tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary

#: Positions in a step at which signs are compared.
POSITIONS = np.arange(6) / 6.0
#: A function that stays this close to zero, over its largest size, is zero but for round-off.
LEAST = 1e-13
#: Crossings this close, in cycles, are one.
APART = 1e-14
#: Values and derivatives of all dofs, shape (nz, N), at phases in cycles, shape (N,).
PhaseFunction = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Crossings:
    """Zeros of switching functions in a period.

    Parameters
    ----------
    phases : ndarray, shape (K,)
        Cycles, ascending, from 0 to below 1.
    labels : tuple of tuple of (int, bool)
        Of each: which functions, and whether they rise.
    first : tuple of bool
        Whether each function is positive at the beginning of the period.
    """

    phases: Array
    labels: tuple[tuple[tuple[int, bool], ...], ...]
    first: tuple[bool, ...]

    def modes(self, phase: Array) -> Array:
        """One where a function is positive, else zero, at phases ``(N,)``: shape (ns, N)."""
        table = np.repeat(np.array(self.first, dtype=float)[:, None], phase.size, axis=1)
        for crossing, label in zip(self.phases, self.labels, strict=True):
            for which, rises in label:
                table[which, phase > crossing] = float(rises)
        return table

    def alike(self, other: Crossings) -> bool:
        """Whether the same functions cross zero in the same order."""
        return self.labels == other.labels and self.first == other.first


def find_crossings(values: Callable[[Array], Array], mesh: Mesh) -> Crossings:
    """Zeros of switching functions along a motion.

    Parameters
    ----------
    values : callable
        Phases (N,) to functions, shape (ns, N).
    mesh : Mesh
        On which the motion is smooth but for kinks.

    Returns
    -------
    Crossings
    """
    phases = np.append(mesh.points(POSITIONS), 1.0)
    table = values(phases)
    found: list[tuple[float, tuple[int, bool]]] = []
    first = []
    for k, row in enumerate(table):
        signs = _signs(row)
        first.append(bool(signs[0] > 0))
        for i in np.flatnonzero(signs[:-1] != signs[1:]):
            root = _root(values, k, phases[i], phases[i + 1])
            found.append((root, (k, bool(signs[i + 1] > 0))))
    found.sort(key=lambda item: item[0])
    groups: list[tuple[float, list[tuple[int, bool]]]] = []
    for phase, label in found:
        if groups and phase - groups[-1][0] <= APART:
            groups[-1][1].append(label)
        else:
            groups.append((phase, [label]))
    labels = tuple(tuple(group) for _, group in groups)
    return Crossings(np.array([phase for phase, _ in groups]), labels, tuple(first))


def _signs(row: Array) -> Array:
    """Signs around the period; zeros, and what is zero but for round-off, have their neighbour's.

    The end of the period is its beginning.
    """
    signs = np.sign(np.where(np.abs(row) <= LEAST * np.abs(row).max(), 0.0, row))
    some = np.flatnonzero(signs)
    if some.size == 0:
        return np.ones(row.size)
    signs[0] = signs[some[0]] if signs[0] == 0 else signs[0]
    signs[-1] = signs[0]
    index = np.where(signs != 0, np.arange(signs.size), 0)
    return signs[np.maximum.accumulate(index)]


def _root(values: Callable[[Array], Array], k: int, low: float, high: float) -> float:
    ends = np.array([low, high])
    at = values(ends)[k]
    if at[0] * at[1] >= 0.0:
        # The sign of an end that is zero but for round-off is its neighbour's: the zero is there.
        return float(ends[np.argmin(np.abs(at))]) % 1.0
    result = find_root(lambda phase: values(phase)[k], (ends[:1], ends[1:]))
    return float(result.x[0]) % 1.0


@dataclass(frozen=True, eq=False)
class Switches:
    """Switching functions of equations in analytic pieces.

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
    equations : ImplicitEquations
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

    equations: ImplicitEquations
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

    equations: ImplicitEquations
    switches: Switches

    def jacobian(self, z: Array, u: Array, p: Array, lanes: Integers, *out: Any) -> None:
        for lane in lanes:
            own = switched(self.switches, z[lane], u, p[lane])
            self.equations.jacobian(z, own, p, np.array([lane]), *out)

    def residual(self, z: Array, u: Array, p: Array, lanes: Integers, *out: Any) -> None:
        for lane in lanes:
            own = switched(self.switches, z[lane], u, p[lane])
            self.equations.residual(z, own, p, np.array([lane]), *out)

    def parameters(self, z: Array, u: Array, p: Array, lanes: Integers, *out: Any) -> None:
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

    def inside(self, step: Integers, position: Array) -> Array:
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
    """Phases of a motion at which the equations switch."""
    found = crossings_of(problem, level.motion, level.mesh, p)
    # Edges that were moved there are where they should be; found again, they scatter by round-off.
    same = found is not None and level.kinks is not None and level.kinks.alike(found)
    return level.kinks if same else found


def crossings_of(
    problem: PeriodicProblem, motion: PhaseFunction, mesh: Mesh, p: Array
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
