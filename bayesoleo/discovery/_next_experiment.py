"""Design of the next run: the feasible run that best separates rival models."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._parallel import single_blas_thread, thread_map
from bayesoleo._types import Array
from bayesoleo.discovery._error_table import ErrorTable, RunError
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._predicted_experiment import (
    POINTS,
    Knowledge,
    Limits,
    Motion,
    Planned,
    Rival,
    Separation,
    blank_record,
    planned_runs,
    predictive_distribution,
    separate,
)
from bayesoleo.errors import CampaignError, ModelError
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._orbit import Status

BEYOND_LIMITS = "an output beyond its limits"


@dataclass(frozen=True)
class ProposedRun:
    """A run and how well it would separate the rivals.

    Parameters
    ----------
    frequency : float
        Hz.
    mean, amplitude : float
        Of the driving channel, SI.
    separation : Separation
    label : str
        Label of an existing run that would be repeated; empty otherwise.
    """

    frequency: float
    mean: float
    amplitude: float
    separation: Separation
    label: str = ""


@dataclass(frozen=True)
class Proposals:
    """Proposed runs to distinguish rival models.

    Parameters
    ----------
    rivals : tuple of str
        Their names.
    drive : str
        The channel that moves.
    limits : Limits
        Limits of the rig.
    trials : tuple of ProposedRun
        New runs, the best first.
    repeats : tuple of ProposedRun
        Each existing run, if repeated.
    left_out : mapping of str to int
        Runs without a prediction by reason.
    policy : SearchPolicy
    """

    rivals: tuple[str, ...]
    drive: str
    limits: Limits
    trials: tuple[ProposedRun, ...]
    repeats: tuple[ProposedRun, ...]
    left_out: Mapping[str, int]
    policy: SearchPolicy = SearchPolicy()

    def shortlist(self, count: int = 5) -> tuple[ProposedRun, ...]:
        """The best run at each frequency, the best first; neighbours on the grid are similar."""
        best: dict[float, ProposedRun] = {}
        for trial in self.trials:
            best.setdefault(trial.frequency, trial)
        return tuple(best.values())[:count]

    @property
    def best_repeat(self) -> ProposedRun | None:
        """The existing run with the most informative repetition; None if none was solved."""
        return max(self.repeats, key=lambda trial: trial.separation.information, default=None)

    @property
    def inseparable(self) -> tuple[tuple[str, str], ...]:
        """Pairs that no run within the limits separates by one standard deviation."""
        reach = _reach(self.trials, len(self.rivals))
        first, second = np.triu_indices(len(self.rivals), 1)
        return tuple(
            (self.rivals[i], self.rivals[j])
            for i, j in zip(first, second, strict=True)
            if reach[i, j] < self.policy.separable
        )


def propose_runs(
    rivals: Sequence[Rival],
    records: Sequence[Record],
    errors: ErrorTable,
    limits: Limits | None = None,
    *,
    jobs: int | None = None,
) -> Proposals:
    """Rank the feasible runs by how well they separate rival models.

    Each rival was estimated from the existing runs and predicts a new one with the remaining
    uncertainty of its parameters. The noise of the new run is that of the others, scaled by the
    best rival's ratio to noise.

    Parameters
    ----------
    rivals : sequence of Rival
        Two or more.
    records : sequence of Record
        All existing runs.
    errors : ErrorTable
        Errors of the best rival, and the noise.
    limits : Limits, optional
        Limits of the rig; by default those of the existing runs.
    jobs : int, optional
        Threads.

    Returns
    -------
    Proposals

    Raises
    ------
    InputError
        If there are fewer than two rivals, a run is transient, or the model has several inputs,
        so that a new run is not defined.
    """
    drive, policy = drive_of(rivals, records), rivals[0].fit.policy
    outputs = rivals[0].fit.predictor.outputs
    chosen = Limits.of(records, drive, outputs) if limits is None else limits
    known = tuple(Knowledge.of(rival.fit) for rival in rivals)
    judge = _Judge(tuple(rivals), known, tuple(records), drive, chosen, expected_noise(errors))
    with single_blas_thread():
        planned = thread_map(judge, planned_runs(chosen, records, drive), jobs)
        repeated = thread_map(judge, list(records), jobs)
    return Proposals(
        tuple(rival.name for rival in rivals),
        drive,
        chosen,
        _ranked([item for item in planned if isinstance(item, ProposedRun)], len(rivals), policy),
        tuple(item for item in repeated if isinstance(item, ProposedRun)),
        Counter(item for item in planned if isinstance(item, str)),
        policy,
    )


@dataclass(frozen=True)
class _Judge:
    """Predicts a planned or an existing run with all rivals, and computes their separation."""

    rivals: tuple[Rival, ...]
    known: tuple[Knowledge, ...]
    records: tuple[Record, ...]
    drive: str
    limits: Limits
    noise: Mapping[str, float]

    def __call__(self, run: Planned | Record) -> ProposedRun | str:
        """The trial, or the reason why there is none."""
        record, outputs = self._blank(run), self.rivals[0].fit.predictor.outputs
        pairs = zip(self.rivals, self.known, strict=True)
        found = [
            predictive_distribution(rival, known, record, self.noise) for rival, known in pairs
        ]
        failed = [item for item in found if isinstance(item, Status)]
        if failed:
            return failed[0].message
        solved = [item for item in found if not isinstance(item, Status)]
        if isinstance(run, Planned) and not _inside(self.limits, outputs, [y for _, y in solved]):
            return BEYOND_LIMITS
        separation = separate([item for item, _ in solved])
        if isinstance(run, Planned):
            return ProposedRun(run.frequency, run.mean, run.amplitude, separation)
        move = Motion.of(run, self.drive)
        return ProposedRun(run.frequency, move.mean, move.amplitude, separation, run.label)

    def _blank(self, run: Planned | Record) -> Record:
        """The run without its outputs; a planned one has the conditions of the nearest run."""
        outputs = self.rivals[0].fit.predictor.outputs
        if isinstance(run, Record):
            return blank_record(run, run.frequency, self.drive, run.harmonics[self.drive], outputs)
        item, spread = run.waveform, _input_variance(self.records, self.drive)
        waveform = replace(item, variances=np.full(item.orders.size, spread))
        near = min(self.records, key=lambda record: _distance(record, run, self.drive))
        return blank_record(near, run.frequency, self.drive, waveform, outputs)


def drive_of(rivals: Sequence[Rival], records: Sequence[Record]) -> str:
    """The one channel that drives all rivals.

    Raises
    ------
    InputError
        If the rivals cannot predict a new run.
    """
    if len(rivals) < 2:
        hint = "name two or more effects that may be missing"
        raise ModelError("fewer than two rivals", value=len(rivals), hint=hint)
    check_periodic(records)
    channels = {
        name for rival in rivals for name in rival.fit.model.inputs if name in records[0].samples
    }
    outputs = {name for rival in rivals for name in rival.fit.predictor.outputs}
    driving = sorted(channels - outputs)
    if len(driving) != 1:
        raise ModelError(
            "the next run can be proposed for models with one input only",
            value=driving,
            hint="several measured inputs are not defined in a new run",
        )
    return driving[0]


def check_periodic(records: Sequence[Record]) -> None:
    """Raise where a run is a transient, because a few numbers do not describe a new transient.

    Raises
    ------
    CampaignError
        With the first such run.
    """
    transient = [record.label for record in records if not record.periodic]
    if transient:
        raise CampaignError(
            "the next run can be proposed for periodic runs only",
            run=transient[0],
            key="kind",
            value="transient",
            hint="simulate a transient of your choice with each rival, and compare them",
        )


def expected_noise(errors: ErrorTable) -> dict[str, float]:
    """Noise of a new run's average at each of the points compared, by output, SI.

    The median over the runs of the standard error of their averages, converted to these points,
    times the ratio of the repeating error to that noise where it is above one.
    """
    found = {}
    for output in errors.outputs:
        entries = [entry for entry in errors.entries if entry.output == output]
        ratio = float(np.sqrt(np.nanmean([entry.ratio**2 for entry in entries])))
        found[output] = float(np.median([_at_points(entry) for entry in entries])) * max(ratio, 1.0)
    return found


def _at_points(entry: RunError) -> float:
    """Noise of an averaged residual at one of the points, without that of the input."""
    own = entry.average.noise if entry.spectrum is None else entry.spectrum.noise
    return float(own * np.sqrt(POINTS / entry.coefficients))


def _input_variance(records: Sequence[Record], drive: str) -> float:
    """Variance of a coefficient of the driving channel, the median over runs."""
    known = [item.variances[item.orders > 0] for item in (r.harmonics[drive] for r in records)]
    return float(np.median(np.concatenate(known)))


def _distance(record: Record, run: Planned, drive: str) -> float:
    """Distance of an existing run from a planned one, whose conditions the nearest run gives."""
    mean = Motion.of(record, drive).mean
    apart = abs(mean - run.mean) / run.amplitude if run.amplitude else 0.0
    return float(apart + abs(np.log(record.frequency / run.frequency)))


def _inside(limits: Limits, outputs: Sequence[str], found: Sequence[Array]) -> bool:
    for b, output in enumerate(outputs):
        low, high = limits.outputs.get(output, (-np.inf, np.inf))
        if any(y[b].min() < low or y[b].max() > high for y in found):
            return False
    return True


def _reach(trials: Sequence[ProposedRun], count: int) -> Array:
    """Largest separation of each pair by any run, shape (count, count)."""
    if not trials:
        return np.zeros((count, count))
    return np.max(np.stack([trial.separation.sigma for trial in trials]), axis=0)


def _ranked(
    trials: Sequence[ProposedRun], count: int, policy: SearchPolicy
) -> tuple[ProposedRun, ...]:
    """Sorted by information; between equal runs by the separation of the weakest pair."""
    first, second = np.triu_indices(count, 1)
    can = _reach(trials, count)[first, second] >= policy.separable

    def worth(trial: ProposedRun) -> tuple[float, float]:
        sigma = trial.separation.sigma[first, second]
        least = float(sigma[can].min()) if can.any() else float(sigma.min())
        return round(trial.separation.information / policy.equal_information), least

    return tuple(sorted(trials, key=worth, reverse=True))
