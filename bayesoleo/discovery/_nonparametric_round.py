"""A nonparametric round: a smooth function explains the residual where no named effect does.

Named effects are tried first, one after the other. Two models then compete with the present one:
the smooth function beside the named effects, if they left a residual, and the function *instead* of
them. A named effect may only be the closest to the true one, and several named effects together may
reach the noise although one law of the same quantities is the cause. The weighted sum of squares
plus the logarithm of the number of averaged values for each unknown decides (Schwarz 1978, Annals
of Statistics 6(2)). Where this is not decisive, no named effect is kept. The hold-out runs then
decide, as for every effect. The named effects closest to the function are reported with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesoleo import _distributions as distributions
from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import AddedEffect, Roles
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._hold_out_confirmation import (
    confirmed,
    contradicted,
    fall_on_hold_out,
    judged,
)
from bayesoleo.discovery._nonparametric_quantities import ranges
from bayesoleo.discovery._nonparametric_search import CurveSearch, Tried, closest, search
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import ABSORBING_FAMILIES, Ranked, scales_of
from bayesoleo.discovery._refit import Refit, fall_from, refit
from bayesoleo.discovery._round import Round
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._state import State
from bayesoleo.effects._nonparametric import FAMILY, Axis

Merit = Callable[..., float]


@dataclass(frozen=True)
class _Answer:
    """A function added to one of two models, after estimation."""

    state: State
    search: CurveSearch
    refit: Refit
    ranking: tuple[Ranked, ...]
    instead: bool
    merit: float


def with_nonparametric(
    outcome: Round,
    first: Round,
    roles: Roles,
    numerics: Numerics,
    *,
    room: bool = True,
    callback: ProgressCallback,
) -> Round:
    """A round that accepted no effect, with a nonparametric effect if one explains the residual.

    Parameters
    ----------
    outcome : Round
        It accepted no effect.
    first : Round
        The first of the same loop: its model has none of the added effects.
    roles : Roles
        Runs.
    numerics : Numerics
        Scheme, threads.
    room : bool
        Whether one more effect may be added; else a function may only replace effects.
    callback : callable
        Receives a message at each step.

    Returns
    -------
    Round
        A confirmed function is the accepted effect, first in the ranking. If it replaces earlier
        effects, the new state has none of them.
    """
    state, policy = outcome.before, numerics.policy
    steps = state.assembly.steps
    named = len(steps) > len(first.before.assembly.steps)
    nonparametric = sum(step.effect.family == FAMILY for step in steps)
    if nonparametric >= policy.curves or (not named and (state.at_floor or not room)):
        return outcome
    if not room and len(steps) < policy.fewest_replaced:
        return outcome  # named effects could not be combined
    # At the noise floor a function could explain noise only.
    beside = room and not state.at_floor
    alone = _stands_by_itself(first, policy)
    instead = named and (not alone or _several_in_one_balance(steps, policy))
    if not (beside or instead):
        return outcome
    callback("look for a nonparametric effect")
    chances = []
    if not state.at_floor:
        found = _Chance.at(state, outcome, numerics)
        outcome = replace(outcome, nonparametric=found.search)
        if found.search.p_value >= policy.significance:
            return outcome
        if beside:
            chances.append(found)
    if instead:
        # The present model moves as measured; a model without its effects may have a smaller range.
        also = ranges(state.fit, state.assembly, first.before.assembly.native)
        chances.append(_Chance.at(first.before, first, numerics, also))
    return _decided(outcome, chances, roles, numerics, callback)


def _decided(
    outcome: Round,
    chances: Sequence[_Chance],
    roles: Roles,
    numerics: Numerics,
    callback: ProgressCallback,
) -> Round:
    """The round with the best function that the hold-out runs confirm, or the reason for none."""
    reasons, common = [outcome.reason], chances[-1].base
    # A single named effect that leaves only noise is no sum of effects with a common law as their
    # cause: the more likely model of the two is then taken.
    policy = numerics.policy
    favour = 0.0 if _alone(outcome.before) else policy.decisive
    merit = partial(_merit, present=outcome.before.fit, reference=common, favour=favour)
    for k in range(policy.curves_tried):
        answers = [item for chance in chances for item in chance.answers(k, merit, numerics)]
        for answer in _better(answers, merit):
            accepted, reason = _accepting(outcome, answer, roles, numerics, callback)
            if accepted.accepted is not None:
                return accepted
            reasons.append(reason)
    return replace(outcome, reason="; ".join(reasons))


def _alone(state: State) -> bool:
    """Whether a single named effect leaves only noise."""
    return state.at_floor and len(state.assembly.steps) == 1


def _better(answers: Sequence[_Answer], merit: Merit) -> list[_Answer]:
    """Answers that are better than the present model, the best first.

    All are compared with the same noise. The residual of a transient counts as coloured noise. The
    residual of a worse answer contains model error, so that the smallest inflation is used.
    """
    least = min((item.refit.inflation for item in answers), default=1.0)
    merits = [merit(item.refit, instead=item.instead, inflation=least) for item in answers]
    order = sorted(range(len(answers)), key=lambda k: -merits[k])
    return [answers[k] for k in order if merits[k] > 0]


def _stands_by_itself(first: Round, policy: SearchPolicy) -> bool:
    """Whether the first effect explained nearly all of the excess alone. An effect of an absorbing
    family counts only if it left only noise."""
    found = first.accepted
    if found is None or found.gain < policy.own_right:
        return False
    return not found.absorbs or (found.refit is not None and found.refit.reached)


def _several_in_one_balance(steps: Sequence[AddedEffect], policy: SearchPolicy) -> bool:
    """Whether a balance has several named effects, which one function of its quantities may
    explain together."""
    places = [step.target for step in steps if step.effect.family not in ABSORBING_FAMILIES]
    return any(places.count(place) >= policy.fewest_replaced for place in places)


@dataclass(frozen=True)
class _Chance:
    """A model, and the functions that may be added to it."""

    state: State
    base: Base
    search: CurveSearch
    outcome: Round
    instead: bool

    @classmethod
    def at(
        cls,
        state: State,
        outcome: Round,
        numerics: Numerics,
        also: Mapping[str, Axis] | None = None,
    ) -> _Chance:
        """The functions for a model's residual; with ``also`` they replace its named effects."""
        base = state.base()
        found = search(base, state.assembly, numerics.jobs, also)
        return cls(state, base, found, outcome, also is not None)

    def answers(self, k: int, merit: Merit, numerics: Numerics) -> list[_Answer]:
        """The function of rank ``k`` from zero, estimated; none where there are fewer.

        The score ranks functions by the criterion that also judges estimates. If the model is close
        to the data, the score also gives the number of pieces. A model without the named effects is
        far from the data, where linearisation is poor: there the number of pieces increases as long
        as the estimate explains significantly more.
        """
        price = float(np.log(max(self.base.noise, 2.0)))
        leading = self.search.leading(numerics.policy.curves_tried)
        chosen = sorted(leading, key=lambda item: item.rank * price - item.fall)[k : k + 1]
        found: list[_Answer] = []
        for item in chosen:
            for one in self.search.finenesses(item) if self.instead else (item,):
                answer = self._estimated(one, merit, numerics)
                if found and not _is_better(answer, found[0]):
                    break
                found = [answer]
        return found

    def _estimated(self, item: Tried, merit: Merit, numerics: Numerics) -> _Answer:
        assembly = self.state.assembly
        scales = scales_of(self.state.fit, assembly.drive, assembly.native)
        result = refit(self.base, item.score(self.base, assembly, scales), numerics)
        worth = merit(result, instead=self.instead, inflation=result.inflation)
        return _Answer(self.state, self.search, result, self.outcome.ranking, self.instead, worth)


def _is_better(fine: _Answer, coarse: _Answer) -> bool:
    """Whether finer pieces explain significantly more and come close to the present model."""
    least = min(fine.refit.inflation, coarse.refit.inflation)
    gained = (fine.refit.fall - coarse.refit.fall) / least
    more = fine.refit.size - coarse.refit.size
    p_value = float(distributions.chi2.sf(gained, more))
    return _goes_on(coarse.merit, fine.merit, p_value, fine.refit.policy)


def _goes_on(coarse: float, fine: float, p_value: float, policy: SearchPolicy) -> bool:
    """Whether to try finer pieces, by the merits and the probability of the fall by noise."""
    if not np.isfinite(coarse):
        return True
    if fine <= 0.0:
        return fine - coarse > policy.finer_gain * max(-coarse, 0.0)
    return p_value < policy.finer


def _merit(
    own: Refit,
    *,
    instead: bool,
    inflation: float,
    present: ModelFit,
    reference: Base,
    favour: float,
) -> float:
    """Gain of a function over the present model in Schwarz's criterion. A function that replaces
    named effects needs none of their unknowns and has the advantage ``favour``."""
    gained = fall_from(reference, own.fit) - fall_from(reference, present)
    values = max(reference.noise, 2.0)  # in noise units: the number of averaged values
    more = len(own.fit.problem.names) - len(present.problem.names)
    # In coloured noise fewer values are independent; the inflation divides the gain accordingly.
    merit = gained / inflation - more * float(np.log(values))
    return merit + favour if instead else merit


def _accepting(
    outcome: Round, answer: _Answer, roles: Roles, numerics: Numerics, callback: ProgressCallback
) -> tuple[Round, str]:
    """The round with the answer accepted if it is confirmed, and the reason."""
    result = answer.refit
    near = closest(result.contribution, [item.score for item in answer.ranking])
    gain = min(max(result.share, 0.0), 1.0) if np.isfinite(result.share) else 0.0
    distinct = {
        " @ ".join(it.score.option.key) for it in answer.ranking if _distinguished(result, it)
    }
    same = tuple(
        name.split(" @ ")[0]
        for name, cosine in near
        if cosine > 0 and cosine**2 > numerics.policy.same_cosine and name not in distinct
    )
    item = Ranked(result.score, answer.search.p_value, gain, True, same, result, near)
    after, reason = confirmed(answer.state, item, result, roles, numerics, callback)
    if after is None:
        return outcome, reason
    if outcome.before.at_floor and not after.at_floor:
        return outcome, f"{item.effect} leaves more than the named effects"
    if answer.instead and contradicted(outcome.before, after, result.inflation):
        return outcome, f"{item.effect} predicts hold-out runs worse than the named effects"
    if answer.instead and _alone(outcome.before):
        pair = judged(outcome.before, after)
        if after.hold_errors.entries and fall_on_hold_out(*pair, result.inflation).value <= 0:
            named = outcome.before.assembly.steps[0].effect.id
            return outcome, f"{item.effect} predicts hold-out runs no better than {named}"
    if answer.instead:
        before = [step.effect.id for step in outcome.before.assembly.steps]
        reason += f", and replaces {' and '.join(before)}, which only resembled it"
    ranking = (item, *outcome.ranking)
    return replace(outcome, ranking=ranking, accepted=item, after=after, reason=reason), reason


def _distinguished(own: Refit, other: Ranked) -> bool:
    """Whether the data distinguish a function from a similar named effect, by the estimate of the
    named effect where there is one."""
    if other.refit is not None:
        return not own.resembles(other.refit)
    return own.outdoes(other.score)


def nonparametric_notes(rounds: Sequence[Round]) -> list[str]:
    """Remarks on the nonparametric effects that were added, with the most similar named effects."""
    found = []
    for entry in rounds:
        item = entry.accepted
        if item is None or item.score.option.candidate.family != FAMILY:
            continue
        near = ", ".join(f"{effect} (cosine {cosine:.2f})" for effect, cosine in item.closest)
        text = f"{item.effect} @ {item.target} is no named effect"
        found.append(text + (f"; the most similar named effects: {near}" if near else ""))
    return found
