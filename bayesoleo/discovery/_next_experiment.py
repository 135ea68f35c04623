"""Design of the next run: the feasible run that is expected to tell most.

It tells which of several models is true, weighted by their probabilities, or it makes the
parameters of one model more precise. Runs with one periodic input are planned over the range of the
rig; transients, and runs with several inputs, vary those that were measured.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bayesoleo._parallel import single_blas_thread
from bayesoleo._types import Array
from bayesoleo._worker_processes import process_map
from bayesoleo.discovery._expected_information import (
    Component,
    Precision,
    PredictiveDistribution,
    Separation,
    entropy,
    in_common_directions,
    precision_gain,
    separate,
)
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_and_hold_out_error import ErrorTable, RunError
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._predicted_experiment import (
    BEYOND,
    POINTS,
    Knowledge,
    Limits,
    Motion,
    NewRunNoise,
    Planned,
    Rival,
    blank_record,
    planned_runs,
    predictive_distribution,
    solved_like,
)
from bayesoleo.discovery._spectral_data import PRIOR_LINES
from bayesoleo.discovery._varied_runs import REACH, Variation, repeated, varied_runs
from bayesoleo.errors import InputError, ModelError, choose
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._transient_run import TransientRun
from bayesoleo.solvers._orbit import Status

#: A run on the grid of the rig's range, a measured one to be repeated, or a variation of one.
Run = Planned | Record | Variation
BEYOND_LIMITS = "an output beyond its limits"
#: What a run is to tell: which structure is true, or the parameters of the final model.
STRUCTURES, PARAMETERS = "structures", "parameters"
#: Frequencies at which the noise of a new run is tabulated.
TABULATED = 256
#: Variance of noise that is none.
TINY = 1e-300


@dataclass(frozen=True)
class ProposedRun:
    """A run and what it is expected to tell.

    Parameters
    ----------
    frequency : float
        Hz; NaN of a transient.
    mean, amplitude : float
        Of the driving channel, SI; NaN where a measured run is varied.
    separation : Separation or None
        Of the rivals, where these are to be told apart.
    label : str
        Label of an existing run that would be repeated; empty otherwise.
    precision : Precision or None
        Of the parameters, where these are to be known better.
    like, change : str
        The existing run that it varies, and what it changes in it; empty where it is described by
        frequency, mean and amplitude.
    """

    frequency: float
    mean: float
    amplitude: float
    separation: Separation | None
    label: str = ""
    precision: Precision | None = None
    like: str = ""
    change: str = ""

    @property
    def information(self) -> float:
        """Expected information, in bits, by which runs are ranked."""
        told = self.separation or self.precision
        assert told is not None
        return told.information

    @property
    def weakest(self) -> float:
        """Separation of the weakest pair of rivals, in standard deviations."""
        return 0.0 if self.separation is None else self.separation.weakest


@dataclass(frozen=True)
class Proposals:
    """Proposed runs.

    Parameters
    ----------
    rivals : tuple of str
        Names of the rival models; of one where its parameters are to be known better.
    weights : tuple of float
        Their probabilities; the sum is one.
    drive : str
        The channel that moves; empty where measured runs are varied.
    limits : Limits
        Of the rig.
    trials : tuple of ProposedRun
        New runs, the best first.
    repeats : tuple of ProposedRun
        Each existing run, if repeated.
    left_out : mapping of str to int
        Runs without a prediction by reason.
    policy : SearchPolicy
    """

    rivals: tuple[str, ...]
    weights: tuple[float, ...]
    drive: str
    limits: Limits
    trials: tuple[ProposedRun, ...]
    repeats: tuple[ProposedRun, ...]
    left_out: Mapping[str, int]
    policy: SearchPolicy = SearchPolicy()

    @property
    def entropy(self) -> float:
        """Entropy of the rivals' probabilities, in bits: the most that a run can tell."""
        return entropy(np.array(self.weights))

    def shortlist(self, count: int = 5) -> tuple[ProposedRun, ...]:
        """The best run at each frequency, the best first; neighbours on the grid are similar."""
        best: dict[object, ProposedRun] = {}
        for trial in self.trials:
            best.setdefault((trial.like, trial.change) if trial.like else trial.frequency, trial)
        return tuple(best.values())[:count]

    @property
    def best_repeat(self) -> ProposedRun | None:
        """The existing run with the most informative repetition; None if none was solved."""
        return max(self.repeats, key=lambda trial: trial.information, default=None)

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
    aim: str = STRUCTURES,
    jobs: int | None = None,
) -> Proposals:
    """Rank the feasible runs by the information that they are expected to give.

    Each rival was estimated from the existing runs and predicts a new one with the remaining
    uncertainty of its parameters. The noise of the new run is that of the others, coloured as
    theirs, scaled by the best rival's ratio to noise.

    Parameters
    ----------
    rivals : sequence of Rival
        Two or more with their probabilities; one where parameters are to be known better.
    records : sequence of Record
        All existing runs.
    errors : ErrorTable
        Errors of the best rival, and the noise.
    limits : Limits, optional
        Limits of the rig; by default those of the existing runs. Of variations of measured runs
        only those of outputs count.
    aim : str
        ``"structures"``, ``"parameters"`` or the name of one parameter.
    jobs : int, optional
        Threads.

    Returns
    -------
    Proposals

    Raises
    ------
    InputError
        If there are fewer than two rivals to be told apart, there is no such parameter, or no run
        can be varied.
    """
    if aim == STRUCTURES and len(rivals) < 2:
        hint = "name two or more effects that may be missing"
        raise ModelError("fewer than two rivals", value=len(rivals), hint=hint)
    drive, policy = drive_of(rivals, records), rivals[0].fit.policy
    outputs = rivals[0].fit.predictor.outputs
    planned: Sequence[Run]
    repeats: Sequence[Run]
    limits = limits_of(records, drive, outputs) if limits is None else limits
    if drive:
        planned, repeats = planned_runs(limits, records, drive), records
    else:
        planned = varied_runs(records, rivals[0].fit.model, outputs)
        repeats = [repeated(record, outputs) for record in records]
    noise = expected_noise(errors, records)
    judge = _Judge(tuple(rivals), tuple(records), drive, limits, noise, aim)
    runs = [*planned, *repeats]
    with single_blas_thread():
        found = process_map(_judged, judge, runs, jobs, known=_records_of)
    new, again = found[: len(planned)], found[len(planned) :]
    weights = np.array([rival.weight for rival in rivals])
    return Proposals(
        tuple(rival.name for rival in rivals),
        tuple(map(float, weights / weights.sum())),
        drive,
        limits,
        _ranked([item for item in new if isinstance(item, ProposedRun)]),
        tuple(item for item in again if isinstance(item, ProposedRun)),
        Counter(item for item in new if isinstance(item, str)),
        policy,
    )


def limits_of(records: Sequence[Record], drive: str, outputs: Sequence[str]) -> Limits:
    """Limits that the existing runs suggest; of variations of these, only those of the outputs,
    which may be larger by as much as the inputs may."""
    if drive:
        return Limits.of(records, drive, outputs)
    free, seen = (-np.inf, np.inf), {}
    for name in outputs:
        values = [float(f(r.samples[name])) for r in records for f in (np.min, np.max)]
        room = (REACH - 1.0 + BEYOND) * (max(values) - min(values))
        seen[name] = (min(values) - room, max(values) + room)
    return Limits(free, free, free, free, free, seen)


def _judged(judge: _Judge, run: Run) -> ProposedRun | str:
    """What one run would tell; most of it is arrays, for which threads wait for each other."""
    return judge(run)


def _records_of(judge: _Judge) -> Sequence[Record]:
    """Records that a judge and its runs share."""
    fitted = [record for rival in judge.rivals for record in rival.fit.records]
    return list({id(record): record for record in (*judge.records, *fitted)}.values())


@dataclass(frozen=True)
class _Judge:
    """Predicts a planned or an existing run with all rivals, and what it would tell.

    Parameters
    ----------
    rivals : tuple of Rival
    records : tuple of Record
        The existing runs.
    drive : str
        Channel that is planned; empty where existing runs are varied.
    limits : Limits
    noise : mapping of str to NewRunNoise
        By output.
    aim : str
        What the run is to tell.
    begins : dict of (rival, run) to TransientRun or None
        Where solutions of a transient's variations begin; found when first asked for.
    """

    rivals: tuple[Rival, ...]
    records: tuple[Record, ...]
    drive: str
    limits: Limits
    noise: Mapping[str, NewRunNoise]
    aim: str
    begins: dict[tuple[int, str], TransientRun | None] = field(default_factory=dict)

    def __call__(self, run: Run) -> ProposedRun | str:
        """The trial, or the reason why there is none."""
        record, outputs = self._blank(run), self.rivals[0].fit.predictor.outputs
        solved, known = [], []
        for k, rival in enumerate(self.rivals):
            known.append(self._known(rival.fit, run, record.periodic))
            begin = self._begin(k, run.like) if isinstance(run, Variation) else None
            found = predictive_distribution(rival.fit, known[-1], record, self.noise, begin)
            if isinstance(found, Status):
                return found.message
            solved.append(found)
        new = isinstance(run, Planned) or (isinstance(run, Variation) and bool(run.change))
        if new and not _inside(self.limits, outputs, [y for _, y in solved]):
            return BEYOND_LIMITS
        told = self._told([item for item, _ in solved], known)
        return self._described(run, record.frequency, told)

    def __getstate__(self) -> dict[str, Any]:
        # Another process finds its own: these change while they would be sent.
        return vars(self) | {"begins": {}}

    def _begin(self, rival: int, label: str) -> TransientRun | None:
        """Where a rival's solutions of a transient's variations begin: found once."""
        key = rival, label
        if key not in self.begins:
            fit = self.rivals[rival].fit
            known = Knowledge.of(fit, label)
            self.begins[key] = solved_like(fit, known, self.records, label)
        return self.begins[key]

    def _known(self, fit: ModelFit, run: Run, periodic: bool) -> Knowledge:
        if isinstance(run, Variation):
            return Knowledge.of(fit, run.like, run.start, periodic=periodic)
        return Knowledge.of(fit, periodic=periodic)

    def _told(
        self, solved: Sequence[PredictiveDistribution], known: Sequence[Knowledge]
    ) -> Separation | Precision:
        if self.aim == STRUCTURES:
            weights = [rival.weight for rival in self.rivals]
            solved = in_common_directions(solved)
            return separate(solved, weights, self._components(solved, known))
        names = known[0].names
        shared = set(self.rivals[0].fit.shared)
        of = [k for k, name in enumerate(names) if name in shared]
        if self.aim != PARAMETERS:
            of = [names.index(self.aim)]
        return precision_gain(solved[0], known[0].root, names, of)

    def _components(
        self, solved: Sequence[PredictiveDistribution], known: Sequence[Knowledge]
    ) -> list[Component]:
        """Rivals as mixtures over the size of their least certain amplitude."""
        found = []
        for k, (rival, item, own) in enumerate(zip(self.rivals, solved, known, strict=True)):
            for size in rival.sizes:
                place = own.names.index(size.name)
                direction = own.root[:, place]
                ratio = size.sd / max(float(np.linalg.norm(direction)), TINY)
                changed = item.given(direction, size.mean - own.theta[place], ratio)
                found.append(Component(k, size.weight, changed))
            if not rival.sizes:
                found.append(Component(k, 1.0, item))
        return found

    def _described(self, run: Run, frequency: float, told: Separation | Precision) -> ProposedRun:
        """The run with what it tells."""
        own = {
            "separation": told if isinstance(told, Separation) else None,
            "precision": told if isinstance(told, Precision) else None,
        }
        if isinstance(run, Planned):
            return ProposedRun(run.frequency, run.mean, run.amplitude, **own)  # type: ignore[arg-type]
        if isinstance(run, Record):
            move = Motion.of(run, self.drive)
            return ProposedRun(
                run.frequency, move.mean, move.amplitude, label=run.label, **own  # type: ignore[arg-type]
            )  # fmt: skip
        label = "" if run.change else run.like
        return ProposedRun(
            frequency, np.nan, np.nan, label=label, like=run.like, change=run.change, **own  # type: ignore[arg-type]
        )  # fmt: skip

    def _blank(self, run: Run) -> Record:
        """The run without its outputs; a planned one has the conditions of the nearest run."""
        outputs = self.rivals[0].fit.predictor.outputs
        if isinstance(run, Variation):
            return run.record
        if isinstance(run, Record):
            return blank_record(run, run.frequency, self.drive, run.harmonics[self.drive], outputs)
        item, spread = run.waveform, _input_variance(self.records, self.drive)
        waveform = replace(item, variances=np.full(item.orders.size, spread))
        near = min(self.records, key=lambda record: _distance(record, run, self.drive))
        return blank_record(near, run.frequency, self.drive, waveform, outputs)


def drive_of(rivals: Sequence[Rival], records: Sequence[Record]) -> str:
    """The one channel that drives all rivals; empty where measured runs are to be varied, because
    they are transients or several channels drive the rivals."""
    if not all(record.periodic for record in records):
        return ""
    channels = {
        name for rival in rivals for name in rival.fit.model.inputs if name in records[0].samples
    }
    outputs = {name for rival in rivals for name in rival.fit.predictor.outputs}
    driving = sorted(channels - outputs)
    return driving[0] if len(driving) == 1 else ""


def check_aim(aim: str, parameters: Sequence[str]) -> None:
    """Raise where a run cannot be proposed for an aim.

    Parameters
    ----------
    aim : str
    parameters : sequence of str
        That are estimated, shared by all runs.

    Raises
    ------
    InputError
        If it is none of the words and no such parameter.
    """
    known = (STRUCTURES, PARAMETERS, *parameters)
    if aim not in known:
        raise InputError("unknown aim", key="next_run", value=aim, hint=choose(aim, known))


def expected_noise(errors: ErrorTable, records: Sequence[Record]) -> dict[str, NewRunNoise]:
    """Noise of a new run, by output.

    The median over the runs of what their averages have at each frequency, and their samples, times
    the ratio of the repeating error to that noise where it is above one.
    """
    frequency = {record.label: record.frequency for record in records if record.periodic}
    found = {}
    for output in errors.outputs:
        entries = [entry for entry in errors.entries if entry.output == output]
        ratio = max(float(np.sqrt(np.nanmean([entry.ratio**2 for entry in entries]))), 1.0)
        sample = ratio * float(np.median([entry.sigma for entry in entries]))
        lines = [_lines(e, frequency[e.run]) for e in entries if e.run in frequency]
        highest = max((float(f[-1]) for f, _ in lines), default=1.0)
        grid = np.linspace(0.0, highest, TABULATED)
        levels = [np.interp(grid, f, level) for f, level in lines] or [np.ones(grid.size)]
        found[output] = NewRunNoise(
            grid, ratio**2 * np.maximum(np.median(levels, axis=0), TINY), sample
        )
    return found


def _lines(entry: RunError, frequency: float) -> tuple[Array, Array]:
    """Frequencies of a run's lines, Hz, and the variance of an orthonormal coefficient of its
    average at :data:`POINTS` points, without that of the input."""
    spectrum = entry.spectrum
    if spectrum is None:
        white = entry.average.noise**2 * POINTS / entry.coefficients
        return np.array([0.0, frequency]), np.full(2, white)
    free = 2.0 * spectrum.lines
    mean = float(np.sum(spectrum.weights * spectrum.level) / spectrum.samples)
    level = (free * spectrum.level + PRIOR_LINES * mean) / (free + PRIOR_LINES)
    lines = np.arange(spectrum.level.size) * frequency / spectrum.lines
    return lines, POINTS * level / spectrum.samples


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
    found = [trial.separation.sigma for trial in trials if trial.separation is not None]
    return np.max(np.stack(found), axis=0) if found else np.zeros((count, count))


def _ranked(trials: Sequence[ProposedRun]) -> tuple[ProposedRun, ...]:
    """Sorted by information, which is told of them; between equal runs by the weakest pair."""
    return tuple(sorted(trials, key=lambda trial: (trial.information, trial.weakest), reverse=True))
