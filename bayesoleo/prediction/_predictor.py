"""Prediction of all runs of a campaign, for one or many vectors of unknowns.

It assigns each unknown to its place in the model: shared ones once, by-run ones once for each run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesoleo._parallel import available_cores, shared_size, thread_map
from bayesoleo._types import Array, Float, Int, Integers
from bayesoleo.errors import ModelError
from bayesoleo.model._drive_and_start import start_parameters
from bayesoleo.model._kernels import kernels
from bayesoleo.model._model import Model
from bayesoleo.model._priors import Prior
from bayesoleo.prediction._mesh_steps import fineness
from bayesoleo.prediction._periodic_run import PredictedSamples, RunPredictor
from bayesoleo.prediction._periodic_solver import SolvedRun
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._transient_run import TransientRun
from bayesoleo.solvers._orbit import Status, first_failure
from bayesoleo.solvers._schemes import COLLOCATION, DEFAULT_SCHEME

#: Parameter vectors of one task: enough to share a run's inputs, few enough to stay in the cache.
BLOCK = 32


@dataclass(frozen=True)
class Layout:
    """Maps a vector of unknowns to each run's model parameters.

    Parameters
    ----------
    names : tuple of str
        Unknowns: ``damping``, or ``offset[run]`` for a parameter that varies by run.
    parameters : tuple of str
        The model's parameter behind each unknown.
    runs : tuple of str
        Labels of the runs.
    columns : tuple of ndarray of int, shape (na,)
        For each run, the unknown behind each of its active parameters.
    active : tuple of tuple of str
        For each run, the estimated parameters that it depends on, in the model's order: a periodic
        run has no start.
    """

    names: tuple[str, ...]
    parameters: tuple[str, ...]
    runs: tuple[str, ...]
    columns: tuple[Integers, ...]
    active: tuple[tuple[str, ...], ...]

    @classmethod
    def of(cls, model: Model, runs: Sequence[str], periodic: Sequence[bool] = ()) -> Layout:
        """Layout of a model's estimated parameters over runs.

        Parameters
        ----------
        model : Model
        runs : sequence of str
            Their labels.
        periodic : sequence of bool, optional
            Which of them are periodic; by default none.
        """
        kinds = list(periodic) or [False] * len(runs)
        starts = start_parameters(model) if any(kinds) else frozenset()
        active = [
            tuple(name for name in model.estimated() if not (kind and name in starts))
            for kind in kinds
        ]
        names: list[str] = []
        owners: list[str] = []
        columns: list[list[int]] = [[] for _ in runs]
        for name in model.estimated():
            used = [r for r, own in enumerate(active) if name in own]
            by_run = model.parameters[name].by_run
            for k, r in enumerate(used):
                columns[r].append(len(names) + (k if by_run else 0))
            new = [f"{name}[{runs[r]}]" for r in used] if by_run else [name]
            names, owners = names + new, owners + [name] * len(new)
        places = tuple(np.array(own, dtype=np.int64) for own in columns)
        return cls(tuple(names), tuple(owners), tuple(runs), places, tuple(active))

    @classmethod
    def of_records(cls, model: Model, records: Sequence[Record]) -> Layout:
        """Layout of a model's estimated parameters over measured runs."""
        labels = [record.label for record in records]
        return cls.of(model, labels, [record.periodic for record in records])

    def priors(self, model: Model) -> tuple[Prior, ...]:
        """Prior of each unknown.

        Raises
        ------
        ModelError
            If an estimated parameter has none.
        """
        priors = []
        for name in self.parameters:
            prior = model.parameters[name].prior
            if prior is None:
                raise ModelError(
                    f"model {model.name!r}: parameter {name!r} has no prior",
                    hint="give it sd=…, relative_sd=…, bounds=(low, high) or prior=…, "
                    "or write fixed=True",
                )
            priors.append(prior)
        return tuple(priors)

    def start(self, model: Model) -> Array:
        """Nominal values of the unknowns, shape (l,)."""
        return np.array([model.parameters[name].value for name in self.parameters])


@dataclass(frozen=True)
class RunPrediction:
    """Prediction of one run at one vector of unknowns.

    Parameters
    ----------
    y : ndarray, shape (ny, N)
        Outputs at the raw samples, SI.
    sensitivity : ndarray, shape (ny, l, N)
        Derivatives with respect to all unknowns.
    status : Status
    jumped : bool
        Whether the periodic solution left the branch of the one it was started from.
    monodromy : ndarray, shape (D, D), or None
        Of the periodic solution; its eigenvalues are the Floquet multipliers.
    """

    y: Float[Array, "outputs samples"]
    sensitivity: Float[Array, "outputs unknowns samples"]
    status: Status
    jumped: bool = False
    monodromy: Float[Array, "states states"] | None = None


class Predictor:
    """A model over the runs of a campaign.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    records : sequence of Record
        The runs.
    steps : int
        Steps of the mesh in a period. Where all runs are transients, how finely their steps are
        cut; beside periodic runs that follows from how much more these take than their first.
    scheme : str
        Discretisation: ``radau2``, ``radau3``, ``gauss2``, ``gauss3`` or ``thesis``.
    solver : str
        Of periodic runs, see :func:`~bayesoleo.prediction.periodic_orbit`; a transient is
        solved by collocation.
    backend : {"numba", "numpy"}
        Kernels; NumPy's are ready at once.
    jobs : int, optional
        Threads.
    share : Predictor, optional
        Of other models of the same runs; input rows are computed once for all.
    """

    def __init__(
        self,
        model: Model,
        records: Sequence[Record],
        *,
        steps: int = 256,
        scheme: str = DEFAULT_SCHEME,
        solver: str = COLLOCATION,
        backend: str = "numba",
        jobs: int | None = None,
        share: Predictor | None = None,
    ):
        self.model, self.records, self.steps, self.scheme, self.jobs = (
            model,
            tuple(records),
            steps,
            scheme,
            jobs,
        )
        self.backend, self.solver = backend, solver
        #: How finely transients are cut, also beside periodic runs of other steps.
        self.fineness = fineness(model, self.records, steps)
        self.layout = Layout.of_records(model, records)
        compiled = {own: kernels(model, own, backend) for own in dict.fromkeys(self.layout.active)}
        self.outputs = tuple(model.outputs)
        shared = {} if share is None else {id(run.record): run for run in share.runs}

        def build(item: tuple[Record, tuple[str, ...]]) -> RunPredictor:
            record, own = item[0], compiled[item[1]]
            like = shared.get(id(record))
            if record.periodic:
                rows = None if like is None else like.known_rows
                if solver == COLLOCATION:
                    return RunPredictor(model, own, record, steps, scheme, rows)
                return SolvedRun(model, own, record, steps, scheme, solver, backend, rows)
            same = like if isinstance(like, TransientRun) else None
            return TransientRun(model, own, record, self.fineness, scheme, same)

        self.runs: list[RunPredictor] = thread_map(
            build, list(zip(self.records, self.layout.active, strict=True)), jobs
        )
        self._base = np.stack([run.base_constants() for run in self.runs])
        #: Of the last evaluation, the first run that could not be solved.
        self._failed: int | None = None

    def __copy__(self) -> Predictor:
        """A copy that shares everything, and not one made anew of a state."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        return other

    def __getstate__(self) -> dict[str, Any]:
        """State from which another process makes the same predictor, without compiled code."""
        names = ("model", "records", "steps", "scheme", "solver", "backend", "jobs")
        return {name: getattr(self, name) for name in names} | {
            "found": [run.found() for run in self.runs]
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        found, model, records = (state.pop(name) for name in ("found", "model", "records"))
        Predictor.__init__(self, model, records, **state)
        for run, known in zip(self.runs, found, strict=True):
            run.restore(known)

    def constants(
        self, theta: Float[Array, "vectors unknowns"], run: int
    ) -> Float[Array, "vectors constants"]:
        """Model constants of a run, shape (L, np), from unknowns of shape (L, l)."""
        p = np.repeat(self._base[run][None], theta.shape[0], axis=0)
        p[:, self.runs[run].active] = theta[:, self.layout.columns[run]]
        return p

    def set_anchor(self, theta: Float[Array, " unknowns"]) -> list[Status]:
        """Solve every run at ``theta (l,)`` and start later solutions from there."""
        work = range(len(self.runs))
        return thread_map(
            lambda r: self.runs[r].set_anchor(self.constants(theta[None], r)[0]), work, self.jobs
        )

    def solved_anew(self, theta: Float[Array, " unknowns"]) -> list[PredictedSamples]:
        """Outputs of every run at ``theta (l,)`` without sensitivities, whether or not it has an
        anchor."""
        work = range(len(self.runs))
        return thread_map(
            lambda r: self.runs[r].solved_anew(self.constants(theta[None], r)[0]), work, self.jobs
        )

    def predict(self, theta: Float[Array, " unknowns"]) -> list[RunPrediction]:
        """Outputs and sensitivities of every run at ``theta (l,)``."""
        return thread_map(lambda r: self._predict_run(theta, r), range(len(self.runs)), self.jobs)

    def evaluate(self, theta: Float[Array, " unknowns"]) -> list[RunPrediction]:
        """Anchor every run at ``theta (l,)`` and predict it there, by one solve.

        Where runs were anchored before and one cannot be solved at ``theta``, all stay where they
        were anchored, all predictions have its status and are not finite, and the others need not
        be solved: what a step of an estimate asks is whether all can be.
        """
        everything = range(len(self.runs))
        if any(run.anchor is None for run in self.runs):
            return thread_map(lambda r: self._evaluate_run(theta, r), everything, self.jobs)
        before = [run.anchor for run in self.runs]
        found = self._until_one_fails(lambda r: self._evaluate_run(theta, r))
        self._failed = next((r for r, run in found.items() if not run.status.ok), None)
        if self._failed is None:
            return [found[r] for r in everything]
        for run, anchor in zip(self.runs, before, strict=True):
            run.anchor = anchor
        return [self._unsolved(r, found[self._failed].status) for r in everything]

    def outputs_first(self, theta: Float[Array, " unknowns"]) -> list[RunPrediction] | None:
        """Outputs of every run at ``theta (l,)`` without sensitivities; no anchor moves.

        None where that is no cheaper than :meth:`evaluate`, or the outputs may be others than
        there. Asked for the same vector next, that goes on from here. Where one run cannot be
        solved, all predictions have its status and are not finite.
        """
        if not all(run.shows_outputs_first for run in self.runs):
            return None
        found = self._until_one_fails(lambda r: self._outputs_of(theta, r))
        failed = next((r for r, run in found.items() if not run.status.ok), None)
        if failed is None:
            return [found[r] for r in range(len(self.runs))]
        self._failed = failed
        return [self._unsolved(r, found[failed].status) for r in range(len(self.runs))]

    def _outputs_of(self, theta: Array, r: int) -> RunPrediction:
        samples = self.runs[r].predict(self.constants(theta[None], r))
        nothing = np.empty((len(self.outputs), 0, samples.y.shape[2]))
        return RunPrediction(samples.y[0], nothing, Status(int(samples.status[0])))

    def _until_one_fails(self, predict: Callable[[int], RunPrediction]) -> dict[int, RunPrediction]:
        """Predictions by run, that which failed last time first, and none after one that fails; in
        several threads the others go together, whatever comes of each."""
        runs = list(range(len(self.runs)))
        if self._failed is not None:
            runs.remove(self._failed)
            runs.insert(0, self._failed)
        found: dict[int, RunPrediction] = {}
        alone = len(runs) if self.jobs == 1 else int(self._failed is not None)
        for r in runs[:alone]:
            found[r] = predict(r)
            if not found[r].status.ok:
                return found
        rest = thread_map(predict, runs[alone:], self.jobs)
        return found | dict(zip(runs[alone:], rest, strict=True))

    def _evaluate_run(self, theta: Array, r: int) -> RunPrediction:
        return self._by_unknown(r, self.runs[r].evaluate(self.constants(theta[None], r)[0]))

    def _unsolved(self, r: int, status: Status) -> RunPrediction:
        shape, unknowns = self.runs[r].measured.shape, len(self.layout.names)
        nothing = np.full((shape[0], unknowns, shape[1]), np.nan)
        return RunPrediction(np.full(shape, np.nan), nothing, status)

    def _predict_run(self, theta: Array, r: int) -> RunPrediction:
        run, constants = self.runs[r], self.constants(theta[None], r)
        known = run.known_at(constants[0])
        return self._by_unknown(r, known or run.predict(constants, derivatives=True))

    def _by_unknown(self, r: int, samples: PredictedSamples) -> RunPrediction:
        """Derivatives of one run's samples with respect to all unknowns."""
        assert samples.y_p is not None
        _, ny, _, count = samples.y_p.shape
        sensitivity = np.zeros((ny, len(self.layout.names), count))
        sensitivity[:, self.layout.columns[r]] = samples.y_p[0]
        return RunPrediction(
            samples.y[0],
            sensitivity,
            Status(int(samples.status[0])),
            samples.jumped is not None and bool(samples.jumped[0]),
            None if samples.monodromy is None else samples.monodromy[0],
        )

    def simulate(self, theta: Float[Array, "vectors unknowns"], r: int) -> PredictedSamples:
        """Outputs of run number ``r`` for many vectors, shape (L, l)."""
        return self.runs[r].predict(self.constants(theta, r))

    def simulate_at(
        self,
        theta: Float[Array, "vectors unknowns"],
        r: int,
        chosen: Int[Integers, " samples"],
    ) -> PredictedSamples:
        """The same at some samples of the run alone, given by their numbers."""
        return self.runs[r].predict_at(self.constants(theta, r), chosen)

    def sum_of_squares(
        self, theta: Float[Array, "vectors unknowns"]
    ) -> tuple[Float[Array, "vectors runs outputs"], Int[Integers, " vectors"]]:
        """Sums of squared residuals, shape (L, N, ny), and the status of each vector, shape (L,).

        Every vector's result is computed from its own lane in a fixed order, so neither the cut
        into blocks nor the threads change a bit of it.
        """
        total = np.full((len(theta), len(self.runs), len(self.outputs)), np.nan)

        def squares(r: int, lanes: Integers) -> Integers:
            total[lanes, r], status = self.runs[r].squares(self.constants(theta[lanes], r))
            return status

        status = self.by_blocks(len(theta), BLOCK, squares)
        total[status != Status.CONVERGED.value] = np.nan
        return total, status

    def by_blocks(
        self, count: int, size: int, solve: Callable[[int, Integers], Integers]
    ) -> Int[Integers, " vectors"]:
        """Solve blocks of vectors in threads, run by run.

        A vector that has no solution of one run is left out of those after it.

        Parameters
        ----------
        count : int
            Number of vectors.
        size : int
            Vectors of a block at most.
        solve : callable
            Of a run's number and numbers of vectors, (L,), their statuses, (L,).

        Returns
        -------
        ndarray of int, shape (count,)
            The first failure of each vector: it does not depend on the blocks.
        """
        status = np.zeros((count, len(self.runs)), dtype=np.int64)
        size = shared_size(count, size, self.jobs or available_cores())

        def work(start: int) -> None:
            lanes = np.arange(start, min(start + size, count))
            for r in range(len(self.runs)):
                if not lanes.size:
                    return
                status[lanes, r] = solve(r, lanes)
                lanes = lanes[status[lanes, r] == Status.CONVERGED.value]

        thread_map(work, range(0, count, size), self.jobs)
        return first_failure(status)
