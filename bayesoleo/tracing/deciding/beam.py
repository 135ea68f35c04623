"""Other first effects carried forward, and final models compared.

The effect that explains most by itself is not always part of the best model of several; and of two
that are missing each alone may predict other runs worse than none. Where the search ended with more
than one effect, left more than noise, or added no cause but what varies from run to run, the first
effects that were nearly as good as the one that was taken are followed to their ends too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.effects import Effect
from bayesoleo.effects.unnamed import FAMILY
from bayesoleo.tracing.deciding.confirmation import confirmed, judged, speak_against
from bayesoleo.tracing.deciding.elimination import dispersion
from bayesoleo.tracing.deciding.fall import fall_on_hold_out
from bayesoleo.tracing.deciding.lookahead import leads_as_far
from bayesoleo.tracing.deciding.progress import Progress
from bayesoleo.tracing.deciding.ranking import ABSORBING_FAMILIES, Ranked
from bayesoleo.tracing.deciding.refit import fall_from, schwarz_price
from bayesoleo.tracing.deciding.rounds import Round
from bayesoleo.tracing.deciding.state import fit_state
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.fitting.roles import Roles
from bayesoleo.tracing.policy import SearchPolicy


def best_of_beam(
    progress: Progress,
    roles: Roles,
    numerics: Numerics,
    follow: Callable[[Progress, int], Progress],
    effects: Sequence[Effect] | None,
    max_effects: int,
    callback: ProgressCallback,
) -> Progress:
    """The best final model that the best few first effects lead to.

    Parameters
    ----------
    progress : Progress
        A finished search.
    roles : Roles
    numerics : Numerics
    follow : callable (progress, most) -> Progress
        Carries a search on to its end, with so many effects at most.
    effects : sequence of Effect or None
        Instead of the catalogue.
    max_effects : int
        Effects added at most.
    callback : callable
        Told what is being done.

    Returns
    -------
    Progress
        Finished. Effects of other final models that are about as likely stand in the classes of
        those that are in their place here.
    """
    best = progress
    for first in followed(progress, numerics.policy):
        if (first.effect, first.target) in best.state.assembly.added:
            continue
        if not leads_as_far(progress, first, roles, numerics, effects, callback):
            continue
        callback(f"follow {first.effect} as the first effect instead")
        other = _followed(progress, first, roles, numerics, follow, max_effects, callback)
        if other is not None and other.state.assembly.added:
            best = _better(best, other, numerics.policy, callback)
    return best


def followed(progress: Progress, policy: SearchPolicy) -> list[Ranked]:
    """First effects that were nearly as good as the one that was taken, the best first.

    None where one effect alone led down to the noise. Those that the data could not tell from it
    are looked at in its place by the review.
    """
    opening, final = progress.rounds[0], progress.state
    taken = opening.accepted
    curve = any(step.effect.family == FAMILY for step in final.assembly.steps)
    alone = taken is not None and not taken.absorbs and len(final.assembly.added) < 2 and not curve
    if final.at_floor and (taken is None or alone):
        return []
    pool = [
        (item.refit.worth, item)
        for item in opening.ranking
        if item.refit is not None
        and np.isfinite(item.refit.share)
        and item.p_value < policy.significance
        and not item.absorbs
        and item.score.option.candidate.family != FAMILY
    ]
    most = max((worth for worth, _ in pool), default=0.0)
    clear = final.at_floor and not curve and not _absorbs(progress)
    behind = policy.followed_behind_clear if clear else policy.followed_behind
    seen = set(final.assembly.added)
    alike = set() if taken is None else {taken.effect, *taken.same}
    chosen: list[Ranked] = []
    for worth, item in sorted(pool, key=lambda one: -one[0]):
        names = {item.effect, f"{item.effect} @ {item.target}"}
        if worth > (1.0 - behind) * most and (item.effect, item.target) not in seen:
            if not names & alike:
                chosen.append(item)
            alike |= names | set(item.same)
    return chosen[: policy.followed]


def _followed(
    progress: Progress,
    first: Ranked,
    roles: Roles,
    numerics: Numerics,
    follow: Callable[[Progress, int], Progress],
    max_effects: int,
    callback: ProgressCallback,
) -> Progress | None:
    opening, result = progress.rounds[0], first.refit
    assert result is not None
    after, reason = confirmed(opening.before, first, result, roles, numerics, callback)
    provisional = after is None
    if after is None:
        if result.share < numerics.policy.fair_share or not result.excludes_null():
            return None
        after = fit_state(result.assembly, roles, numerics, start=result.fit.point.theta)
        reason += "; it is taken on trial, to be confirmed together with the next one"
    present = len(progress.state.assembly.added)
    few = progress.state.at_floor and not (opening.accepted and opening.accepted.absorbs)
    most = max(present, 2) if few else min(max(present + 1, 2), max_effects)
    begun = Round(
        opening.before, opening.ranking, opening.failed, first, after, reason, opening.tests
    )
    # Of the notes only that on the roles holds for the other search too.
    notes = tuple(note for note in progress.notes if note == roles.description)
    found = follow(Progress(progress.first, after, (begun,), notes), most)
    if provisional and not _together_confirmed(found):
        return None
    return found


def _together_confirmed(found: Progress) -> bool:
    """Whether effects of which the first was refused by itself are confirmed together."""
    if len(found.state.assembly.added) < 2:
        return False
    return fall_on_hold_out(*judged(found.first, found.state), _inflation(found)).confirms


def _better(
    best: Progress, other: Progress, policy: SearchPolicy, callback: ProgressCallback
) -> Progress:
    """The better of two finished searches, with the other's effects in its classes if it is about
    as likely."""
    gap, scale = likelihood_gap(best, other)
    if set(best.state.assembly.added) == set(other.state.assembly.added):
        return best
    if (best.state.at_floor and not other.state.at_floor) or speak_against(
        best.state, other.state, _inflation(best)
    ):
        return best
    curve = any(step.effect.family == FAMILY for step in best.state.assembly.steps)
    symptom = _absorbs(best) and not _absorbs(other)
    equal = policy.equal_likelihood
    if gap > scale * (policy.decisive if curve else -equal if symptom else equal):
        return _with_notes(best, other, gap, callback)
    if abs(gap) <= equal * scale and not curve:
        return _with_classes(best, other)
    return best


def _absorbs(found: Progress) -> bool:
    """Whether a model has effects that take up a part of whatever is missing, and name no cause."""
    return any(step.effect.family in ABSORBING_FAMILIES for step in found.state.assembly.steps)


def _with_notes(
    best: Progress, other: Progress, gap: float, callback: ProgressCallback
) -> Progress:
    """The other search, which says what it stands instead of."""
    names, present = (
        " and ".join(effect for effect, _ in one.state.assembly.added) or "no effect"
        for one in (other, best)
    )
    callback(f"take {names} instead of {present}")
    way = f"falls by {gap:.3g}" if gap > 0 else f"rises by {-gap:.3g} only, and they name causes"
    told = (
        f"instead of {present} the model has {names}: with unknowns counted (Schwarz 1978) the"
        f" weighted squared error on fitted runs {way}"
    )
    return replace(other, notes=(*other.notes, told))


def likelihood_gap(one: Progress, other: Progress) -> tuple[float, float]:
    """By how much less the other final model leaves, unknowns counted, and the scale of that.

    The scale is the dispersion of what the better one leaves times the inflation by the noise's
    colour: one of them is a squared standard deviation.
    """
    base = one.first.base()
    price, falls, worth = schwarz_price(base), [], []
    for state in (one.state, other.state):
        fall = fall_from(base, state.fit)
        falls.append(fall)
        worth.append(fall - price * len(state.fit.problem.names))
    left = replace(base, excess=base.excess - max(falls))
    return worth[1] - worth[0], dispersion(left) * max(map(_inflation, (one, other)))


def _inflation(found: Progress) -> float:
    """Largest variance of an added effect's unknowns over that in white noise."""
    refits = [item.accepted.refit for item in found.rounds if item.accepted is not None]
    return max((result.inflation for result in refits if result is not None), default=1.0)


def _with_classes(best: Progress, other: Progress) -> Progress:
    """With the other model's effects in the classes of those that are in their place.

    Effects that both models have stand in each other's place; the rest as they were added.
    """
    ours, theirs = best.state.assembly.added, other.state.assembly.added
    left = [key for key in ours if key not in theirs]
    more = [key for key in theirs if key not in ours]
    rounds = list(best.rounds)
    for k, key in enumerate(more):
        if not left:
            break
        place = left[min(k, len(left) - 1)]
        for number, item in enumerate(rounds):
            accepted = item.accepted
            if accepted is None or (accepted.effect, accepted.target) != place:
                continue
            name = key[0] if key[0] != place[0] else f"{key[0]} @ {key[1]}"
            if name in accepted.same:
                continue
            new = replace(accepted, same=(*accepted.same, name))
            ranking = tuple(new if one is accepted else one for one in item.ranking)
            rounds[number] = replace(item, ranking=ranking, accepted=new)
    return replace(best, rounds=tuple(rounds))
