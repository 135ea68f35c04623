"""One round of the search, and the progress from which a search resumes.

A round scores every effect, estimates the best few and confirms one on the hold-out runs. The
progress holds everything that the search needs to continue after its last finished round.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Roles
from bayesoleo.discovery._by_other_drive import misleads, with_suggestions
from bayesoleo.discovery._fit_and_hold_out_error import least_noise
from bayesoleo.discovery._fit_difference import undecided
from bayesoleo.discovery._hold_out_confirmation import confirmed
from bayesoleo.discovery._nonparametric_search import CurveSearch
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import ABSORBING_FAMILIES, Ranked, rank, score_candidates
from bayesoleo.discovery._refit import Refit, refit_all
from bayesoleo.discovery._scanned_columns import Scanned
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import corrected_p, effective_tests
from bayesoleo.discovery._state import State
from bayesoleo.discovery._two_effects import confirmed_together
from bayesoleo.effects._effect import Effect
from bayesoleo.effects._nonparametric import FAMILY

JUDGED = "effects that were added on trial are not confirmed beside each other, and were removed"
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
        The effect that was added.
    after : State or None
        The model with the accepted effect.
    reason : str
        Why the effect was accepted, or none was, in one sentence.
    tests : float
        Effective number of independent tests of the search.
    nonparametric : CurveSearch or None
        The smooth functions that were tried where no named effect explains the residual.
    """

    before: State
    ranking: tuple[Ranked, ...]
    failed: dict[str, str]
    accepted: Ranked | None
    after: State | None
    reason: str
    tests: float
    nonparametric: CurveSearch | None = None
    #: Whether the effect was added because of the one that the next round is to confirm.
    on_trial: bool = False
    #: What the candidates change in the outputs, where it was kept.
    _scanned: Scanned | None = field(default=None, compare=False, repr=False)
    #: The next round, where it was looked at before this one ended.
    _ahead: Round | None = field(default=None, compare=False, repr=False)


def examine(
    state: State,
    roles: Roles,
    numerics: Numerics,
    *,
    effects: Sequence[Effect] | None,
    seed: int,
    limit: str = "",
    ahead: bool = False,
    keep_columns: bool = False,
    before: Callable[[], object] = lambda: None,
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
    ahead : bool
        Whether to look one round ahead where all that is confirmed is an effect that names no
        cause.
    keep_columns : bool
        Whether a round that accepts no effect keeps what the candidates change in the outputs.
    before : callable
        What this process does first, while others score candidates.
    callback : callable
        Receives a message at each step.
    """
    if limit and any(step.effect.family == FAMILY for step in state.assembly.steps):
        # A curve absorbs the share of named effects, so that a ranking of them is meaningless.
        before()
        return Round(state, (), {}, None, None, limit, 1.0)
    base, policy, kept = state.base(), numerics.policy, list[Scanned]()
    scores, failed = score_candidates(
        base,
        state.assembly,
        effects,
        numerics.jobs,
        keep=kept.append if keep_columns else None,
        before=before,
        callback=callback,
    )
    scanned = kept[0] if kept else None
    tests = effective_tests(scores, seed, policy=policy)
    # They have served, and are half of what a round takes in memory and where it is kept.
    scores = [replace(one, columns=np.empty((0, one.columns.shape[1]))) for one in scores]
    ranking = rank(scores, tests, {}, policy=policy)
    stop = _stopping_reason(state, ranking, tests, policy)
    if stop is not None or limit:
        return Round(state, ranking, failed, None, None, stop or limit, tests, _scanned=scanned)
    refits = _refit_best(base, ranking, tests, numerics, callback)
    if misleads(state, refits):
        refits = with_suggestions(state, base, ranking, refits, effects, numerics, callback)
    ranking = rank(scores, tests, refits, base=base, policy=policy)
    fitted: dict[int, State] = {}
    accepted, after, reason = _choose(
        state, base, ranking, refits, roles, numerics, callback, fitted
    )
    pair, looked = None, list[Round]()
    if ahead and accepted is not None and _explains_nothing(refits[id(accepted.score)]):

        def follow(one: State) -> tuple[Ranked | None, State | None]:
            looked.append(
                examine(one, roles, numerics, effects=effects, seed=seed, callback=callback)
            )
            return looked[-1].accepted, looked[-1].after

        pair = confirmed_together(state, ranking, refits, roles, numerics, follow, callback, fitted)
        accepted, after, reason = pair or (accepted, after, reason)
    if accepted is not None and after is not None and np.isnan(after.worst_ratio):
        reason = f"with {accepted.effect} a run has no solution at the estimate"
        accepted, after = None, None
    scanned = scanned if after is None else None  # of a model that is final
    trial = pair is not None and after is not None
    then = next((one for one in looked if one.before is after), None)
    return Round(
        state, ranking, failed, accepted, after, reason, tests,
        on_trial=trial, _scanned=scanned, _ahead=then,
    )  # fmt: skip


def _explains_nothing(result: Refit) -> bool:
    """Whether an effect names no cause and leaves more than noise."""
    return result.score.option.candidate.family in ABSORBING_FAMILIES and not result.reached


def _stopping_reason(
    state: State, ranking: Sequence[Ranked], tests: float, policy: SearchPolicy
) -> str | None:
    worst = state.worst_ratio
    best = max((item.gain for item in ranking), default=0.0)
    if state.at_floor and best < policy.floor_share:
        return (
            f"no effect is missing: the residual is at most {worst:.2f} times the expected error"
            f" and no effect explains more than {100 * best:.1f} % of the excess"
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
    """Estimate the best few physical effects, and effects of absorbing families if these may
    explain more."""
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
    """Whether a score would be significant in white noise.

    Linearisation at the null is poor for some effects. The inflation of their score then includes
    the error of the linearisation, and only an estimate shows whether they are significant.
    """
    return corrected_p(replace(item.score, inflation=1.0), tests) < policy.significance


def _hidden(
    ranking: Sequence[Ranked], named: Sequence[Ranked], tests: float, policy: SearchPolicy
) -> list[Ranked]:
    """Effects that explain as much as the significant ones, but whose score is inconclusive."""
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
    """Estimate the best of a pool, and those that score near the best."""
    near = numerics.policy.near_best
    chosen = [item.score for item in pool[:most] if item.gain >= near * pool[0].gain]
    if not chosen:
        return {}
    callback(
        f"estimate the best {len(chosen)}: {', '.join(s.option.candidate.effect for s in chosen)}"
    )
    results = refit_all(base, chosen, numerics)
    return {id(score): result for score, result in zip(chosen, results, strict=True)}


def _only_absorbs(item: Ranked, refits: dict[int, Refit]) -> bool:
    """Whether an effect merely absorbs another one.

    Most physical effects differ between runs, so that a by-run parameter absorbs a part of any
    missing effect. Where runs are alike, a force that repeats with the drive does so too, and a
    negative mass resembles a spring. Such an effect is needed only if it explains the whole
    residual and no physical effect does, by more than the price of its additional unknowns
    (Schwarz 1978).
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
    """The next effect to confirm, among effects sorted by falling gain.

    If the best leaves only noise, the effect with the best penalised sum of squares is next: the
    price of an unknown is known there. Otherwise it is the simplest effect near the best.
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
    fitted: dict[int, State] | None = None,
) -> tuple[Ranked | None, State | None, str]:
    """The best effect that the hold-out runs confirm; ``fitted`` keeps what was fitted for that.

    Among effects that leave only noise on the fitted runs and have nearly the same penalised sum
    of squares there, the first that also leaves only noise on the hold-out runs is chosen.
    """
    level = numerics.policy.significance
    last = {id(r): _only_absorbs(r, refits) for r in ranking if r.refitted}
    tried = sorted(
        (item for item in ranking if item.refitted and item.may_be_tried(level)),
        key=lambda item: (last[id(item)], -item.gain),
    )
    reasons: list[str] = []
    found: tuple[Ranked, State, str] | None = None
    more = numerics.policy.compared
    while tried and more > 0:
        item = _next([one for one in tried if last[id(one)] == last[id(tried[0])]], refits)
        tried.remove(item)
        result = refits[id(item.score)]
        if found is not None and not _as_good(base, result, refits[id(found[0].score)]):
            continue
        after, reason = confirmed(
            state, item, result, roles, numerics, callback, on_trial=True, fitted=fitted
        )
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


def _as_good(base: Base, result: Refit, other: Refit) -> bool:
    """Whether an effect leaves only noise and its worth is close to that of another one."""
    less = other.worth - result.worth
    return (
        result.reached and less < result.policy.compared_worth * undecided(base, result, other).most
    )


@dataclass(frozen=True)
class Progress:
    """A search between two rounds.

    Parameters
    ----------
    first, state : State
        The model as declared, and with the effects that the finished rounds added.
    rounds : tuple of Round
        The finished rounds.
    notes : tuple of str
        Remarks on the search so far, as sentences.
    broken : bool
        Whether the search was stopped before a round found no further effect, or before the
        review of its final effects.
    """

    first: State
    state: State
    rounds: tuple[Round, ...] = ()
    notes: tuple[str, ...] = ()
    broken: bool = False

    @property
    def finished(self) -> bool:
        """Whether the last round accepted no effect, so that no other round follows."""
        return bool(self.rounds) and self.rounds[-1].after is None

    def with_same_noise(self) -> Progress:
        """The search with the errors of all states relative to one noise, that of the records as
        found last."""
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
        """The search with one more round."""
        before = (replace(one, _scanned=None) if one._scanned else one for one in self.rounds)
        return Progress(self.first, state, (*before, outcome), tuple(notes))

    def ended(self, reason: str) -> Progress:
        """The search, stopped early. An empty last round is added unless the search has a last
        round; a search that has one may still be stopped during its review.

        Parameters
        ----------
        reason : str
            Why the search went no further.
        """
        if self.finished:
            return replace(self, broken=True)
        last = Round(self.state, (), {}, None, None, reason, 1.0)
        return replace(self, rounds=(*self.rounds, last), broken=True)
