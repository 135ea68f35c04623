"""Sampler of the posterior: adaptation, stopping rule and result."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesoleo._parallel import connected, single_blas_thread
from bayesoleo.errors import InputError, choose, import_extra
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._problem import unwatched
from bayesoleo.posterior._checkpoints import Segment, Store, open_store
from bayesoleo.posterior._diagnostics import Samples, autocorrelation_time
from bayesoleo.posterior._log_density import Density, LogDensity
from bayesoleo.posterior._mixture import Mixture
from bayesoleo.posterior._mode_search import with_other_modes
from bayesoleo.posterior._shared_density import DistributedDensity, SharedDensity
from bayesoleo.posterior._stopping import (
    ProgressBar,
    Quality,
    Schedule,
    decisions,
    quality_of,
    sizes_of_every,
    stride_of,
)

if TYPE_CHECKING:
    from bayesoleo.posterior._ensemble_moves import Ensembles, MoveWeights

#: Samplers by name: ensembles of walkers, and the no-U-turn sampler.
SAMPLERS = (ENSEMBLE, NUTS) = ("ensemble", "nuts")
#: Starting points of the mode search, in full and in quick runs.
CLIMBS, QUICK_CLIMBS = 32, 16
#: Fraction of the evaluations that the mode search may take.
SEARCHING = 0.25
#: Evaluations of the log density at which a quick run ends, converged or not, and time steps in all
#: after which it ends too, but not before this number of moves of each walker: half a minute.
QUICK_EVALUATIONS, QUICK_TIME_STEPS, QUICK_STEPS = 40_000, 70_000_000, 64
#: Acceptance of the independence move below which its mixture misses the posterior.
MISSES = 0.15


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
    sampler: str = ENSEMBLE,
    target_accept: float = 0.8,
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
        scheduler. The draws are the same. With ``"nuts"`` chains run in threads of this process.
    sampler : {"ensemble", "nuts"}
        ``"nuts"`` is the no-U-turn sampler of nutpie, which follows the gradient: for posteriors
        that are strongly curved or have many dimensions. It takes ``ensembles`` chains, no
        ``walkers`` or ``weights``, and cannot resume: a run that was stopped starts over, and only
        a complete one is kept in ``out``. The density must be a
        :class:`~bayesoleo.posterior.LogDensity` whose problem has derivatives, or have a method
        ``with_gradient(phi)`` that returns the log density at one point (d,) and its gradient (d,)
        and may be called from several threads. Chains do not move between modes that are apart.
    target_accept : float
        Of ``"nuts"``: mean acceptance to which the step size is adapted. Larger values take
        smaller steps, where trajectories diverge.

    Returns
    -------
    Samples
        With ``reached`` False and a ``warning`` if it stopped at ``max_evaluations``. With
        ``"nuts"`` the warning also tells of trajectories that diverged.

    Raises
    ------
    InputError
        If walkers are too few, or none finds a finite log density; if there is no such sampler, or
        the density has no gradient for it.
    MissingExtraError
        If nutpie is not installed.
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
    number = (QUICK_CLIMBS if quick else CLIMBS) if climbs is None else climbs
    place = None if out is None else Path(out)
    if check_sampler(sampler) == NUTS:
        for key, value in (("walkers", walkers), ("weights", weights), ("scheduler", scheduler)):
            if value is not None:
                raise InputError(
                    "does not belong to the no-U-turn sampler", key=key, value=value,
                    hint='leave it out, or use sampler="ensemble"',
                )  # fmt: skip
        if quick:
            max_evaluations = min(max_evaluations, _quick_evaluations(log_density))
        schedule = _schedule(effective_size, max_evaluations, segment, quick)
        return _by_nuts(
            log_density, start, schedule, ensembles, seed, place, fingerprint, progress, quick,
            number, target_accept,
        )  # fmt: skip
    # emcee brings all of scipy.stats, which a search would wait for.
    from bayesoleo.posterior._ensemble_moves import Ensembles, MoveWeights, default_walkers

    group = Ensembles(
        log_density, ensembles, walkers or default_walkers(dimension), weights or MoveWeights()
    )
    if quick:
        most = max(_quick_evaluations(log_density), QUICK_STEPS * group.chains)
        max_evaluations = min(max_evaluations, most)
    schedule = _schedule(effective_size, max_evaluations, segment, quick)
    print_of_run = _fingerprint(fingerprint, group, start, seed, schedule, number)
    with open_store(place, print_of_run) as store, connected(scheduler) as client:
        if client is not None:
            group = replace(group, log_density=DistributedDensity(log_density, client))
        bar = ProgressBar(schedule.effective_size, progress)
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


def check_sampler(word: str) -> str:
    """The word, if there is such a sampler.

    Raises
    ------
    InputError
        If there is none.
    """
    if word not in SAMPLERS:
        hint = choose(word, SAMPLERS)
        raise InputError("unknown sampler", key="sampler", value=word, hint=hint)
    return word


def _by_nuts(
    log_density: Density,
    start: Mixture,
    schedule: Schedule,
    chains: int,
    seed: int,
    place: Path | None,
    given: str,
    progress: bool | float,
    quick: bool,
    climbs: int,
    target_accept: float,
) -> Samples:
    """Draws by the no-U-turn sampler; those of a complete run that was stored are read."""
    from bayesoleo.posterior import _nuts

    tune = _nuts.QUICK_TUNE if quick else _nuts.TUNE
    schedule = _nuts.with_quick_budget(schedule, chains) if quick else schedule
    settings = [
        given, log_density.names, log_density.runs, chains, seed, tune, schedule.least, climbs,
        target_accept, np.asarray(start.degrees).tolist(),
    ]  # fmt: skip
    if chains < 2:
        raise InputError("agreement between chains needs two", key="ensembles", value=chains)
    import_extra("nutpie", "nuts")
    with _nuts.stored(place, _digest(settings, start)) as slots:
        whole = slots.read(0)
        trace = None if whole is None else _nuts.Trace.of(whole)
        if trace is None or not _nuts.serves(trace, schedule):
            bar = ProgressBar(schedule.effective_size, progress)
            try:
                mixture, spent = _searched(log_density, start, seed, climbs, schedule)
                trace = _nuts.draw(
                    log_density, mixture, schedule, chains=chains, seed=seed, tune=tune,
                    target_accept=target_accept, bar=bar,
                )  # fmt: skip
            finally:
                bar.close()
            trace = replace(trace, warm_up=trace.warm_up + spent)
            slots.write(0, trace.arrays())
    return _nuts.samples_of(trace, log_density, schedule, quick=quick)


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
        return Schedule(min(effective_size, 200.0), evaluations, 20, 3, 1, 16, 5.0, segment)
    return Schedule(effective_size, evaluations, 20, 6, 2, 50, 20.0, segment)


def _fingerprint(
    given: str, group: Ensembles, start: Mixture, seed: int, schedule: Schedule, climbs: int
) -> str:
    """Hash of all that determines the draws; a larger effective size only continues them."""
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
    return _digest(settings, start)


def _digest(settings: list[Any], start: Mixture) -> str:
    """Hash of settings and of the mixture of the start."""
    digest = hashlib.sha256()
    digest.update(json.dumps(settings).encode())
    for array in (start.centres, start.covariances, start.log_weights):
        # Rounded: the mode found on another machine differs in the last bits, and what is stored
        # holds the mode that was used.
        digest.update(np.array2string(array, precision=6, threshold=array.size + 1).encode())
    return digest.hexdigest()


def _first(group: Ensembles, start: Mixture, seed: int, climbs: int, schedule: Schedule) -> Segment:
    """Walkers drawn from the start and from modes found beside it."""
    start, spent = _searched(group.log_density, start, seed, climbs, schedule)
    first = group.start(start, seed)
    return replace(first, evaluations=first.evaluations + spent)


def _searched(
    log_density: Density, start: Mixture, seed: int, climbs: int, schedule: Schedule
) -> tuple[Mixture, int]:
    """The start with modes found beside it, and the rows that the search took."""
    # A climb takes about a dozen times twenty rows plus one for each coordinate.
    climbs = min(climbs, int(SEARCHING * schedule.max_evaluations / (12 * (20 + start.dimension))))
    if climbs <= 0:
        return start, 0
    # A separate generator: if no mode is found, the draws are the same as without the search.
    rng = np.random.default_rng([seed, climbs])
    # What it looks at lies far beyond what is sampled: jumps there say nothing of that.
    with unwatched(log_density):
        most = SEARCHING * schedule.max_evaluations
        return with_other_modes(log_density, start, climbs, rng, most)


def _warm_up(
    store: Store, group: Ensembles, schedule: Schedule, bar: ProgressBar, tuned: bool
) -> None:
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
        bar.show("warm-up", 0.0, _spent(store.segments))
        store.append(now.advance(store.segments[-1], steps, "warm-up"))


def _is_warm(segments: list[Segment], schedule: Schedule) -> bool:
    rounds = [s for s in segments if s.phase == "warm-up"]
    if any(s.phase == "kept" for s in segments) or len(rounds) >= schedule.most_rounds:
        return True
    spent = _spent(segments)
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
    from bayesoleo.posterior._ensemble_moves import MoveWeights  # as in :func:`sample`

    rounds = [s for s in segments if s.phase == "warm-up"]
    return MoveWeights.tuned(_independence(rounds[-1])) if rounds else MoveWeights()


def _independence(segment: Segment) -> float:
    """Acceptance of the independence move."""
    return segment.accepted["independence"] / max(segment.proposed["independence"], 1)


def _keep(
    store: Store, group: Ensembles, schedule: Schedule, bar: ProgressBar
) -> tuple[Quality, list[str]]:
    """Add segments until the criteria are met or the evaluations are used up."""
    while True:
        kept = [s for s in store.segments if s.phase == "kept"]
        done = sum(s.draws for s in kept)
        if done in decisions(schedule.least, done):
            quality = _quality(kept, group)
            short = quality.shortfalls(schedule, group.ensembles)
            bar.show("sampling", float(quality.sizes.min()), _spent(store.segments))
            if not short:
                return quality, []
        steps = min(decisions(schedule.least, done)[-1] - done, schedule.segment)
        spent = _spent(store.segments)
        if spent + steps * group.chains > schedule.max_evaluations:
            return _stopped(kept, group, schedule)
        store.append(group.advance(store.segments[-1], steps, "kept"))


def _spent(segments: list[Segment]) -> int:
    """Rows of the log density so far."""
    return sum(segment.evaluations for segment in segments)


def _quality(kept: list[Segment], group: Ensembles) -> Quality:
    draws = np.concatenate([s.coords for s in kept]).swapaxes(0, 1)
    return quality_of(draws, np.repeat(np.arange(group.ensembles), group.walkers))


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


def _samples(
    segments: list[Segment], group: Ensembles, quality: Quality, short: list[str], quick: bool
) -> Samples:
    kept = [s for s in segments if s.phase == "kept"]
    coords = np.concatenate([s.coords for s in kept]).swapaxes(0, 1)
    errors = getattr(group.log_density, "errors", None)
    every = stride_of(errors, quality, coords.shape[0], coords.shape[1], quick)
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
        effective_size=sizes_of_every(quality, every),
        rhat_nested=quality.rhat,
        acceptance=acceptance,
        evaluations=_spent(segments),
        failures=dict(sum((s.failures for s in segments), start=Counter[str]())),
        branch_jumps=sum(s.branch_jumps for s in segments),
        jumped_part=min(1.0, sum(s.branch_jumps for s in kept) / max(accepted.total(), 1)),
        failed=failed.reshape(draws, every, -1).sum(axis=1),
        reached=not short,
        warning="; ".join(short),
    )
