"""Discretisation error of a motion, whichever solver found it.

The motion is put on a mesh of steps half as long, with an edge at every kink, and one Newton step
is taken there; its change estimates the error of the solver's own steps. A method sees the
equations at its stages only, and an integrator's damped estimate misses features narrower than a
step. The equations are therefore also evaluated densely between the stages. The part of the
residual that no polynomial through the stages follows acts as a jump at the end of each step, and
the linearised problem gives its effect on the motion. Where that matters, steps are cut and the
estimate is repeated.

References
----------
Ascher, U., Mattheij, R. and Russell, R. (1995). Numerical Solution of Boundary Value Problems for
Ordinary Differential Equations, SIAM, section 9.3 (defects and halved meshes).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from bayesoleo._compiled import ImplicitEquations
from bayesoleo._types import Array, Integers
from bayesoleo.solvers._mesh import Mesh, Tableau
from bayesoleo.solvers._moving_edges import linearised_change, moved
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary
from bayesoleo.solvers._switched import (
    Crossings,
    Level,
    PeriodicProblem,
    PhaseFunction,
    crossings_of,
    state_rows,
    switched,
)

#: Points of a period at which equations are looked at, at least, and of a step: a pulse as short as
#: three hundred-thousandths of the period is seen wherever it stands.
#: The last are those of a step at most: longer ones are cut before.
LOOKS, LEAST_LOOKS, MOST_LOOKS = 65_536, 8, 64
#: Steps are cut while what is missed between stages is more than this part of the error, or of the
#: tolerance.
PART = 0.1
MAXIMUM_ROUNDS, MOST_STEPS = 10, 60_000
#: A step is cut if it holds more than this part of the largest missed share of a step.
SHARE = 0.02
#: A kink this close to an edge, over the step and in cycles, takes its place.
BESIDE, CLOSEST = 0.05, 1e-9
#: One-sided values at a step's end are taken this part of its length before the end.
ONE_SIDE = 1e-6
#: Places in a step at which motions are compared.
COMPARED = 8
#: Steps shorter than this part of the period are joined to the next.
SHORTEST = 1e-12
#: A motion about a level that is smaller than this part of it is measured by the level.
LEAST_SWING = 1e-6


@dataclass(frozen=True, eq=False)
class ErrorEstimate:
    """An estimate of a motion's error.

    Parameters
    ----------
    error : float
        Largest error of a state, anywhere in the period, over that state's swing, or of the time
        of a kink in cycles; NaN where no estimate could be made.
    better : Level or None
        The motion after one step of Newton's method, on a mesh that resolves the equations along
        it: where to start for a smaller error.
    """

    error: float
    better: Level | None

    def judged(self, tolerance: float) -> Status:
        """Whether the error is known, and meets a tolerance."""
        if not np.isfinite(self.error):
            return Status.NO_ERROR_ESTIMATE
        return Status.CONVERGED if self.error <= tolerance else Status.TOLERANCE_NOT_MET


NONE = ErrorEstimate(float("nan"), None)


def estimate_error(
    problem: PeriodicProblem,
    method: Tableau,
    p: Array,
    motion: PhaseFunction,
    mesh: Mesh,
    tolerance: float,
    *,
    initial: bool = False,
    looks: int = LOOKS,
) -> ErrorEstimate:
    """Estimate the error of a motion that is said to solve a periodic or an initial value problem.

    Parameters
    ----------
    problem : PeriodicProblem
        Equations and inputs.
    method : Tableau
        Collocation method.
    p : ndarray, shape (np,)
        Constants.
    motion : callable
        Values and derivatives of all dofs, shape (nz, N), at phases in cycles, shape (N,).
    mesh : Mesh
        Steps by which it was found.
    tolerance : float
        Largest error wanted: below a tenth of it nothing more is resolved.
    initial : bool
        Whether the motion starts from a state that is given instead of returning to where it
        began; phases are then parts of its time.
    looks : int
        Points at which the equations are looked at, at least: nothing that lies between them is
        seen.

    Returns
    -------
    ErrorEstimate
    """
    finest, found = _no_longer(_apart(mesh).halved(), MOST_LOOKS / looks), NONE
    for _ in range(MAXIMUM_ROUNDS):
        kinks = crossings_of(problem, motion, finest, p)
        if kinks is not None:
            finest = _with_edges(finest, kinks)
        boundary = problem.on(method, finest, kinks)
        x = _unknowns(boundary, method, finest, motion)
        level = Level(boundary, x, Status.CONVERGED, kinks, 0)
        look = _look(problem, level, p, looks)
        if look is None:
            return NONE
        found, missed = _estimate(problem, level, p, motion, look, initial)
        if not np.isfinite(found.error) or missed <= PART * max(tolerance, found.error - missed):
            return found
        if finest.steps >= MOST_STEPS:
            return found
        finest = _cut(finest, look.shares)
    return found


def _unknowns(boundary: Boundary, method: Tableau, mesh: Mesh, motion: PhaseFunction) -> Array:
    """Unknowns of the scheme, shape (n, w), for a motion: at a kink, from the side of the step."""
    inside = mesh.points(np.minimum(method.c, 1.0 - ONE_SIDE))
    return cast(
        Array, boundary.scheme.from_motion(motion(mesh.edges[:-1])[None], motion(inside)[None])[0]
    )


def _apart(mesh: Mesh) -> Mesh:
    """A mesh without steps whose length is round-off: an integrator takes them at a jump."""
    inner = mesh.edges[1:-1]
    kept = (np.diff(mesh.edges)[:-1] > SHORTEST) & (1.0 - inner > SHORTEST)
    return Mesh(np.concatenate([[0.0], inner[kept], [1.0]]))


def _no_longer(mesh: Mesh, longest: float) -> Mesh:
    """Cut steps into equal parts no longer than that, in cycles."""
    parts = np.ceil(np.diff(mesh.edges) / longest).astype(int)
    ends = np.concatenate([[0], np.cumsum(parts)])
    return Mesh(np.interp(np.arange(ends[-1] + 1), ends, mesh.edges))


def _with_edges(mesh: Mesh, kinks: Crossings) -> Mesh:
    """A mesh with an edge at every kink, in place of edges that almost stand there."""
    inner = mesh.edges[1:-1]
    if kinks.phases.size and inner.size:
        near = np.abs(inner[:, None] - kinks.phases).min(axis=1)
        lengths = np.diff(mesh.edges)
        inner = inner[near > np.maximum(BESIDE * np.minimum(lengths[1:], lengths[:-1]), CLOSEST)]
    return Mesh(np.unique(np.concatenate([[0.0], inner, kinks.phases, [1.0]])))


@dataclass(frozen=True, eq=False)
class _Look:
    """Residual of the equations between the stages.

    Parameters
    ----------
    jumps : ndarray, shape (D, n)
        What a step misses of the state at its end.
    between : ndarray, shape (D,)
        Largest error of a state inside a step that is forgotten before its end.
    scale : ndarray, shape (D,)
        Swing of each state.
    shares : ndarray, shape (n,)
        Larger of both by step, over the scale.
    """

    jumps: Array
    between: Array
    scale: Array
    shares: Array


def _look(problem: PeriodicProblem, level: Level, p: Array, looks: int) -> _Look | None:
    """Look at the equations between the stages of all steps, at places as dense everywhere; None
    where they are no numbers."""
    orders, n = level.scheme.orders, level.mesh.steps
    D, at_stages = sum(orders), _held(level, p)[0].reshape(len(orders), n, -1)
    jumps, between, ends = np.empty((D, n)), np.empty((D, n)), np.empty((2, D, n))
    places = np.exp2(np.ceil(np.log2(looks * np.diff(level.mesh.edges)))).astype(int)
    places = np.clip(places, LEAST_LOOKS, MOST_LOOKS)
    for count in np.unique(places):
        steps = np.flatnonzero(places == count)
        seen = _look_into(problem, level, p, steps, int(count), at_stages[:, steps])
        if seen is None:
            return None
        jumps[:, steps], between[:, steps], ends[:, :, steps] = seen
    low, high = ends[0].min(axis=1), ends[1].max(axis=1)
    size = np.maximum(np.abs(low), np.abs(high))
    scale = np.maximum.reduce([high - low, LEAST_SWING * size, np.full(D, 1e-300)])
    shares = (np.maximum(np.abs(jumps), between) / scale[:, None]).max(axis=0)
    return _Look(-jumps, between.max(axis=1), scale, shares)


def _look_into(
    problem: PeriodicProblem,
    level: Level,
    p: Array,
    steps: Integers,
    count: int,
    at_stages: Array,
) -> tuple[Array, Array, Array] | None:
    """What some steps miss at their ends, and inside them, ``(D, n)``, and between which values
    their states lie, ``(2, D, n)``; None where the equations are no numbers."""
    scheme, number = level.scheme, steps.size
    nodes, weights = np.polynomial.legendre.leggauss(count)
    position, weight = (nodes + 1) / 2, weights / 2
    z = level.inside(np.repeat(steps, count), np.tile(position, number))
    left, lengths = level.mesh.edges[steps], np.diff(level.mesh.edges)[steps]
    phases = (left[:, None] + lengths[:, None] * position).ravel()
    g, gz = _evaluate(problem, z, problem.inputs_at(phases), p)
    missed = g - (at_stages @ scheme.method.weights(position)[0].T).reshape(g.shape)
    if not (np.isfinite(missed).all() and np.isfinite(gz).all()):
        return None
    h = lengths * problem.period
    own = np.outer(h, weight)
    whole = _response(scheme.orders, gz, missed, np.repeat(h, count))
    short = _response(scheme.orders, gz, missed, own.ravel())
    jumps, between = _summed(scheme.orders, whole, short, own, np.outer(h, 1.0 - position))
    states = z[state_rows(scheme.orders)].reshape(-1, number, count)
    return jumps, between, np.stack([states.min(axis=2), states.max(axis=2)])


def _summed(
    orders: tuple[int, ...], whole: Array, short: Array, own: Array, ahead: Array
) -> tuple[Array, Array]:
    """Sum what is missed over each step, and take the largest of what does not last, ``(D, n)``.

    ``own (n, N)`` are the times that belong to the places, ``ahead (n, N)`` those to the end.
    """
    jumps, between, state = np.empty((sum(orders), len(own))), np.empty((sum(orders), len(own))), 0
    for j, order in enumerate(orders):
        top, brief = whole[j].reshape(own.shape), short[j].reshape(own.shape)
        last = state + order - 1
        jumps[last] = np.sum(own * top, axis=1)
        between[last] = np.abs(own * brief).max(axis=1)
        if order == 2:
            jumps[state] = np.sum(own * ahead * top, axis=1)
            between[state] = np.abs(own**2 * brief).max(axis=1)
        state += order
    return jumps, between


def _response(orders: tuple[int, ...], gz: Array, residual: Array, h: Array) -> Array:
    """Highest derivatives ``(d, N)`` by which an implicit Euler step of length ``h (N,)`` removes a
    residual ``(d, N)``."""
    d = len(orders)
    matrix, row = np.empty((h.size, d, d)), 0
    for j, order in enumerate(orders):
        column = gz[:, row] * h if order == 1 else gz[:, row] * h**2 + gz[:, row + 1] * h
        matrix[:, :, j] = (column + gz[:, row + order]).T
        row += order + 1
    try:
        return np.asarray(np.linalg.solve(matrix, residual.T[:, :, None])[:, :, 0].T)
    except np.linalg.LinAlgError:
        return np.full(residual.shape, np.inf)


def _evaluate(problem: PeriodicProblem, z: Array, u: Array, p: Array) -> tuple[Array, Array]:
    """Residuals ``(d, N)`` and their derivatives ``(d, nz, N)``, with the modes of the motion."""
    own = u if problem.switches is None else switched(problem.switches, z, u, p)
    return _with_inputs(problem.equations, len(problem.orders), z, own, p)


def _held(level: Level, p: Array) -> tuple[Array, Array]:
    """The same at the scheme's points, with the modes that are held there."""
    boundary = level.boundary
    return _with_inputs(
        boundary.equations, len(level.scheme.orders), level.rows(), boundary.inputs, p
    )


def _with_inputs(
    equations: ImplicitEquations, d: int, z: Array, u: Array, p: Array
) -> tuple[Array, Array]:
    g, gz = np.empty((1, d, z.shape[1])), np.empty((1, d, *z.shape))
    with np.errstate(all="ignore"):
        equations.jacobian(z[None], u, p[None], np.array([0]), g, gz)
    return g[0], gz[0]


def _estimate(
    problem: PeriodicProblem,
    level: Level,
    p: Array,
    motion: PhaseFunction,
    look: _Look,
    initial: bool,
) -> tuple[ErrorEstimate, float]:
    """The error by one step of Newton's method, and how much of it is missed between stages."""
    dx, shift = linearised_change(problem, level, p, look.jumps, initial=initial)
    if not (np.isfinite(dx).all() and np.isfinite(shift).all()):
        return NONE, 0.0
    kept = state_rows(level.scheme.orders)
    missed = float(((np.abs(dx[:, : len(kept), 1]).max(axis=0) + look.between) / look.scale).max())
    missed = max(missed, float(np.abs(shift[:, 1]).max(initial=0.0)))
    better = _moved_level(problem, level, dx[..., 0], shift[:, 0])
    n, position = level.mesh.steps, np.arange(COMPARED) / COMPARED
    step = np.repeat(np.arange(n), position.size)
    # At the same place between kinks: a contact that comes later is an error of its time.
    now = better.inside(step, np.tile(position, n))[kept]
    changed = np.abs(now - motion(level.mesh.points(position))[kept]) / look.scale[:, None]
    own = max(float(changed.max()), float(np.abs(shift[:, 0]).max(initial=0.0)))
    return ErrorEstimate(own + missed, better), missed


def _moved_level(problem: PeriodicProblem, level: Level, dx: Array, shift: Array) -> Level:
    """The motion after a step of Newton's method, its kinks moved along."""
    if shift.size == 0:
        return replace(level, x=level.x + dx)
    try:
        mesh, kinks = moved(level.mesh, level.placed, shift)
    except ValueError:  # kinks change their order: the step is too long to be taken
        return replace(level, x=level.x + dx)
    return replace(
        level, boundary=problem.on(level.scheme.method, mesh, kinks), kinks=kinks, x=level.x + dx
    )


def _cut(mesh: Mesh, shares: Array) -> Mesh:
    """Halve the steps in which much is missed."""
    cut = shares > SHARE * shares.max()
    middle = 0.5 * (mesh.edges[:-1] + mesh.edges[1:])[cut]
    return Mesh(np.sort(np.concatenate([mesh.edges, middle])))
