"""Periodic orbits of a model under a planned motion, by any of the package's solvers.

One question, five ways to answer it: on an equidistant mesh, on a mesh of its own, by shooting, by
shooting with derivatives from a mesh, and by shooting with a library's integrator. Answers can be
held against each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesoleo._types import Array
from bayesoleo.errors import InputError, ModelError
from bayesoleo.model import Model
from bayesoleo.model.kernels import Kernels, kernels
from bayesoleo.parallel import thread_map
from bayesoleo.prediction.dynamics import dynamics_of
from bayesoleo.prediction.inputs import input_rows
from bayesoleo.prediction.orbit import adaptive_problem, periodic_answer
from bayesoleo.prediction.records import Record
from bayesoleo.prediction.run import RunPredictor
from bayesoleo.prediction.simulate import RunPlan, record_of
from bayesoleo.solvers.adaptive.error_estimate import NONE, ErrorEstimate, estimate_error
from bayesoleo.solvers.adaptive.switched import PeriodicProblem, crossings_of
from bayesoleo.solvers.orbit import Orbit, floquet_multipliers
from bayesoleo.solvers.periodic.solve import Boundary, sensitivities
from bayesoleo.solvers.schemes.choose import DEFAULT_SCHEME
from bayesoleo.solvers.schemes.mesh import Mesh
from bayesoleo.solvers.schemes.tableau import tableau
from bayesoleo.solvers.shooting.hybrid import differentiate_on_mesh
from bayesoleo.solvers.shooting.initial_value import Dynamics
from bayesoleo.solvers.shooting.library import FEWEST_STEPS as LIBRARY_STEPS
from bayesoleo.solvers.shooting.library import shoot_by_library
from bayesoleo.solvers.shooting.shoot import Shot, shoot_on_steps, solve_shooting
from bayesoleo.solvers.status import Status
from bayesoleo.solvers.transient.state_space import StateSpace

Rows = Callable[[Array], Array]

METHODS = ("discretisation", "adaptive", "shooting", "hybrid", "library")
#: Equal steps to begin with, at least and for each harmonic of an input, and at most.
FEWEST_STEPS, STEPS_PER_HARMONIC, MOST_STEPS = 64, 4, 8192
#: An error from which it falls with the method's order, if the equations have no kinks.
CLOSE = 1e-4
#: How often shooting is tried on finer steps, and the smallest local error of a library.
MORE_SHOTS, LEAST_LOCAL = 4, 1e-12


@dataclass(frozen=True, eq=False)
class PeriodicOrbits:
    """Orbits of ``L`` parameter vectors, with derivatives.

    Parameters
    ----------
    orbits : tuple of Orbit, length L
        States, status, multipliers and cost of each.
    motions, slopes : tuple of callable
        Values and derivatives of all dofs ``(nz, N)``, and those of these by the estimated
        parameters ``(nz, na, N)``, at phases ``(N,)`` in cycles.
    kernels : Kernels
        Of the model.
    record : Record
        Its inputs.
    p : ndarray, shape (L, np)
        Constants of the model.
    """

    orbits: tuple[Orbit, ...]
    motions: tuple[Rows, ...]
    slopes: tuple[Rows, ...]
    kernels: Kernels
    record: Record
    p: Array

    @property
    def status(self) -> NDArray[np.int64]:
        """Values of :class:`~bayesoleo.solvers.status.Status`, shape (L,): look here first."""
        return np.array([int(orbit.status) for orbit in self.orbits], dtype=np.int64)

    @property
    def parameters(self) -> tuple[str, ...]:
        """By which derivatives are taken, length na."""
        return self.kernels.derived.active

    def rows(self, phase: ArrayLike) -> Array:
        """Values and derivatives of all dofs, shape (L, nz, N); NaN where there is no orbit."""
        return self._each(self.motions, np.asarray(phase, dtype=float), (self._nz,))

    def rows_by_parameter(self, phase: ArrayLike) -> Array:
        """Their derivatives by the estimated parameters, shape (L, nz, na, N)."""
        shape = (self._nz, len(self.parameters))
        return self._each(self.slopes, np.asarray(phase, dtype=float), shape)

    def outputs(self, phase: ArrayLike) -> dict[str, Array]:
        """All outputs at phases in cycles, each of shape (L, N); SI."""
        at = np.asarray(phase, dtype=float)
        z, u, lanes = self.rows(at), self._inputs(at), np.arange(len(self.orbits))
        y = np.empty((lanes.size, len(self.kernels.derived.outputs), at.size))
        with np.errstate(all="ignore"):
            self.kernels.output(z, u, self.p, lanes, y)
        return dict(zip(self.kernels.derived.outputs, np.moveaxis(y, 1, 0), strict=True))

    def outputs_by_parameter(self, phase: ArrayLike) -> dict[str, Array]:
        """Their derivatives by the estimated parameters, each of shape (L, na, N)."""
        at = np.asarray(phase, dtype=float)
        z, u, lanes = self.rows(at), self._inputs(at), np.arange(len(self.orbits))
        names = self.kernels.derived.outputs
        yz = np.empty((lanes.size, len(names), self._nz, at.size))
        yp = np.empty((lanes.size, len(names), len(self.parameters), at.size))
        with np.errstate(all="ignore"):
            self.kernels.output_jacobian(z, u, self.p, lanes, yz, yp)
        yp += np.einsum("lyzn,lzan->lyan", yz, self.rows_by_parameter(at))
        return dict(zip(names, np.moveaxis(yp, 1, 0), strict=True))

    @property
    def _nz(self) -> int:
        return sum(order + 1 for order in self.kernels.derived.orders)

    def _inputs(self, phase: Array) -> Array:
        return input_rows(self.record, self.kernels.derived.inputs, phase)

    def _each(self, functions: tuple[Rows, ...], phase: Array, shape: tuple[int, ...]) -> Array:
        found = np.full((len(self.orbits), *shape, phase.size), np.nan)
        for lane, (orbit, function) in enumerate(zip(self.orbits, functions, strict=True)):
            if orbit.status.solved:
                found[lane] = function(phase)
        return found


def periodic_orbit(
    model: Model,
    plan: RunPlan,
    values: Mapping[str, ArrayLike] | None = None,
    method: str = "discretisation",
    *,
    steps: int | None = None,
    scheme: str = DEFAULT_SCHEME,
    tolerance: float = 1e-8,
    backend: str = "numba",
    jobs: int | None = None,
) -> PeriodicOrbits:
    """Solve a model for its periodic orbit, for one or several parameter vectors.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    plan : RunPlan
        Motion of the inputs and conditions.
    values : mapping of str to float or array_like, shape (L,), optional
        Parameters that are not at their nominal value. Each vector starts from the model's own
        guess: what is found for it does not depend on the others.
    method : {"discretisation", "adaptive", "shooting", "hybrid", "library"}
        On a mesh of equal steps; on a mesh with error control; by shooting, with derivatives by the
        second, linear problem; by shooting, with derivatives on a mesh made of its steps; by
        shooting with SciPy's LSODA, the slow and independent check.
    steps : int, optional
        Of the mesh of equal steps; by default they are halved until the tolerance is met, down to
        :data:`MOST_STEPS`. The hybrid's mesh for derivatives has at least so many.
    scheme : str
        Of the meshes. Shooting does without; only equal steps can use ``thesis``.
    tolerance : float
        Estimated largest error of a state, anywhere in the period, over that state's swing, or of
        the time of a kink in cycles. The error of every motion is estimated after it was found,
        with the equations looked at between the steps' own points as well. It is the orbit's
        ``error``; where it is larger, its status is ``TOLERANCE_NOT_MET``, and where it cannot be
        estimated, ``NO_ERROR_ESTIMATE``. Derivatives by parameters are not judged.
    backend : {"numba", "numpy"}
        Kernels; NumPy's need no compilation, but are called back from compiled shooting slowly.
    jobs : int, optional
        Threads over parameter vectors.

    Returns
    -------
    PeriodicOrbits
        Look at ``status`` first: a failure is a value, not an exception.

    Raises
    ------
    InputError
        If the method or a name is unknown, lengths differ, or an input is missing.
    ModelError
        If the model has no dof.

    References
    ----------
    Verbeek (1993), sections 4.3.1 and 4.3.2, eqs. 4.21-4.28 and 4.36-4.41.
    """
    if method not in METHODS:
        hint = f"use {', '.join(METHODS)}"
        raise InputError("no such method", key="method", value=method, hint=hint)
    if not model.dofs:
        raise ModelError(f"model {model.name!r} has no dof", hint="evaluate its outputs instead")
    lanes = _lanes(model, values or {})
    for name in model.inputs:
        if name not in plan.inputs:
            hint = f"give inputs={{{name!r}: motion(…)}}"
            raise InputError(f"model {model.name!r} needs the input {name!r}", hint=hint)
    compiled = kernels(model, model.estimated(), backend)
    record = record_of(model, plan)
    run = RunPredictor(model, compiled, record, steps or _first_steps(record), scheme)
    p = np.repeat(run.base_constants()[None], len(lanes), axis=0)
    for row, lane in zip(p, lanes, strict=True):
        for name, value in lane.items():
            row[compiled.derived.constants.index(name)] = value
    way = _Way(model, plan, run, steps, tolerance, scheme, backend, jobs)
    ways: dict[str, Callable[[Array], list[Found]]] = {
        "discretisation": way.discretised,
        "adaptive": partial(way.adaptive, lanes),
        "shooting": way.shot,
        "hybrid": way.hybrid,
        "library": way.by_library,
    }
    orbits, motions, slopes = zip(*ways[method](p), strict=True)
    return PeriodicOrbits(orbits, motions, slopes, compiled, run.record, p)


def _first_steps(record: Record) -> int:
    """Equal steps to begin with: a few for each harmonic of the inputs, a power of two."""
    highest = max((int(h.orders.max(initial=1)) for h in record.harmonics.values()), default=1)
    wanted = max(FEWEST_STEPS, STEPS_PER_HARMONIC * highest)
    return int(min(MOST_STEPS, 2 ** int(np.ceil(np.log2(wanted)))))


def _lanes(model: Model, values: Mapping[str, ArrayLike]) -> list[dict[str, float]]:
    """One mapping for each parameter vector."""
    for name in values:
        if name not in model.parameters:
            hint = f"parameters there are: {', '.join(model.parameters)}"
            raise InputError("no such parameter", key=name, hint=hint)
    try:
        columns = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in values.values()))
    except ValueError as error:
        lengths = {name: np.size(value) for name, value in values.items()}
        hint = "give single numbers, or as many of each"
        raise InputError("lengths differ", key="values", value=lengths, hint=hint) from error
    count = columns[0].size if columns else 1
    table = [column.ravel().tolist() for column in columns]
    return [{n: c[k] for n, c in zip(values, table, strict=True)} for k in range(count)]


Found = tuple[Orbit, Rows, Rows]


@dataclass(frozen=True, eq=False)
class _Way:
    """One model under one plan, solved by each of the methods."""

    model: Model
    plan: RunPlan
    run: RunPredictor
    steps: int | None
    tolerance: float
    scheme: str
    backend: str
    jobs: int | None

    # -- errors ----------------------------------------------------------------------------

    @cached_property
    def problem(self) -> PeriodicProblem:
        """By which errors are estimated: the equations are evaluated a few times only, so that
        nothing is compiled for it."""
        return adaptive_problem(self.model, self.plan, "numpy")[1]

    def judged(
        self, found: Found, p: Array, method: str = DEFAULT_SCHEME
    ) -> tuple[Found, ErrorEstimate]:
        """An orbit with the error of its motion, and a status that compares it to the tolerance."""
        orbit, motion, slopes = found
        if not orbit.status.solved:
            return found, NONE
        mesh = Mesh(np.append(orbit.phases, 1.0))
        error = estimate_error(self.problem, tableau(method), p, motion, mesh, self.tolerance)
        judged = replace(orbit, status=error.judged(self.tolerance), error=error.error)
        return (judged, motion, slopes), error

    # -- equal steps -----------------------------------------------------------------------

    def discretised(self, p: Array) -> list[Found]:
        return [self._refined(row) for row in p]

    def _refined(self, p: Array) -> Found:
        """On a mesh of equal steps, halved until the tolerance is met unless they are given."""
        run = self.run
        found, error = self.judged(self._on(run, p), p)
        while self.steps is None and found[0].status is Status.TOLERANCE_NOT_MET:
            before = error.error
            run = RunPredictor(self.model, run.kernels, run.record, 2 * run.steps, self.scheme)
            finer, error = self.judged(self._on(run, p), p)
            if not finer[0].status.solved:
                break
            found = finer
            if not _promises(before, error.error, self.tolerance, run.steps):
                break
        return found

    def _on(self, run: RunPredictor, p: Array) -> Found:
        solution, lane = run.solve_from_guess(p), p[None]
        solution, x_theta, monodromy = sensitivities(run.boundary, lane, solution)
        rows = _sampled(run, solution.x[0][..., None], True)
        nodes = np.arange(run.steps) / run.steps
        orbit = Orbit(
            nodes, rows(nodes)[_state_rows(run)].T, run.period, floquet_multipliers(monodromy[0]),
            Status(int(solution.status[0])), np.nan,
            int(solution.iterations[0] + 1) * run.points.size,
        )  # fmt: skip
        return orbit, rows, _sampled(run, x_theta[0], False)

    # -- a mesh of its own -----------------------------------------------------------------

    def adaptive(self, lanes: list[dict[str, float]], p: Array) -> list[Found]:
        def one(lane: dict[str, float]) -> Found:
            answer = periodic_answer(
                self.model, self.plan, lane,
                tolerance=self.tolerance, method=self.scheme, backend=self.backend,
            )  # fmt: skip
            return answer.orbit, answer.solution.motion, answer.solution.motion_by_parameter

        return thread_map(one, lanes, self.jobs)

    # -- shooting --------------------------------------------------------------------------

    def shots(self, p: Array, *, by_parameter: bool) -> list[tuple[Shot, Orbit]]:
        """Motions by shooting, with their judged orbits."""
        active = self.run.kernels.derived.active
        dynamics = dynamics_of(self.model, self.run.record, active, self.backend)

        def one(row: Array) -> tuple[Shot, Orbit]:
            start = np.ascontiguousarray(self._start(row))
            shot = solve_shooting(
                dynamics, row, self.run.period, start,
                tolerance=self.tolerance, sensitivities=by_parameter,
            )  # fmt: skip
            return self._on_more_steps(dynamics, row, shot, by_parameter)

        return thread_map(one, list(p), self.jobs)

    def _on_more_steps(
        self, dynamics: Dynamics, p: Array, shot: Shot, by_parameter: bool
    ) -> tuple[Shot, Orbit]:
        """Shoot again, by steps that resolve what the integrator stepped over."""
        (orbit, *_), error = self.judged((shot.orbit(), shot.sample, shot.sample), p, "radau5")
        for _ in range(MORE_SHOTS):
            better = error.better
            if orbit.status is not Status.TOLERANCE_NOT_MET or better is None:
                break
            mesh = better.mesh.halved()
            kinks = np.zeros(0) if better.kinks is None else better.kinks.phases
            other = shoot_on_steps(
                dynamics, p, shot, np.ascontiguousarray(better.x[0, : shot.start.size]),
                mesh.edges, np.isin(mesh.edges[1:], kinks),
                tolerance=self.tolerance, sensitivities=by_parameter,
            )  # fmt: skip
            if other is None:
                break
            (again, *_), following = self.judged(
                (other.orbit(), other.sample, other.sample), p, "radau5"
            )
            if not following.error < error.error:
                break
            shot, orbit, error = other, again, following
        return shot, orbit

    def _start(self, row: Array) -> Array:
        """State of the guess at phase zero, shape (D,)."""
        rows = _sampled(self.run, self.run.guess(row)[0][..., None], True)(np.zeros(1))
        return rows[_state_rows(self.run), 0]

    def shot(self, p: Array) -> list[Found]:
        return [
            (orbit, shot.sample, shot.sample_theta)
            for shot, orbit in self.shots(p, by_parameter=True)
        ]

    def hybrid(self, p: Array) -> list[Found]:
        _, problem, _ = adaptive_problem(self.model, self.plan, self.backend)
        method = tableau(self.scheme)

        def one(item: tuple[Array, tuple[Shot, Orbit]]) -> Found:
            row, (shot, orbit) = item
            if not orbit.status.solved:
                return orbit, shot.sample, shot.sample_theta

            def on(mesh: Mesh, motion: Rows) -> Boundary:
                return problem.on(method, mesh, crossings_of(problem, motion, mesh, row))

            found = differentiate_on_mesh(shot, on, row, self.run.steps)
            return orbit, shot.sample, found.sample_theta

        shots = self.shots(p, by_parameter=False)
        return thread_map(one, list(zip(p, shots, strict=True)), self.jobs)

    # -- a library -------------------------------------------------------------------------

    def by_library(self, p: Array) -> list[Found]:
        derived, run = self.run.kernels.derived, self.run
        space = StateSpace(
            run.kernels,
            derived.orders,
            lambda t: input_rows(run.record, derived.inputs, t / run.period),
            len(derived.active),
            len(derived.admissible),
        )

        def one(row: Array) -> Found:
            start, local, steps = self._start(row), self.tolerance, LIBRARY_STEPS
            best: tuple[Found, ErrorEstimate] | None = None
            for _ in range(MORE_SHOTS):
                shot = shoot_by_library(
                    space, row, run.period, start, tolerance=local, fewest_steps=steps
                )
                now = self.judged((shot.orbit, shot.sample, shot.sample_theta), row)
                if best is None or now[1].error < best[1].error:
                    best = now
                if now[0][0].status is not Status.TOLERANCE_NOT_MET or local <= LEAST_LOCAL:
                    break
                start, steps = shot.orbit.states[0], 4 * steps
                # Errors of steps add up: they are asked for as much smaller.
                local = max(LEAST_LOCAL, 0.1 * local * self.tolerance / now[1].error)
            assert best is not None
            return best[0]

        return thread_map(one, list(p), self.jobs)


def _promises(before: float, now: float, tolerance: float, steps: int) -> bool:
    """Whether halving equal steps goes on to pay: kinks leave an error that hardly falls."""
    if 2 * steps > MOST_STEPS:
        return False
    if not now < CLOSE:  # far from where an order shows
        return True
    gain = max(before / now, 1.0 + 1e-9)
    halvings = np.log(now / tolerance) / np.log(gain)
    return bool(halvings <= np.log2(MOST_STEPS / steps) + 1.0)


def _state_rows(run: RunPredictor) -> list[int]:
    """Rows, of values and derivatives of all dofs, that are the state, length D."""
    first = np.cumsum([0, *(order + 1 for order in run.scheme.orders)])
    return [int(first[j]) + k for j, o in enumerate(run.scheme.orders) for k in range(o)]


def _sampled(run: RunPredictor, x: Array, single: bool) -> Rows:
    """Rows at phases of unknowns ``(n, w, C)`` on the mesh of equal steps."""
    scheme, n, step = run.scheme, run.steps, run.boundary.step(run.steps)

    def rows(phase: Array) -> Array:
        found = scheme.sample(x[None], scheme.plan(phase, n), step)[0]
        return cast(Array, found[:, 0] if single else found)

    return rows
