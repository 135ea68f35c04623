"""Sampler of the posterior: adaptation, stopping rule and result."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from bayesoleo._parallel import connected, single_blas_thread
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._problem import unwatched
from bayesoleo.posterior._checkpoints import Segment, Store, open_store
from bayesoleo.posterior._diagnostics import (
    Samples,
    autocorrelation_time,
    effective_size as effective_size_of,
    nested_rhat,
    rhat_limit,
)
from bayesoleo.posterior._ensemble_moves import (
    DistributedDensity,
    Ensembles,
    MoveWeights,
    SharedDensity,
    default_walkers,
)
from bayesoleo.posterior._log_density import Density, LogDensity
from bayesoleo.posterior._mixture import Mixture
from bayesoleo.posterior._mode_search import with_other_modes

#: Starting points of the mode search, in full and in quick runs.
CLIMBS, QUICK_CLIMBS = 32, 16
#: Fraction of the evaluations that the mode search may take.
SEARCHING = 0.25
#: Evaluations of the log density at which a quick run ends, converged or not, and time steps in all
#: after which it ends too, but not before this number of moves of each walker: half a minute.
QUICK_EVALUATIONS, QUICK_TIME_STEPS, QUICK_STEPS = 40_000, 70_000_000, 64
#: Acceptance of the independence move below which its mixture misses the posterior.
MISSES = 0.15
#: Draws that are handed on at least, where each one costs a factorisation for each run, and by
#: quick runs.
ENOUGH, ENOUGH_QUICK = 4_000, 1_000
#: What it costs to predict and to store with a draw, in evaluations of the density.
COSTS = 3


@dataclass(frozen=True)
class Schedule:
    """Schedule of sampling: adaptation, length of segments, stopping rule.

    Parameters
    ----------
    effective_size : float
        Requested effective sample size of every quantity.
    max_evaluations : int
        Budget of rows of the log density; no segment begins that would exceed it.
    warm_up : int
        Draws of the first warm-up round; each later one has twice as many.
    most_rounds : int
        Warm-up rounds at most.
    least_rounds : int
        Warm-up rounds before proposals of the mixture that are accepted may end it.
    least : int
        Kept draws of each walker before the stopping rule is applied.
    times : float
        Kept draws, in autocorrelation times, from which the estimates are reliable.
    segment : int
        Draws of the longest segment, the most that an interruption can lose.
    """

    effective_size: float
    max_evaluations: int
    warm_up: int
    most_rounds: int
    least_rounds: int
    least: int
    times: float
    segment: int


@dataclass(frozen=True)
class Quality:
    """Diagnostics of the draws kept so far.

    Parameters
    ----------
    times, sizes, rhat : ndarray, shape (d,)
        Autocorrelation time, effective size, nested R-hat.
    draws : int
        Kept draws of each walker.
    """

    times: Array
    sizes: Array
    rhat: Array
    draws: int

    def shortfalls(self, schedule: Schedule, ensembles: int) -> list[str]:
        """Criteria that are not met yet, in words; empty if all are."""
        if not np.all(np.isfinite(self.times)):
            return ["a quantity never moved"]
        short = []
        if self.sizes.min() < schedule.effective_size:
            short.append(
                f"the effective size is {self.sizes.min():.0f}"
                f" of {schedule.effective_size:.0f} asked for"
            )
        if self.draws < schedule.times * self.times.max():
            short.append(
                f"{self.draws} draws are fewer than {schedule.times:.0f}"
                f" autocorrelation times of {self.times.max():.1f}"
            )
        limit = rhat_limit(ensembles, schedule.effective_size)
        if self.rhat.max() > limit:
            short.append(
                f"the ensembles disagree: nested R-hat {self.rhat.max():.3f} above {limit:.3f}"
            )
        return short


@single_blas_thread()  # matrices are small: threads take longer to meet than to work
def sample(
    log_density: Density,
    start: Mixture,
    *,
    effective_size: float = 1000,
    ensembles: int = 4,
    walkers: int | None = None,
    seed: int,
    out: Path | str | None = None,
    fingerprint: str = "",
    progress: bool | float = True,
    max_evaluations: int = 2_000_000,
    weights: MoveWeights | None = None,
    segment: int = 100,
    quick: bool = False,
    climbs: int | None = None,
    scheduler: str | None = None,
) -> Samples:
    """Draw from a density until every quantity has the effective size asked for.

    Parameters
    ----------
    log_density : Density
        Over ``d`` coordinates without bounds, usually a
        :class:`~bayesoleo.posterior.LogDensity`.
    start : Mixture
        Laplace approximations at the modes; walkers start there and the independence move proposes
        from it.
    effective_size : float
        Effective sample size of every quantity at which sampling stops, by the smaller of two
        estimates.
    ensembles : int
        Independent ensembles; nested R-hat compares them.
    walkers : int, optional
        Walkers of each; by default chosen from ``d``.
    seed : int
        Seed of the random generator; the draws do not depend on threads.
    out : path-like, optional
        Folder of checkpoints. An interrupted run continues there to the same draws; a complete
        one is read.
    fingerprint : str
        Hash of data, model and priors; a folder with another hash is refused.
    progress : bool or float
        Whether to show a bar of the effective size, at once or after so many seconds.
    max_evaluations : int
        Rows of the log density at which sampling stops.
    weights : MoveWeights, optional
        How often each kind of move is chosen; by default the warm-up's acceptance decides.
    segment : int
        Draws of the longest checkpointed segment.
    quick : bool
        Shorter warm-up, an effective size of at most 200 and not more than
        :data:`QUICK_EVALUATIONS`, fewer where each solves long runs, but
        :data:`QUICK_STEPS` moves of each walker.
    climbs : int, optional
        Starting points of the search for modes that the start does not have, by default
        32, with ``quick`` 16; zero disables it. Without the search, walkers that all start in one
        mode reach their effective sample size there and miss others.
    scheduler : str, optional
        Processes or machines that evaluate the density: ``local:4``, or the address of a Dask
        scheduler. The draws are the same.

    Returns
    -------
    Samples
        With ``reached`` False and a ``warning`` if it stopped at ``max_evaluations``.

    Raises
    ------
    InputError
        If walkers are too few, or none finds a finite log density.
    ResultsError
        If the folder holds another run or another process writes there.

    References
    ----------
    Foreman-Mackey et al. (2013), "emcee: the MCMC hammer", *PASP* 125. Margossian et al. (2024) for
    the stopping rule.
    """
    dimension = len(log_density.names)
    if start.dimension != dimension:
        raise InputError(
            "the start's mixture has another dimension than the log density",
            value=(start.dimension, dimension),
        )
    if not effective_size > 0:
        raise InputError(
            "the effective size must be positive", key="effective_size", value=effective_size
        )
    group = Ensembles(
        log_density, ensembles, walkers or default_walkers(dimension), weights or MoveWeights()
    )
    if quick:
        most = max(_quick_evaluations(log_density), QUICK_STEPS * group.chains)
        max_evaluations = min(max_evaluations, most)
    schedule = _schedule(effective_size, max_evaluations, segment, quick)
    number = (QUICK_CLIMBS if quick else CLIMBS) if climbs is None else climbs
    print_of_run = _fingerprint(fingerprint, group, start, seed, schedule, number)
    place = None if out is None else Path(out)
    with open_store(place, print_of_run) as store, connected(scheduler) as client:
        if client is not None:
            group = replace(group, log_density=DistributedDensity(log_density, client))
        bar = _Bar(schedule.effective_size, progress)
        try:
            if not store.segments:
                store.append(_first(group, start, seed, number, schedule))
            with _shared(group) as group:
                _warm_up(store, group, schedule, bar, quick and weights is None)
                if weights is None:
                    group = replace(group, weights=_tuned(store.segments))
                quality, short = _keep(store, group, schedule, bar)
        finally:
            bar.close()
        return _samples(store.segments, group, quality, short, quick)


@contextmanager
def _shared(group: Ensembles) -> Iterator[Ensembles]:
    """The ensembles with a density that other processes of this machine evaluate too, if theirs is
    one of a campaign."""
    density = group.log_density
    if not isinstance(density, LogDensity) or not isinstance(density.problem, CampaignProblem):
        yield group
        return
    shared = SharedDensity(density)
    try:
        yield replace(group, log_density=shared)
    finally:
        shared.end()


def _quick_evaluations(log_density: Density) -> int:
    """Evaluations of a quick run: fewer where the runs of one take many time steps."""
    problem = getattr(log_density, "problem", None)
    if not isinstance(problem, CampaignProblem):
        return QUICK_EVALUATIONS
    steps = sum(run.steps for run in problem.predictor.runs)
    return min(QUICK_EVALUATIONS, QUICK_TIME_STEPS // max(steps, 1))


def _schedule(effective_size: float, evaluations: int, segment: int, quick: bool) -> Schedule:
    if quick:
        return Schedule(min(effective_size, 200.0), evaluations, 20, 3, 1, 25, 10.0, segment)
    return Schedule(effective_size, evaluations, 20, 6, 2, 50, 20.0, segment)


def _fingerprint(
    given: str, group: Ensembles, start: Mixture, seed: int, schedule: Schedule, climbs: int
) -> str:
    """Hash of all that determines the draws; a larger effective size only continues them."""
    digest = hashlib.sha256()
    settings = [
        given,
        group.log_density.names,
        group.log_density.runs,
        group.ensembles,
        group.walkers,
        astuple(group.weights),
        seed,
        schedule.warm_up,
        schedule.most_rounds,
        schedule.least_rounds,
        np.asarray(start.degrees).tolist(),
        climbs,
    ]
    digest.update(json.dumps(settings).encode())
    for array in (start.centres, start.covariances, start.log_weights):
        # Rounded: the mode found on another machine differs in the last bits, and segments hold the
        # mode that was used.
        digest.update(np.array2string(array, precision=6, threshold=array.size + 1).encode())
    return digest.hexdigest()


def _first(group: Ensembles, start: Mixture, seed: int, climbs: int, schedule: Schedule) -> Segment:
    """Walkers drawn from the start and from modes found beside it."""
    spent = 0
    # A climb takes about a dozen times twenty rows plus one for each coordinate.
    climbs = min(climbs, int(SEARCHING * schedule.max_evaluations / (12 * (20 + start.dimension))))
    if climbs > 0:
        # A separate generator: if no mode is found, the draws are the same as without the search.
        rng = np.random.default_rng([seed, climbs])
        # What it looks at lies far beyond what is sampled: jumps there say nothing of that.
        with unwatched(group.log_density):
            most = SEARCHING * schedule.max_evaluations
            start, spent = with_other_modes(group.log_density, start, climbs, rng, most)
    first = group.start(start, seed)
    return replace(first, evaluations=first.evaluations + spent)


def _warm_up(store: Store, group: Ensembles, schedule: Schedule, bar: _Bar, tuned: bool) -> None:
    """Rounds of doubling length, the mixture adapted after each, until one lasts ten times tau.

    Where rounds are few, the weights of the moves are tuned too, after one whose mixture missed:
    its proposals would be most of what is evaluated.
    """
    while not _is_warm(store.segments, schedule):
        rounds = sum(s.phase == "warm-up" for s in store.segments)
        missed = tuned and rounds and _independence(store.segments[-1]) < MISSES
        # By what is stored alone, so that a run that goes on after a stop has the same draws.
        now = replace(group, weights=_tuned(store.segments)) if missed else group
        steps = schedule.warm_up * 2**rounds
        bar.show("warm-up", 0.0, store.segments)
        store.append(now.advance(store.segments[-1], steps, "warm-up"))


def _is_warm(segments: list[Segment], schedule: Schedule) -> bool:
    rounds = [s for s in segments if s.phase == "warm-up"]
    if any(s.phase == "kept" for s in segments) or len(rounds) >= schedule.most_rounds:
        return True
    spent = sum(s.evaluations for s in segments)
    following = schedule.warm_up * 2 ** len(rounds) * segments[0].coords.shape[1]
    if spent + following > schedule.max_evaluations / 2:  # leave half for draws that are kept
        return True
    # Nearly all independence proposals are accepted: walkers have forgotten their start, and none
    # is left in a tail that the mixture misses.
    if len(rounds) >= schedule.least_rounds and _independence(rounds[-1]) > 0.8:
        return True
    if len(rounds) < 2:
        return False
    times = autocorrelation_time(rounds[-1].coords.swapaxes(0, 1))
    return bool(np.all(rounds[-1].draws >= 10 * times))


def _tuned(segments: list[Segment]) -> MoveWeights:
    """Move weights from the last warm-up, fixed before draws are kept, also after a restart."""
    rounds = [s for s in segments if s.phase == "warm-up"]
    return MoveWeights.tuned(_independence(rounds[-1])) if rounds else MoveWeights()


def _independence(segment: Segment) -> float:
    """Acceptance of the independence move."""
    return segment.accepted["independence"] / max(segment.proposed["independence"], 1)


def _keep(
    store: Store, group: Ensembles, schedule: Schedule, bar: _Bar
) -> tuple[Quality, list[str]]:
    """Add segments until the criteria are met or the evaluations are used up."""
    while True:
        kept = [s for s in store.segments if s.phase == "kept"]
        done = sum(s.draws for s in kept)
        if done in _decisions(schedule.least, done):
            quality = _quality(kept, group)
            short = quality.shortfalls(schedule, group.ensembles)
            bar.show("sampling", float(quality.sizes.min()), store.segments)
            if not short:
                return quality, []
        steps = min(_decisions(schedule.least, done)[-1] - done, schedule.segment)
        spent = sum(s.evaluations for s in store.segments)
        if spent + steps * group.chains > schedule.max_evaluations:
            return _stopped(kept, group, schedule)
        store.append(group.advance(store.segments[-1], steps, "kept"))


def _decisions(least: int, done: int) -> list[int]:
    """Numbers of draws at which the stopping rule is applied, up to the first after those done.

    They grow by a fifth and depend on nothing else, so that an interrupted run stops at the same
    draw. The diagnostics, whose cost grows with the draws, are thus computed rarely.
    """
    numbers = [least]
    while numbers[-1] <= done:
        numbers.append(int(np.ceil(1.2 * numbers[-1])))
    return numbers


def _stopped(
    kept: list[Segment], group: Ensembles, schedule: Schedule
) -> tuple[Quality, list[str]]:
    if sum(s.draws for s in kept) < 4:  # splitting chains in halves needs this many
        raise InputError(
            "no draw could be kept within so many evaluations",
            key="max_evaluations",
            value=schedule.max_evaluations,
            hint=f"allow at least {4 * schedule.least * group.chains}",
        )
    quality = _quality(kept, group)
    short = quality.shortfalls(schedule, group.ensembles)
    return quality, [f"stopped before {schedule.max_evaluations} evaluations", *short]


def _quality(kept: list[Segment], group: Ensembles) -> Quality:
    draws = np.concatenate([s.coords for s in kept]).swapaxes(0, 1)
    ensemble = np.repeat(np.arange(group.ensembles), group.walkers)
    return Quality(
        autocorrelation_time(draws),
        effective_size_of(draws),
        nested_rhat(draws, ensemble),
        draws.shape[1],
    )


def _every(group: Ensembles, quality: Quality, chains: int, draws: int, quick: bool) -> int:
    """Of how many draws of a chain one is handed on; all are, unless each one costs a factorisation
    a run, or the run is quick: every draw that is handed on is solved for once more."""
    errors = getattr(group.log_density, "errors", None)
    if quick:
        # An autocorrelation time loses a quarter of the information on the quantity that moves
        # most quickly, and less on the others. Where all draws are nearly independent, enough are
        # left: one costs as much to hand on as three to draw.
        most = draws // -(-ENOUGH_QUICK // chains)
        return int(max(1, min(most, max(COSTS, quality.times.min()))))
    if errors is None or not errors.over_runs:
        return 1
    # A quarter of the autocorrelation time loses a hundredth of the information at most.
    return int(max(1, min(chains * draws // ENOUGH, quality.times.min() / 4)))


def _sizes_of_every(quality: Quality, every: int) -> Array:
    """Effective sizes, shape (m,), of every so many draws of chains whose correlation falls as a
    power of the distance."""
    correlation = np.clip((quality.times - 1) / (quality.times + 1), 0.0, 1.0)
    apart = (1 + correlation**every) / np.maximum(1 - correlation**every, 1e-300)
    return np.minimum(quality.sizes, quality.sizes * quality.times / (every * apart))


def _samples(
    segments: list[Segment], group: Ensembles, quality: Quality, short: list[str], quick: bool
) -> Samples:
    kept = [s for s in segments if s.phase == "kept"]
    coords = np.concatenate([s.coords for s in kept]).swapaxes(0, 1)
    every = _every(group, quality, coords.shape[0], coords.shape[1], quick)
    # The last draw of each few, with what failed on the way to all of them.
    first = np.arange(coords.shape[1] % every, coords.shape[1], every)
    last = first + every - 1
    failed = np.concatenate([s.failed for s in kept])[coords.shape[1] % every :]
    coords = coords[:, last]
    chains, draws, dimension = coords.shape
    natural = group.log_density.natural(coords.reshape(-1, dimension))
    proposed = sum((s.proposed for s in kept), start=Counter[str]())
    accepted = sum((s.accepted for s in kept), start=Counter[str]())
    acceptance = {name: accepted[name] / n for name, n in proposed.items() if n}
    acceptance["all"] = accepted.total() / proposed.total()
    return Samples(
        names=group.log_density.names,
        runs=group.log_density.runs,
        draws=natural.reshape(chains, draws, dimension),
        log_density=np.concatenate([s.log_density for s in kept])[last].T,
        log_likelihood=np.concatenate([s.by_run for s in kept])[last].swapaxes(0, 1),
        ensemble=np.repeat(np.arange(group.ensembles), group.walkers),
        start=group.log_density.natural(segments[0].coords[0]),
        mixture=kept[-1].mixture,
        autocorrelation_time=quality.times,
        effective_size=_sizes_of_every(quality, every),
        rhat_nested=quality.rhat,
        acceptance=acceptance,
        evaluations=sum(s.evaluations for s in segments),
        failures=dict(sum((s.failures for s in segments), start=Counter[str]())),
        branch_jumps=sum(s.branch_jumps for s in segments),
        jumped_part=min(1.0, sum(s.branch_jumps for s in kept) / max(accepted.total(), 1)),
        failed=failed.reshape(draws, every, -1).sum(axis=1),
        reached=not short,
        warning="; ".join(short),
    )


class _Bar:
    """Progress towards the effective size."""

    def __init__(self, total: float, shown: bool | float) -> None:
        self._delay = 0.0 if shown is True else shown
        self._bar = tqdm(
            total=round(total), disable=not shown, unit=" effective draws", delay=self._delay
        )
        self._bar.set_description("warm-up", refresh=False)

    def show(self, phase: str, size: float, segments: list[Segment]) -> None:
        self._bar.set_description(phase, refresh=False)
        self._bar.set_postfix(evaluations=sum(s.evaluations for s in segments), refresh=False)
        self._bar.n = min(round(size), self._bar.total)
        if self._bar.format_dict["elapsed"] >= self._delay:
            self._bar.refresh()

    def close(self) -> None:
        self._bar.close()
