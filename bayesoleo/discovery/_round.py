"""One round of the search, and the progress from which a search resumes.

One round of the search: score every effect, estimate the best few, confirm one on runs that were
not used.

How far a search has come: all that it needs to go on after its last finished round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._parallel import thread_map
from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Roles
from bayesoleo.discovery._error_table import least_noise
from bayesoleo.discovery._fit import Numerics
from bayesoleo.discovery._hold_out_confirmation import confirmed
from bayesoleo.discovery._nonparametric_search import CurveSearch
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import ABSORBING_FAMILIES, Ranked, rank, score_candidates
from bayesoleo.discovery._refit import Refit, refit
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import corrected_p, effective_tests
from bayesoleo.discovery._state import State
from bayesoleo.effects._effect import Effect
from bayesoleo.effects._nonparametric import FAMILY

INSIGNIFICANT = "no effect is significant after the correction for the search"


@dataclass(frozen=True)
class Round:
    """Outcome of one round.

    Parameters
    ----------
    before : State
        The model that was examined.
    ranking : tuple of Ranked
        Best first.
    failed : dict of str to str
        Effects that could not be scored, with the reason.
    accepted : Ranked or None
    after : State or None
        With the accepted effect in.
    reason : str
        One sentence.
    tests : float
        Effective number of independent tests of the search.
    nonparametric : CurveSearch or None
        The smooth functions that were tried where no named effect explains what is left.
    """

    before: State
    ranking: tuple[Ranked, ...]
    failed: dict[str, str]
    accepted: Ranked | None
    after: State | None
    reason: str
    tests: float
    nonparametric: CurveSearch | None = None


def examine(
    state: State,
    roles: Roles,
    numerics: Numerics,
    *,
    effects: Sequence[Effect] | None,
    seed: int,
    limit: str = "",
    callback: ProgressCallback,
) -> Round:
    """Look for the effect that a fitted model lacks.

    Parameters
    ----------
    state : State
        The fitted model.
    roles : Roles
        Runs.
    numerics : Numerics
        Scheme, threads.
    effects : sequence of Effect or None
        Instead of the catalogue.
    seed : int
        For the correction for the search.
    limit : str
        Why effects are only ranked and none is accepted; empty where one may be.
    callback : callable
        Told what is being done.
    """
    if limit and any(step.effect.family == FAMILY for step in state.assembly.steps):
        # A curve takes up what named effects would have explained: to rank them says nothing.
        return Round(state, (), {}, None, None, limit, 1.0)
    base, policy = state.base(), numerics.policy
    scores, failed = score_candidates(
        base,
        state.assembly,
        effects,
        numerics.jobs,
        order=lambda _, place: place,
        callback=callback,
    )
    scores.sort(key=lambda score: -score.share)
    tests = effective_tests(scores, seed, policy=policy)
    ranking = rank(scores, tests, {}, policy=policy)
    stop = _stopping_reason(state, ranking, tests, policy)
    if stop is not None or limit:
        return Round(state, ranking, failed, None, None, stop or limit, tests)
    refits = _refit_best(base, ranking, tests, numerics, callback)
    ranking = rank(scores, tests, refits, policy=policy)
    accepted, after, reason = _choose(state, base, ranking, refits, roles, numerics, callback)
    return Round(state, ranking, failed, accepted, after, reason, tests)


def _stopping_reason(
    state: State, ranking: Sequence[Ranked], tests: float, policy: SearchPolicy
) -> str | None:
    worst = state.worst_ratio
    best = max((item.gain for item in ranking), default=0.0)
    if state.at_floor and best < policy.floor_share:
        return (
            f"nothing is missing: the residual is {worst:.2f} times what is expected at most"
            f" and no effect explains more than {100 * best:.0f} % of the excess"
        )
    if not any(_may_be_significant(item, tests, policy) for item in ranking):
        return INSIGNIFICANT
    return None


def _refit_best(
    base: Base,
    ranking: Sequence[Ranked],
    tests: float,
    numerics: Numerics,
    callback: ProgressCallback,
) -> dict[int, Refit]:
    """Estimate the best few effects of physics, and what takes up anything where that may explain
    more than they do."""
    policy = numerics.policy
    level = policy.significance
    significant = [item for item in ranking if item.p_value < level and item.gain > 0]
    named = [item for item in significant if not item.absorbs]
    found = _refit_few(base, named, policy.refits, numerics, callback)
    hidden = _hidden(ranking, named, tests, policy)
    found |= _refit_few(base, hidden, policy.hidden_refits, numerics, callback)
    explained = max((result.share for result in found.values()), default=0.0)
    able = [item for item in ranking if item.absorbs and _may_be_significant(item, tests, policy)]
    able = [item for item in able if item.gain > explained]
    return found | _refit_few(base, able, policy.absorbing_refits, numerics, callback)


def _may_be_significant(item: Ranked, tests: float, policy: SearchPolicy) -> bool:
    """Whether a score would be significant in white noise, which is what an estimate may find.

    Where a step from the null describes an effect badly its score seems to scatter with what the
    step leaves; only its estimate tells whether it does.
    """
    return corrected_p(replace(item.score, inflation=1.0), tests) < policy.significance


def _hidden(
    ranking: Sequence[Ranked], named: Sequence[Ranked], tests: float, policy: SearchPolicy
) -> list[Ranked]:
    """Effects that explain as much as the significant ones do, of which the null says nothing."""
    enough = named[0].gain if named else 0.0
    return [
        item
        for item in ranking
        if not item.absorbs
        and item.p_value >= policy.significance
        and item.gain > policy.near_best * enough
        and _may_be_significant(item, tests, policy)
    ]


def _refit_few(
    base: Base, pool: Sequence[Ranked], most: int, numerics: Numerics, callback: ProgressCallback
) -> dict[int, Refit]:
    """Estimate the best of a pool, best first, as far as they score near it."""
    near = numerics.policy.near_best
    chosen = [item.score for item in pool[:most] if item.gain >= near * pool[0].gain]
    if not chosen:
        return {}
    callback(
        f"estimate the best {len(chosen)}: {', '.join(s.option.candidate.effect for s in chosen)}"
    )
    results = thread_map(lambda score: refit(base, score, numerics), chosen, numerics.jobs)
    return {id(score): result for score, result in zip(chosen, results, strict=True)}


def _only_absorbs(item: Ranked, refits: dict[int, Refit]) -> bool:
    """Whether an effect merely takes up what another does, without need.

    Much that physics does differs between runs, so a parameter of each run's own takes a part of it
    up, whatever is missing; where runs are alike, so does what repeats with the drive; and a mass
    of less than nothing looks like a spring. Such an effect is needed where it explains all that is
    left and no effect of physics does, by more than its additional unknowns are worth (Schwarz
    1978).
    """
    own = refits[id(item.score)]
    if not (item.absorbs or own.unusual):
        return False
    physics = [
        r
        for r in refits.values()
        if r.score.option.candidate.family not in ABSORBING_FAMILIES and r is not own
    ]
    return not (own.reached and own.worth > max((r.worth for r in physics), default=0.0))


def _next(tried: Sequence[Ranked], refits: dict[int, Refit]) -> Ranked:
    """Of effects by falling gain the best for its unknowns, or the simplest near the best.

    What an unknown is worth is known where only noise is left.
    """
    best = refits[id(tried[0].score)]
    if best.reached:
        return max(tried, key=lambda one: refits[id(one.score)].worth)
    least = max(tried[0].gain, 0.0) - best.policy.equal_share
    near = [one for one in tried if one.gain >= least]
    return min(near, key=lambda one: refits[id(one.score)].size)


def _choose(
    state: State,
    base: Base,
    ranking: Sequence[Ranked],
    refits: dict[int, Refit],
    roles: Roles,
    numerics: Numerics,
    callback: ProgressCallback,
) -> tuple[Ranked | None, State | None, str]:
    """The best effect that the runs not used confirm.

    Of effects that leave nothing but noise on the fitted runs and are worth nearly as much there,
    the first that does so on the others too.
    """
    level = numerics.policy.significance
    last = {id(r): _only_absorbs(r, refits) for r in ranking if r.refitted}
    tried = sorted(
        (item for item in ranking if item.refitted and item.p_value < level),
        key=lambda item: (last[id(item)], -item.gain),
    )
    reasons: list[str] = []
    found: tuple[Ranked, State, str] | None = None
    more = numerics.policy.compared
    while tried and more > 0:
        item = _next([one for one in tried if last[id(one)] == last[id(tried[0])]], refits)
        tried.remove(item)
        result = refits[id(item.score)]
        if found is not None and not _as_good(result, refits[id(found[0].score)]):
            continue
        after, reason = confirmed(state, item, result, roles, numerics, callback)
        if after is None:
            reasons.append(reason)
        elif after.at_floor or not result.reached:
            if found is None or after.at_floor:
                return item, after, reason
        elif found is None:
            found = item, after, reason
        more -= found is not None
    if found is not None:
        return found
    if not reasons:
        estimated = any(np.isfinite(one.share) for one in refits.values())
        reasons = [INSIGNIFICANT if estimated else "no candidate could be estimated"]
    return None, None, "; ".join(reasons)


def _as_good(result: Refit, other: Refit) -> bool:
    """Whether an effect leaves nothing but noise and is worth nearly as much as another one."""
    less, policy = other.worth - result.worth, result.policy
    scale = policy.equal_likelihood * max(result.inflation, other.inflation)
    return result.reached and less < policy.compared_worth * scale


@dataclass(frozen=True)
class Progress:
    """A search between two rounds.

    Parameters
    ----------
    first, state : State
        The model as declared, and with the effects that the finished rounds added.
    rounds : tuple of Round
        Those that are finished.
    notes : tuple of str
        What a reader should know so far.
    broken : bool
        Whether it ended before a round found nothing more, or before its final effects had been
        looked at again.
    """

    first: State
    state: State
    rounds: tuple[Round, ...] = ()
    notes: tuple[str, ...] = ()
    broken: bool = False

    @property
    def finished(self) -> bool:
        """Whether the last round accepted nothing, so that no other follows."""
        return bool(self.rounds) and self.rounds[-1].after is None

    def with_same_noise(self) -> Progress:
        """With the errors of all states held against the noise that was found last: it is that of
        the records, and no round has another."""
        noise = self.state.errors.record_noise
        for entry in self.rounds:
            noise = least_noise(noise, entry.before.errors.record_noise)
        known: dict[int, State] = {}

        def same(state: State) -> State:
            return known.setdefault(id(state), state.with_noise(noise))

        rounds = tuple(
            replace(
                entry,
                before=same(entry.before),
                after=None if entry.after is None else same(entry.after),
            )
            for entry in self.rounds
        )
        return replace(self, first=same(self.first), state=same(self.state), rounds=rounds)

    def after(self, outcome: Round, state: State, notes: list[str]) -> Progress:
        """With one more round."""
        return Progress(self.first, state, (*self.rounds, outcome), tuple(notes))

    def ended(self, reason: str) -> Progress:
        """Broken off: with a last round that examined nothing and accepts nothing, where there is
        none. After the last round effects are still looked at again, so that one that has it may
        break off too.

        Parameters
        ----------
        reason : str
            Why the search went no further.
        """
        if self.finished:
            return replace(self, broken=True)
        last = Round(self.state, (), {}, None, None, reason, 1.0)
        return replace(self, rounds=(*self.rounds, last), broken=True)
