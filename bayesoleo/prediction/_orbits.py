"""Periodic orbits of a model under a planned motion, by any of the package's solvers.

There are five solvers: a mesh of equal steps, an adaptive mesh, shooting, shooting with derivatives
from a mesh, and shooting with a library's integrator. Their results can be compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo._parallel import thread_map
from bayesoleo._types import Array, Integers
from bayesoleo.errors import InputError, ModelError
from bayesoleo.model._kernels import Kernels, kernels
from bayesoleo.model._model import Model
from bayesoleo.prediction._inputs import input_rows
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._periodic_solver import (
    MOST_ADAPTIVE_STEPS,
    TOLERANCE,
    PeriodicMotion,
    PeriodicSolver,
    check_solver,
)
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._simulate import RunPlan, check_plan, record_of
from bayesoleo.prediction._starts import guess_rows
from bayesoleo.solvers._adaptive_mesh import AdaptiveSolution, AdaptiveStart
from bayesoleo.solvers._orbit import Orbit, Status
from bayesoleo.solvers._periodic import sensitivities
from bayesoleo.solvers._schemes import COLLOCATION, DEFAULT_SCHEME
from bayesoleo.solvers._switched import PhaseFunction, state_rows

#: Equal steps to begin with, at least and for each harmonic of an input, and at most.
FEWEST_STEPS, STEPS_PER_HARMONIC, MOST_STEPS = 64, 4, 8192
#: An error from which it falls with the method's order, if the equations have no kinks.
CLOSE = 1e-4


@dataclass(frozen=True, eq=False)
class PeriodicOrbits:
    """Orbits of ``L`` parameter vectors, with derivatives.

    Parameters
    ----------
    motions : tuple of PeriodicMotion, length L
        Of each, its orbit, and values and derivatives at any phase.
    kernels : Kernels
        Of the model.
    record : Record
        Its inputs.
    p : ndarray, shape (L, np)
        Constants of the model.
    """

    motions: tuple[PeriodicMotion, ...]
    kernels: Kernels
    record: Record
    p: Array

    @property
    def orbits(self) -> tuple[Orbit, ...]:
        """States, status, multipliers and cost of each."""
        return tuple(motion.orbit for motion in self.motions)

    @property
    def status(self) -> Integers:
        """Values of :class:`~bayesoleo.solvers.Status`, shape (L,): look here first."""
        return np.array([int(orbit.status) for orbit in self.orbits], dtype=np.int64)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Parameters by which derivatives are taken, length na."""
        return self.kernels.derived.active

    def rows(self, phase: ArrayLike) -> Array:
        """Values and derivatives of all dofs, shape (L, nz, N); NaN where there is no orbit."""
        return self._each("rows", np.asarray(phase, dtype=float), (self._nz,))

    def rows_by_parameter(self, phase: ArrayLike) -> Array:
        """Their derivatives by the estimated parameters, shape (L, nz, na, N)."""
        shape = (self._nz, len(self.parameters))
        return self._each("rows_by_parameter", np.asarray(phase, dtype=float), shape)

    def dof(self, name: str, phase: ArrayLike, derivative: int = 0) -> Array:
        """A dof or its time derivative at phases in cycles, shape (L, N); SI.

        Raises
        ------
        InputError
            If there is no such dof.
        """
        derived = self.kernels.derived
        if name not in derived.dofs:
            raise InputError("no such dof", key=name, hint=f"there are {', '.join(derived.dofs)}")
        k = derived.dofs.index(name)
        return self.rows(phase)[:, sum(order + 1 for order in derived.orders[:k]) + derivative]

    def outputs(self, phase: ArrayLike) -> dict[str, Array]:
        """All outputs at phases in cycles, each of shape (L, N); SI."""
        at = np.asarray(phase, dtype=float)
        z, u, lanes = self.rows(at), self._inputs(at), np.arange(len(self.motions))
        y = np.empty((lanes.size, len(self.kernels.derived.outputs), at.size))
        with np.errstate(all="ignore"):
            self.kernels.output(z, u, self.p, lanes, y)
        return dict(zip(self.kernels.derived.outputs, np.moveaxis(y, 1, 0), strict=True))

    def outputs_by_parameter(self, phase: ArrayLike) -> dict[str, Array]:
        """Their derivatives by the estimated parameters, each of shape (L, na, N)."""
        at = np.asarray(phase, dtype=float)
        z, u, lanes = self.rows(at), self._inputs(at), np.arange(len(self.motions))
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

    def _each(self, name: str, phase: Array, shape: tuple[int, ...]) -> Array:
        found = np.full((len(self.motions), *shape, phase.size), np.nan)
        for lane, motion in enumerate(self.motions):
            if motion.orbit.status.solved:
                found[lane] = getattr(motion, name)(phase)
        return found


def periodic_orbit(
    model: Model,
    plan: RunPlan,
    values: Mapping[str, ArrayLike] | None = None,
    solver: str = COLLOCATION,
    *,
    steps: int | None = None,
    scheme: str = DEFAULT_SCHEME,
    tolerance: float = TOLERANCE,
    near: PeriodicOrbits | None = None,
    stiffness: str | None = None,
    max_steps: int = MOST_ADAPTIVE_STEPS,
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
    solver : {"collocation", "adaptive", "shooting", "hybrid", "library"}
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
    near : PeriodicOrbits, optional
        One similar motion of the same model, by the same solver, to start from; an adaptive mesh is
        taken over with it.
    stiffness : str, optional
        A parameter along which the adaptive solver walks up from a value small enough, where a
        direct solution fails: of a contact, or the slope of a friction.
    max_steps : int
        Of an adaptive mesh.
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
        If the solver or a name is unknown, lengths differ, or an input is missing.
    ModelError
        If the model has no dof.

    References
    ----------
    Verbeek (1993), sections 4.3.1 and 4.3.2, eqs. 4.21-4.28 and 4.36-4.41.
    """
    check_solver(solver, scheme)
    if not model.dofs:
        raise ModelError(f"model {model.name!r} has no dof", hint="evaluate its outputs instead")
    lanes = _lanes(model, values or {})
    check_plan(model, plan, {})
    if stiffness is not None and stiffness not in model.parameters:
        hint = f"parameters there are: {', '.join(model.parameters)}"
        raise InputError("no such parameter", key="stiffness", value=stiffness, hint=hint)
    compiled = kernels(model, model.estimated(), backend)
    record = record_of(model, plan)
    constants = compiled.derived.constants
    run = RunPredictor(model, compiled, record, steps or _first_steps(record), scheme)
    p = np.repeat(run.base_constants()[None], len(lanes), axis=0)
    for row, lane in zip(p, lanes, strict=True):
        for name, value in lane.items():
            row[constants.index(name)] = value
    way = PeriodicSolver(
        solver, model, compiled, record, scheme, run.steps, tolerance, backend,
        None if stiffness is None else constants.index(stiffness), max_steps,
    )  # fmt: skip

    def one(row: Array) -> PeriodicMotion:
        if solver == COLLOCATION:
            return _refined(run, way, row, refine=steps is None)
        return way.solve(row, _start(run, row) if near is None else _from(near.motions[0]))

    # Equal steps are compiled for many vectors at once, and their threads share a cache.
    motions = thread_map(one, list(p), 1 if solver == COLLOCATION else jobs)
    return PeriodicOrbits(tuple(motions), compiled, record, p)


def _from(motion: PeriodicMotion) -> PhaseFunction | AdaptiveStart:
    """Start from a motion, on its mesh if it has one."""
    found = motion.solution
    return found.start() if isinstance(found, AdaptiveSolution) else motion.rows


def _start(run: RunPredictor, p: Array) -> PhaseFunction:
    """Start from the model's own guess."""
    constants = dict(zip(run.kernels.derived.constants, p, strict=True))
    return lambda phase: guess_rows(run.model, run.kernels.derived, run.record, constants, phase)


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


def _refined(
    run: RunPredictor, solver: PeriodicSolver, p: Array, *, refine: bool
) -> PeriodicMotion:
    """A motion on equal steps, halved until the tolerance is met if they may be refined."""
    found, error = solver.judged(_on_equal_steps(run, p), p)
    while refine and found.orbit.status is Status.TOLERANCE_NOT_MET:
        before = error.error
        run = RunPredictor(run.model, run.kernels, run.record, 2 * run.steps, solver.scheme)
        finer, error = solver.judged(_on_equal_steps(run, p), p)
        if not finer.orbit.status.solved:
            break
        found = finer
        if not _promises(before, error.error, solver.tolerance, run.steps):
            break
    return found


def _on_equal_steps(run: RunPredictor, p: Array) -> PeriodicMotion:
    solution = run.solve_from_guess(p)
    solution, x_theta, (monodromy,) = sensitivities(run.boundary, p[None], solution)
    nodes = np.arange(run.steps) / run.steps
    orbit = Orbit(
        phases=nodes,
        states=run.rows(solution.x[0], nodes)[state_rows(run.scheme.orders)].T,
        period=run.period,
        monodromy=monodromy,
        status=Status(int(solution.status[0])),
        error=np.nan,
        evaluations=int(solution.iterations[0] + 1) * run.points.size,
    )
    return PeriodicMotion(
        orbit,
        lambda phase: run.rows(solution.x[0], phase),
        lambda phase: run.rows(x_theta[0], phase),
        solution,
    )


def _promises(before: float, now: float, tolerance: float, steps: int) -> bool:
    """Whether halving equal steps goes on to pay: kinks leave an error that hardly falls."""
    if 2 * steps > MOST_STEPS:
        return False
    if not now < CLOSE:  # far from where an order shows
        return True
    gain = max(before / now, 1.0 + 1e-9)
    halvings = np.log(now / tolerance) / np.log(gain)
    return bool(halvings <= np.log2(MOST_STEPS / steps) + 1.0)
