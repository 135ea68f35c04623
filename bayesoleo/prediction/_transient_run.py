"""Prediction of one transient run, with sensitivities.

The mesh is chosen once; every solution starts from the initial state and is evaluated at samples.
"""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np

from bayesoleo._types import Array
from bayesoleo.model._kernels import Kernels
from bayesoleo.model._model import Model
from bayesoleo.prediction._inputs import (
    RowCache,
    highest_derivatives,
    input_rows,
    signal_of,
    signal_of_transient,
)
from bayesoleo.prediction._mesh_steps import WHOLE
from bayesoleo.prediction._periodic_run import PredictedSamples, RunPredictor
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._starts import Anchor, InitialState, Motion
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._initial_value import Dynamics
from bayesoleo.solvers._mesh import Mesh, equidistant, halved, joined, resolving, tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary, Solution
from bayesoleo.solvers._schemes import DEFAULT_SCHEME
from bayesoleo.solvers._transient import (
    integrate,
    solve_transient,
    state_rows,
    transient_sensitivities,
)

#: To follow the inputs, steps are shortened to this many samples and to this angle at the highest
#: frequency of an input at most, which a method of fifth order follows to 1e-4.
SAMPLES_A_STEP, ANGLE = 4, 0.75
#: Steps of that angle beyond which an integrator would take minutes, step by step in arrays.
MOST_INTEGRATED = 5_000
#: Where steps are chosen by the inputs alone they are halved until the motion changes by less than
#: this part of its size, and are no more than so many.
SETTLED, MOST_STEPS = 3e-5, 400_000
#: Bytes that solving vectors together may take, about; and arrays of the size of the motion, by
#: parameter where derivatives are asked for, that are held at once.
MOST_BYTES, ARRAYS = 1e9, 8
#: Steps of equal length where equations have no explicit form for an integrator to choose by.
FALLBACK = 512
#: Steps of an integrator from which on it is worth the time to find out whether fewer would do: to
#: solve so many takes about as long as what Python does around it.
WORTH_JOINING = 512


class TransientRun(RunPredictor):
    """One transient run of one model.

    The mesh is chosen where the run is first anchored and kept from then on, so that all later
    solutions are functions of their own parameters alone.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    kernels : Kernels
        Of that model.
    record : Record
        A transient run.
    steps : int
        Fineness: :data:`WHOLE` is the integrator's own mesh; twice as much halves its steps. Half
        as much doubles them where they are many; how fine they must be is then for whoever asks to
        find out, as for a periodic run.
    scheme_name : str
        Discretisation by collocation; the thesis's differences have no counterpart here, and the
        default stands in for them.
    like : TransientRun, optional
        The same run under another model, whose mesh and input rows are taken over.
    """

    #: The last single solution, with the anchor that it began at and its constants.
    _last: tuple[Anchor | None, Array, Solution] | None = None

    def __init__(
        self,
        model: Model,
        kernels: Kernels,
        record: Record,
        steps: int,
        scheme_name: str,
        like: TransientRun | None = None,
    ):
        self.model, self.kernels, self.record = model, kernels, record
        derived = kernels.derived
        self._check(record)
        self.method = tableau(DEFAULT_SCHEME if scheme_name == "thesis" else scheme_name)
        self.period, self.fineness = record.span, steps
        self.known_rows: RowCache = {} if like is None else like.known_rows
        self.position = record.position
        self._observe(self.position)
        self.initial = InitialState(model, kernels, record)
        self._input_names = derived.inputs
        highest = highest_derivatives(derived.inputs)
        #: Channels as this model takes them; the time is none.
        self.curves: dict[str, Any] = {
            name: signal_of(record, name, order)
            for name, order in highest.items()
            if name != "time"
        }
        #: The mesh as chosen, before it is cut finer; none yet where nobody chose one.
        self.chosen: Mesh | None = None if like is None else like.chosen
        self.motions: dict[str, Motion] = {} if like is None else like.known_motions()
        self._adopt(self.chosen or equidistant(1))

    def start_like(self, other: TransientRun) -> None:
        """Begin on the mesh of another run with the same dofs, from its motion."""
        self.chosen, self.motions = other.chosen, other.known_motions()
        if self.chosen is not None:
            self._adopt(self.chosen)

    def resampled(self, record: Record) -> TransientRun:
        """The same run, anchor and mesh included, looked at at other times of the same span."""
        other = copy(self)
        other.record, other.position = record, record.position
        other.sample_inputs = input_rows(record, self.kernels.derived.inputs, other.position)
        other.measured = np.stack([record.samples[name] for name in self.kernels.derived.outputs])
        if self.plan is not None:
            other.plan = self.collocation.plan(other.position, self.steps, initial=True)
        return other

    def _inputs(self, position: Array) -> Array:
        return input_rows(self.record, self.kernels.derived.inputs, position)

    @property
    def _dynamics(self) -> Dynamics:
        """Equations and inputs as an integrator takes them."""
        derived = self.kernels.derived
        signal = signal_of_transient(self.record, derived.inputs)
        return Dynamics(
            self.kernels, derived.orders, signal, len(derived.active), len(derived.admissible)
        )

    def _adopt(self, mesh: Mesh) -> None:
        """Work on a mesh, cut as fine as asked for, or as coarse."""
        times = round(np.log2(self.fineness / WHOLE))
        fine = halved(mesh, max(times, 0))
        if times < 0 and follows_inputs(mesh):
            fine = equidistant(int(np.ceil(mesh.steps * self.fineness / WHOLE)))
        elif times < 0 and mesh.steps >= WORTH_JOINING:
            fine = joined(mesh, -times)
        derived = self.kernels.derived
        self.collocation = Collocation(self.method, derived.orders, fine)
        self.steps, self.scheme = fine.steps, self.collocation
        self.points = self.scheme.phases(fine.steps)
        grid = f"{self.method.name} {hash(fine.edges.tobytes())}"
        self.boundary = Boundary(
            equations=self.kernels,
            scheme=self.scheme,
            period=self.period,
            inputs=input_rows(self.record, derived.inputs, self.points, grid, self.known_rows),
            conditions=len(derived.admissible),
            active=len(derived.active),
        )
        self.plan = (
            self.collocation.plan(self.position, fine.steps, initial=True) if derived.dofs else None
        )

    def _choose(self, mesh: Mesh) -> None:
        """Keep a mesh for good, cut where the inputs change faster than its steps can follow."""
        self.chosen = resolving(mesh, self._inputs, self.method, self._shortest)
        self._adopt(self.chosen)

    @property
    def _shortest(self) -> float:
        """Part of the time below which steps are not cut for the sake of inputs."""
        of_samples = SAMPLES_A_STEP / (self.record.time.size - 1)
        return min([of_samples, *(ANGLE / angle for angle in self._angles() if angle > 0)])

    def _angles(self) -> list[float]:
        """Angle by which the highest frequency of each input turns in all the time."""
        bands = [getattr(curve, "band", None) for curve in self.curves.values()]
        return [2 * np.pi * band.upper * self.period for band in bands if band is not None]

    def found(self) -> dict[str, Any]:
        """As of a periodic run, and the mesh."""
        return {**super().found(), "chosen": self.chosen}

    def restore(self, found: dict[str, Any]) -> None:
        """Take over what :meth:`found` gave."""
        super().restore(found)
        if self.chosen is not None:
            self._adopt(self.chosen)

    @property
    def can_be_coarser(self) -> bool:
        """Whether its steps follow the inputs of a long record, so that fewer may do.

        An integrator's steps are as long as its error allows.
        """
        if not self.kernels.derived.dofs:
            return False
        return self.is_long if self.chosen is None else follows_inputs(self.chosen)

    @property
    def can_be_joined(self) -> bool:
        """Whether its steps are an integrator's, and so many that joining them is worth a look."""
        if not self.kernels.derived.dofs or self.chosen is None:
            return False
        return self.chosen.steps >= WORTH_JOINING and not follows_inputs(self.chosen)

    @property
    def is_long(self) -> bool:
        """Whether an integrator would take minutes to follow the inputs."""
        return max(self._angles(), default=0.0) > ANGLE * MOST_INTEGRATED

    # -- solving ---------------------------------------------------------------------------

    def set_anchor(self, p: Array) -> Status:
        """Solve at constants ``p (np,)`` and keep the solution as the start of later ones.

        The first call chooses the mesh.
        """
        if not self.kernels.derived.dofs:
            return Status.CONVERGED
        return self._anchored(p)[0]

    def _anchored(self, p: Array) -> tuple[Status, Array | None]:
        """Status of the anchor at constants ``p (np,)``, and derivatives (1, n, w, na)."""
        if self._stands_at(p):
            assert self.anchor is not None
            return Status.CONVERGED, np.moveaxis(self.anchor.x_p, 0, 2)[None]
        start = self.initial(p[None])
        if start.status[0] != Status.CONVERGED.value:
            return Status(int(start.status[0])), None
        solution = self._first(p, start.state[0]) if self.anchor is None else self._alone(p)
        if isinstance(solution, Status):
            return solution, None
        x_p = None
        if solution.status[0] == Status.CONVERGED.value:
            solution, x_p, _ = transient_sensitivities(
                self.boundary, p[None], solution, start.by_parameter
            )
            if solution.status[0] == Status.CONVERGED.value:
                moved = np.ascontiguousarray(np.moveaxis(x_p[0], 2, 0))
                self.anchor = Anchor(p.copy(), solution.x[0], moved)
                self._last = None  # it began at the anchor of before, which would be kept with it
        return Status(int(solution.status[0])), x_p

    def _stands_at(self, p: Array) -> bool:
        """Whether the anchor is the solution at constants ``p (np,)``."""
        return self.anchor is not None and np.array_equal(self.anchor.p, p)

    def _alone(self, p: Array) -> Solution:
        """The solution at constants ``p (np,)``, from the anchor; asked again, from memory."""
        anchor, last = self.anchor, self._last
        if last is None or last[0] is not anchor or not np.array_equal(last[1], p):
            last = self._last = anchor, p.copy(), self._solved(p[None])
        return last[2]

    def solved_anew(self, p: Array) -> PredictedSamples:
        """Outputs at constants ``p (np,)``; without an anchor from the start, and none is set."""
        if not self.kernels.derived.dofs or self.anchor is not None:
            return self.predict(p[None])
        state, status = self.initial.states(p[None])
        if status[0] != Status.CONVERGED.value:
            return self._failed(Status(int(status[0])))
        solution = self._first(p, state[0])
        if isinstance(solution, Status):
            return self._failed(solution)
        return self._at_samples(p[None], solution.x, None, solution.status, derivatives=False)

    def known_at(self, p: Array) -> PredictedSamples | None:
        """Outputs with derivatives of the anchor, if it is the solution at constants ``p``."""
        return self.evaluate(p) if self._stands_at(p) else None

    @property
    def shows_outputs_first(self) -> bool:
        """As of a periodic run; the start decides which solution a transient is."""
        return not self.kernels.derived.dofs or self.anchor is not None

    def evaluate(self, p: Array) -> PredictedSamples:
        """Set the anchor at constants ``p (np,)``, and take outputs with derivatives from it."""
        if not self.kernels.derived.dofs:
            return super().evaluate(p)
        status, x_p = self._anchored(p)
        if status is not Status.CONVERGED or self.anchor is None:
            return self._failed(status)
        found = np.array([status.value], dtype=np.int64)
        return self._at_samples(p[None], self.anchor.x[None], x_p, found, derivatives=True)

    def _first(self, p: Array, state: Array) -> Solution | Status:
        """The first solution, on a mesh of its own unless one was taken over."""
        rows: Motion = lambda position: self._known(position, state)  # noqa: E731
        if self.can_be_coarser:
            equal = self._by_inputs(p, state, rows) if self.chosen is None else None
            equal = self._begun_at(p, state, rows) if equal is None else equal
            if equal.status[0] == Status.CONVERGED.value or self.fineness < WHOLE:
                return equal
            # Where a force jumps, an integrator's own steps may still get across.
            self.chosen = None
        if self.chosen is None:
            found = integrate(self._dynamics, p, state, self.period)
            if not found.status.ok and found.status is not Status.SINGULAR:
                return found.status
            self._choose(found.mesh or equidistant(FALLBACK))
            if (integrated := found.rows) is not None:
                rows = lambda position: integrated(position * self.period)  # noqa: E731
        return self._begun_at(p, state, rows)

    def _begun_at(self, p: Array, state: Array, rows: Motion) -> Solution:
        """A solution on the present mesh, from a motion and its first state."""
        start = self._unknowns(rows)
        start[:, 0, : self.scheme.state_size] = state
        return solve_transient(self.boundary, p[None], start)

    def _by_inputs(self, p: Array, state: Array, rows: Motion) -> Solution:
        """The first solution on equal steps that follow the inputs: the longest that suffice."""
        steps = int(np.ceil(1.0 / self._shortest))
        solution, place = self._on_equal(steps, p, state, rows), np.linspace(0.0, 1.0, 16 * WHOLE)
        if self.fineness < WHOLE:
            return solution
        while 2 * steps <= MOST_STEPS and solution.status[0] == Status.CONVERGED.value:
            coarse, motion = solution, self._motion_of(solution)
            solution = self._on_equal(2 * steps, p, state, motion)
            if solution.status[0] == Status.CONVERGED.value:
                states, finer = state_rows(self.kernels.derived.orders), self._motion_of(solution)
                if _rests(finer(place)[states], motion(place)[states]):
                    self._keep_equal(steps)
                    return coarse
            steps *= 2
        return solution

    def _keep_equal(self, steps: int) -> None:
        self.chosen = equidistant(steps)
        self._adopt(self.chosen)

    def _on_equal(self, steps: int, p: Array, state: Array, rows: Motion) -> Solution:
        """A solution on equal steps, which are kept."""
        self._keep_equal(steps)
        return self._begun_at(p, state, rows)

    def _motion_of(self, solution: Solution) -> Motion:
        """Rows of a solution on the present mesh at positions."""
        scheme, steps, step = self.collocation, self.steps, self.boundary.step(self.steps)

        def rows(position: Array) -> Array:
            plan = scheme.plan(position, steps, initial=True)
            return scheme.sample(solution.x[..., None], plan, step)[0, :, 0]

        return rows

    def _unknowns(self, rows: Motion) -> Array:
        """The scheme's unknowns ``(1, n, w)`` of a motion."""
        nodes = self.collocation.nodes(self.steps)
        return self.scheme.from_motion(rows(nodes)[None], rows(self.points)[None])

    def _known(self, position: Array, state: Array) -> Array:
        """Rows ``(nz, N)`` of the known motions; what is not known stays as it starts."""
        derived, first, value = self.kernels.derived, 0, 0
        rows = np.zeros((len(derived.states), position.size))
        for dof, order in zip(derived.dofs, derived.orders, strict=True):
            motion = self.motions[dof](position) if dof in self.motions else None
            if motion is not None and motion.shape[0] == order + 1:
                rows[first : first + order + 1] = motion
            else:
                rows[first] = state[value]
            first, value = first + order + 1, value + order
        return rows

    def _together(self, derivatives: bool) -> int:
        """How many vectors are solved together: a long record on a fine mesh fills the memory."""
        derived = self.kernels.derived
        size = len(derived.states) * self.points.size * (len(derived.active) if derivatives else 1)
        return max(int(MOST_BYTES / (8 * ARRAYS * max(size, 1))), 1)

    def solve(self, p: Array) -> Solution:
        """Solutions for constants ``p (L, np)``, each started from the anchor alone."""
        return self._alone(p[0]) if len(p) == 1 and self.anchor is not None else self._solved(p)

    def _solved(self, p: Array) -> Solution:
        most = self._together(derivatives=False)
        if p.shape[0] > most:
            parts = [self._solved(p[k : k + most]) for k in range(0, p.shape[0], most)]
            rows = zip(*((part.x, part.status, part.iterations) for part in parts), strict=True)
            return Solution(*map(np.concatenate, rows))
        if self.anchor is None:
            shape = (p.shape[0], self.steps, self.scheme.width)
            failed = np.full(p.shape[0], Status.NO_CONVERGENCE.value, dtype=np.int64)
            return Solution(np.full(shape, np.nan), failed, np.zeros(p.shape[0], dtype=np.int64))
        state, status = self.initial.states(p)
        x = self.anchor.predict(p[:, self.active] - self.anchor.p[self.active])
        x[:, 0, : self.scheme.state_size] = state
        found = Solution(x, status.copy(), np.zeros(p.shape[0], dtype=np.int64))
        good = status == Status.CONVERGED.value
        solution = solve_transient(self.boundary, p[good], x[good])
        found.x[good], found.status[good] = solution.x, solution.status
        found.iterations[good] = solution.iterations
        return found

    def predict(self, p: Array, *, derivatives: bool = False) -> PredictedSamples:
        """Outputs at the raw samples for constants ``p (L, np)``."""
        if not self.kernels.derived.dofs:
            status = np.zeros(p.shape[0], dtype=np.int64)
            return self._at_samples(p, None, None, status, derivatives)
        most = self._together(derivatives)
        if p.shape[0] > most:
            pieces = (p[k : k + most] for k in range(0, p.shape[0], most))
            return _joined([self.predict(piece, derivatives=derivatives) for piece in pieces])
        solution = self.solve(p)
        x_p: Array | None = None
        if derivatives:
            start = self.initial(p).by_parameter
            solution, x_p, _ = transient_sensitivities(self.boundary, p, solution, start)
        return self._at_samples(p, solution.x, x_p, solution.status, derivatives)

    def _at(self, phase: Array) -> Any:
        """Plan of the collocation for positions."""
        return self.collocation.plan(phase, self.steps, initial=True)


def follows_inputs(mesh: Mesh) -> bool:
    """Whether a mesh is one of equal steps, as chosen by the inputs of a long record."""
    return mesh.steps > MOST_INTEGRATED and bool(np.ptp(mesh.relative) < 1e-6)


def _joined(parts: list[PredictedSamples]) -> PredictedSamples:
    """Predictions of some vectors after each other."""
    derivatives = [part.y_p for part in parts if part.y_p is not None]
    return PredictedSamples(
        np.concatenate([part.y for part in parts]),
        np.concatenate(derivatives) if derivatives else None,
        np.concatenate([part.status for part in parts]),
    )


def _rests(now: Array, before: Array) -> bool:
    """Whether rows ``(nz, N)`` of a motion have changed by next to nothing."""
    size = np.abs(now).max(axis=1)
    return bool((np.abs(now - before).max(axis=1) <= SETTLED * size).all())
