"""Mesh edges that move to the phases at which the equations switch.

With the modes of all steps held, the equations are smooth for any trial motion. The unknowns are
solved for together with the phases of the edges at which modes change, so that their switching
functions are zero there. That converges from much further away than an iteration in which every
trial motion changes the equations, and every step keeps the order of the method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers._mesh import Mesh, Tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary, solve_from_guess, solve_periodic
from bayesoleo.solvers._switched import Crossings, Level, PeriodicProblem, PhaseFunction, state_rows

#: Part of a stretch between kinks that remains at least.
LEAST = 0.1
MAXIMUM_ITERATIONS, MAXIMUM_HALVINGS = 40, 12
#: Newton's error after a step is about its square: a relative step of 1e-6 that still contracts
#: leaves 1e-12. Where round-off stops it before, a step this small is taken as converged.
LAST_STEP, SMALL_STEP = 1e-6, 1e-8
#: By how much a stretch between two kinks may shrink or grow in a step.
SHRINK, GROW = 0.6, 1.5
#: For differences: part of the step beside it by which an edge is moved.
PART = 1e-4


@dataclass(frozen=True, eq=False)
class Warp:
    """A rising map of the period onto itself, linear between given phases and their images.

    Parameters
    ----------
    source, image : ndarray, shape (K + 2,)
        From 0 to 1.
    """

    source: Array
    image: Array

    def forward(self, phase: Array) -> Array:
        """Images of phases from 0 to 1."""
        return np.interp(phase, self.source, self.image)

    def back(self, phase: Array) -> Array:
        """Phases of which these, from 0 to 1, are images."""
        return np.interp(phase, self.image, self.source)

    def mesh(self, mesh: Mesh) -> Mesh:
        """A mesh whose steps move along."""
        return Mesh(self.forward(mesh.edges))


SAME = Warp(np.array([0.0, 1.0]), np.array([0.0, 1.0]))


def warp_between(before: Crossings | None, after: Crossings | None) -> Warp:
    """The map from one set of kinks to another; the identity unless they are the same kinks."""
    if before is None or after is None or not before.alike(after):
        return SAME
    return Warp(*(np.concatenate([[0.0], c.phases, [1.0]]) for c in (before, after)))


def extrapolate(before: Crossings | None, now: Crossings | None, amount: float) -> Warp:
    """The map from the present kinks to the next ones.

    Parameters
    ----------
    before, now : Crossings
        Of two solutions on the way.
    amount : float
        Length of the next step over that of the last.

    Returns
    -------
    Warp
        The shortest stretch between two kinks goes on in geometric proportion, as the duration of a
        contact does with its stiffness; the others change in proportion to it, so that they settle
        where it vanishes.
    """
    last = warp_between(before, now)
    if last is SAME:
        return SAME
    old, new = np.diff(last.source), np.diff(last.image)
    k = int(np.argmin(new))
    change = new[k] * ((new[k] / old[k]) ** amount - 1.0)
    if new[k] != old[k]:
        amount = change / (new[k] - old[k])
    lengths = np.maximum(new + amount * (new - old), LEAST * new)
    lengths[k] = new[k] + change
    image = np.concatenate([[0.0], np.cumsum(lengths / lengths.sum())])
    image[-1] = 1.0
    return Warp(last.image, image)


def solve_on(
    problem: PeriodicProblem,
    method: Tableau,
    p: Array,
    mesh: Mesh,
    start: PhaseFunction,
    kinks: Crossings | None = None,
    *,
    far: bool = False,
) -> Level:
    """Solve on a mesh; edges that stand on kinks are moved along, with the steps between them.

    Parameters
    ----------
    problem : PeriodicProblem
        Equations and inputs.
    method : Tableau
        Collocation method.
    p : ndarray, shape (np,)
        Constants.
    mesh : Mesh
        With an edge at every kink.
    start : callable
        A motion to start from.
    kinks : Crossings, optional
        Where modes change. Without them, or where no such motion is found, every trial motion has
        its own modes.
    far : bool
        Whether the start is but a guess, from which continuation in the inputs may be needed.

    Returns
    -------
    Level
    """
    spent = 0
    if kinks is not None and problem.switches is not None:
        boundary = problem.on(method, mesh, kinks)
        begin = unknowns(boundary, mesh, start)
        level = Level(boundary, begin, Status.NO_CONVERGENCE, kinks, 0)
        level = solve_with_edges(problem, p, level)
        if level.status is Status.CONVERGED:
            return level
        spent = level.evaluations
    boundary = problem.on(method, mesh)
    solve = solve_from_guess if far else solve_periodic
    found = solve(boundary, p[None], unknowns(boundary, mesh, start)[None])
    spent += int(found.iterations[0] + 1) * boundary.inputs.shape[1]
    return Level(boundary, found.x[0], Status(int(found.status[0])), None, spent)


def unknowns(boundary: Boundary, mesh: Mesh, start: PhaseFunction) -> Array:
    """The scheme's unknowns, shape (n, w), that represent a motion."""
    nodes, points = start(mesh.edges[:-1]), start(boundary.scheme.phases(mesh.steps))
    return cast(Array, boundary.scheme.from_motion(nodes[None], points[None])[0])


def solve_with_edges(problem: PeriodicProblem, p: Array, level: Level) -> Level:
    """Newton's method for the unknowns and the phases of the edges together.

    Parameters
    ----------
    problem : PeriodicProblem
        With switches.
    p : ndarray, shape (np,)
        Constants.
    level : Level
        Where to start: unknowns on a mesh with an edge at every kink.

    Returns
    -------
    Level
    """
    last = np.inf
    for _ in range(MAXIMUM_ITERATIONS):
        step = _newton_step(problem, level, p)
        level = replace(level, evaluations=level.evaluations + step.evaluations)
        if not (np.isfinite(step.dx).all() and np.isfinite(step.shift).all()):
            return replace(level, status=Status.SINGULAR)
        fraction = _allowed(level.placed, step.shift)
        trial = _take(problem, level, step, fraction)
        for _ in range(MAXIMUM_HALVINGS):
            status = _judge(trial, p)
            if status is Status.CONVERGED:
                break
            fraction /= 2
            trial = _take(problem, level, step, fraction)
        if status is not Status.CONVERGED:
            return replace(level, status=status)
        size, level = step.size(level), trial
        if fraction == 1.0 and (size < SMALL_STEP or (size < LAST_STEP and size < 0.1 * last)):
            return replace(level, status=Status.CONVERGED)
        last = size if fraction == 1.0 else np.inf
    return replace(level, status=Status.NO_CONVERGENCE)


@dataclass(frozen=True, eq=False)
class _Step:
    """Changes of the unknowns, (n, w), and of the edges' phases, (K,)."""

    dx: Array
    shift: Array
    evaluations: int

    def size(self, level: Level) -> float:
        """Largest change of a state over its largest value, of an edge over the steps beside it."""
        states = level.scheme.state_size
        largest = np.maximum(np.abs(level.x[:, :states]).max(axis=0), 1e-300)
        change = float((np.abs(self.dx[:, :states]).max(axis=0) / largest).max())
        beside = _beside(level.mesh, level.placed)
        return max(change, float((np.abs(self.shift) / beside).max(initial=0.0)))


def _newton_step(problem: PeriodicProblem, level: Level, p: Array) -> _Step:
    """Solve the linearised equations of all steps and all edges."""
    dx, shift = linearised_change(problem, level, p)
    points = level.boundary.inputs.shape[1]
    return _Step(dx[..., 0], shift[:, 0], 2 * points if level.placed.phases.size else points)


def linearised_change(
    problem: PeriodicProblem,
    level: Level,
    p: Array,
    missed: Array | None = None,
    *,
    initial: bool = False,
) -> tuple[Array, Array]:
    """A step of Newton's method, and the response to what is added to the state after each step.

    Parameters
    ----------
    problem : PeriodicProblem
        Equations and inputs.
    level : Level
        A motion on a mesh; its kinks, if any, stand on edges.
    p : ndarray, shape (np,)
        Constants.
    missed : ndarray, shape (D, n), optional
        Added to the states at the ends of steps.
    initial : bool
        Hold the first state instead of closing the period.

    Returns
    -------
    dx : ndarray, shape (n, w, C)
        Changes of the unknowns: Newton's step, and the response; NaN where the system is singular.
    shift : ndarray, shape (K, C)
        Changes of the phases of the kinks, in cycles.
    """
    boundary, scheme, lane = level.boundary, level.scheme, np.array([0])
    count, n = 0 if level.kinks is None else level.kinks.phases.size, level.mesh.steps
    z = level.rows()
    g, gz = _equations(level, p, z, boundary.inputs)
    more = 0 if missed is None else 1
    right = np.zeros((1, g.shape[0], 1 + count + more, g.shape[1]))
    jumps = np.zeros((1, scheme.state_size, 1 + count + more, n))
    right[0, :, 0] = g
    if count:
        edges = slice(1, 1 + count)
        right[0, :, edges], jumps[0, :, edges] = _by_edges(problem, level, p, z, g, gz)
    if missed is not None:
        jumps[0, :, -1] = missed
    found, _, ok = scheme.linear(
        gz[None], right, level.x[None], lane, boundary.step(n), initial=initial, jumps=jumps
    )
    changes = found[0][:, :, [0, *range(1 + count, 1 + count + more)]]
    if not ok[0]:
        return np.full(changes.shape, np.nan), np.zeros((count, 1 + more))
    if not count:
        return changes, np.zeros((0, 1 + more))
    return _with_edges(problem, level, p, found[0], changes)


def _with_edges(
    problem: PeriodicProblem, level: Level, p: Array, found: Array, changes: Array
) -> tuple[Array, Array]:
    """Move the edges so that their switching functions stay zero, ``(n, w, C)`` and ``(K, C)``."""
    values, own, by_state = _at_edges(problem, level, p)
    phases, states = level.placed.phases, level.scheme.state_size
    at = np.searchsorted(level.mesh.edges, phases) % level.mesh.steps
    change = np.einsum("kj,kjc->kc", by_state, found[at, :states])
    columns = [0, *range(1 + phases.size, found.shape[2])]
    right = change[:, columns]
    right[:, 0] += values
    shift = -_solve(np.diag(own) + change[:, 1 : 1 + phases.size], right)
    return changes + found[:, :, 1 : 1 + phases.size] @ shift, shift


def _solve(matrix: Array, right: Array) -> Array:
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return np.full(right.shape, np.nan)


def _equations(level: Level, p: Array, z: Array, u: Array) -> tuple[Array, Array]:
    """Residuals ``(d, N)`` and partial derivatives ``(d, nz, N)`` at the points."""
    d = len(level.scheme.orders)
    g, gz = np.empty((1, d, z.shape[1])), np.empty((1, d, *z.shape))
    with np.errstate(all="ignore"):
        level.boundary.equations.jacobian(z[None], u, p[None], np.array([0]), g, gz)
    return g[0], gz[0]


def _by_edges(
    problem: PeriodicProblem, level: Level, p: Array, z: Array, g: Array, gz: Array
) -> tuple[Array, Array]:
    """Derivatives of residuals, (d, K, N), and of the gaps between steps, (D, K, n), by the phases
    of the edges on kinks: the steps between them change their lengths, and the points their phases.
    """
    scheme, mesh, kinks = level.scheme, level.mesh, level.placed
    count, phases, gaps = kinks.phases.size, scheme.phases(mesh.steps), level.gaps()
    part = PART * _beside(mesh, kinks)
    later = problem.held(phases + part.min(), level.boundary.inputs)
    by_phase = (_equations(level, p, z, later)[0] - g) / part.min()
    residuals = np.empty((g.shape[0], count, g.shape[1]))
    jumps = np.empty((scheme.state_size, count, mesh.steps))
    for k in range(count):
        other = _on(level, *moved(mesh, kinks, part[k] * (np.arange(count) == k)))
        by_rows = np.einsum("dzn,zn->dn", gz, (other.rows() - z) / part[k])
        residuals[:, k] = by_rows + by_phase * (other.scheme.phases(mesh.steps) - phases) / part[k]
        jumps[:, k] = (other.gaps() - gaps) / part[k]
    return residuals, jumps


def _on(level: Level, mesh: Mesh, kinks: Crossings) -> Level:
    """The same unknowns on another mesh; its inputs are left as they were."""
    scheme = replace(level.scheme, mesh=mesh)
    return replace(level, boundary=replace(level.boundary, scheme=scheme), kinks=kinks)


def moved(mesh: Mesh, kinks: Crossings, shift: Array) -> tuple[Mesh, Crossings]:
    """Edges on kinks moved, and those between them along."""
    other = replace(kinks, phases=kinks.phases + shift)
    return warp_between(kinks, other).mesh(mesh), other


def _beside(mesh: Mesh, kinks: Crossings) -> Array:
    """Length of the shorter step beside each kink, in cycles, shape (K,)."""
    at, lengths = np.searchsorted(mesh.edges, kinks.phases), np.diff(mesh.edges)
    return np.minimum(lengths[at - 1], lengths[at % mesh.steps])


def _allowed(kinks: Crossings, shift: Array) -> float:
    """Part of a shift that keeps the kinks in their order."""
    lengths = np.diff(np.concatenate([[0.0], kinks.phases, [1.0]]))
    change = np.diff(np.concatenate([[0.0], shift, [0.0]]))
    limit = np.where(change < 0.0, SHRINK, GROW) * lengths
    return float(min(1.0, np.min(limit / np.maximum(np.abs(change), 1e-300))))


def _take(problem: PeriodicProblem, level: Level, step: _Step, fraction: float) -> Level:
    """Part of a step."""
    mesh, kinks = moved(level.mesh, level.placed, fraction * step.shift)
    boundary = problem.on(level.scheme.method, mesh, kinks)
    return replace(level, boundary=boundary, kinks=kinks, x=level.x + fraction * step.dx)


def _judge(level: Level, p: Array) -> Status:
    """Whether a trial motion may be gone on with."""
    boundary, z = level.boundary, level.rows()
    if not np.isfinite(z).all():
        return Status.NOT_FINITE
    if boundary.conditions == 0:
        return Status.CONVERGED
    a = np.empty((1, boundary.conditions, z.shape[1]))
    with np.errstate(all="ignore"):
        boundary.equations.admissible(z[None], boundary.inputs, p[None], np.array([0]), a)
    return Status.CONVERGED if np.all(a > 0.0) else Status.INADMISSIBLE


def _at_edges(problem: PeriodicProblem, level: Level, p: Array) -> tuple[Array, Array, Array]:
    """Each edge's switching function, and its derivatives by the edge's phase at the same state,
    both (K,), and by the state, (K, D)."""
    switches, mesh, kinks = problem.switches, level.mesh, level.placed
    assert switches is not None
    steps = np.searchsorted(mesh.edges, kinks.phases) - 1
    z = level.inside(steps, np.ones(steps.size))
    u = problem.inputs_at(kinks.phases)
    u[list(switches.rows)] = kinks.modes(0.5 * (mesh.edges[steps] + mesh.edges[steps + 1]))
    part = PART * _beside(mesh, kinks)
    which, each = [label[0][0] for label in kinks.labels], np.arange(steps.size)
    values = switches.values(z, u, p)[which, each]
    later = switches.values(z, problem.held(kinks.phases + part, u), p)[which, each]
    slopes = switches.slopes(z, u, p)[which, :, each]
    return values, (later - values) / part, slopes[:, state_rows(level.scheme.orders)]
