"""Prediction of one periodic run, with sensitivities: model outputs at raw samples."""

from __future__ import annotations

import threading
from dataclasses import astuple, dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np

from bayesoleo._types import Array, Bool, Flags, Float, Int, Integers
from bayesoleo.errors import CampaignError, ModelError
from bayesoleo.model._expressions import COSINE, SINE, TIME, WITHIN
from bayesoleo.model._kernels import Kernels
from bayesoleo.model._model import Model
from bayesoleo.prediction._inputs import RowCache, input_rows
from bayesoleo.prediction._kept_by_record import KeptByRecord
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._stability import unstable_of
from bayesoleo.prediction._starts import (
    PATH_PIECES,
    Anchor,
    KnownRows,
    Motion,
    guesses_of,
    solve_from_shot,
)
from bayesoleo.prediction._sum_of_squares import FusedOutputs, squared_distances
from bayesoleo.solvers._collocation import Collocation, SamplePlan
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import (
    Boundary,
    Solution,
    Trial,
    sensitivities,
    sensitivities_at,
    solve_extrapolated,
    solve_from_guess,
    solve_periodic,
)
from bayesoleo.solvers._schemes import scheme

#: Parameter vectors whose samples are evaluated together.
CHUNK = 8
#: Steps of a period up to which its factorisation takes some tens of milliseconds.
FEW_STEPS = 1024
#: Damped steps of Newton's method from a predicted motion, in a first attempt, and undamped ones
#: after it, before it has as many damped ones as ever: damped steps are caught between the kinks of
#: friction with clearance. Smooth motions converge in two. About an estimate of such friction, 4
#: damped ones solve 38 % of the vectors, 10 solve half, and 40 solve 85 % in 2.6 times as long; 200
#: undamped ones leave one in 100. After 4 damped ones a density takes 0.86 times as long as after
#: 10.
FIRST_DAMPED, WHOLE_STEPS, DAMPED_STEPS = 4, 200, 40
#: Whole steps by which states are sought that follow a known motion. A solution on another mesh
#: differs from that motion by less than this part of its size about its mean, and another motion by
#: more. A coordinate at rest may differ by this part of its value.
FOLLOWING, KEPT, AT_REST = 40, 1e-3, 1e-9
#: Plans of all models' samples, up to so many bytes.
_plans = KeptByRecord(1e8)
#: Threads share a run.
_COUNTING = threading.Lock()


@dataclass(frozen=True)
class PredictedSamples:
    """Predicted outputs of one run.

    Parameters
    ----------
    y : ndarray, shape (L, ny, N)
        At the raw samples, SI; NaN where the solve failed.
    y_p : ndarray, shape (L, ny, na, N), or None
        Derivatives with respect to the active parameters.
    status : ndarray of int, shape (L,)
        Values of :class:`~bayesoleo.solvers.Status`.
    jumped : ndarray of bool, shape (L,), or None
        Whether a periodic solution left the branch of the anchor from which it was started, or
        changed the number of its unstable multipliers; None where there is no such thing.
    monodromy : ndarray, shape (L, D, D), or None
        Of the periodic solutions, where derivatives were asked for; its eigenvalues are the Floquet
        multipliers.
    """

    y: Float[Array, "vectors outputs samples"]
    y_p: Float[Array, "vectors outputs active samples"] | None
    status: Int[Integers, " vectors"]
    jumped: Bool[Flags, " vectors"] | None = None
    monodromy: Float[Array, "vectors states states"] | None = None


class RunPredictor:
    """One run of one model; all arrays that do not depend on parameters are computed once.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    kernels : Kernels
        Of that model.
    record : Record
        A periodic run.
    steps : int
        Steps of the mesh.
    scheme_name : str
        Discretisation.
    known_rows : dict, optional
        Input rows that another model of the same run has computed; this one adds to it.
    """

    #: Of a plan, with samples in the order of their phase and as they were recorded.
    _by_phase: tuple[Any, FusedOutputs | None] | None = None
    _as_recorded: tuple[Any, FusedOutputs | None] | None = None

    #: Solutions so far that left the branch of the anchor from which they were started or changed
    #: its stability, those that did the latter only, and whether they are looked for: where a
    #: solution is known, it costs more than the solution. What is not watched is only compared, and
    #: given up sooner.
    jumps, changes, watched = 0, 0, True
    #: How often a motion may still be sought by shooting; None for any number.
    shots: int | None = None

    def __init__(
        self,
        model: Model,
        kernels: Kernels,
        record: Record,
        steps: int,
        scheme_name: str,
        known_rows: RowCache | None = None,
    ):
        self.model, self.kernels, self.record, self.steps = model, kernels, record, steps
        derived = kernels.derived
        self._check(record)
        if any(expression.has(TIME) for expression in derived.residual):
            raise ModelError(
                f"model {model.name!r}: an equation depends on time, so that nothing periodic "
                f"solves it, and run {record.label} is periodic",
                hint="use time in outputs, or in equations of transients only",
            )
        self.scheme, self.scheme_name = scheme(scheme_name, derived.orders), scheme_name
        self.period = 1.0 / record.frequency
        self.points = self.scheme.phases(steps)
        self.known_rows: RowCache = {} if known_rows is None else known_rows
        #: Channels' rows that guesses took so far, at nodes and at collocation points.
        self._guessed: tuple[KnownRows, KnownRows] = ({}, {})
        grid = f"{scheme_name} {steps}"
        self.boundary = Boundary(
            equations=kernels,
            scheme=self.scheme,
            period=self.period,
            inputs=input_rows(record, derived.inputs, self.points, grid, self.known_rows),
            conditions=len(derived.admissible),
            active=len(derived.active),
        )
        self.plan = self._plan_of_samples() if derived.dofs else None
        self.motions: dict[str, Motion] = {}
        self._observe(record.phase)

    def _plan_of_samples(self) -> Any:
        """Plan of the scheme for the samples, which all models of the run share."""
        if not isinstance(self.scheme, Collocation):
            return self.scheme.plan(self.record.phase, self.steps)

        def made() -> Array:
            plan = self.scheme.plan(self.record.phase, self.steps)
            rows = [part[None] if part.ndim == 1 else part for part in astuple(plan)]
            return np.concatenate(rows, dtype=float)

        # Copies may be written to: kernels would compile once more for arrays that may not.
        key = "plan", self.scheme_name, self.steps
        kept = _plans.of(self.record, key, made)
        weights = np.split(kept[2:].copy(), 3)
        return SamplePlan(kept[0].astype(np.int64), kept[1].copy(), *weights)

    def _observe(self, position: Array) -> None:
        """What is measured, the inputs at the samples, and no solution yet."""
        derived, record = self.kernels.derived, self.record
        self.sample_inputs = input_rows(
            record, derived.inputs, position, "samples", self.known_rows
        )
        self.measured = np.stack([record.samples[name] for name in derived.outputs])
        self.anchor: Anchor | None = None
        self.active = np.array(
            [derived.constants.index(name) for name in derived.active], dtype=np.int64
        )

    def _check(self, record: Record) -> None:
        # An input may be one measured channel at the harmonics of another.
        needed = [part for name in self.model.inputs for part in name.split(WITHIN)]
        known = {*record.samples, COSINE, SINE}
        missing = [name for name in (*needed, *self.model.outputs) if name not in known]
        if missing:
            raise CampaignError(
                f"model {self.model.name!r} needs channel {missing[0]!r}, which the campaign lacks",
                run=record.label,
                hint=f"channels there are: {', '.join(record.samples)}",
            )
        for name, condition in self.model.conditions.items():
            if name not in record.conditions and condition.default is None:
                raise CampaignError(
                    f"model {self.model.name!r} needs condition {name!r}",
                    run=record.label,
                    hint=f'write {name} = {{ value = …, unit = "{condition.unit}" }} '
                    "under [runs.conditions]",
                )

    def found(self) -> dict[str, Any]:
        """What does not follow from model, record and mesh, to be given to :meth:`restore`."""
        return {"anchor": self.anchor, "measured": self.measured}

    def restore(self, found: dict[str, Any]) -> None:
        """Take over what :meth:`found` gave of the same run, here or in another process."""
        vars(self).update(found)

    @property
    def is_long(self) -> bool:
        """Whether the inputs of a transient choose its steps."""
        return False

    @property
    def can_be_coarser(self) -> bool:
        """Whether fewer steps than an integrator's may do; of a periodic run nobody chose any."""
        return False

    @property
    def can_be_joined(self) -> bool:
        """Whether a comparison may do with fewer steps than were chosen."""
        return bool(self.kernels.derived.dofs)

    def base_constants(self) -> Array:
        """Nominal parameters and this run's conditions, shape (np,)."""
        values = []
        for name in self.kernels.derived.constants:
            if name in self.model.parameters:
                values.append(self.model.parameters[name].value)
            else:
                default = self.model.conditions[name].default
                values.append(
                    self.record.conditions.get(name, np.nan if default is None else default)
                )
        return np.array(values)

    def known_motions(self) -> dict[str, Motion]:
        """The anchored motion of each dof, from which an extended model of the run can start."""
        if self.anchor is None:
            return {}
        starts = np.cumsum([0, *(order + 1 for order in self.kernels.derived.orders)])
        return {
            dof: partial(self._rows_of, int(starts[k]), int(starts[k + 1]))
            for k, dof in enumerate(self.kernels.derived.dofs)
        }

    def _rows_of(self, first: int, last: int, phase: Array) -> Array:
        assert self.anchor is not None
        return self.rows(self.anchor.x, phase)[first:last]

    def rows(self, x: Array, phase: Array) -> Array:
        """Values and derivatives of all dofs at phases ``(N,)`` in cycles, shape (nz, N), of
        unknowns ``x (n, w)``; of their derivatives ``(n, w, na)``, shape (nz, na, N)."""
        alone = x.ndim == 2
        step = self.boundary.step(self.steps)
        found = self.scheme.sample(x[None, :, :, None] if alone else x[None], self._at(phase), step)
        return np.asarray(found[0, :, 0] if alone else found[0])

    def _at(self, phase: Array) -> Any:
        """Plan of the scheme for phases."""
        return self.scheme.plan(phase, self.steps)

    def guess(self, p: Array) -> Array:
        """First guess of the unknowns at constants ``p (np,)``, shape (1, n, w)."""
        return self._guesses(p[None])

    def _guesses(self, p: Array) -> Array:
        """First guesses at constants ``p (L, np)``, shape (L, n, w)."""
        derived = self.kernels.derived
        constants = [dict(zip(derived.constants, row, strict=True)) for row in p]
        nodes = np.arange(self.steps) / self.steps
        at_nodes, at_points = (
            guesses_of(self.model, derived, self.record, constants, phase, self.motions, known)
            for phase, known in zip((nodes, self.points), self._guessed, strict=True)
        )
        return self.scheme.from_motion(at_nodes, at_points)

    def set_anchor(self, p: Array) -> Status:
        """Solve at constants ``p (np,)`` and keep the solution as the start of later ones."""
        if not self.kernels.derived.dofs:
            return Status.CONVERGED
        solution = self._from_anchor(p[None]) if self.anchor is not None else None
        if solution is None or solution.status[0] != Status.CONVERGED.value:
            solution = self.solve_from_guess(p)
        if solution.status[0] == Status.CONVERGED.value:
            solution, x_p, monodromy = sensitivities(self.boundary, p[None], solution)
            if solution.status[0] == Status.CONVERGED.value:
                moved = np.ascontiguousarray(np.moveaxis(x_p[0], 2, 0))
                anchor = Anchor(p.copy(), solution.x[0], moved, monodromy[0])
                if self.watched:
                    anchor = anchor.after(self.anchor, self.boundary, self.active)
                self.anchor = anchor
                self.jumps += anchor.jumped
                self.changes += anchor.changed
        return Status(int(solution.status[0]))

    def solve_from_guess(self, p: Array) -> Solution:
        """Periodic solution at constants ``p (np,)`` without an anchor."""
        guess = self.guess(p)
        solution = solve_from_guess(self.boundary, p[None], guess, exchange=self._exchanges)
        # Equations of what lags behind a motion are singular at rest, wherever their answer is.
        if solution.status[0] not in (Status.NO_CONVERGENCE.value, Status.SINGULAR.value):
            return solution
        if (self.anchor is not None and not self.watched) or self.shots == 0:
            # A step of an estimate that is only compared: half of it takes less time than shooting
            # through hundreds of cycles of a broadband input.
            return solution
        self.shots = None if self.shots is None else self.shots - 1
        if self.anchor is not None:
            guess = self.anchor.x[None]  # nearer, so that shooting takes fewer passes
        found = solve_from_shot(self.model, self.kernels, self.record, self.boundary, p, guess)
        return solution if found is None else found

    @property
    def _exchanges(self) -> bool:
        """Whether to go on where an elimination has to exchange rows: each iteration then takes a
        factorisation of the whole period, too long for a model that is only compared."""
        return self.watched or self.steps <= FEW_STEPS

    def _from_anchor(self, p: Array) -> Solution:
        anchor = self.anchor
        assert anchor is not None
        change = p[:, self.active] - anchor.p[self.active]
        extrapolation, compiled = anchor.extrapolation, self.boundary.arranged is not None
        most = FIRST_DAMPED if compiled else DAMPED_STEPS
        solution = solve_extrapolated(
            self.boundary, p, extrapolation, change, max_iterations=most, exchange=self._exchanges
        )
        if compiled:
            solution = self._once_more(p, solution, change, undamped=True)
            solution = self._once_more(p, solution, change, undamped=False)
        for pieces in PATH_PIECES:
            failed = np.flatnonzero(solution.status != Status.CONVERGED.value)
            for lane in failed:
                solution = self._along_path(p, solution, int(lane), pieces)
        return solution

    def _once_more(
        self, p: Array, solution: Solution, change: Array, *, undamped: bool
    ) -> Solution:
        """Lanes that have not converged, from their predictions with more steps. Of whole steps,
        which may reach any motion, only one near its prediction is taken."""
        anchor = self.anchor
        assert anchor is not None
        failed = np.flatnonzero(solution.status == Status.NO_CONVERGENCE.value)
        if not failed.size:
            return solution
        start = anchor.predict(change[failed])
        trial = solve_periodic(
            self.boundary, p[failed], start, overwrite=True,
            max_iterations=WHOLE_STEPS if undamped else DAMPED_STEPS,
            monotone=not undamped, exchange=not undamped and self._exchanges,
        )  # fmt: skip
        found = trial.status == Status.CONVERGED.value
        if undamped:
            found &= ~anchor.left_by(change[failed], trial.x)
        x, status = solution.x, solution.status.copy()
        told = found if undamped else np.ones_like(found)
        x[failed[found]], status[failed[told]] = trial.x[found], trial.status[told]
        return replace(solution, x=x, status=status)

    def _along_path(self, p: Array, solution: Solution, lane: int, pieces: int) -> Solution:
        """Walk from the anchor to one lane's parameters in equal pieces.

        What is only compared is not led by where rows have to be exchanged: the way to a mirrored
        vector goes through equations without an answer, and takes a hundred times as long.
        """
        anchor = self.anchor
        assert anchor is not None
        x = anchor.x[None]
        for fraction in np.linspace(0.0, 1.0, pieces + 1)[1:]:
            between = anchor.p + fraction * (p[lane] - anchor.p)
            trial = solve_periodic(
                self.boundary, between[None], x, max_iterations=15, exchange=self.watched
            )
            if trial.status[0] != Status.CONVERGED.value:
                return solution
            x = trial.x
        result, status = solution.x.copy(), solution.status.copy()
        result[lane], status[lane] = x[0], Status.CONVERGED.value
        return replace(solution, x=result, status=status)

    def solve(self, p: Array) -> Solution:
        """Periodic solutions for constants ``p (L, np)``; the anchor must be set."""
        if self.anchor is None:
            count = p.shape[0]
            failed = np.full(count, Status.NO_CONVERGENCE.value, dtype=np.int64)
            empty = np.zeros((count, self.steps, self.scheme.width))
            return Solution(empty, failed, np.zeros(count, dtype=np.int64))
        return self._from_anchor(p)

    def predict(self, p: Array, *, derivatives: bool = False) -> PredictedSamples:
        """Outputs at the raw samples for constants ``p (L, np)``."""
        if not self.kernels.derived.dofs:
            status = np.zeros(p.shape[0], dtype=np.int64)
            return self._at_samples(p, None, None, status, derivatives)
        solution = self.solve(p)
        x_p: Array | None = None
        monodromy: Array | None = None
        if derivatives:
            solution, x_p, monodromy = sensitivities(self.boundary, p, solution)
        samples = self._at_samples(p, solution.x, x_p, solution.status, derivatives)
        jumped = self._left(p, solution.x, samples.status, monodromy)
        return replace(samples, jumped=jumped, monodromy=monodromy)

    def predict_at(self, p: Array, chosen: Integers) -> PredictedSamples:
        """The same at some of the samples alone, ``chosen (m,)`` by their numbers: where these are
        few, only the solutions take time. Whether outputs are finite and inside the admissible
        region is judged at these samples."""
        if type(self) is not RunPredictor or not self.kernels.derived.dofs:
            every = self.predict(p)
            return replace(every, y=every.y[..., chosen])
        solution = self.solve(p)
        plan, step = self._at(self.record.phase[chosen]), self.boundary.step(self.steps)
        z = self.scheme.sample(solution.x[..., None], plan, step)[:, :, 0]
        inputs = np.ascontiguousarray(self.sample_inputs[:, chosen])
        y, status = self._only_outputs(p, z, inputs, solution.status)
        return PredictedSamples(y, None, status, self._left(p, solution.x, status))

    def sample_rest(self, p: Array) -> PredictedSamples:
        """Equations at rest, and outputs as if rest solved them, with derivatives, at constants
        ``p (1, np)``: what that needs is compiled then."""
        lanes = np.zeros(1, dtype=np.int64)
        x = np.zeros((1, self.steps, self.scheme.width))
        Trial(self.boundary, p, x).evaluate(lanes)
        return self._at_samples(p, x, np.ones((*x.shape, len(self.active))), lanes, True)

    def compare_rest(self, p: Array) -> PredictedSamples:
        """Compare rest with the samples as solutions are, at constants ``p (1, np)``, and make it
        the anchor: what that needs is compiled then."""
        x = np.zeros((1, self.steps, self.scheme.width))
        moved = np.zeros((len(self.active), *x.shape[1:]))
        self.anchor = Anchor(p[0], x[0], moved, np.zeros((self.scheme.state_size,) * 2))
        self.anchor.left_by(np.zeros((1, len(self.active))), x)
        return self._at_samples(p, x, None, np.zeros(1, dtype=np.int64), derivatives=False)

    def _left(self, p: Array, x: Array, status: Integers, monodromy: Array | None = None) -> Flags:
        """Whether solutions that converged left the anchor's branch, which is counted."""
        anchor = self.anchor
        if not self.watched or anchor is None or anchor.monodromy is None:  # of a transient
            return np.zeros(p.shape[0], dtype=np.bool_)
        good = status == Status.CONVERGED.value
        left = anchor.left_by(p[:, self.active] - anchor.p[self.active], x) & good
        for lane in np.flatnonzero(left):  # few: those that the prediction misses by far
            left[lane] = not anchor.leads_to(p[lane], x[lane], self.boundary, self.active)
        changed = np.zeros_like(left)
        if monodromy is not None:
            changed = good & ~left & (unstable_of(monodromy) != anchor.unstable)
        left |= changed
        if left.any():
            with _COUNTING:
                self.jumps += int(left.sum())
                self.changes += int(changed.sum())
        return cast(Flags, left)

    def evaluate(self, p: Array) -> PredictedSamples:
        """Set the anchor at constants ``p (np,)``, and take outputs with derivatives from it.

        One solve does for both, where :meth:`predict` would repeat it.
        """
        status = np.array([self.set_anchor(p)], dtype=np.int64)
        if not self.kernels.derived.dofs:
            return self._at_samples(p[None], None, None, status, derivatives=True)
        if self.anchor is None or status[0] != Status.CONVERGED.value:
            return self._failed(Status(int(status[0])))
        x_p = np.moveaxis(self.anchor.x_p, 0, 2)[None]
        samples = self._at_samples(p[None], self.anchor.x[None], x_p, status, derivatives=True)
        monodromy = None if self.anchor.monodromy is None else self.anchor.monodromy[None]
        return replace(samples, jumped=np.array([self.anchor.jumped]), monodromy=monodromy)

    def _failed(self, status: Status) -> PredictedSamples:
        """One vector's samples where there is no solution."""
        shape = (1, len(self.kernels.derived.outputs), len(self.active), self.record.time.size)
        nothing = np.full((1, shape[1], shape[3]), np.nan), np.full(shape, np.nan)
        return PredictedSamples(*nothing, np.array([status.value], dtype=np.int64))

    def solved_anew(self, p: Array) -> PredictedSamples:
        """Outputs at constants ``p (np,)``, which the anchor is set at first."""
        status = self.set_anchor(p)
        return self.predict(p[None]) if status is Status.CONVERGED else self._failed(status)

    def known_at(self, p: Array) -> PredictedSamples | None:
        """Outputs with derivatives at constants ``p (np,)`` where they are known; of periodic runs
        :meth:`predict` also tells whether a solution left its branch."""
        return None

    @property
    def shows_outputs_first(self) -> bool:
        """Whether outputs cost far less without derivatives, and do not depend on the anchor but
        for round-off: the branch of a periodic solution does."""
        return not self.kernels.derived.dofs

    def evaluate_on(self, other: RunPredictor, p: Array) -> PredictedSamples | None:
        """Outputs with derivatives where constants leave the motion of another model unchanged.

        Nothing is solved but the derivatives, by one elimination for all sets of constants. The
        motion becomes the anchor.

        Parameters
        ----------
        other : RunPredictor
            The same run under a model that this one extends, at its anchor.
        p : ndarray, shape (L, np)
            Constants at which the extension is absent.

        Returns
        -------
        PredictedSamples or None
            None where the models have other states or meshes, or the motion is another one.
        """
        motion = other.anchor
        if motion is None or not self._moves_like(other):
            return None
        found = sensitivities_at(self.boundary, p, motion.x)
        if found is None:
            return None
        x_p, monodromy = found
        moved = np.ascontiguousarray(np.moveaxis(x_p[0], 2, 0))
        self.anchor = Anchor(p[0].copy(), motion.x, moved, monodromy[0])
        x = np.repeat(motion.x[None], len(p), axis=0)
        status = np.full(len(p), Status.CONVERGED.value, dtype=np.int64)
        return self._at_samples(p, x, x_p, status, derivatives=True)

    def follow(self, p: Array) -> PredictedSamples | None:
        """Outputs with derivatives where states follow :attr:`motions`, or what drives the model,
        and act on neither.

        All start from guesses, and take whole steps. What lags behind a motion, or is dragged along
        by it, is found in a few of these; with a residual that has to fall the iteration is caught
        between the kinks of a clearance, and a solution for other constants leads nowhere. The
        first solution becomes the anchor.

        Parameters
        ----------
        p : ndarray, shape (L, np)
            Constants at which the states act on nothing.

        Returns
        -------
        PredictedSamples or None
            Without a solution where the motion would be another one. None where there is no
            solution at all, or another integrator makes it.
        """
        if type(self) is not RunPredictor:
            return None
        guesses = self._guesses(p)
        solution = solve_periodic(
            self.boundary, p, guesses, max_iterations=FOLLOWING, monotone=False, exchange=False
        )
        solution, x_p, monodromy = sensitivities(self.boundary, p, solution)
        status = solution.status.copy()
        lanes = np.flatnonzero(status == Status.CONVERGED.value)
        other = ~self._are_known(solution.x[lanes], guesses[lanes])
        status[lanes[other]] = Status.NO_CONVERGENCE.value
        solved = np.flatnonzero(status == Status.CONVERGED.value)
        if not solved.size:
            return None
        k = int(solved[0])
        moved = np.ascontiguousarray(np.moveaxis(x_p[k], 2, 0))
        samples = self._at_samples(p, solution.x, x_p, status, derivatives=True)
        if not (samples.status == Status.CONVERGED.value).any():
            return None
        self.anchor = Anchor(p[k].copy(), solution.x[k], moved, monodromy[k])
        return samples

    def _are_known(self, x: Array, guesses: Array) -> Flags:
        """Whether dofs whose motions are known move as they were guessed to, ``(L,)``, in unknowns
        ``x (L, n, w)``."""
        derived, step = self.kernels.derived, self.boundary.step(self.steps)
        starts = np.cumsum([0, *(order + 1 for order in derived.orders)])
        known = [
            int(a) for dof, a in zip(derived.dofs, starts, strict=False) if dof in self.motions
        ]
        plan = self._at(np.arange(self.steps) / self.steps)
        found, expected = (
            self.scheme.sample(unknowns[..., None], plan, step)[:, known, 0]
            for unknowns in (x, guesses)
        )
        away = np.linalg.norm(found - expected, axis=2)
        about = np.linalg.norm(expected - expected.mean(axis=2, keepdims=True), axis=2)
        whole = np.linalg.norm(expected, axis=2)
        same = away <= np.maximum(KEPT * about, AT_REST * whole)
        return np.asarray(same.all(axis=1), dtype=np.bool_)

    def _moves_like(self, other: RunPredictor) -> bool:
        """Whether unknowns mean the same: one mesh, and the same states in the same order."""
        if not type(self) is type(other) is RunPredictor:
            return False
        mine, its = self.kernels.derived, other.kernels.derived
        same = mine.dofs == its.dofs and mine.orders == its.orders and bool(mine.dofs)
        return same and (self.steps, self.scheme_name) == (other.steps, other.scheme_name)

    def _at_samples(
        self,
        p: Array,
        x: Array | None,
        x_p: Array | None,
        status: Integers,
        derivatives: bool,
    ) -> PredictedSamples:
        """Outputs of solutions ``x (L, n, w)`` with their derivatives ``x_p (L, n, w, na)``."""
        fused = None if derivatives or x is None else self._fused_outputs(by_phase=False)
        if fused is not None and x is not None:
            lanes = np.flatnonzero(status == Status.CONVERGED.value)
            step = self.boundary.step(self.steps)
            y, inside, defined = fused.outputs(self.measured, x, p, step, lanes)
            status = _failing(status, lanes, defined[lanes], inside[lanes])
            y[status != Status.CONVERGED.value] = np.nan
            return PredictedSamples(y, None, status)
        z = self._rows_at_samples(None if x is None else x[..., None], p)[:, :, 0]
        if not derivatives or x_p is None:
            return self._outputs(p, z, None, status, derivatives)
        # Most parameters of a force law act on its outputs alone, and move no state.
        moves = x_p.any(axis=(0, 1, 2))
        few = x_p if moves.all() else np.ascontiguousarray(x_p[..., moves])
        return self._outputs(p, z, (self._rows_at_samples(few, p), moves), status, derivatives)

    def _outputs(
        self,
        p: Array,
        z: Array,
        moved: tuple[Array, Flags] | None,
        status: Integers,
        derivatives: bool,
    ) -> PredictedSamples:
        """Outputs of rows ``z (L, nz, N)`` at the samples, and derivatives, with those of the rows
        by the parameters that move them, and which these are."""
        lanes = np.flatnonzero(status == Status.CONVERGED.value)
        y, status = self._only_outputs(p, z, self.sample_inputs, status)
        if not derivatives:
            return PredictedSamples(y, None, status)
        count, ny, samples = y.shape
        na = len(self.kernels.derived.active)
        yz, yp = np.zeros((count, ny, z.shape[1], samples)), np.zeros((count, ny, na, samples))
        with np.errstate(all="ignore"):
            self.kernels.output_jacobian(z, self.sample_inputs, p, lanes, yz, yp)
        if moved is not None:
            z_p, moves = moved
            through = np.einsum("lyzn,lzan->lyan", yz, z_p)
            if moves.all():
                yp += through
            else:
                yp[:, :, moves] += through
        return PredictedSamples(y, yp, status)

    def _only_outputs(
        self, p: Array, z: Array, inputs: Array, status: Integers
    ) -> tuple[Array, Integers]:
        """Outputs ``(L, ny, N)`` of rows ``z (L, nz, N)`` and ``inputs (nu, N)``, and statuses with
        those of lanes whose outputs are not finite or leave the admissible region."""
        lanes = np.flatnonzero(status == Status.CONVERGED.value)
        y = np.full((p.shape[0], len(self.kernels.derived.outputs), inputs.shape[1]), np.nan)
        with np.errstate(all="ignore"):
            self.kernels.output(z, inputs, p, lanes, y)
        return y, self._judge(status, z, inputs, p, y, lanes)

    def squares(self, p: Array) -> tuple[Array, Integers]:
        """Sums of squared residuals, shape (L, ny), and statuses, for constants ``p (L, np)``; sums
        of failed lanes mean nothing.

        The same as comparing :meth:`predict` with the measurement, but fused where there is
        compiled code for it.
        """
        fused = self._fused_outputs(by_phase=True)
        if fused is None:
            return self._squares_of_predictions(p)
        solution = self.solve(p)
        lanes = np.flatnonzero(solution.status == Status.CONVERGED.value)
        step = self.boundary.step(self.steps)
        sums, inside, defined = fused.sums(self.measured, solution.x, p, step, lanes)
        finite = defined[lanes] & np.isfinite(sums[lanes]).all(axis=1)
        status = _failing(solution.status, lanes, finite, inside[lanes])
        self._left(p, solution.x, status)
        return sums, status

    def _fused_outputs(self, *, by_phase: bool) -> FusedOutputs | None:
        """Of the present plan: a transient's changes with its mesh."""
        # Samples of a transient have the order of their phase.
        name = "_by_phase" if by_phase and self.record.periodic else "_as_recorded"
        known: tuple[Any, FusedOutputs | None] | None = getattr(self, name)
        if known is None or known[0] is not self.plan:
            made = FusedOutputs.of(
                self.kernels, self.scheme, self.plan, self.sample_inputs, by_phase=by_phase
            )
            known = self.plan, made
            setattr(self, name, known)
        return known[1]

    def _squares_of_predictions(self, p: Array) -> tuple[Array, Integers]:
        """Through predictions of a few vectors at a time."""
        parts = [self.predict(p[first : first + CHUNK]) for first in range(0, len(p), CHUNK)]
        squares = [squared_distances(self.measured, part.y) for part in parts]
        return np.concatenate(squares), np.concatenate([part.status for part in parts])

    def _rows_at_samples(self, x: Array | None, p: Array) -> Array:
        """Values and derivatives of the dofs at the raw samples, shape (L, nz, C, N)."""
        if x is None:
            return np.empty((p.shape[0], 0, 1, self.record.time.size))
        return self.scheme.sample(x, self.plan, self.boundary.step(self.steps))

    def _judge(
        self, status: Integers, z: Array, inputs: Array, p: Array, y: Array, lanes: Integers
    ) -> Integers:
        """Mark lanes whose outputs are not finite or whose samples leave the admissible region."""
        finite = np.isfinite(y).all(axis=(1, 2))[lanes]
        inside = np.ones(lanes.size, dtype=np.bool_)
        if self.boundary.conditions:
            a = np.ones((p.shape[0], self.boundary.conditions, y.shape[2]))
            with np.errstate(all="ignore"):
                self.kernels.admissible(z, inputs, p, lanes, a)
                # A minimum that keeps what is no number, and one that leaves it out.
                finite &= ~np.isnan(a.min(axis=(1, 2), initial=np.inf)[lanes])
                inside = np.fmin.reduce(a, axis=(1, 2), initial=np.inf)[lanes] > 0
        status = _failing(status, lanes, finite, inside)
        y[status != Status.CONVERGED.value] = np.nan
        return status


def _failing(status: Integers, lanes: Integers, finite: Flags, inside: Flags) -> Integers:
    """Statuses (L,) with those of the chosen lanes that are not finite or not inside."""
    status = status.copy()
    status[lanes[~finite]] = Status.NOT_FINITE.value
    status[lanes[~inside]] = Status.INADMISSIBLE.value
    return status
