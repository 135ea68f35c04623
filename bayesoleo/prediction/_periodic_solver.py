"""Solvers of periodic runs by name, and a run solved by one of them.

Equal steps (``collocation``) are solved by ``RunPredictor``, for many parameter vectors at once.
The solvers of this file take one parameter vector and a motion to start from, and return a motion
with its derivatives and an estimate of its error.

The motion is evaluated at the raw samples directly from the solver's representation. It is also
interpolated, with its derivatives, to the run's mesh of equal steps. That is the anchor from which
later solutions start, and the basis of scores and of the response to input noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, cast

import numpy as np

from bayesoleo._types import Array, Integers
from bayesoleo.errors import InputError, ModelError, choose
from bayesoleo.model._derivatives import analytic_pieces
from bayesoleo.model._kernels import Kernels, kernels
from bayesoleo.model._model import Model
from bayesoleo.prediction._inputs import (
    RowCache,
    dynamics_of,
    highest_derivatives,
    input_rows,
    signal_of,
)
from bayesoleo.prediction._periodic_run import PredictedSamples, RunPredictor
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.prediction._stability import unstable_of
from bayesoleo.prediction._starts import Anchor, Motion, guess_rows
from bayesoleo.solvers._adaptive_mesh import (
    AdaptiveSolution,
    AdaptiveStart,
    solve_adaptive,
    solve_stiffening,
)
from bayesoleo.solvers._error_estimate import NONE, ErrorEstimate, estimate_error
from bayesoleo.solvers._initial_value import Dynamics
from bayesoleo.solvers._library_integrator import FEWEST_STEPS as LIBRARY_STEPS, shoot_by_library
from bayesoleo.solvers._mesh import Mesh, tableau
from bayesoleo.solvers._orbit import Orbit, Status
from bayesoleo.solvers._periodic import Boundary, Solution
from bayesoleo.solvers._schemes import COLLOCATION, DEFAULT_SCHEME, SOLVERS
from bayesoleo.solvers._shooting import Shot, differentiate_on_mesh, shoot_on_steps, solve_shooting
from bayesoleo.solvers._state_space import StateSpace
from bayesoleo.solvers._switched import (
    PeriodicProblem,
    PhaseFunction,
    Switches,
    crossings_of,
    state_rows,
)

#: Estimated largest error of a motion over its swing that is asked for.
TOLERANCE = 1e-8
#: How often shooting is tried on finer steps, and the smallest local error of a library.
MORE_SHOTS, LEAST_LOCAL = 4, 1e-12
#: Steps of an adaptive mesh at most.
MOST_ADAPTIVE_STEPS = 20_000
#: Schemes that have no mesh of unequal steps.
_ON_UNEQUAL_STEPS = ("radau2", "radau3", "gauss2", "gauss3")


def check_solver(name: str, scheme: str = DEFAULT_SCHEME) -> str:
    """The name of a solver, if there is one that can use the scheme.

    Raises
    ------
    InputError
        If there is no such solver, or it cannot use the scheme.
    """
    if name not in SOLVERS:
        raise InputError("unknown solver", key="solver", value=name, hint=choose(name, SOLVERS))
    if name in ("adaptive", "hybrid") and scheme not in _ON_UNEQUAL_STEPS:
        hint = f"use scheme {' or '.join(_ON_UNEQUAL_STEPS)}, or solver {COLLOCATION}"
        raise InputError(
            f"scheme {scheme!r} needs equal steps, which this solver does not take",
            key="solver", value=name, hint=hint,
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
    rows: PhaseFunction
    rows_by_parameter: PhaseFunction
    solution: Any = None


@dataclass(frozen=True, eq=False)
class PeriodicSolver:
    """One model under the inputs of one run, and a solver with an estimate of its error.

    Parameters
    ----------
    name : {"adaptive", "shooting", "hybrid", "library"}
        See :func:`~bayesoleo.prediction.periodic_orbit`.
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
        start: PhaseFunction | AdaptiveStart,
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
        state = self._state_of(start)
        if self.name == "library":
            return self._by_library(p, state, judge)
        hybrid = self.name == "hybrid"
        shot, orbit = self._shot(p, state, derivatives and not hybrid, judge)
        by_parameter: PhaseFunction = shot.sample_theta
        if hybrid and derivatives and orbit.status.solved:
            by_parameter = self._on_mesh_of(shot, p)
        return PeriodicMotion(orbit, shot.sample, by_parameter, shot)

    def _state_of(self, start: PhaseFunction | AdaptiveStart) -> Array:
        """The state at phase zero."""
        motion = start.motion if isinstance(start, AdaptiveStart) else start
        return motion(np.zeros(1))[state_rows(self.kernels.derived.orders), 0]

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

    def _adaptive(self, p: Array, start: PhaseFunction | AdaptiveStart) -> PeriodicMotion:
        solve: Callable[..., AdaptiveSolution] = solve_adaptive
        if self.stiffness is not None:
            solve = partial(solve_stiffening, index=self.stiffness)
        options: dict[str, Any] = {
            "tolerance": self.tolerance, "method": self.scheme, "max_steps": self.max_steps
        }  # fmt: skip
        found = solve(self.compiled_problem, p, start, **options)
        if found.orbit.status is Status.SINGULAR:
            # As equations of what lags behind a motion are at rest, wherever their answer is.
            shot: Shot | None = None
            with suppress(ModelError):  # where it cannot be integrated
                shot, _ = self._shot(p, self._state_of(start), by_parameter=False, judge=False)
            if shot is not None and shot.status is Status.CONVERGED:
                found = solve(self.compiled_problem, p, shot.sample, **options)
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

    def _on_mesh_of(self, shot: Shot, p: Array) -> PhaseFunction:
        """Derivatives by parameters on a mesh made of the integrator's steps."""
        problem, method = self.compiled_problem, tableau(self.scheme)

        def on(mesh: Mesh, motion: PhaseFunction) -> Boundary:
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


class SolvedRun(RunPredictor):
    """One periodic run of one model, solved one parameter vector at a time.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    kernels : Kernels
        Of that model.
    record : Record
        A periodic run.
    steps : int
        Of the mesh on which motions are kept.
    scheme_name : str
        Of the meshes.
    solver : {"adaptive", "shooting", "hybrid", "library"}
        See :func:`~bayesoleo.prediction.periodic_orbit`.
    backend : {"numba", "numpy"}
        Of the kernels on an adaptive mesh; integrators take compiled ones, since calling NumPy's
        step by step takes minutes.
    known_rows : dict, optional
        Input rows that another model of the same run has computed.
    """

    def __init__(
        self,
        model: Model,
        kernels: Kernels,
        record: Record,
        steps: int,
        scheme_name: str,
        solver: str,
        backend: str = "numba",
        known_rows: RowCache | None = None,
    ):
        check_solver(solver, scheme_name)
        super().__init__(model, kernels, record, steps, scheme_name, known_rows)
        inputs = _as_taken(record, kernels.derived.inputs)
        compiled = backend if solver == "adaptive" else "numba"
        self.solver = PeriodicSolver(
            solver, model, kernels, inputs, scheme_name, steps, backend=compiled
        )

        #: The last anchor that was set here, and its motion.
        self._anchored: tuple[Anchor | None, PeriodicMotion | None] = None, None

    # -- one parameter vector --------------------------------------------------------------

    def motion(self, p: Array, *, derivatives: bool = True) -> PeriodicMotion:
        """The motion at constants ``p (np,)``, a function of these and of the anchor alone."""
        for start in self._starts(p):
            found = self.solver.solve(p, start, derivatives=derivatives, judge=False)
            if found.orbit.status.solved:
                break
        return found

    def error(self) -> ErrorEstimate:
        """Error of the anchor's motion."""
        assert self.anchor is not None
        anchor, found = self._anchored
        if found is None or anchor is not self.anchor:  # of another process, or of another run
            found = self.motion(self.anchor.p, derivatives=False)
        return self.solver.judged(found, self.anchor.p)[1]

    def _starts(self, p: Array) -> Iterator[Motion]:
        """Motions to start from, the most promising first."""
        if self.anchor is not None:
            change = (p - self.anchor.p)[self.active]
            yield partial(self.rows, self.anchor.predict(change[None])[0])
            if change.any():
                yield partial(self.rows, self.anchor.x)
        constants = dict(zip(self.kernels.derived.constants, p, strict=True))
        yield lambda phase: guess_rows(
            self.model, self.kernels.derived, self.record, constants, phase, self.motions
        )

    def _on_mesh(self, motion: Motion) -> Array:
        """A motion in the unknowns of the run's mesh, ``(n, w)``; of derivatives ``(na, n, w)``."""
        at_nodes, at_points = motion(np.arange(self.steps) / self.steps), motion(self.points)
        if at_nodes.ndim == 2:
            found: Array = self.scheme.from_motion(at_nodes[None], at_points[None])[0]
            return found
        return self.scheme.from_motion(*(np.moveaxis(z, 1, 0) for z in (at_nodes, at_points)))

    def set_anchor(self, p: Array) -> Status:
        """Solve at constants ``p (np,)`` and keep the solution as the start of later ones."""
        return self._anchor_at(p)[1]

    def _anchor_at(self, p: Array) -> tuple[PeriodicMotion | None, Status]:
        if not self.kernels.derived.dofs:
            return None, Status.CONVERGED
        found = self.motion(p)
        status = _usable(found)
        if status.ok:
            x, x_p = self._on_mesh(found.rows), self._on_mesh(found.rows_by_parameter)
            if not np.isfinite(x_p).all():
                return found, Status.SINGULAR
            old, matrix = self.anchor, found.orbit.monodromy
            anchor = Anchor(p.copy(), x, np.ascontiguousarray(x_p), matrix)
            left = old is not None and old.unstable != anchor.unstable
            self.anchor = replace(anchor, jumped=left)
            self._anchored = self.anchor, found
            self.jumps += left
            self.changes += left
        return found, status

    # -- many ------------------------------------------------------------------------------

    def solve(self, p: Array) -> Solution:
        """Periodic solutions for constants ``p (L, np)`` on the run's mesh."""
        found = [self.motion(row, derivatives=False) for row in p]
        status = np.array([_usable(one).value for one in found], dtype=np.int64)
        x = np.zeros((len(p), self.steps, self.scheme.width))
        for lane in np.flatnonzero(status == Status.CONVERGED.value):
            x[lane] = self._on_mesh(found[lane].rows)
        return Solution(x, status, np.zeros(len(p), dtype=np.int64))

    def predict(self, p: Array, *, derivatives: bool = False) -> PredictedSamples:
        """Outputs at the raw samples for constants ``p (L, np)``."""
        if not self.kernels.derived.dofs:
            return super().predict(p, derivatives=derivatives)
        found = [self.motion(row, derivatives=derivatives) for row in p]
        samples = self._sampled(p, found, [_usable(one) for one in found], derivatives)
        left = np.zeros(len(p), dtype=np.bool_)
        if self.anchor is not None and self.watched and samples.monodromy is not None:
            left = (unstable_of(samples.monodromy) != self.anchor.unstable) & (samples.status == 0)
            self.jumps += int(left.sum())
            self.changes += int(left.sum())
        return replace(samples, jumped=left)

    def evaluate(self, p: Array) -> PredictedSamples:
        """Set the anchor at constants ``p (np,)``, and take outputs with derivatives from it."""
        found, status = self._anchor_at(p)
        if found is None:
            return super().predict(p[None], derivatives=True)
        samples = self._sampled(p[None], [found], [status], True)
        jumped = status.ok and self.anchor is not None and self.anchor.jumped
        return replace(samples, jumped=np.array([jumped]))

    def squares(self, p: Array) -> tuple[Array, Integers]:
        """Sums of squared residuals, shape (L, ny), and statuses, for constants ``p (L, np)``."""
        return self._squares_of_predictions(p)

    def _sampled(
        self, p: Array, found: list[PeriodicMotion], solved: list[Status], derivatives: bool
    ) -> PredictedSamples:
        """Outputs of motions at the samples, NaN where there is none."""
        status, phase = np.array([one.value for one in solved], dtype=np.int64), self.record.phase
        nz, na = self.scheme.state_size + len(self.scheme.orders), len(self.active)
        z = np.full((len(p), nz, phase.size), np.nan)
        z_p = np.full((len(p), nz, na, phase.size), np.nan) if derivatives else None
        for lane in np.flatnonzero(status == Status.CONVERGED.value):
            z[lane] = found[lane].rows(phase)
            if z_p is not None:
                z_p[lane] = found[lane].rows_by_parameter(phase)
        moved = None if z_p is None else (z_p, np.ones(na, dtype=np.bool_))
        samples = self._outputs(p, z, moved, status, derivatives)
        return replace(samples, monodromy=np.stack([one.orbit.monodromy for one in found]))


def _usable(found: PeriodicMotion) -> Status:
    """Status of a motion as a prediction: one whose error is too large or not known is used all the
    same, as on equal steps, and its error is told with the estimate."""
    status = found.orbit.status
    return Status.CONVERGED if status.solved else status


def _as_taken(record: Record, rows: tuple[tuple[str, int], ...]) -> Record:
    """A record whose harmonics are those that a model takes of each channel: a solver that takes
    fewer derivatives must not see more of them."""
    taken = {
        name: signal_of(record, name, highest)
        for name, highest in highest_derivatives(rows).items()
        if name != "time"
    }
    known = {name: item for name, item in taken.items() if isinstance(item, Harmonics)}
    return replace(record, harmonics={**record.harmonics, **known})
