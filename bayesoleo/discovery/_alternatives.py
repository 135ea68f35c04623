"""Alternative searches: other first effects, and backward elimination.

The effect that explains most alone is not always part of the best model of several effects, and
each of two missing effects may alone predict the hold-out runs worse than no effect. Other first
effects are therefore followed to the end where the search added more than one effect, left more
than noise, or found only parameters that vary from run to run. A full search takes minutes; a
forecast of the best second effect, on the fitted runs alone, tells in seconds which first effects
can compete. Backward elimination removes effects that do not pay for their unknowns beside the
others.

References
----------
Schwarz (1978), Annals of Statistics 6(2), 461-464; Burnham and Anderson (2002), Model Selection
and Multimodel Inference, section 2.5: dispersion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import AddedEffect, Roles
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_difference import noise_between
from bayesoleo.discovery._hold_out_confirmation import (
    confirmed,
    contradicted,
    fall_error,
    fall_on_hold_out,
    judged,
    lacks_input,
    with_error,
)
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import ABSORBING_FAMILIES, Ranked, score_candidates
from bayesoleo.discovery._refit import (
    Inflation,
    Refit,
    colour_of,
    compare,
    fall_from,
    inflation_along,
    price_in,
    quick_fit,
    refit_all,
    schwarz_price,
    start_from,
)
from bayesoleo.discovery._round import Progress, Round
from bayesoleo.discovery._score_basis import Base, squared_distance
from bayesoleo.discovery._state import State, fit_state, state_of
from bayesoleo.effects._effect import Effect
from bayesoleo.effects._nonparametric import FAMILY


@dataclass(frozen=True)
class Loss:
    """Rise of the sum of squares without one effect, after a new fit of all other unknowns.

    Parameters
    ----------
    step : AddedEffect
        The effect.
    rise : float
        Rise of the weighted sum of squares on the fitted runs.
    size : int
        Number of unknowns of the effect.
    price : float
        Price of one unknown, in units of the scale.
    noise : Inflation
        Variance of the rise over that in white noise of the samples, times the dispersion of the
        residual.
    """

    step: AddedEffect
    rise: float
    size: int
    price: float
    noise: Inflation

    @property
    def scale(self) -> float:
        """Unit of the rise; of transients that by which effects are taken on trial."""
        return self.noise.on_trial

    @property
    def worth(self) -> float:
        """Rise beyond the price of the unknowns, in units of the scale; NaN is never below."""
        return self.rise / self.scale - self.price * self.size

    def __str__(self) -> str:
        error = fall_error(self.rise, self.size, self.noise.value)
        unknowns = "its unknown is" if self.size == 1 else f"its {self.size} unknowns are"
        return (
            f"without it the weighted squared error on fitted runs rises by"
            f" {with_error(self.rise, error)}, and {unknowns} worth"
            f" {self.price * self.size * self.scale:.3g} (Schwarz 1978)"
        )


def eliminated(
    state: State,
    before: State,
    roles: Roles,
    numerics: Numerics,
    notes: list[str],
    callback: ProgressCallback,
    *,
    last_too: bool = False,
) -> State:
    """The state without effects that are not worth their unknowns.

    The model is refitted without each earlier effect in turn. As long as an effect is not worth its
    unknowns, the one with the smallest loss is removed. The last one was just found to be needed,
    beside the estimate that the model had before. Where the model without it does better from the
    new estimate than it did before, that was a wrong optimum, and the last one is tested like the
    others if its amplitudes are near their null: a wrong optimum is not a missing effect.

    Parameters
    ----------
    state : State
        The state with an effect just added.
    before : State
        The state that it was added to.
    roles : Roles
    numerics : Numerics
    notes : list of str
        Receives the removed effects with the reasons.
    callback : callable
        Receives a message at each step.
    last_too : bool
        Test the last one as the others: it was found to be needed in another form of the model.
    """
    last = () if last_too else state.assembly.steps[-1:]
    while state.assembly.steps:
        base = state.base()
        doubted = [
            step
            for step in state.assembly.steps
            if not plainly_needed(state, base, step, just_added=step in last)
        ]
        if not doubted:
            return state
        callback("test whether all effects are still needed")
        losses = [loss_without(state, base, step, numerics) for step in doubted]
        losses = [one for one in losses if one.step not in last or _escaped(one, base, before)]
        least = min(
            losses, key=lambda loss: loss.worth if np.isfinite(loss.worth) else np.inf, default=None
        )
        if least is None or not least.worth < 0.0:
            return state
        effect = least.step.effect.id
        callback(f"remove {effect}: {least}")
        why = "a later effect made it superfluous"
        if least.step in last:
            why = "its estimate led the model without it to a better optimum, and it is not needed"
        notes.append(f"{effect} was removed again because {why}: {least}")
        assembly = state.assembly.without(least.step)
        start = start_from(base.fit, base.fit.values, assembly.model())
        state = fit_state(assembly, roles, numerics, start=start, progress=callback)
    return state


def _escaped(loss: Loss, base: Base, before: State) -> bool:
    """Whether the model without the last effect does better than it did before that was added."""
    share, _ = compare(base, before.fit)
    gained = -share * base.fall_back - loss.rise
    # Twice a logarithm of densities is a difference of squares.
    return bool(gained > 2.0 * base.policy.better_optimum_declared * loss.scale)


def plainly_needed(
    state: State, base: Base, step: AddedEffect, *, just_added: bool = False
) -> bool:
    """Whether an effect's amplitudes are so far from their null that no fit without it is needed.

    The criterion is Wald's statistic. Where it differs much from the fall of the sum of squares, it
    is the smaller of the two (Hauck and Donner 1977, JASA 72, 851-853). An effect that was just
    found to be needed is doubted only if that statistic is below the price of its unknowns. What is
    left of a transient is seldom white: its colour lowers the statistic.
    """
    point, names = state.fit.point, state.fit.problem.names
    index = [k for k, name in enumerate(names) if name.split("[")[0] in step.amplitudes]
    covariance = point.covariance[np.ix_(index, index)]
    if not index or not point.status.ok or not np.isfinite(covariance).all():
        return False
    distance = squared_distance(point.theta[index], covariance)
    factor = 1.0 if just_added else base.policy.plainly_needed
    enough = factor * schwarz_price(base) * len(index)
    if distance > enough and not state.fit.all_periodic:
        known = colour_of(state.fit, [names[k] for k in index])
        distance = 0.0 if known is None else distance / max(known[0], 1.0)
    return bool(distance > enough)


def loss_without(state: State, base: Base, step: AddedEffect, numerics: Numerics) -> Loss:
    """The loss without one effect of a model, after a new fit of all other unknowns."""
    return compared_without(state, base, step, numerics)[0]


def compared_without(
    state: State, base: Base, step: AddedEffect, numerics: Numerics
) -> tuple[Loss, ModelFit]:
    """The loss without one effect of a model, and the fit of all other unknowns."""
    without = state.assembly.without(step).model()
    fit = quick_fit(base, without, base.fit.values, numerics)
    return loss_of(base, step, fit), fit


def loss_of(base: Base, step: AddedEffect, fit: ModelFit) -> Loss:
    """The loss of a model's fit without an effect, or also without others."""
    share, changes = compare(base, fit)
    names = [n for n in base.fit.problem.names if n not in fit.problem.names]
    measured = inflation_along(base, base.fit, names, changes)
    found, spread = Inflation(1.0, 0) if measured is None else measured, dispersion(base)
    noise = Inflation(found.value * spread, found.freedom, found.on_trial * spread)
    return Loss(step, -share * base.fall_back, len(names), price_in(base, noise), noise)


def dispersion(base: Base) -> float:
    """Mean square of the residual of periodic runs over that of the noise, at least one. For
    transients it is one, because their inflation holds it."""
    if not base.fit.all_periodic or not base.excess > base.feigned:
        return 1.0
    return 1.0 + base.excess / max(base.noise, 1e-300)


def leads_as_far(
    progress: Progress,
    first: Ranked,
    roles: Roles,
    numerics: Numerics,
    effects: Sequence[Effect] | None,
    callback: ProgressCallback,
) -> bool:
    """Whether a first effect, with the best second one, competes with the first two added effects.

    It competes if their penalised sums of squares are about equal, or if it leaves only noise.

    Parameters
    ----------
    progress : Progress
        A finished search.
    first : Ranked
        An effect that was estimated in its first round.
    roles : Roles
    numerics : Numerics
    effects : sequence of Effect or None
        Instead of the catalogue.
    callback : callable
        Receives a message at each step.
    """
    result = first.refit
    assert result is not None
    callback(f"try {first.effect} as the first effect")
    fitted = replace(roles, held_out=(), strategy="none")
    state = state_of(result.assembly, result.fit, fitted)
    if state.at_floor:
        return True
    reference = progress.first.base()
    seconds = _best_seconds(state, numerics, effects)
    if any(second.reached for second in seconds):
        return True
    tried = (result, *seconds)
    falls = [fall_from(reference, one.fit) for one in tried]
    worths = [_worth(reference, fall, one.fit) for fall, one in zip(falls, tried, strict=True)]
    present = _with_two(progress).fit
    fall = fall_from(reference, present)
    left = replace(reference, excess=reference.excess - max(fall, *falls))
    best = int(np.argmax(worths))
    scale = dispersion(left) * noise_between(reference, tried[best].fit, present)[0]
    return (
        worths[best] > _worth(reference, fall, present) - numerics.policy.equal_likelihood * scale
    )


def _best_seconds(
    state: State, numerics: Numerics, effects: Sequence[Effect] | None
) -> list[Refit]:
    """The effects that score best beside a first one, estimated."""
    base = state.base()
    scores, _ = score_candidates(base, state.assembly, effects, numerics.jobs)
    named = [score for score in scores if score.option.candidate.family != FAMILY]
    chosen = sorted(named, key=lambda score: -score.fall)[: numerics.policy.seconds]
    return refit_all(base, chosen, numerics)


def _with_two(progress: Progress) -> State:
    """The model with the first two effects that were added, or the final one if it has fewer."""
    after = [entry.after for entry in progress.rounds if entry.after is not None]
    return after[1] if len(after) > 1 else progress.state


def _worth(reference: Base, fall: float, fit: ModelFit) -> float:
    return fall - schwarz_price(reference) * len(fit.problem.names)


def best_of_beam(
    progress: Progress,
    roles: Roles,
    numerics: Numerics,
    follow: Callable[[Progress, int], Progress],
    effects: Sequence[Effect] | None,
    max_effects: int,
    callback: ProgressCallback,
) -> Progress:
    """The best of the final models that start with the best few first effects.

    Parameters
    ----------
    progress : Progress
        A finished search.
    roles : Roles
    numerics : Numerics
    follow : callable (progress, most) -> Progress
        Continues a search to its end, with so many effects at most.
    effects : sequence of Effect or None
        Instead of the catalogue.
    max_effects : int
        Largest number of effects to add.
    callback : callable
        Receives a message at each step.

    Returns
    -------
    Progress
        Finished. Effects of other final models that are about as likely are in the classes of the
        effects that they would replace.
    """
    best = progress
    for first in followed(progress, numerics.policy):
        if (first.effect, first.target) in best.state.assembly.added:
            continue
        if not leads_as_far(progress, first, roles, numerics, effects, callback):
            continue
        callback(f"search again with {first.effect} as the first effect")
        other = _followed(progress, first, roles, numerics, follow, max_effects, callback)
        if other is not None and other.state.assembly.added:
            declared = roles.strategy == "declared"
            best = _better(best, other, declared, numerics.policy, callback)
    cut = len(best.state.assembly.steps) >= _most_compared(progress, max_effects)
    if best is progress or best.state.at_floor or not cut:
        return best
    # Its last round only ranked, because the comparison allowed it no more effects than the other
    # search had.
    callback("go on with the effects that were taken")
    return follow(replace(best, rounds=best.rounds[:-1]), max_effects)


def _most_compared(progress: Progress, max_effects: int) -> int:
    """Largest number of effects of a search that is compared with a finished one."""
    present, opening = len(progress.state.assembly.added), progress.rounds[0]
    few = progress.state.at_floor and not (opening.accepted and opening.accepted.absorbs)
    return max(present, 2) if few else min(max(present + 1, 2), max_effects)


def followed(progress: Progress, policy: SearchPolicy) -> list[Ranked]:
    """First effects that were nearly as good as the one that was taken, the best first.

    There is none where one effect alone left only noise. Effects that the data could not
    distinguish from it are covered by the review.
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
        and item.may_be_tried(policy.significance)
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
    if lacks_input(result, roles) is not None:
        return None
    after, reason = confirmed(opening.before, first, result, roles, numerics, callback)
    provisional = after is None
    if after is None:
        if result.share < numerics.policy.fair_share or not result.excludes_null():
            return None
        after = fit_state(result.assembly, roles, numerics, start=result.fit.point.theta)
        reason += "; it is added provisionally, to be confirmed together with the next one"
    begun = Round(
        opening.before, opening.ranking, opening.failed, first, after, reason, opening.tests
    )
    # Only the note on the roles applies to the other search too.
    notes = tuple(note for note in progress.notes if note == roles.description)
    found = follow(
        Progress(progress.first, after, (begun,), notes), _most_compared(progress, max_effects)
    )
    if provisional and not _together_confirmed(found):
        return None
    return found


def _together_confirmed(found: Progress) -> bool:
    """Whether effects are confirmed together of which the first alone was not confirmed."""
    if len(found.state.assembly.added) < 2:
        return False
    return fall_on_hold_out(*judged(found.first, found.state), _inflation(found)).confirms


def _better(
    best: Progress,
    other: Progress,
    declared: bool,
    policy: SearchPolicy,
    callback: ProgressCallback,
) -> Progress:
    """The better of two finished searches; if both are about as likely, the other's effects join
    its classes. Hold-out runs count with the fitted ones where they are declared."""
    fitted, scale = likelihood_gap(best, other)
    inflation = max(map(_inflation, (best, other)))
    by_others = hold_out_gap(best.state, other.state, inflation) if declared else 0.0
    gap = fitted + scale * by_others
    if set(best.state.assembly.added) == set(other.state.assembly.added):
        return best
    if (best.state.at_floor and not other.state.at_floor) or contradicted(
        best.state, other.state, _inflation(best)
    ):
        return best
    curve = any(step.effect.family == FAMILY for step in best.state.assembly.steps)
    symptom = _absorbs(best) and not _absorbs(other)
    equal = policy.equal_likelihood
    if gap > scale * (policy.decisive if curve else -equal if symptom else equal):
        return _with_notes(best, other, fitted, callback, symptom=symptom)
    if abs(gap) <= equal * scale and not curve:
        return _with_classes(best, other)
    return best


def _absorbs(found: Progress) -> bool:
    """Whether a model has effects of absorbing families, which name no cause."""
    return any(step.effect.family in ABSORBING_FAMILIES for step in found.state.assembly.steps)


def _with_notes(
    best: Progress, other: Progress, gap: float, callback: ProgressCallback, *, symptom: bool = True
) -> Progress:
    """The other search, with a note on the effects that it replaces."""
    names, present = (
        " and ".join(effect for effect, _ in one.state.assembly.added) or "no effect"
        for one in (other, best)
    )
    callback(f"take {names} instead of {present}")
    if gap > 0:
        way = f"falls by {gap:.3g}"
    elif symptom:
        way = f"rises by {-gap:.3g} only, and they name causes"
    else:
        way = f"rises by {-gap:.3g}, and hold-out runs speak for them by more"
    note = (
        f"instead of {present} the model has {names}: with unknowns counted (Schwarz 1978) the"
        f" weighted squared error on fitted runs {way}"
    )
    return replace(other, notes=(*other.notes, note))


def likelihood_gap(one: Progress, other: Progress) -> tuple[float, float]:
    """Advantage of the other final model in the penalised sum of squares, and its scale.

    The scale is the noise along the difference of both models over white noise, times the
    dispersion of the better one's residual. A gap of one scale is a squared standard deviation.
    """
    base = one.first.base()
    price, falls, worth = schwarz_price(base), [], []
    for state in (one.state, other.state):
        fall = fall_from(base, state.fit)
        falls.append(fall)
        worth.append(fall - price * len(state.fit.problem.names))
    left = replace(base, excess=base.excess - max(falls))
    noise, _ = noise_between(base, one.state.fit, other.state.fit)
    return worth[1] - worth[0], dispersion(left) * noise


def hold_out_gap(one: State, other: State, inflation: float = 1.0) -> float:
    """Advantage of another model on the hold-out runs, as twice a logarithm of likelihoods.

    The fall of the sum of squares is divided by the variance of the noise along the difference of
    both models, over that of white noise. Errors of the parameters are part of this noise, of the
    model that is known less.
    """
    fall = fall_on_hold_out(*judged(one, other), inflation)
    error = max(fall.error, fall.scatter)
    # Noise of the variance I gives the fall the variance 4 I times its mean.
    return 4.0 * fall.expected * fall.value / error**2 if error > 0 else 0.0


def _inflation(found: Progress) -> float:
    """Largest variance of an added effect's unknowns over that in white noise, of transients by
    the colour alone: what early models of a search left is no noise."""
    refits = [item.accepted.refit for item in found.rounds if item.accepted is not None]
    return max((result.noise.on_trial for result in refits if result is not None), default=1.0)


def _with_classes(best: Progress, other: Progress) -> Progress:
    """The search with the other model's effects in the classes of those that they replace.

    Effects that both models have correspond; the others correspond in the order of their addition.
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
