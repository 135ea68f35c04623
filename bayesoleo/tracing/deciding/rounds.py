"""One round of the search: score every effect, estimate the best few, confirm one on runs that were
not used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo.effects import Effect
from bayesoleo.effects.unnamed import FAMILY
from bayesoleo.parallel import thread_map
from bayesoleo.tracing.deciding.confirmation import confirmed
from bayesoleo.tracing.deciding.refit import AS_LIKELY, Refit, refit
from bayesoleo.tracing.deciding.state import State
from bayesoleo.tracing.fitting.assembly import Option
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.fitting.roles import Roles
from bayesoleo.tracing.scoring.base import Base
from bayesoleo.tracing.scoring.scales import scales_of
from bayesoleo.tracing.scoring.score import Score, score_all
from bayesoleo.tracing.scoring.significance import (
    classes,
    corrected_p,
    effective_tests,
    without_twins,
)
from bayesoleo.tracing.unnamed.search import Search

#: The search ends at the floor if no candidate explains this part of the excess.
FLOOR_SHARE = 0.10
#: Nominal probability of adding an effect to data that lack none.
LEVEL = 0.01
#: Candidates estimated before one is chosen, and how far behind the best a score may lie to be
#: among them.
MOST_REFITS, NEAR = 6, 0.25
#: The same of what only its estimate can show to be significant.
MOST_HIDDEN = 2
#: The same of what takes up a part of whatever is missing.
MOST_IMITATING = 3
#: Effects after estimation within this share of the best are as good; the simplest of them is
#: taken.
AS_GOOD = 0.02
#: Effects that runs not used are asked about where the first is not down to the noise on them, and
#: by how many times what makes two effects equally likely they may be worth less than it.
MOST_COMPARED, CLOSE = 4, 2.0

INSIGNIFICANT = "no effect is significant after the correction for the search"
#: Families of effects that take up a part of whatever is missing: what varies from run to run, and
#: what repeats with the drive.
IMITATORS = frozenset({"run-to-run", "clock"})

Say = Callable[[str], None]


@dataclass(frozen=True)
class Ranked:
    """A scored candidate with what the search makes of it.

    Parameters
    ----------
    score : Score
    p_value : float
        Corrected for the search.
    gain : float
        Share of the excess, after estimation where it was estimated.
    refitted : bool
        Whether it was.
    same : tuple of str
        Ids of effects that these data cannot tell from it.
    refit : Refit or None
        The extended model, where it was estimated.
    closest : tuple of (str, float)
        Of an unnamed effect: the named ones most like it, with the cosine between what they change.
    beside : Refit or None
        Its estimate beside the other effects of the final model, where these are others than when
        it was added.
    """

    score: Score
    p_value: float
    gain: float
    refitted: bool
    same: tuple[str, ...]
    refit: Refit | None = None
    closest: tuple[tuple[str, float], ...] = ()
    beside: Refit | None = None

    @property
    def effect(self) -> str:
        """Canonical id."""
        return self.score.option.candidate.effect

    @property
    def target(self) -> str:
        """Where it sits."""
        return self.score.option.candidate.target

    @property
    def imitates(self) -> bool:
        """Whether it takes up a part of whatever is missing, and names no cause."""
        return self.score.option.candidate.family in IMITATORS


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
    unnamed : Search or None
        The smooth functions that were tried where no named effect explains what is left.
    """

    before: State
    ranking: tuple[Ranked, ...]
    failed: dict[str, str]
    accepted: Ranked | None
    after: State | None
    reason: str
    tests: float
    unnamed: Search | None = None


def examine(
    state: State,
    roles: Roles,
    numerics: Numerics,
    *,
    effects: Sequence[Effect] | None,
    seed: int,
    limit: str = "",
    say: Say,
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
    say : callable
        Told what is being done.
    """
    if limit and any(step.effect.family == FAMILY for step in state.assembly.steps):
        # A curve takes up what named effects would have explained: to rank them says nothing.
        return Round(state, (), {}, None, None, limit, 1.0)
    scales = scales_of(state.fit, state.assembly.drive, tuple(state.assembly.native.dofs))
    options = state.assembly.options(scales, None if effects is None else tuple(effects))
    say(f"score {len(options)} candidates")
    base = state.base()
    scores, failed = _scored(base, options, numerics)
    tests = effective_tests(scores, seed)
    ranking = rank(scores, tests, {})
    stop = _stopping_reason(state, ranking, tests)
    if stop is not None or limit:
        return Round(state, ranking, failed, None, None, stop or limit, tests)
    refits = _refit_best(base, ranking, tests, numerics, say)
    ranking = rank(scores, tests, refits)
    accepted, after, reason = _choose(state, base, ranking, refits, roles, numerics, say)
    return Round(state, ranking, failed, accepted, after, reason, tests)


def _scored(
    base: Base, options: Sequence[Option], numerics: Numerics
) -> tuple[list[Score], dict[str, str]]:
    """Scores by falling share, each effect once, and why there is none for others."""
    scores, failed = score_all(base, options, numerics.jobs)
    order = {option.key: k for k, option in enumerate(options)}
    kept, twins = without_twins(sorted(scores, key=lambda score: order[score.option.key]))
    return sorted(kept, key=lambda score: -score.share), failed | twins


def rank(scores: Sequence[Score], tests: float, refits: dict[int, Refit]) -> tuple[Ranked, ...]:
    """Scores with what the search makes of them, those first that were estimated.

    Parameters
    ----------
    scores : sequence of Score
    tests : float
        Effective number of independent tests.
    refits : dict of int to Refit
        By the ``id`` of the score.
    """
    groups = classes(scores)
    ranked = []
    for k, score in enumerate(scores):
        same = _same(scores, k, groups[k], refits)
        fitted = refits.get(id(score))
        if fitted is not None and not np.isfinite(fitted.share):
            fitted = None  # an estimate that failed says no more than the score
        # The excess is known up to noise: what explains all of it must not seem to explain more.
        gain = min(score.share if fitted is None else max(fitted.share, 0.0), 1.0)
        p = corrected_p(score if fitted is None else _estimated(score, fitted), tests)
        ranked.append(Ranked(score, p, gain, fitted is not None, same, fitted))
    # What was estimated is known better than what was only scored, and comes first.
    return tuple(sorted(ranked, key=lambda item: (not item.refitted, -item.gain)))


def _estimated(score: Score, fitted: Refit) -> Score:
    """A score with what was found by estimation in place of what was expected at the null."""
    return replace(score, fall=fitted.fall, inflation=fitted.inflation, freedom=fitted.freedom)


def _same(
    scores: Sequence[Score], k: int, group: Sequence[int], refits: dict[int, Refit]
) -> tuple[str, ...]:
    """Effects that look like number ``k``, by their estimates where both have one."""
    own, found = refits.get(id(scores[k])), []
    for j, other in enumerate(scores):
        estimated = refits.get(id(other))
        if j == k:
            continue
        if own is not None and estimated is not None and np.isfinite(estimated.share):
            alike = own.resembles(estimated)
        elif own is not None and estimated is not None and own.reached:
            # An estimate that failed tells nothing apart from what its score promises.
            alike = not own.outdoes(other)
        else:
            alike = j in group and not (own is not None and own.outdoes(other))
        if alike:
            found.append(name_among(scores[k], other))
    return tuple(dict.fromkeys(found))


def name_among(own: Score, other: Score) -> str:
    """What the class of an effect calls another one: by its place as well if the id is the same."""
    effect, target = other.option.key
    return f"{effect} @ {target}" if effect == own.option.key[0] else effect


def _stopping_reason(state: State, ranking: Sequence[Ranked], tests: float) -> str | None:
    worst = state.worst_ratio
    best = max((item.gain for item in ranking), default=0.0)
    if state.at_floor and best < FLOOR_SHARE:
        return (
            f"nothing is missing: the residual is {worst:.2f} times what is expected at most"
            f" and no effect explains more than {100 * best:.0f} % of the excess"
        )
    if not any(_may_be_significant(item, tests) for item in ranking):
        return INSIGNIFICANT
    return None


def _refit_best(
    base: Base, ranking: Sequence[Ranked], tests: float, numerics: Numerics, say: Say
) -> dict[int, Refit]:
    """Estimate the best few effects of physics, and what takes up anything where that may explain
    more than they do."""
    significant = [item for item in ranking if item.p_value < LEVEL and item.gain > 0]
    named = [item for item in significant if not item.imitates]
    found = _refit_few(base, named, MOST_REFITS, numerics, say)
    hidden = _hidden(ranking, named, tests)
    found |= _refit_few(base, hidden, MOST_HIDDEN, numerics, say)
    explained = max((result.share for result in found.values()), default=0.0)
    able = [item for item in ranking if item.imitates and _may_be_significant(item, tests)]
    able = [item for item in able if item.gain > explained]
    return found | _refit_few(base, able, MOST_IMITATING, numerics, say)


def _may_be_significant(item: Ranked, tests: float) -> bool:
    """Whether a score would be significant in white noise, which is what an estimate may find.

    Where a step from the null describes an effect badly its score seems to scatter with what the
    step leaves; only its estimate tells whether it does.
    """
    return corrected_p(replace(item.score, inflation=1.0), tests) < LEVEL


def _hidden(ranking: Sequence[Ranked], named: Sequence[Ranked], tests: float) -> list[Ranked]:
    """Effects that explain as much as the significant ones do, of which the null says nothing."""
    enough = named[0].gain if named else 0.0
    return [
        item
        for item in ranking
        if not item.imitates
        and item.p_value >= LEVEL
        and item.gain > NEAR * enough
        and _may_be_significant(item, tests)
    ]


def _refit_few(
    base: Base, pool: Sequence[Ranked], most: int, numerics: Numerics, say: Say
) -> dict[int, Refit]:
    """Estimate the best of a pool, best first, as far as they score near it."""
    chosen = [item.score for item in pool[:most] if item.gain >= NEAR * pool[0].gain]
    if not chosen:
        return {}
    say(f"estimate the best {len(chosen)}: {', '.join(s.option.candidate.effect for s in chosen)}")
    results = thread_map(lambda score: refit(base, score, numerics), chosen, numerics.jobs)
    return {id(score): result for score, result in zip(chosen, results, strict=True)}


def _only_imitates(item: Ranked, refits: dict[int, Refit]) -> bool:
    """Whether an effect merely takes up what another does, without need.

    Much that physics does differs between runs, so a parameter of each run's own takes a part of it
    up, whatever is missing; where runs are alike, so does what repeats with the drive; and a mass
    of less than nothing looks like a spring. Such an effect is needed where it explains all that is
    left and no effect of physics does, by more than its additional unknowns are worth (Schwarz
    1978).
    """
    own = refits[id(item.score)]
    if not (item.imitates or own.unusual):
        return False
    physics = [
        r
        for r in refits.values()
        if r.score.option.candidate.family not in IMITATORS and r is not own
    ]
    return not (own.reached and own.worth > max((r.worth for r in physics), default=0.0))


def _next(tried: Sequence[Ranked], refits: dict[int, Refit]) -> Ranked:
    """Of effects by falling gain the best for its unknowns, or the simplest near the best.

    What an unknown is worth is known where only noise is left.
    """
    if refits[id(tried[0].score)].reached:
        return max(tried, key=lambda one: refits[id(one.score)].worth)
    near = [one for one in tried if one.gain >= max(tried[0].gain, 0.0) - AS_GOOD]
    return min(near, key=lambda one: refits[id(one.score)].size)


def _choose(
    state: State,
    base: Base,
    ranking: Sequence[Ranked],
    refits: dict[int, Refit],
    roles: Roles,
    numerics: Numerics,
    say: Say,
) -> tuple[Ranked | None, State | None, str]:
    """The best effect that the runs not used confirm.

    Of effects that leave nothing but noise on the fitted runs and are worth nearly as much there,
    the first that does so on the others too.
    """
    last = {id(r): _only_imitates(r, refits) for r in ranking if r.refitted}
    tried = sorted(
        (item for item in ranking if item.refitted and item.p_value < LEVEL),
        key=lambda item: (last[id(item)], -item.gain),
    )
    reasons: list[str] = []
    found: tuple[Ranked, State, str] | None = None
    more = MOST_COMPARED
    while tried and more > 0:
        item = _next([one for one in tried if last[id(one)] == last[id(tried[0])]], refits)
        tried.remove(item)
        result = refits[id(item.score)]
        if found is not None and not _as_good(result, refits[id(found[0].score)]):
            continue
        after, reason = confirmed(state, item, result, roles, numerics, say)
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
    less = other.worth - result.worth
    return result.reached and less < CLOSE * AS_LIKELY * max(result.inflation, other.inflation)
