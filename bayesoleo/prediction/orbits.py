"""Periodic orbits of a model under a planned motion, by any of the package's solvers.

One question, five ways to answer it: on an equidistant mesh, on a mesh of its own, by shooting, by
shooting with derivatives from a mesh, and by shooting with a library's integrator. Answers can be
held against each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
from bayesoleo.solvers.adaptive.switched import crossings_of
from bayesoleo.solvers.orbit import Orbit, floquet_multipliers
from bayesoleo.solvers.periodic.solve import Boundary, Solution, sensitivities
from bayesoleo.solvers.schemes.choose import DEFAULT_SCHEME
from bayesoleo.solvers.schemes.mesh import Mesh
from bayesoleo.solvers.schemes.tableau import tableau
from bayesoleo.solvers.shooting.hybrid import differentiate_on_mesh
from bayesoleo.solvers.shooting.library import shoot_by_library
from bayesoleo.solvers.shooting.shoot import Shot, solve_shooting
from bayesoleo.solvers.status import Status
from bayesoleo.solvers.transient.state_space import StateSpace

Array = NDArray[np.float64]
Rows = Callable[[Array], Array]

METHODS = ("discretisation", "adaptive", "shooting", "hybrid", "library")


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
            if orbit.status is Status.CONVERGED:
                found[lane] = function(phase)
        return found


def periodic_orbit(
    model: Model,
    plan: RunPlan,
    values: Mapping[str, ArrayLike] | None = None,
    method: str = "discretisation",
    *,
    steps: int = 256,
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
    steps, scheme : int and str
        Of the mesh of equal steps; the hybrid's has at least so many. Shooting does
        without; only equal steps can use ``thesis``.
    tolerance : float
        Of the adaptive mesh and of shooting; of LSODA the local error.
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
    run = RunPredictor(model, compiled, record_of(model, plan), steps, scheme)
    p = np.repeat(run.base_constants()[None], len(lanes), axis=0)
    for row, lane in zip(p, lanes, strict=True):
        for name, value in lane.items():
            row[compiled.derived.constants.index(name)] = value
    way = _Way(model, plan, run, tolerance, scheme, backend, jobs)
    ways: dict[str, Callable[[Array], list[Found]]] = {
        "discretisation": way.discretised,
        "adaptive": partial(way.adaptive, lanes),
        "shooting": way.shot,
        "hybrid": way.hybrid,
        "library": way.by_library,
    }
    orbits, motions, slopes = zip(*ways[method](p), strict=True)
    return PeriodicOrbits(orbits, motions, slopes, compiled, run.record, p)


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
    tolerance: float
    scheme: str
    backend: str
    jobs: int | None

    def discretised(self, p: Array) -> list[Found]:
        run = self.run
        each = [run.solve_from_guess(row) for row in p]
        solution = Solution(*(
            np.concatenate([getattr(one, name) for one in each])
            for name in ("x", "status", "iterations")
        ))  # fmt: skip
        solution, x_theta, monodromy = sensitivities(run.boundary, p, solution)
        size, found = run.scheme.state_size, []
        for lane in range(len(p)):
            spent = int(solution.iterations[lane] + 1) * run.points.size
            orbit = Orbit(
                np.arange(run.steps) / run.steps, self._states(solution, lane)[:, :size],
                run.period, floquet_multipliers(monodromy[lane]),
                Status(int(solution.status[lane])), np.nan, spent,
            )  # fmt: skip
            found.append(
                (orbit, self._sampled(solution.x[lane][..., None], True),
                 self._sampled(x_theta[lane], False))
            )  # fmt: skip
        return found

    def _states(self, solution: Solution, lane: int) -> Array:
        """States at the nodes ``(n, D)``, also of a scheme whose unknowns are values only."""
        nodes = np.arange(self.run.steps) / self.run.steps
        rows = self._sampled(solution.x[lane][..., None], True)(nodes)
        return rows[self._state_rows()].T

    def _state_rows(self) -> list[int]:
        first = np.cumsum([0, *(order + 1 for order in self.run.scheme.orders)])
        return [int(first[j]) + k for j, o in enumerate(self.run.scheme.orders) for k in range(o)]

    def _sampled(self, x: Array, single: bool) -> Rows:
        """Rows at phases of unknowns ``(n, w, C)`` on the mesh of equal steps."""
        scheme, n, step = self.run.scheme, self.run.steps, self.run.boundary.step(self.run.steps)

        def rows(phase: Array) -> Array:
            found = scheme.sample(x[None], scheme.plan(phase, n), step)[0]
            return found[:, 0] if single else found

        return rows

    def adaptive(self, lanes: list[dict[str, float]], p: Array) -> list[Found]:
        def one(lane: dict[str, float]) -> Found:
            answer = periodic_answer(
                self.model, self.plan, lane,
                tolerance=self.tolerance, method=self.scheme, backend=self.backend,
            )  # fmt: skip
            return answer.orbit, answer.solution.motion, answer.solution.motion_by_parameter

        return thread_map(one, lanes, self.jobs)

    def shots(self, p: Array, *, by_parameter: bool) -> list[Shot]:
        active = self.run.kernels.derived.active
        dynamics = dynamics_of(self.model, self.run.record, active, self.backend)

        def one(row: Array) -> Shot:
            start = np.ascontiguousarray(self._start(row))
            return solve_shooting(
                dynamics, row, self.run.period, start,
                tolerance=self.tolerance, sensitivities=by_parameter,
            )  # fmt: skip

        return thread_map(one, list(p), self.jobs)

    def _start(self, row: Array) -> Array:
        """State of the guess at phase zero, shape (D,)."""
        return self._sampled(self.run.guess(row)[0][..., None], True)(np.zeros(1))[
            self._state_rows(), 0
        ]

    def shot(self, p: Array) -> list[Found]:
        return [
            (shot.orbit(), shot.sample, shot.sample_theta)
            for shot in self.shots(p, by_parameter=True)
        ]

    def hybrid(self, p: Array) -> list[Found]:
        _, problem, _ = adaptive_problem(self.model, self.plan, self.backend)
        method = tableau(self.scheme)

        def one(item: tuple[Array, Shot]) -> Found:
            row, shot = item
            if not shot.status.ok:
                return shot.orbit(), shot.sample, shot.sample_theta

            def on(mesh: Mesh, motion: Rows) -> Boundary:
                return problem.on(method, mesh, crossings_of(problem, motion, mesh, row))

            found = differentiate_on_mesh(shot, on, row, self.run.steps)
            return shot.orbit(), shot.sample, found.sample_theta

        shots = self.shots(p, by_parameter=False)
        return thread_map(one, list(zip(p, shots, strict=True)), self.jobs)

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
            shot = shoot_by_library(
                space, row, run.period, self._start(row), tolerance=self.tolerance
            )
            return shot.orbit, shot.sample, shot.sample_theta

        return thread_map(one, list(p), self.jobs)
