"""Solvers of periodic motions by name, for one model under the inputs of one run.

Equal steps (``collocation``) are solved by :class:`~bayesoleo.prediction.run.RunPredictor`, for
many parameter vectors at once. The other solvers stand here: each takes one parameter vector and a
motion to start from, and returns a motion with its derivatives and an estimate of its error.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.model import Model
from bayesoleo.model.kernels import Kernels, kernels
from bayesoleo.model.switching import analytic_pieces
from bayesoleo.prediction.dynamics import dynamics_of
from bayesoleo.prediction.inputs import input_rows
from bayesoleo.prediction.records import Record
from bayesoleo.solvers.adaptive.error_estimate import NONE, ErrorEstimate, estimate_error
from bayesoleo.solvers.adaptive.refine import AdaptiveSolution, AdaptiveStart, solve_adaptive
from bayesoleo.solvers.adaptive.stiffening import solve_stiffening
from bayesoleo.solvers.adaptive.switched import (
    Motion,
    PeriodicProblem,
    Switches,
    crossings_of,
    state_rows,
)
from bayesoleo.solvers.orbit import Orbit
from bayesoleo.solvers.periodic.solve import Boundary
from bayesoleo.solvers.schemes.choose import COLLOCATION, DEFAULT_SCHEME, SOLVERS
from bayesoleo.solvers.schemes.mesh import Mesh
from bayesoleo.solvers.schemes.tableau import tableau
from bayesoleo.solvers.shooting.hybrid import differentiate_on_mesh
from bayesoleo.solvers.shooting.initial_value import Dynamics
from bayesoleo.solvers.shooting.library import FEWEST_STEPS as LIBRARY_STEPS
from bayesoleo.solvers.shooting.library import shoot_by_library
from bayesoleo.solvers.shooting.shoot import Shot, shoot_on_steps, solve_shooting
from bayesoleo.solvers.status import Status
from bayesoleo.solvers.transient.state_space import StateSpace

#: Estimated largest error of a motion over its swing that is asked for.
TOLERANCE = 1e-8
#: How often shooting is tried on finer steps, and the smallest local error of a library.
MORE_SHOTS, LEAST_LOCAL = 4, 1e-12
#: Steps of an adaptive mesh at most.
MOST_ADAPTIVE_STEPS = 20_000
#: Schemes that have no mesh of unequal steps.
_ON_UNEQUAL_STEPS = ("radau2", "radau3", "gauss2", "gauss3")


def check_solver(name: str, scheme: str = DEFAULT_SCHEME, key: str = "solver") -> str:
    """The name of a solver, if there is one that can use the scheme.

    Raises
    ------
    InputError
        If there is no such solver, or it cannot use the scheme.
    """
    if name not in SOLVERS:
        close = difflib.get_close_matches(name, SOLVERS, 1)
        hint = f"did you mean {close[0]}? " if close else ""
        hint += f"use {', '.join(SOLVERS)}"
        raise InputError("unknown solver", key=key, value=name, hint=hint)
    if name in ("adaptive", "hybrid") and scheme not in _ON_UNEQUAL_STEPS:
        hint = f"use scheme {' or '.join(_ON_UNEQUAL_STEPS)}, or solver {COLLOCATION}"
        raise InputError(
            f"scheme {scheme!r} needs equal steps, which this solver does not take",
            key=key, value=name, hint=hint,
        )  # fmt: skip
    return name


@dataclass(frozen=True, eq=False)
class PeriodicMotion:
    """A periodic motion of one parameter vector, whichever solver found it.

    Parameters
    ----------
    orbit : Orbit
        States, status, estimated error, monodromy, cost.
    rows : callable
        Values and derivatives of all dofs, shape (nz, N), at phases in cycles, shape (N,).
    rows_by_parameter : callable
        Derivatives of these by the active parameters, shape (nz, na, N).
    solution : object, optional
        What the solver itself returned, from which it can start again.
    """

    orbit: Orbit
    rows: Motion
    rows_by_parameter: Motion
    solution: Any = None


@dataclass(frozen=True, eq=False)
class PeriodicSolver:
    """One model under the inputs of one run, and a solver with an estimate of its error.

    Parameters
    ----------
    name : {"adaptive", "shooting", "hybrid", "library"}
        See :func:`~bayesoleo.prediction.orbits.periodic_orbit`.
    model : Model
        In the drive in which it is solved.
    kernels : Kernels
        Of that model.
    record : Record
        A periodic run.
    scheme : str
        Of the meshes.
    steps : int
        Of the hybrid's mesh for derivatives, at least.
    tolerance : float
        Estimated largest error of a state over its swing.
    backend : {"numba", "numpy"}
        Of the kernels that a solver calls.
    stiffness : int, optional
        A constant along which the adaptive solver walks up where a direct solution fails.
    max_steps : int
        Of an adaptive mesh.
    """

    name: str
    model: Model
    kernels: Kernels
    record: Record
    scheme: str = DEFAULT_SCHEME
    steps: int = 1
    tolerance: float = TOLERANCE
    backend: str = "numba"
    stiffness: int | None = None
    max_steps: int = MOST_ADAPTIVE_STEPS

    @property
    def period(self) -> float:
        """Seconds."""
        return 1.0 / self.record.frequency

    def solve(
        self,
        p: Array,
        start: Motion | AdaptiveStart,
        *,
        derivatives: bool = True,
        judge: bool = True,
    ) -> PeriodicMotion:
        """The motion at constants ``p (np,)`` from a start.

        Without ``derivatives`` those by parameters may be left out. With ``judge`` the error is
        estimated, which takes longer than to shoot, and steps are made shorter until it is within
        the tolerance; an adaptive mesh is judged in any case.
        """
        if self.name == "adaptive":
            return self._adaptive(p, start)
        motion = start.motion if isinstance(start, AdaptiveStart) else start
        state = motion(np.zeros(1))[state_rows(self.kernels.derived.orders), 0]
        if self.name == "library":
            return self._by_library(p, state, judge)
        hybrid = self.name == "hybrid"
        shot, orbit = self._shot(p, state, derivatives and not hybrid, judge)
        by_parameter: Motion = shot.sample_theta
        if hybrid and derivatives and orbit.status.solved:
            by_parameter = self._on_mesh_of(shot, p)
        return PeriodicMotion(orbit, shot.sample, by_parameter, shot)

    # -- errors ----------------------------------------------------------------------------

    @cached_property
    def problem(self) -> PeriodicProblem:
        """The problem by which errors are estimated: the equations are evaluated a few times only,
        so that nothing is compiled for it."""
        return periodic_problem(self.model, self.record, "numpy", self.kernels.derived.active)

    def judged(self, found: PeriodicMotion, p: Array) -> tuple[PeriodicMotion, ErrorEstimate]:
        """A motion with its error, and a status that compares the error to the tolerance."""
        orbit = found.orbit
        if not orbit.status.solved:
            return found, NONE
        mesh = Mesh(np.append(orbit.phases, 1.0))
        # A shot's steps are those of five stages.
        method = "radau5" if self.name in ("shooting", "hybrid") else DEFAULT_SCHEME
        error = estimate_error(self.problem, tableau(method), p, found.rows, mesh, self.tolerance)
        status = error.judged(self.tolerance)
        return replace(found, orbit=replace(orbit, status=status, error=error.error)), error

    # -- a mesh of its own -----------------------------------------------------------------

    @cached_property
    def compiled_problem(self) -> PeriodicProblem:
        """The problem with the kernels of the backend."""
        return periodic_problem(self.model, self.record, self.backend, self.kernels.derived.active)

    def _adaptive(self, p: Array, start: Motion | AdaptiveStart) -> PeriodicMotion:
        solve: Callable[..., AdaptiveSolution] = solve_adaptive
        if self.stiffness is not None:
            solve = partial(solve_stiffening, index=self.stiffness)
        found = solve(
            self.compiled_problem, p, start,
            tolerance=self.tolerance, method=self.scheme, max_steps=self.max_steps,
        )  # fmt: skip
        return PeriodicMotion(found.orbit, found.motion, found.motion_by_parameter, found)

    # -- shooting --------------------------------------------------------------------------

    @cached_property
    def dynamics(self) -> Dynamics:
        """The equations as the integrator takes them."""
        return dynamics_of(self.model, self.record, self.kernels.derived.active, self.backend)

    def _shot(self, p: Array, state: Array, by_parameter: bool, judge: bool) -> tuple[Shot, Orbit]:
        """A motion by shooting, with its judged orbit, on steps that resolve what the integrator
        stepped over."""
        shot = solve_shooting(
            self.dynamics, p, self.period, np.ascontiguousarray(state),
            tolerance=self.tolerance, sensitivities=by_parameter,
        )  # fmt: skip
        if not judge:
            return shot, shot.orbit()
        orbit, error = self._judged_shot(shot, p)
        for _ in range(MORE_SHOTS):
            better = error.better
            if orbit.status is not Status.TOLERANCE_NOT_MET or better is None:
                break
            mesh = better.mesh.halved()
            kinks = np.zeros(0) if better.kinks is None else better.kinks.phases
            other = shoot_on_steps(
                self.dynamics, p, shot, np.ascontiguousarray(better.x[0, : shot.start.size]),
                mesh.edges, np.isin(mesh.edges[1:], kinks),
                tolerance=self.tolerance, sensitivities=by_parameter,
            )  # fmt: skip
            if other is None:
                break
            again, following = self._judged_shot(other, p)
            if not following.error < error.error:
                break
            shot, orbit, error = other, again, following
        return shot, orbit

    def _judged_shot(self, shot: Shot, p: Array) -> tuple[Orbit, ErrorEstimate]:
        motion, error = self.judged(PeriodicMotion(shot.orbit(), shot.sample, shot.sample_theta), p)
        return motion.orbit, error

    def _on_mesh_of(self, shot: Shot, p: Array) -> Motion:
        """Derivatives by parameters on a mesh made of the integrator's steps."""
        problem, method = self.compiled_problem, tableau(self.scheme)

        def on(mesh: Mesh, motion: Motion) -> Boundary:
            return problem.on(method, mesh, crossings_of(problem, motion, mesh, p))

        return differentiate_on_mesh(shot, on, p, self.steps).sample_theta

    # -- a library -------------------------------------------------------------------------

    @cached_property
    def space(self) -> StateSpace:
        """The equations as SciPy's integrators take them."""
        derived = self.kernels.derived
        return StateSpace(
            self.kernels,
            derived.orders,
            lambda t: input_rows(self.record, derived.inputs, t / self.period),
            len(derived.active),
            len(derived.admissible),
        )

    def _by_library(self, p: Array, state: Array, judge: bool) -> PeriodicMotion:
        local, steps = self.tolerance, LIBRARY_STEPS
        best: tuple[PeriodicMotion, ErrorEstimate] | None = None
        for _ in range(MORE_SHOTS):
            shot = shoot_by_library(
                self.space, p, self.period, state, tolerance=local, fewest_steps=steps
            )
            found = PeriodicMotion(shot.orbit, shot.sample, shot.sample_theta, shot)
            if not judge:
                return found
            now = self.judged(found, p)
            if best is None or now[1].error < best[1].error:
                best = now
            if now[0].orbit.status is not Status.TOLERANCE_NOT_MET or local <= LEAST_LOCAL:
                break
            state, steps = shot.orbit.states[0], 4 * steps
            # Errors of steps add up: they are asked for as much smaller.
            local = max(LEAST_LOCAL, 0.1 * local * self.tolerance / now[1].error)
        assert best is not None
        return best[0]


def periodic_problem(
    model: Model, record: Record, backend: str = "numpy", active: Sequence[str] | None = None
) -> PeriodicProblem:
    """A periodic run as the adaptive solver takes it, in analytic pieces.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    record : Record
        A periodic run.
    backend : {"numpy", "numba"}
        Kernels; NumPy's need no compilation.
    active : sequence of str, optional
        Parameters to differentiate by; by default those that are estimated.
    """
    compiled = kernels(model, model.estimated() if active is None else tuple(active), backend)
    derived = compiled.derived
    pieces, switches = _in_pieces(model, compiled, backend)
    rows = pieces.derived.inputs
    modes = () if switches is None else switches.rows
    known = [k for k in range(len(rows)) if k not in modes]

    def inputs_at(phase: Array) -> Array:
        table = np.zeros((len(rows), phase.size))
        table[known] = input_rows(record, tuple(rows[k] for k in known), phase)
        return table

    return PeriodicProblem(
        equations=pieces,
        orders=derived.orders,
        period=1.0 / record.frequency,
        inputs_at=inputs_at,
        conditions=len(derived.admissible),
        active=len(derived.active),
        switches=switches,
    )


def _in_pieces(model: Model, compiled: Kernels, backend: str) -> tuple[Kernels, Switches | None]:
    """Kernels whose modes are inputs, and what decides on the modes."""
    pieces = analytic_pieces(model)
    if pieces.switches == 0:
        return compiled, None
    modes = [name for name in pieces.model.conditions if name not in model.conditions]
    moving = replace(
        pieces.model,
        conditions=model.conditions,
        inputs={**model.inputs, **dict.fromkeys(modes, "")},
    )
    chosen = kernels(moving, compiled.derived.active, backend)
    derived, lane = chosen.derived, np.array([0])
    if derived.orders != compiled.derived.orders:
        # An output asks for a higher derivative of a dof than the equations determine.
        return compiled, None

    def values(z: Array, u: Array, p: Array) -> Array:
        y = np.empty((1, len(derived.outputs), z.shape[1]))
        with np.errstate(all="ignore"):
            chosen.output(z[None], u, p[None], lane, y)
        return cast(Array, y[0])

    def slopes(z: Array, u: Array, p: Array) -> Array:
        count = len(derived.outputs)
        yz = np.empty((1, count, *z.shape))
        yp = np.empty((1, count, len(derived.active), z.shape[1]))
        with np.errstate(all="ignore"):
            chosen.output_jacobian(z[None], u, p[None], lane, yz, yp)
        return cast(Array, yz[0])

    return chosen, Switches(values, slopes, tuple(derived.inputs.index((m, 0)) for m in modes))
