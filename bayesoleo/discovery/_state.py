"""State of the search: a fitted model with its errors on all runs.

The errors are compared with the noise on fitted and hold-out runs.

Fits with more than the expected error are repeated from other starts, because a local optimum is no
missing effect. Where a resonance lies between two driven frequencies, the sum of squares has an
optimum on either side of each, and an estimate ends in the one nearest its start.
"""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from bayesoleo._parallel import connected, each_done, thread_map
from bayesoleo._types import Array
from bayesoleo._worker_processes import process_map
from bayesoleo.discovery._assembly import Assembly, Roles
from bayesoleo.discovery._expected_error import (
    Compared,
    EstimateCovariance,
    expected_of_fitted,
    expected_of_held_out,
)
from bayesoleo.discovery._fewest_steps import for_comparison
from bayesoleo.discovery._fit import COMPARED, ModelFit, fit_model
from bayesoleo.discovery._fit_and_hold_out_error import (
    ErrorTable,
    Noise,
    compared,
    is_at_floor,
    too_quiet,
    with_same_noise,
)
from bayesoleo.discovery._noise_of_estimates import NoiseOfEstimates, colours_of
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._other_starts import promising
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._run_predictions import Prediction, predict_fitted, predict_held_out
from bayesoleo.discovery._score_basis import Base, base_of
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.model._model import Model
from bayesoleo.prediction._mesh_steps import steps_for
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._stability import Stability


def better_start(
    fit: ModelFit, numerics: Numerics, before: Callable[[], object] = lambda: None
) -> Array | None:
    """A better optimum of the estimate, from other starts.

    Parameters
    ----------
    fit : ModelFit
        A fit with more than the expected error.
    numerics : Numerics
    before : callable
        What this process does first, while another one begins with the starts.

    Returns
    -------
    ndarray, shape (l,), or None
        The better optimum; None if no start from draws of the priors leads to one.
    """
    best, height = None, fit.point.objective + numerics.policy.better_optimum_declared
    starts = promising(fit.problem, fit.point.theta, numerics.policy)
    for point in process_map(_from_start, (fit, numerics), starts, numerics.jobs, before=before):
        if point.status.ok and point.objective > height:
            best, height = point.theta, point.objective
    return best


def _from_start(shared: tuple[ModelFit, Numerics], start: Array) -> PointEstimate:
    """The estimate from another start, also in another process; a better one is estimated anew."""
    fit, numerics = shared
    return fit_model(
        fit.model,
        fit.records,
        replace(numerics, steps=fit.steps),
        start=start,
        tolerance=1e-4,
        max_iterations=30,
        resolution=COMPARED,
        share=fit.predictor,
        check_mesh=False,
    ).point


@dataclass(frozen=True)
class State:
    """A fitted model with its predictions and errors.

    Parameters
    ----------
    assembly : Assembly
        The model at the estimate.
    fit : ModelFit
        Its fit to the fitted runs.
    fitted, held_out : list of Prediction
        Predictions by run.
    fit_errors, hold_errors : ErrorTable
        Errors of these predictions.
    known : EstimateCovariance, optional
        To what the estimates are known by the spectrum of the noise and the noise of measured
        inputs; where it is not known, the fit's own covariance says it for white noise.
    """

    assembly: Assembly
    fit: ModelFit
    fitted: list[Prediction]
    held_out: list[Prediction]
    fit_errors: ErrorTable
    hold_errors: ErrorTable
    known: EstimateCovariance | None = None

    def sd_of(self, unknown: str) -> float | None:
        """Standard deviation of an estimate; None for what was not estimated."""
        names = self.fit.problem.names
        if unknown not in names:
            return None
        known = self._by_colour or self.known
        if known is not None:
            return float(np.sqrt(known.of([unknown])[0, 0]))
        return float(self.fit.point.sd[names.index(unknown)])

    @cached_property
    def _by_colour(self) -> EstimateCovariance | None:
        """To what estimates are known by the spectrum of what is left of transients; None where
        that is flat. Differences of neighbours, by which noise is measured, miss what is slow."""
        if not colours_of(self.fit):
            return None
        covariance = NoiseOfEstimates.of(self.fit).covariance
        return EstimateCovariance(self.fit.problem.names, covariance)

    @property
    def policy(self) -> SearchPolicy:
        """The search policy."""
        return self.fit.policy

    @property
    def errors(self) -> ErrorTable:
        """One entry for each run and output: that of the hold-out prediction where there is one."""
        held = {entry.run for entry in self.hold_errors.entries}
        rest = tuple(entry for entry in self.fit_errors.entries if entry.run not in held)
        return ErrorTable((*rest, *self.hold_errors.entries))

    @property
    def stability(self) -> Stability | None:
        """Stability of the periodic solutions of all runs; None where there are none."""
        known = self.fit.stability
        if known is None:
            return None
        # With leave-one-run-out all runs are fitted as well.
        runs = {p.record.label: p.predictor.runs[0] for p in self.held_out}
        runs = {label: run for label, run in runs.items() if label not in known.runs}
        matrices = [run.anchor.monodromy if run.anchor else None for run in runs.values()]
        jumps, changes = (
            np.array([getattr(run, key) for run in runs.values()], dtype=np.int64)
            for key in ("jumps", "changes")
        )
        return known.together(Stability.of(tuple(runs), matrices, jumps, changes))

    @property
    def by_role(self) -> dict[str, dict[str, dict[str, float]]]:
        """Pooled errors by role, as in the summary."""
        return {**self.fit_errors.by_role(), **self.hold_errors.by_role()}

    @property
    def worst_ratio(self) -> float:
        """Largest pooled ratio to the expected error over roles and outputs."""
        tables = [t for t in (self.fit_errors, self.hold_errors) if t.entries]
        return float(np.max([table.worst_ratio(key="ratio_to_expected") for table in tables]))

    @property
    def at_floor(self) -> bool:
        """Whether the errors of all fitted and hold-out runs agree with the expected ones."""
        return all(
            is_at_floor(table, policy=self.policy) for table in (self.fit_errors, self.hold_errors)
        )

    @property
    def too_quiet(self) -> tuple[str, ...]:
        """Errors that are smaller than chance allows, because the noise is overestimated."""
        return (
            *too_quiet(self.fit_errors, policy=self.policy),
            *too_quiet(self.hold_errors, policy=self.policy),
        )

    def with_noise(self, noise: Noise) -> State:
        """The same errors relative to a noise that was found with another model."""
        return replace(
            self,
            fit_errors=with_same_noise(self.fit_errors, noise),
            hold_errors=with_same_noise(self.hold_errors, noise),
        )

    @property
    def unsolved(self) -> tuple[str, ...]:
        """Runs whose prediction failed, with the reason."""
        found = [*self.fitted, *self.held_out]
        return tuple(f"{p.record.label}: {p.status.message}" for p in found if not p.status.ok)

    def base(self) -> Base:
        """Residuals and sensitivities for the scores of candidates, on a mesh for comparisons."""
        return _bases.of(self)


class _Bases:
    """Bases of the states that were asked for last, which go with their states.

    A round, the elimination after it and the confirmation use the same base.
    """

    #: Each may hold hundreds of columns of a record.
    MOST = 2

    def __init__(self) -> None:
        self.kept = OrderedDict[int, tuple[weakref.ref[State], Base]]()
        # A state may go while this thread holds it: then the thread asks again.
        self.lock = threading.RLock()

    def of(self, state: State) -> Base:
        """The base of a state, kept or made now."""
        number = id(state)
        with self.lock:
            if number in self.kept:
                self.kept.move_to_end(number)
                return self.kept[number][1]
        fit = for_comparison(state.fit)
        entries = {(entry.run, entry.output): entry for entry in state.fit_errors.entries}
        base = base_of(fit, entries)
        with self.lock:
            self.kept[number] = weakref.ref(state, partial(self._forget, number)), base
            while len(self.kept) > self.MOST:
                self.kept.popitem(last=False)
        return base

    def _forget(self, number: int, _: object) -> None:
        """Of a state that is no more, before another one has its number."""
        with self.lock:
            self.kept.pop(number, None)

    def clear(self) -> None:
        """Forget all."""
        with self.lock:
            self.kept.clear()


_bases = _Bases()


def forget_bases() -> None:
    """Free the memory of all bases that are kept."""
    _bases.clear()


def state_of(assembly: Assembly, fit: ModelFit, roles: Roles) -> State:
    """Predict all runs at a fit and compare with the measurements."""
    fitted = predict_fitted(fit)
    held_out = (
        _left_out(fit, roles)
        if roles.strategy == "leave-one-run-out"
        else predict_held_out(fit, roles.held_out)
    )
    jobs, policy = fit.numerics.jobs, fit.policy
    found = _compared(fitted, held_out, roles, fit.numerics)
    fit_errors, known = expected_of_fitted(fit, fitted, found[: len(fitted)])
    if roles.strategy != "leave-one-run-out":
        known = {"": known[""]} if known else {}
    rows = thread_map(
        lambda pair: expected_of_held_out(*pair, known, policy=policy),
        list(zip(held_out, found[len(fitted) :], strict=True)),
        jobs,
    )
    return State(
        assembly.with_values(fit.shared),
        fit,
        fitted,
        held_out,
        ErrorTable(tuple(fit_errors)),
        ErrorTable(tuple(entry for row in rows for entry in row)),
        known.get(""),
    )


def _compared(
    fitted: Sequence[Prediction], held_out: Sequence[Prediction], roles: Roles, numerics: Numerics
) -> list[Compared]:
    """Errors of fitted runs, then of those held out, with the noise as it was measured first."""
    fit_or_not = [(p, "fit") for p in fitted] + [(p, "hold-out") for p in held_out]

    def errors(item: tuple[Prediction, str]) -> Compared:
        prediction, role = item
        by_label = {prediction.record.label: role}
        return compared(prediction, by_label, roles.noise_of, policy=numerics.policy)

    # All at once, since there may be no more than one of each.
    return thread_map(errors, fit_or_not, numerics.jobs)


def _left_out(fit: ModelFit, roles: Roles) -> list[Prediction]:
    """Each run predicted by a fit to all the others, from the joint estimate."""
    numerics = replace(fit.numerics, scheduler=None)
    names = fit.problem.names
    left_out = _LeftOut(fit.model, fit.records, numerics, fit.steps, names, fit.point.theta)
    with connected(fit.numerics.scheduler) as client:
        # Each local fit uses all threads.
        found = dict(each_done(left_out, roles.held_out, client=client, jobs=1))
    return [found[index] for index in range(len(roles.held_out))]


@dataclass(frozen=True)
class _LeftOut:
    """Prediction of one run by the others, as a task for a worker."""

    model: Model
    records: tuple[Record, ...]
    numerics: Numerics
    steps: int
    names: tuple[str, ...]
    theta: np.ndarray

    def __call__(self, record: Record) -> Prediction:
        others = [other for other in self.records if other.label != record.label]
        keep = [k for k, name in enumerate(self.names) if not name.endswith(f"[{record.label}]")]
        steps = steps_for(self.model, self.records, self.steps, others)
        numerics = replace(self.numerics, steps=steps)
        partial = fit_model(self.model, others, numerics, start=self.theta[keep])
        return predict_held_out(partial, [record])[0]


def fit_state(
    assembly: Assembly,
    roles: Roles,
    numerics: Numerics,
    *,
    start: np.ndarray | None = None,
    progress: Callable[[str], None] | None = None,
) -> State:
    """Fit an assembly and describe its state."""
    fit = fit_model(
        assembly.model(),
        roles.fitted,
        numerics,
        start=start,
        damped=bool(assembly.steps),
        progress=progress,
    )
    return state_of(assembly, fit, roles)
