"""Estimation problem of a model and the reduced runs of a campaign."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy

import numpy as np

from bayesoleo._parallel import thread_map
from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import RunSamples
from bayesoleo.error_models._signatures import Signatures
from bayesoleo.error_models._stretch import Stretch
from bayesoleo.errors import InputError
from bayesoleo.estimation._least_squares import BatchNormalEquations, reduce_rows
from bayesoleo.estimation._problem import Evaluation, Misfit
from bayesoleo.model._priors import Prior
from bayesoleo.prediction._predictor import Predictor, RunPrediction
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._orbit import Status

# Vectors that one batch of sensitivities is computed for: what they take is the raw samples of a
# run times the unknowns.
_LANES = 16


class CampaignProblem:
    """Residuals of all runs of a campaign.

    Parameters
    ----------
    predictor : Predictor
        Model and runs.
    fixed : mapping, optional
        See :meth:`holding`.
    """

    def __init__(
        self, predictor: Predictor, free: Integers | None = None, full: Array | None = None
    ):
        self.predictor = predictor
        self._last: tuple[Array, Evaluation] | None = None
        #: Of the effects that the model might lack, if they were computed.
        self.signatures: Signatures | None = None
        #: Effective number of samples by run and output, if it was computed.
        self.effective: Array | None = None
        #: To the covariance of the estimate by the spectra of the noise, if it was computed.
        self.stretch: Stretch | None = None
        layout = predictor.layout
        self._all_priors = layout.priors(predictor.model)
        self._free = np.arange(len(layout.names)) if free is None else free
        self._full = layout.start(predictor.model) if full is None else full
        self.names = tuple(layout.names[k] for k in self._free)
        self.priors: tuple[Prior, ...] = tuple(self._all_priors[k] for k in self._free)
        self.outputs = predictor.outputs
        self.runs = layout.runs
        self.counts = np.array(
            [[_count(record)] * len(self.outputs) for record in predictor.records]
        )

    def kept(self, run: int, values: Array) -> Array:
        """Of samples along the last axis of one run's arrays, those that count."""
        kept = self.predictor.records[run].kept
        return values if kept is None else values[..., kept]

    def holding(self, values: dict[str, float]) -> CampaignProblem:
        """The same problem with some unknowns held, e.g. the shared ones on a hold-out run."""
        names = self.predictor.layout.names
        full = self._full.copy()
        for name, value in values.items():
            if name in names:
                full[names.index(name)] = value
        free = np.array([k for k, name in enumerate(names) if name not in values], dtype=np.int64)
        return CampaignProblem(self.predictor, free, full)

    @property
    def nuisances(self) -> frozenset[str]:
        """Unknowns whose prior is a measurement, and counts in every estimator."""
        layout, parameters = self.predictor.layout, self.predictor.model.parameters
        owners = zip(layout.names, layout.parameters, strict=True)
        return frozenset(name for name, owner in owners if parameters[owner].measured)

    @property
    def start(self) -> Array:
        """Nominal values of the unknowns, shape (l,)."""
        return self._full[self._free]

    @property
    def branch_jumps(self) -> Integers:
        """Solutions so far, by run, that left the branch of the one they started from, (N,)."""
        return np.array([run.jumps for run in self.predictor.runs], dtype=np.int64)

    @property
    def stability_changes(self) -> Integers:
        """Those of them that changed the stability only, (N,)."""
        return np.array([run.changes for run in self.predictor.runs], dtype=np.int64)

    @contextmanager
    def unwatched(self) -> Iterator[None]:
        """Only compare solutions meanwhile; see the function of that name."""
        before = [run.watched for run in self.predictor.runs]
        for run in self.predictor.runs:
            run.watched = False
        try:
            yield
        finally:
            for run, watched in zip(self.predictor.runs, before, strict=True):
                run.watched = watched

    @contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Evaluate elsewhere meanwhile; solvers then start where they did, on their branch."""
        runs, last = self.predictor.runs, self._last
        before = [(run.found(), run.jumps, run.changes) for run in runs]
        try:
            with self.unwatched():
                yield
        finally:
            for run, (found, jumps, changes) in zip(runs, before, strict=True):
                run.restore(found)
                run.jumps, run.changes = jumps, changes
            self._last = last

    def full(self, theta: Array) -> Array:
        """All unknowns of the predictor, shape (L, all), from the free ones, shape (L, l)."""
        vectors = np.repeat(self._full[None], theta.shape[0], axis=0)
        vectors[:, self._free] = theta
        return vectors

    def evaluate(self, theta: Array) -> Evaluation:
        """Residuals and sensitivities at one vector, shape (l,).

        Every evaluation re-anchors the solver at ``theta``: an estimate walks, and starts each
        solve where it stands. Asked again for the last vector, it answers from memory.
        """
        if self._last is None or not np.array_equal(self._last[0], theta):
            self._last = (np.array(theta), self._evaluate(theta))
        return self._last[1]

    def forget(self) -> None:
        """Free the memory of the last vector: one asked for again is solved again."""
        self._last = None

    def residuals_first(self, theta: Array) -> Evaluation | None:
        """Residuals at one vector without sensitivities, where they cost far less; else None.

        The solvers stay where they are. Asked for the same vector next, :meth:`evaluate` goes on
        from here.
        """
        runs = self.predictor.outputs_first(self.full(theta[None])[0])
        return None if runs is None else self._of_runs(runs)

    def evaluate_anchored(self, theta: Array) -> Evaluation:
        """Residuals and sensitivities at one vector from the frozen anchor, which stays.

        They depend on the vector alone, as :meth:`misfit` does.
        """
        return self._of_runs(self.predictor.predict(self.full(theta[None])[0]), self._free)

    def for_thread(self) -> CampaignProblem:
        """A copy that works in one thread and counts jumps of its own, from the same anchors."""
        other = copy(self)
        other.predictor, other._last = copy(self.predictor), None
        other.predictor.jobs = 1
        other.predictor.runs = [copy(run) for run in self.predictor.runs]
        return other

    def _evaluate(self, theta: Array) -> Evaluation:
        return self._of_runs(self.predictor.evaluate(self.full(theta[None])[0]), self._free)

    def _of_runs(self, runs: Sequence[RunPrediction], free: Integers | None = None) -> Evaluation:
        """Residuals of predictions, and the sensitivities by some unknowns."""
        residual: Sequence[Sequence[Array]] = [
            list(self.kept(r, record.measured - run.y))
            for r, (record, run) in enumerate(zip(self.predictor.runs, runs, strict=True))
        ]
        outputs = range(len(self.outputs))
        chosen = np.arange(0) if free is None else free
        return Evaluation(
            residual=tuple(np.concatenate([r[b] for r in residual]) for b in outputs),
            sensitivity=tuple(
                np.concatenate(
                    [self.kept(r, run.sensitivity[b][chosen]).T for r, run in enumerate(runs)]
                )
                for b in outputs
            ),
            status=max((run.status for run in runs), default=Status.CONVERGED),
            monodromy=tuple(run.monodromy for run in runs),
        )

    def misfit(self, theta: Array) -> Misfit:
        """Sums of squares at many vectors, shape (L, l), from the frozen anchor."""
        if all(record.kept is None for record in self.predictor.records):
            return Misfit(*self.predictor.sum_of_squares(self.full(theta)))
        return self._misfit_of_the_kept(theta)

    def _misfit_of_the_kept(self, theta: Array) -> Misfit:
        """The same where some samples do not count: by way of the residuals."""
        sums = np.full((len(theta), len(self.runs), len(self.outputs)), np.nan)

        def squares(r: int, lanes: Integers) -> Integers:
            residual, status = self.residuals(theta[lanes], r)
            sums[lanes, r] = np.sum(residual**2, axis=2)
            return status

        status = self.predictor.by_blocks(len(theta), _LANES, squares)
        sums[status != Status.CONVERGED] = np.nan
        return Misfit(sums, status)

    @property
    def samples(self) -> tuple[RunSamples, ...]:
        """When the samples of each run were taken, s."""
        return tuple(
            _samples_of(record, self.kept(r, record.time), self.predictor.model.inputs)
            for r, record in enumerate(self.predictor.records)
        )

    def residuals(self, theta: Array, run: int) -> tuple[Array, Integers]:
        """Residuals (L, s, n) of one run at vectors (L, l) and statuses (L,), from the anchor."""
        samples = self.predictor.simulate(self.full(theta), run)
        left = np.subtract(self.predictor.runs[run].measured, samples.y, out=samples.y)
        return self.kept(run, left), samples.status

    def outputs_at(self, theta: Array, run: int, chosen: Integers) -> Array:
        """Outputs (L, s, m) of one run at vectors (L, l), from the anchor, at some of the samples
        that count, by their numbers (m,)."""
        kept = self.predictor.records[run].kept
        numbers = chosen if kept is None else np.flatnonzero(kept)[chosen]
        return self.predictor.simulate_at(self.full(theta), run, numbers).y

    def freeze(self, theta: Array) -> Status:
        """Fix the anchor that :meth:`misfit` starts from: it then depends on the vector alone."""
        return max(self.predictor.set_anchor(self.full(theta[None])[0]), default=Status.CONVERGED)

    @property
    def lanes(self) -> int:
        """Vectors whose sensitivities are computed together."""
        return _LANES

    @property
    def data(self) -> tuple[Array, ...]:
        """Measured samples of each output, runs one after the other, SI."""
        rows = (self.kept(r, run.measured) for r, run in enumerate(self.predictor.runs))
        columns = zip(*rows, strict=True)
        return tuple(np.concatenate(column) for column in columns)

    def with_data(self, data: Sequence[Array]) -> CampaignProblem:
        """The same problem with other measured samples, shape (n_b,) for each output.

        Raises
        ------
        InputError
            If their number is another, or they are not finite.
        """
        wanted = [column.shape for column in self.data]
        given = [np.shape(column) for column in data]
        if given != wanted or not all(np.isfinite(column).all() for column in data):
            raise InputError(
                "data must be finite and as many as the problem's",
                key="data",
                value=given,
                hint=f"give arrays of shapes {wanted}",
            )
        predictor, first = copy(self.predictor), 0
        predictor.runs = []
        for run in self.predictor.runs:
            last = first + _count(run.record)
            other = copy(run)
            fresh = np.stack([np.asarray(column[first:last]) for column in data])
            if run.record.kept is not None:
                fresh, counting = run.measured.copy(), fresh
                fresh[:, run.record.kept] = counting
            other.measured = fresh
            predictor.runs.append(other)
            first = last
        return CampaignProblem(predictor, self._free, self._full)

    def normal_equations(self, theta: Array, data: Sequence[Array]) -> BatchNormalEquations:
        """Equations at vectors (L, l), each compared with its own row of data (L, n_b).

        Solves start from the anchor; :meth:`freeze` it near the vectors.
        """
        if self.predictor.model.dofs and any(run.anchor is None for run in self.predictor.runs):
            self.freeze(self.start)
        full = self.full(theta)
        ends = np.cumsum(self.counts[:, 0])
        shape = (len(theta), len(self.outputs), full.shape[1])

        def of_run(r: int) -> BatchNormalEquations:
            samples = self.predictor.runs[r].predict(
                self.predictor.constants(full, r), derivatives=True
            )
            assert samples.y_p is not None
            columns = self.predictor.layout.columns[r]
            gram, slope = np.zeros((*shape, full.shape[1])), np.zeros(shape)
            sums = np.empty(shape[:2])
            cut = slice(ends[r] - self.counts[r, 0], ends[r])
            y, y_p = self.kept(r, samples.y), self.kept(r, samples.y_p)
            for b, column in enumerate(data):
                rows = reduce_rows(column[:, cut] - y[:, b], y_p[:, b].mT)
                gram[:, b, columns[:, None], columns], slope[:, b, columns], sums[:, b] = rows
            return BatchNormalEquations(gram, slope, sums, samples.status)

        parts = thread_map(of_run, range(len(self.predictor.runs)), self.predictor.jobs)
        return BatchNormalEquations(
            np.sum([part.gram for part in parts], axis=0)[:, :, self._free[:, None], self._free],
            np.sum([part.slope for part in parts], axis=0)[:, :, self._free],
            np.sum([part.sums for part in parts], axis=0),
            np.stack([part.status for part in parts]).max(axis=0),
        )


def _samples_of(record: Record, time: Array, inputs: Iterable[str]) -> RunSamples:
    """When samples of a run were taken, and where in its cycle: by the first input that swings."""
    if not record.periodic:
        return RunSamples(time, None)
    first = record.frequency * float(time[0] - record.time[0])
    for channel in inputs:
        harmonics = record.harmonics.get(channel)
        swing = None if harmonics is None else harmonics.coefficients[harmonics.orders == 1]
        if swing is not None and swing.size:
            return RunSamples(
                time, record.frequency, first + float(np.angle(swing[0])) / (2 * np.pi)
            )
    return RunSamples(time, record.frequency, first)


def _count(record: Record) -> int:
    """Samples that count."""
    return record.time.size if record.kept is None else int(record.kept.sum())
