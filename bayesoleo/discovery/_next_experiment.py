"""Which run, among those that the rig can do, best tells rival models apart."""

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
    """A run and how well it would tell the rivals apart.

    Parameters
    ----------
    frequency : float
        Hz.
    mean, amplitude : float
        Of the driving channel, SI.
    separation : Separation
    label : str
        Of a run that was made, and would be repeated; empty otherwise.
    """

    frequency: float
    mean: float
    amplitude: float
    separation: Separation
    label: str = ""


@dataclass(frozen=True)
class Proposals:
    """What to measure next to tell rival models apart.

    Parameters
    ----------
    rivals : tuple of str
        Their names.
    drive : str
        The channel that moves.
    limits : Limits
        What the rig can do.
    trials : tuple of ProposedRun
        Runs that were not made, the best first.
    repeats : tuple of ProposedRun
        Each run that was made, were it made once more.
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
        """The best run at each frequency, the best first: neighbours on a grid say the same."""
        best: dict[float, ProposedRun] = {}
        for trial in self.trials:
            best.setdefault(trial.frequency, trial)
        return tuple(best.values())[:count]

    @property
    def best_repeat(self) -> ProposedRun | None:
        """The run that was made whose repetition would tell most; None if none was solved."""
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
    """Rank the runs that a rig can do by how well they tell rival models apart.

    Each rival was estimated from the runs that there are, and foresees a new one with what these
    leave unknown of its parameters. The noise of the new run is that of the others, widened where
    an error remains that no rival explains.

    Parameters
    ----------
    rivals : sequence of Rival
        Two or more.
    records : sequence of Record
        All runs that there are.
    errors : ErrorTable
        What the best rival leaves, and the noise.
    limits : Limits, optional
        What the rig can do; by default what it did.
    jobs : int, optional
        Threads.

    Returns
    -------
    Proposals

    Raises
    ------
    InputError
        If there are fewer than two rivals, runs are transient, or the model has several inputs,
        so that it is not clear what a new run would be.
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
    """Foresees a run, planned or made, with all rivals, and tells how well it separates them."""

    rivals: tuple[Rival, ...]
    known: tuple[Knowledge, ...]
    records: tuple[Record, ...]
    drive: str
    limits: Limits
    noise: Mapping[str, float]

    def __call__(self, run: Planned | Record) -> ProposedRun | str:
        """The trial, or why there is none."""
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
        """The run without its answers; a planned one under the conditions of the nearest made."""
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
        If a run that was not made cannot be foreseen by them.
    """
    if len(rivals) < 2:
        hint = "name two or more effects that might be what is missing"
        raise ModelError("fewer than two rivals to tell apart", value=len(rivals), hint=hint)
    check_periodic(records)
    channels = {
        name for rival in rivals for name in rival.fit.model.inputs if name in records[0].samples
    }
    outputs = {name for rival in rivals for name in rival.fit.predictor.outputs}
    driving = sorted(channels - outputs)
    if len(driving) != 1:
        raise ModelError(
            "what to measure next is foreseen for models with one input only",
            value=driving,
            hint="with several measured inputs it is not clear what they would be in a new run",
        )
    return driving[0]


def check_periodic(records: Sequence[Record]) -> None:
    """Raise where a run is a transient, whose like is not described by a few numbers.

    Raises
    ------
    CampaignError
        With the first such run.
    """
    transient = [record.label for record in records if not record.periodic]
    if transient:
        raise CampaignError(
            "what to measure next is foreseen for periodic runs only",
            run=transient[0],
            key="kind",
            value="transient",
            hint="simulate a transient of your choice with each rival, and compare them",
        )


def expected_noise(errors: ErrorTable) -> dict[str, float]:
    """Noise of a new run's average at each of the points compared, by output, SI.

    The median over the runs of the standard error of their averages, brought to these points, times
    the ratio of what repeats to that noise where it is above one.
    """
    found = {}
    for output in errors.outputs:
        entries = [entry for entry in errors.entries if entry.output == output]
        ratio = float(np.sqrt(np.nanmean([entry.ratio**2 for entry in entries])))
        found[output] = float(np.median([_at_points(entry) for entry in entries])) * max(ratio, 1.0)
    return found


def _at_points(entry: RunError) -> float:
    """Noise of an averaged residual at one of so many points, the input's left out."""
    own = entry.average.noise if entry.spectrum is None else entry.spectrum.noise
    return float(own * np.sqrt(POINTS / entry.coefficients))


def _input_variance(records: Sequence[Record], drive: str) -> float:
    """Variance of a coefficient of the driving channel, the median over runs."""
    known = [item.variances[item.orders > 0] for item in (r.harmonics[drive] for r in records)]
    return float(np.median(np.concatenate(known)))


def _distance(record: Record, run: Planned, drive: str) -> float:
    """How far a run that was made is from one that was not: it gives the conditions."""
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
    """By information; where that is all there is to know, by the pair that is separated least."""
    first, second = np.triu_indices(count, 1)
    can = _reach(trials, count)[first, second] >= policy.separable

    def worth(trial: ProposedRun) -> tuple[float, float]:
        sigma = trial.separation.sigma[first, second]
        least = float(sigma[can].min()) if can.any() else float(sigma.min())
        return round(trial.separation.information / policy.equal_information), least

    return tuple(sorted(trials, key=worth, reverse=True))
