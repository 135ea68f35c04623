"""Review of the final effects: each against all alternatives, beside the others.

While another effect is missing, its error blurs the difference between two candidates: they look
equivalent, or the wrong one seems better. With all other effects in the model, only noise limits
the comparison. A candidate that does better beside the others replaces the effect that was added
(sequential replacement; Miller 2002, Subset Selection in Regression, section 3.9).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo._worker_processes import process_map
from bayesoleo.discovery._alternatives import Loss, dispersion, eliminated, loss_without
from bayesoleo.discovery._assembly import AddedEffect, Roles
from bayesoleo.discovery._fit_difference import undecided
from bayesoleo.discovery._hold_out_confirmation import (
    confirmed,
    contradicted,
    fall_on_hold_out,
    judged,
)
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import (
    ABSORBING_FAMILIES,
    Ranked,
    name_among,
    rank,
    score_candidates,
)
from bayesoleo.discovery._refit import (
    Refit,
    fall_from,
    new_parameters,
    quick_fit,
    records_of,
    refit,
    refit_all,
    refit_at,
    start_from,
)
from bayesoleo.discovery._round import Progress, Round
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._state import State, fit_state
from bayesoleo.effects._effect import Effect
from bayesoleo.effects._nonparametric import FAMILY
from bayesoleo.errors import ModelError

#: Parts of an effect that are left while another one takes its place.
TAKEN_BACK = (0.8, 0.6, 0.4, 0.2, 0.1)


@dataclass(frozen=True)
class Place:
    """A final effect's place in the model, and its possible substitutes.

    Parameters
    ----------
    number : int
        Number of the round that added the effect, from zero.
    base : Base
        Residuals of the final model without the effect, on the fitted runs.
    own : Ranked
        The effect, estimated there, with its class.
    rivals : tuple of Ranked
        Other effects that were estimated there, the best first.
    """

    number: int
    base: Base
    own: Ranked
    rivals: tuple[Ranked, ...]

    @property
    def better(self) -> tuple[Ranked, ...]:
        """Rivals that make the data more than twenty times as likely, the best first.

        A cause replaces an effect of an absorbing family if it is as likely. A rival that leaves
        more than noise must also explain as much of the remainder as a further effect would have
        to, because two shapes of one cause differ by less.
        """
        own = self.own.refit
        assert own is not None
        policy = own.policy
        found = []
        for rival in self.rivals:
            result = rival.refit
            assert result is not None
            gap = result.worth - own.worth
            needed = undecided(self.base, result, own).most * _dispersion(result, self.base)
            if rival.absorbs < self.own.absorbs:
                needed = -needed
            clearly = result.reached or gap > policy.fair_share * own.remaining
            if rival.absorbs <= self.own.absorbs and gap > needed and clearly:
                found.append(rival)
        return tuple(found[: policy.review_confirmed])


def _dispersion(result: Refit, base: Base) -> float:
    """Dispersion of the residual of an estimate."""
    return dispersion(replace(base, excess=base.excess - result.fall))


def reviewed(
    progress: Progress,
    roles: Roles,
    numerics: Numerics,
    effects: Sequence[Effect] | None,
    callback: ProgressCallback,
    *,
    replacing: bool = True,
    before: Callable[[], object] = lambda: None,
) -> Progress:
    """Review the final effects of a finished search, each beside the others.

    Parameters
    ----------
    progress : Progress
        Finished.
    roles : Roles
    numerics : Numerics
    effects : sequence of Effect or None
        Instead of the catalogue.
    callback : callable
        Receives a message at each step.
    replacing : bool
        Whether an effect may be replaced by one that does better.
    before : callable
        Called before each effect is reviewed.

    Returns
    -------
    Progress
        Finished, with new classes; or unfinished if an effect was replaced, so that the search
        continues.
    """
    curve = any(step.effect.family == FAMILY for step in progress.state.assembly.steps)
    for step in progress.state.assembly.steps:
        number = _added_by(progress, step)
        if number is None or step.effect.family == FAMILY:
            continue
        accepted = progress.rounds[number].accepted
        if curve and (accepted is None or not accepted.same):
            continue  # beside a curve no effect is replaced, and only known rivals are estimated
        before()
        callback(f"review the alternatives to {step.effect.id}")
        place = place_of(progress, step, number, roles, numerics, effects, only_known=curve)
        if place is None:
            continue
        for better in place.better if replacing and not curve else ():
            found = _replaced(progress, step, place, better, roles, numerics, callback)
            if found is not None:
                return found
        progress = _with_class(progress, place)
    if curve or not replacing or len(progress.state.assembly.steps) < 2:
        return progress
    before()
    return _smaller(progress, roles, numerics, callback)


def _smaller(
    progress: Progress, roles: Roles, numerics: Numerics, callback: ProgressCallback
) -> Progress:
    """The search with one effect less, if a substitute makes a second effect superfluous.

    An effect that only resembles the true one needs a companion. Beside each other both seem to be
    needed, whereas the true effect in place of the first needs no companion.
    """
    steps = progress.state.assembly.steps
    fitted = replace(roles, held_out=(), strategy="none")
    for step in steps:
        for result, gap in _close_rivals(progress, step):
            state = fit_state(result.assembly, fitted, numerics, start=result.fit.point.theta)
            base = state.base()
            callback(f"test whether {result.score.option.key[0]} makes another effect superfluous")
            losses = [
                loss_without(state, base, other, numerics) for other in state.assembly.steps[:-1]
            ]
            least = min(losses, key=lambda loss: loss.worth if np.isfinite(loss.worth) else np.inf)
            if not least.worth + gap / least.scale < 0.0:
                continue
            found = _without_companion(progress, step, result, least, roles, numerics, callback)
            if found is not None:
                return found
    return progress


def _close_rivals(progress: Progress, step: AddedEffect) -> list[tuple[Refit, float]]:
    """Estimates of possible substitutes of an effect, and the difference in worth, which is less
    than the price of a further effect's unknowns."""
    entry = _entry_of(progress, step)
    own = entry.accepted.refit if entry is not None and entry.accepted is not None else None
    if entry is None or own is None or _added_by(progress, step) is not None:
        return []  # estimated beside other effects than the present ones
    rivals = [
        (item.refit, own.worth - item.refit.worth)
        for item in entry.ranking
        if item.refit is not None
        and item.refit is not own
        and not item.absorbs
        and np.isfinite(item.refit.share)
        and item.score.option.candidate.family != FAMILY
    ]
    near = [one for one in rivals if one[1] < 2.0 * own.price * own.noise.on_trial]
    return sorted(near, key=lambda one: one[1])[: own.policy.review_simpler]


def _entry_of(progress: Progress, step: AddedEffect) -> Round | None:
    """The round that added a final effect."""
    key = step.effect.id, step.target
    for item in reversed(progress.rounds):
        if item.accepted is not None and (item.accepted.effect, item.accepted.target) == key:
            return item
    return None


def _without_companion(
    progress: Progress,
    step: AddedEffect,
    result: Refit,
    least: Loss,
    roles: Roles,
    numerics: Numerics,
    callback: ProgressCallback,
) -> Progress | None:
    """The search with a rival in a place and without another effect, unless the hold-out runs
    contradict it."""
    final, name = progress.state, result.score.option.key[0]
    after = fit_state(result.assembly.without(least.step), roles, numerics)
    if (final.at_floor and not after.at_floor) or contradicted(final, after, result.noise.on_trial):
        return None
    entry = _entry_of(progress, step)
    assert entry is not None
    item = next(one for one in entry.ranking if one.refit is result)
    reason = f"{name} replaces {step.effect.id} and makes {least.step.effect.id} superfluous"
    callback(reason)
    reason = f"{reason}: {least}"
    last = replace(entry, accepted=item, after=after, reason=reason)
    notes = (*progress.notes, reason)
    return Progress(progress.first, after, (*progress.rounds[:-1], last), notes)


def _added_by(progress: Progress, step: AddedEffect) -> int | None:
    """Number of the round that added a final effect; None if the other effects and the corner of
    friction are the same now."""
    key = step.effect.id, step.target
    for number, item in reversed(list(enumerate(progress.rounds))):
        if item.accepted is not None and (item.accepted.effect, item.accepted.target) == key:
            beside = set(item.before.assembly.added)
            now = set(progress.state.assembly.added) - {key}
            corner = item.before.assembly.corner
            same = beside == now and corner == progress.state.assembly.corner
            return None if same else number
    return None


def place_of(
    progress: Progress,
    step: AddedEffect,
    number: int,
    roles: Roles,
    numerics: Numerics,
    effects: Sequence[Effect] | None,
    *,
    only_known: bool = False,
) -> Place | None:
    """Possible substitutes of a final effect; None where they cannot be estimated.

    With ``only_known`` only members of its earlier class are estimated.
    """
    final, accepted = progress.state, progress.rounds[number].accepted
    assert accepted is not None
    # With the corner that was found, also where only this effect had it.
    less = final.assembly.without(step).with_corner(final.assembly.corner)
    left = set(less.added)
    gone = [one for one in final.assembly.steps if (one.effect.id, one.target) not in left]
    if any(one is not step and one.effect.family not in ABSORBING_FAMILIES for one in gone):
        return None  # other effects change the terms of this one
    fitted = replace(roles, held_out=(), strategy="none")
    # What the priors hardly allow was looked at when the effect was added: no draws from them.
    start = start_from(final.fit, final.fit.values, less.model())
    quick = replace(numerics, steps=final.fit.steps_for(fitted.fitted))
    without = fit_state(less, fitted, quick, start=start)
    if not all(np.isfinite(run.y).all() for run in without.fit.predictions):
        return None  # a run has no solution there, and nothing can be scored
    base = without.base()
    key = step.effect.id, step.target
    # The effect itself represents those that are equivalent to it.
    scores, _ = score_candidates(
        base, less, effects, numerics.jobs, order=lambda option, _: option.key != key
    )
    if not scores or scores[0].option.key != key:
        return None
    own, others = scores[0], scores[1:]
    known = accepted.same
    chosen = [own, *_worth_estimating(own, others, known, only_known, numerics.policy)]
    results = refit_all(base, chosen, numerics)
    refits = {id(score): result for score, result in zip(chosen, results, strict=True)}
    same = set(own.names) <= set(final.fit.problem.names)
    if same and fall_from(base, final.fit) > refits[id(own)].fall:
        # Estimated anew, it may end at a worse optimum than that of the final model, which a rival
        # would seem to surpass.
        refits[id(own)] = refit_at(base, own, final.assembly, final.fit)
    refits |= _from_other_shapes(base, refits, chosen, numerics)
    if same:
        spanned = set(progress.rounds[-1].failed)
        refits |= _in_exchange(final, step, base, refits, chosen, spanned, numerics)
    ranking = rank(scores, progress.rounds[number].tests, refits, base=base, policy=numerics.policy)
    mine = next(item for item in ranking if item.score is own)
    if mine.refit is None:
        return None
    rest = [item for item in ranking if item.refit is not None and item is not mine]
    rest.sort(key=lambda item: -(item.refit.worth if item.refit else 0.0))
    return Place(number, base, mine, tuple(rest))


def _from_other_shapes(
    base: Base, refits: Mapping[int, Refit], chosen: Sequence[Score], numerics: Numerics
) -> dict[int, Refit]:
    """Better estimates, from other starts, of effects that are slightly behind the best.

    Where friction switches, the error has several minima along the shape, and the shape with the
    best score at the null may lie near the wrong one. Two effects would then seem distinguishable
    that differ in their shape only.
    """
    best = max(result.fall for result in refits.values())
    behind = [
        score
        for score in chosen
        if score.shapes and refits[id(score)].fall > base.policy.restart_share * best
    ]
    items = [(score, refits[id(score)].fall, refits[id(score)].inflation) for score in behind]
    found = process_map(_restarted, (base, numerics, best), items, numerics.jobs, known=records_of)
    pairs = zip(behind, found, strict=True)
    return {id(score): replace(one, score=score) for score, one in pairs if one is not None}


def _restarted(
    shared: tuple[Base, Numerics, float], item: tuple[Score, float, float]
) -> Refit | None:
    """A better estimate of one effect from other shapes, without its score; None where there is
    none. Its best known fall and inflation are given with it."""
    (base, numerics, best), (score, fall, inflation) = shared, item
    better, grids, tried = None, score.option.candidate.shapes, [dict(score.shapes)]
    for part in base.policy.shape_starts:
        if best - fall < base.policy.restart_gap * inflation:
            break
        shapes = {n: grid[int(part * (len(grid) - 1))] for n, grid in grids.items()}
        if shapes in tried:  # of a scan of two values all parts are the first
            continue
        tried.append(shapes)
        again = refit(base, replace(score, shapes=shapes), numerics)
        if np.isfinite(again.share) and again.fall > fall:
            better, fall, inflation = again, again.fall, again.inflation
    return None if better is None else replace(better, score=cast(Any, None))


def _in_exchange(
    final: State,
    step: AddedEffect,
    base: Base,
    refits: Mapping[int, Refit],
    chosen: Sequence[Score],
    spanned: Set[str],
    numerics: Numerics,
) -> dict[int, Refit]:
    """Better estimates of kin, and of effects that the final model produces already, led from its
    estimate.

    Near the final estimate such an effect says the same as the one that was added, in other words,
    as an error of a mass and one of a force's gain do. Far from it, where the added effect is
    absent, its score is poor and its estimate may end in another optimum: the two would seem to
    differ. Here the added effect is taken back in parts, and the other follows.
    """
    own = chosen[0]
    least = refits[id(own)].fall
    found = {}
    for score in chosen[1:]:
        one = score.option.candidate
        # What the other effects make up for while this one is absent may hide a law like it.
        if not _kin(own, score) and f"{one.effect} at {one.target}" not in spanned:
            continue
        known = refits[id(score)]
        if known.fall > least - base.policy.restart_gap * known.inflation:
            continue
        result = _led(final, step, base, score, numerics)
        if result is not None and result.fall > known.fall:
            found[id(score)] = result
    return found


def _led(
    final: State, step: AddedEffect, base: Base, score: Score, numerics: Numerics
) -> Refit | None:
    """The estimate of an effect while another one is taken back; None where one step failed."""
    added = score.option.assembly.steps[-1]
    try:
        both = final.assembly.option(added.effect, added.target, added.scales).assembly
    except ModelError:  # they exclude each other
        return None
    new = new_parameters(both, score, base.policy)
    known = {**{name: 0.0 for name in new if name not in score.shapes}, **final.fit.values}
    both = both.with_values(final.fit.shared).with_parameters(new)
    amounts = {name: final.fit.values.get(name) for name in step.amplitudes}
    if None in amounts.values() or set(score.names) != set(new) - set(score.shapes):
        return None  # values of single runs
    for part in TAKEN_BACK:
        present = both.model().parameters
        held = {
            name: replace(present[name], value=part * cast(float, amount), fixed=True)
            for name, amount in amounts.items()
        }
        fit = quick_fit(base, both.with_parameters(held).model(), known, numerics)
        if not all(np.isfinite(run.y).all() for run in fit.predictions):
            return None
        known |= fit.values
    assembly = score.option.assembly.with_values(base.fit.shared)
    assembly = assembly.with_parameters(new_parameters(assembly, score, base.policy))
    return refit_at(base, score, assembly, quick_fit(base, assembly.model(), known, numerics))


def _worth_estimating(
    own: Score,
    others: Sequence[Score],
    same: Sequence[str],
    only_known: bool,
    policy: SearchPolicy,
) -> list[Score]:
    """Rivals that score near an effect: the best, its kin, and members of its earlier class."""
    absorbs = own.option.candidate.family in ABSORBING_FAMILIES
    near = [
        score
        for score in sorted(others, key=lambda score: -score.fall)
        if score.fall > policy.near_best * own.fall
        and (absorbs or score.option.candidate.family not in ABSORBING_FAMILIES)
    ]
    most = policy.review_rivals
    chosen = [] if only_known else near[:most]
    if not only_known:
        chosen += [score for score in near[most:] if _kin(own, score)]
    before = [one for one in others if name_among(own, one) in same and one not in chosen]
    return [*chosen, *before[:most]]


def _kin(own: Score, other: Score) -> bool:
    """Whether another effect is of the same family at the same place, as two laws of damping."""
    mine, its = own.option.candidate, other.option.candidate
    return (mine.family, mine.target) == (its.family, its.target)


def _replaced(
    progress: Progress,
    step: AddedEffect,
    place: Place,
    better: Ranked,
    roles: Roles,
    numerics: Numerics,
    callback: ProgressCallback,
) -> Progress | None:
    """The search with another effect in a place, unless the hold-out runs contradict it."""
    final = progress.state
    start = place.base.fit.point.theta
    less = final.assembly.without(step).with_corner(final.assembly.corner)
    before = fit_state(less, roles, numerics, start=start)
    assert better.refit is not None
    assert place.own.refit is not None
    after, reason = confirmed(before, better, better.refit, roles, numerics, callback)
    if after is None or (final.at_floor and not after.at_floor):
        return None
    if contradicted(final, after, better.refit.noise.on_trial):
        return None
    if not after.at_floor and _raises(final, after, better.refit.noise.on_trial):
        return None
    gained = better.refit.worth - place.own.refit.worth
    way = f"lower by {gained:.3g}" if gained > 0 else f"higher by {-gained:.3g} only"
    reason += (
        f"; it replaces {step.effect.id}: beside the other effects the weighted squared error is"
        f" {way}, unknowns counted{'' if gained > 0 else ', and it names a cause'}"
    )
    tests = progress.rounds[place.number].tests
    ranking = (better, place.own, *(item for item in place.rivals if item is not better))
    notes = [*progress.notes, f"{better.effect} replaced {step.effect.id}: {reason}"]
    state = eliminated(after, before, roles, numerics, notes, callback)
    last = Round(before, ranking, {}, better, after, reason, tests)
    rounds = (*progress.rounds[:-1], last)
    return Progress(progress.first, state, rounds, tuple(notes))


def _raises(before: State, after: State, inflation: float) -> bool:
    """Whether a model predicts runs that were not fitted worse than another one.

    Where both leave more than noise, the likelihood of the fitted runs overstates the evidence for
    either: what it prefers must at least predict as well. A model with parameters of its own in
    each run fits these to the runs that it predicts, and cannot be compared so.
    """
    pairs = list(zip(before.held_out, after.held_out, strict=True))
    if any(old.status.ok and not new.status.ok for old, new in pairs):
        return True
    alike = all(old.re_estimated == new.re_estimated for old, new in pairs)
    if not before.hold_errors.entries or not alike:
        return False
    return fall_on_hold_out(*judged(before, after), inflation).value < 0.0


def _with_class(progress: Progress, place: Place) -> Progress:
    """The search with the class of a final effect as found beside the others."""
    item = progress.rounds[place.number]
    assert item.accepted is not None
    new = replace(item.accepted, same=place.own.same, beside=place.own.refit)
    # What says the same in other words is as probable, by an estimate beside the same effects.
    alike = {
        (one.effect, one.target): one.refit
        for one in place.rivals
        if name_among(place.own.score, one.score) in place.own.same
    }
    ranking = tuple(
        new
        if one is item.accepted
        else replace(one, beside=alike.get((one.effect, one.target), one.beside))
        for one in item.ranking
    )
    changed = replace(item, ranking=ranking, accepted=new)
    rounds = (*progress.rounds[: place.number], changed, *progress.rounds[place.number + 1 :])
    return replace(progress, rounds=rounds)
