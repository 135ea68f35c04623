"""Adaptive mesh: steps are placed where the solution needs them.

A solution on a mesh and that on the mesh of half its steps differ by the error of the coarse one,
at the nodes and between them. The part that arises inside a step determines the length of that
step: the next mesh has as many steps as a tolerance needs, each with the same share of the error.
Edges are placed where the equations have kinks, so that every step sees smooth equations and the
order of the method is kept across a contact. A solution at a stiff parameter is reached by
continuation from a soft one.

References
----------
Ascher, U., Christiansen, J. and Russell, R. D. (1979). A collocation solver for mixed order systems
of boundary value problems. Mathematics of Computation 33, 659-679 (errors from halved meshes).

Verbeek (1993), section 4.3.1, recommends error-controlled meshes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers._error_estimate import ErrorEstimate, estimate_error
from bayesoleo.solvers._mesh import Mesh, Tableau, equidistant, tableau
from bayesoleo.solvers._moving_edges import SAME, Warp, extrapolate, solve_on, warp_between
from bayesoleo.solvers._orbit import Orbit, Status
from bayesoleo.solvers._periodic import Solution, sensitivities
from bayesoleo.solvers._switched import (
    Crossings,
    Level,
    PeriodicProblem,
    PhaseFunction,
    kinks_of,
    state_rows,
)

#: Part of the tolerance that is aimed at.
SAFETY = 0.3
#: Shortest and longest new step over the old one.
SHORTEST, LONGEST = 1.0 / 4.0, 4.0
#: How fast lengths of steps may change along the period.
GROWTH = 1.0
#: Steps between two kinks.
LEAST_STEPS = 2
#: Equal steps tried in turn where no mesh is given.
FIRST_STEPS = (64, 256, 1024)
MAXIMUM_PASSES = 25
#: How much softer each trial is until one succeeds, and how many there are.
SOFTER, TRIALS = 0.01, 8
#: Factor of the first step, and the largest and smallest one.
FIRST_STEP, LARGEST_STEP, SMALLEST_STEP = 1.2, 100.0, 1.001
#: Error on the way.
ROUGH = 1e-3


@dataclass(frozen=True, eq=False)
class MeshError:
    """Errors over the states' sizes.

    Parameters
    ----------
    own : ndarray, shape (n,)
        What arises inside each step.
    largest : float
        Largest error anywhere.
    """

    own: Array
    largest: float


def remesh(
    mesh: Mesh,
    misfit: MeshError,
    tolerance: float,
    before: Crossings | None,
    after: Crossings | None,
    order: int,
    max_steps: int,
) -> tuple[Mesh, bool]:
    """Place the steps anew.

    Parameters
    ----------
    mesh : Mesh
        The present one, with ``n`` steps.
    misfit : MeshError
        Its errors.
    tolerance : float
        Largest error wanted.
    before, after : Crossings, optional
        Kinks on which edges stand, and on which they shall stand.
    order : int
        Power of its length with which the error of a step falls.
    max_steps : int
        No more than these.

    Returns
    -------
    mesh : Mesh
    enough : bool
        Whether the steps were not limited by their number.
    """
    wanted = _wanted_lengths(mesh, misfit, tolerance, order)
    # Steps move along with the kinks between which they stand.
    edges = warp_between(before, after).forward(mesh.edges)
    number = np.concatenate([[0.0], np.cumsum(np.diff(mesh.edges) / wanted)])
    most = number[-1]
    if most > max_steps:
        number *= max_steps / most
    ends = np.unique(np.concatenate([[0.0], [] if after is None else after.phases, [1.0]]))
    pieces = []
    for low, high in pairwise(ends):
        first, last = np.interp([low, high], edges, number)
        count = max(LEAST_STEPS, int(np.ceil(last - first)))
        inside = np.interp(np.linspace(first, last, count + 1)[1:-1], number, edges)
        pieces.append(np.concatenate([[low], inside]))
    return Mesh(np.unique(np.append(np.concatenate(pieces), 1.0))), most <= max_steps


def _wanted_lengths(mesh: Mesh, misfit: MeshError, tolerance: float, order: int) -> Array:
    """Length of a step around each present one, in cycles, shape (n,)."""
    lengths = np.diff(mesh.edges)
    # What the closure makes of a step's error is measured: it multiplies all of them alike.
    target = SAFETY * tolerance * min(1.0, misfit.own.max() / max(misfit.largest, 1e-300))
    # No pass makes the largest error smaller than this. To ask more of other steps is in vain: what
    # they show may be but the response to that largest one.
    target = max(target, misfit.own.max() * SHORTEST**order)
    factor = (target / np.maximum(misfit.own, 1e-300)) ** (1.0 / order)
    wanted = lengths * np.clip(factor, SHORTEST, LONGEST)
    return _graded(0.5 * (mesh.edges[:-1] + mesh.edges[1:]), wanted)


def _graded(phase: Array, wanted: Array) -> Array:
    """Lengths that grow no faster than allowed on both sides of each phase, around the period."""
    rise = GROWTH * np.concatenate([phase - 1.0, phase, phase + 1.0])
    around = np.tile(wanted, 3)
    ahead = np.minimum.accumulate(around - rise) + rise
    behind = np.minimum.accumulate((around + rise)[::-1])[::-1] - rise
    return np.minimum(ahead, behind)[wanted.size : 2 * wanted.size]


@dataclass(frozen=True, eq=False)
class AdaptiveStart:
    """The start of a search: a motion, and a mesh that suits it.

    Parameters
    ----------
    motion : callable
        Values and derivatives of all dofs, shape (nz, N), at phases in cycles, shape (N,).
    mesh : Mesh, optional
        To begin with; equal steps where there is none.
    kinks : Crossings, optional
        Phases of those of its edges at which the equations switch.
    """

    motion: PhaseFunction
    mesh: Mesh | None = None
    kinks: Crossings | None = None


@dataclass(frozen=True, eq=False)
class AdaptiveSolution:
    """A periodic solution on its mesh.

    Parameters
    ----------
    orbit : Orbit
        States at the nodes, status, estimated error, multipliers.
    problem : PeriodicProblem
        As solved.
    level : Level
        The problem on the last mesh, and the scheme's unknowns.
    p : ndarray, shape (np,)
        Constants.
    next_mesh : Mesh
        For a motion like this one: edges on the kinks, and as many steps as the tolerance needs.
    """

    orbit: Orbit
    problem: PeriodicProblem
    level: Level
    p: Array
    next_mesh: Mesh

    @property
    def mesh(self) -> Mesh:
        """The mesh."""
        return self.level.mesh

    def motion(self, phase: Array) -> Array:
        """Values and derivatives of all dofs, shape (nz, N), at phases in cycles, shape (N,)."""
        return self.level.motion(phase)

    def start(self, warp: Warp = SAME) -> AdaptiveStart:
        """Start of another solution, phases moved by a warp."""
        kinks = self.level.kinks
        if kinks is not None:
            kinks = replace(kinks, phases=warp.forward(kinks.phases))
        return AdaptiveStart(
            lambda phase: self.motion(warp.back(phase)), warp.mesh(self.next_mesh), kinks
        )

    @cached_property
    def sensitivities(self) -> Array:
        """Derivatives of the unknowns by the active parameters, shape (n, w, na).

        They are exact derivatives of the discrete solution on this mesh (Verbeek 1993, eq. 4.28).
        """
        zero = np.zeros(1, dtype=np.int64)
        found = Solution(self.level.x[None], zero, zero)
        return cast(Array, sensitivities(self.level.boundary, self.p[None], found)[1][0])

    def motion_by_parameter(self, phase: Array) -> Array:
        """Derivatives of :meth:`motion` by the active parameters, shape (nz, na, N)."""
        n = self.level.x.shape[0]
        plan, step = self.level.scheme.plan(phase, n), self.level.boundary.step(n)
        found: Array = self.level.scheme.sample(self.sensitivities[None], plan, step)[0]
        return found


def solve_adaptive(
    problem: PeriodicProblem,
    p: Array,
    start: PhaseFunction | AdaptiveStart,
    *,
    method: str = "radau3",
    tolerance: float = 1e-6,
    max_steps: int = 20_000,
) -> AdaptiveSolution:
    """Solve for a periodic solution to a tolerance, with as few steps as it needs.

    Parameters
    ----------
    problem : PeriodicProblem
        Equations and inputs.
    p : ndarray, shape (np,)
        Constants.
    start : callable or AdaptiveStart
        A guess: values and derivatives of all dofs, shape (nz, N), at phases in cycles; or what
        another solution's :meth:`AdaptiveSolution.start` gives.
    method : str
        A collocation method: ``radau2``, ``radau3``, ``gauss2`` or ``gauss3``.
    tolerance : float
        Estimated largest error of a state, anywhere in the period, over that state's swing.
    max_steps : int
        Of the last mesh; where they do not suffice the status is ``TOLERANCE_NOT_MET``.

    Returns
    -------
    AdaptiveSolution
        Whatever came of it; see ``orbit.status``.
    """
    begin = start if isinstance(start, AdaptiveStart) else AdaptiveStart(start)
    end = _Work(problem, p, tableau(method), tolerance, max_steps).run(begin)
    return _finish(end, problem, p)


@dataclass(frozen=True, eq=False)
class _End:
    """The end of a search: its best level and what else is known of it."""

    level: Level
    status: Status
    error: float
    next_mesh: Mesh
    evaluations: int


@dataclass(frozen=True)
class _Work:
    """One search for a mesh."""

    problem: PeriodicProblem
    p: Array
    method: Tableau
    tolerance: float
    max_steps: int

    def run(self, start: AdaptiveStart) -> _End:
        """Solve, halve, compare, place the steps anew, until the tolerance is met."""
        level, spent = self._first(start)
        for _ in range(MAXIMUM_PASSES):
            if level.status is not Status.CONVERGED:
                return _End(level, level.status, np.nan, level.mesh, spent)
            fine = self._solve(level.mesh.halved(), level.motion, level.kinks)
            spent += fine.evaluations
            if fine.status is not Status.CONVERGED:
                return _End(fine, fine.status, np.nan, fine.mesh, spent)
            misfit, kinks = compare(level, fine), kinks_of(self.problem, fine, self.p)
            mesh, enough = remesh(
                level.mesh, misfit, self.tolerance, level.kinks, kinks,
                self.method.stages + 1, self.max_steps // 2,
            )  # fmt: skip
            end = _End(replace(fine, kinks=kinks), Status.CONVERGED, misfit.largest, mesh, spent)
            if misfit.largest <= self.tolerance and (fine.kinks is None or fine.kinks is kinks):
                found = self._checked(fine)
                # The comparison of both meshes is of the coarser one: it errs on the safe side.
                error = max(found.error, misfit.largest)
                end = replace(end, status=found.judged(self.tolerance), error=error)
                if end.status is not Status.TOLERANCE_NOT_MET or found.better is None:
                    return end
                # Both meshes stepped over something; the one of the estimate does not.
                mesh, kinks = found.better.mesh, found.better.kinks
                enough = mesh.steps <= self.max_steps // 2
            if not enough and level.mesh.steps >= self.max_steps // 2:
                break
            level = self._solve(mesh, fine.motion, kinks)
            spent += level.evaluations
        return replace(end, status=Status.TOLERANCE_NOT_MET)

    def _checked(self, level: Level) -> ErrorEstimate:
        """The error, looked for between the points that a solution is made of as well."""
        return estimate_error(
            self.problem, self.method, self.p, level.motion, level.mesh, self.tolerance
        )

    def _first(self, start: AdaptiveStart) -> tuple[Level, int]:
        if start.mesh is not None:
            level = self._solve(start.mesh, start.motion, start.kinks)
            return level, level.evaluations
        spent = 0
        for n in FIRST_STEPS:
            level = self._solve(equidistant(n), start.motion, None, far=True)
            spent += level.evaluations
            if level.status is Status.CONVERGED:
                break
        return level, spent

    def _solve(
        self, mesh: Mesh, start: PhaseFunction, kinks: Crossings | None, *, far: bool = False
    ) -> Level:
        return solve_on(self.problem, self.method, self.p, mesh, start, kinks, far=far)


def _finish(end: _End, problem: PeriodicProblem, p: Array) -> AdaptiveSolution:
    level, status, scheme = end.level, end.status, end.level.scheme
    monodromy = np.full((scheme.state_size, scheme.state_size), np.nan)
    if status.solved:
        held = problem.on(scheme.method, level.mesh, level.kinks)
        level = replace(level, boundary=held)
        found = Solution(level.x[None], np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64))
        found, _, (monodromy,) = sensitivities(held, p[None], found)
        if found.status[0] != Status.CONVERGED.value:
            status = Status(int(found.status[0]))
    orbit = Orbit(
        phases=level.mesh.edges[:-1],
        states=level.x[:, : scheme.state_size],
        period=problem.period,
        monodromy=monodromy,
        status=status,
        error=end.error,
        evaluations=end.evaluations,
    )
    return AdaptiveSolution(orbit, problem, level, p, end.next_mesh)


def compare(coarse: Level, fine: Level) -> MeshError:
    """The gain of a solution by halving its steps.

    States are compared at the same part of the same step, over their largest sizes, and the edges
    on kinks by their phases, in cycles: a contact that comes a little later is an error of its
    time, not one of the velocity, which may change sign in a millionth of the period.
    """
    scheme, n = fine.scheme, fine.mesh.steps
    c, kept = scheme.method.c, state_rows(scheme.orders)
    position = np.concatenate([[0.0], c / 2, [0.5], 0.5 + c / 2])
    step = np.repeat(np.arange(n), 1 + c.size)
    now = fine.inside(step, np.tile(np.concatenate([[0.0], c]), n))[kept]
    half = np.repeat(np.arange(n // 2), position.size)
    change = now - coarse.inside(half, np.tile(position, n // 2))[kept]
    size = np.maximum(np.abs(now).max(axis=1), 1e-300)
    change = change.reshape(len(kept), n // 2, position.size) / size[:, None, None]
    own = np.abs(change - change[:, :, :1]).max(axis=(0, 2))
    late = 0.0
    if coarse.kinks is not None and fine.kinks is not None and fine.kinks.phases.size:
        late = float(np.abs(fine.kinks.phases - coarse.kinks.phases).max())
    return MeshError(own, max(float(np.abs(change).max()), late))


def solve_stiffening(
    problem: PeriodicProblem,
    p: Array,
    start: PhaseFunction | AdaptiveStart,
    index: int,
    *,
    method: str = "radau3",
    tolerance: float = 1e-6,
    max_steps: int = 20_000,
) -> AdaptiveSolution:
    """Solve directly or, where that fails, by continuation in a stiffness.

    Parameters
    ----------
    problem, p, start
        As for :func:`~bayesoleo.solvers.solve_adaptive`, the stiffness at its full
        value.
    index : int
        Of the stiffness among the constants.
    method, tolerance, max_steps
        As there; on the way errors of 1e-3 are enough.

    Returns
    -------
    AdaptiveSolution
        ``orbit.evaluations`` counts all that was spent on the way. Where the walk ends before the
        full stiffness, the direct solution and its status.
    """
    way = _Continuation(problem, p, index, method, max_steps)
    direct = way.solve(p[index], start, tolerance)
    if direct.orbit.status is Status.CONVERGED or not p[index] > 0.0:
        return direct
    spent, rough = direct.orbit.evaluations, max(tolerance, ROUGH)
    for k in range(1, TRIALS + 1):
        here = way.solve(p[index] * SOFTER**k, start, rough)
        spent += here.orbit.evaluations
        if here.orbit.status is Status.CONVERGED:
            break
    else:
        return _spent(direct, spent)
    here, walked = way.walk(here, rough)
    spent += walked
    if here.p[index] != p[index]:
        return _spent(direct, spent)
    last = way.solve(p[index], here.start(), tolerance)
    return _spent(last, spent + last.orbit.evaluations)


def _spent(solution: AdaptiveSolution, evaluations: int) -> AdaptiveSolution:
    return replace(solution, orbit=replace(solution.orbit, evaluations=evaluations))


@dataclass(frozen=True, eq=False)
class _Continuation:
    """Solutions at any value of the stiffness."""

    problem: PeriodicProblem
    p: Array
    index: int
    method: str
    max_steps: int

    def solve(
        self, value: float, start: PhaseFunction | AdaptiveStart, tolerance: float
    ) -> AdaptiveSolution:
        p = self.p.copy()
        p[self.index] = value
        return solve_adaptive(
            self.problem, p, start,
            method=self.method, tolerance=tolerance, max_steps=self.max_steps,
        )  # fmt: skip

    def walk(self, here: AdaptiveSolution, tolerance: float) -> tuple[AdaptiveSolution, int]:
        """As far towards the full stiffness as steps succeed, and the evaluations it took."""
        step, spent, full = np.log(FIRST_STEP), 0, self.p[self.index]
        before: AdaptiveSolution | None = None
        while here.p[self.index] < full and step > np.log(SMALLEST_STEP):
            now = here.p[self.index]
            value, warp = min(full, now * np.exp(step)), SAME
            if before is not None:
                length = np.log(value / now) / np.log(now / before.p[self.index])
                warp = extrapolate(before.level.kinks, here.level.kinks, length)
            trial = self.solve(value, here.start(warp), tolerance)
            spent += trial.orbit.evaluations
            if trial.orbit.status is Status.CONVERGED:
                before, here, step = here, trial, min(2 * step, np.log(LARGEST_STEP))
            else:
                step /= 3
        return here, spent
