"""Effects in transients, judged beside each other.

In a transient, slow noise and the error of a model look alike. Of several missing effects each
leaves the others, and beside what they leave none of them would be significant. An effect is
therefore added on trial first. When no further one is found, each is judged in the final model,
which leaves least: without it, all else estimated anew, the hold-out error must be significantly
higher. Where no hold-out run is declared, or none shows the effect, the error on the fitted runs
must be, after the correction for the search. The effect that misses this most is removed, and the
others are judged again. What is removed leaves more, beside which the next one is hardly seen: so
all that were removed are judged with it too, in the model that had them. Where they are confirmed
together, it stays. That is a second chance, for which half as many false alarms are allowed, and on
fitted runs the correction is for the search of as many effects. A smooth function that stands for
no name is not judged here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo import _distributions as distributions
from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._alternatives import Loss, compared_without, loss_of
from bayesoleo.discovery._assembly import AddedEffect, Roles
from bayesoleo.discovery._hold_out_confirmation import Fall, fall_on_hold_out, judged
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._refit import start_from
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._state import State, fit_state, state_of
from bayesoleo.effects._nonparametric import FAMILY

#: Begins the note on what confirms the final effects.
TOGETHER = "confirmed beside the other effects of the final model"


@dataclass(frozen=True)
class Evidence:
    """What the data say for an effect beside the others.

    Parameters
    ----------
    loss : Loss
        Of the model without it, on the fitted runs.
    fall : Fall or None
        Of the hold-out error by it; None without hold-out runs.
    tests : float
        Effective number of effects that it was chosen from.
    declared : bool
        Whether hold-out runs are declared, so that none of them was fitted.
    policy : SearchPolicy
    others : bool
        Whether it is for the effect together with those that were removed before.
    """

    loss: Loss
    fall: Fall | None
    tests: float
    declared: bool
    policy: SearchPolicy = SearchPolicy()
    others: bool = False

    @property
    def is_known(self) -> bool:
        """Whether the model could be solved without the effect."""
        known = self.fall is None or np.isfinite(self.fall.value)
        return bool(np.isfinite(self.loss.rise) and known)

    @property
    def by_others(self) -> Fall | None:
        """The fall of the hold-out error; None where no hold-out run shows the effect."""
        return self.fall if self.fall is not None and self.fall.error > 0 else None

    @property
    def p(self) -> float:
        """The p-value on the fitted runs, corrected for the search."""
        loss, noise = self.loss, self.loss.noise
        if noise.freedom:
            local = distributions.f.sf(
                loss.rise / noise.value / loss.size, loss.size, noise.freedom
            )
        else:
            local = distributions.chi2.sf(loss.rise / noise.value, loss.size)
        return float(-np.expm1(self.tests * np.log1p(-min(local, 1 - 1e-16))))

    @property
    def missing(self) -> float:
        """Standard errors by which an effect misses what keeps it; none below zero."""
        asked = distributions.norm.isf(self.policy.significance)
        fitted = float(asked - distributions.norm.isf(max(self.p, 1e-300)))
        if self.by_others is None:
            return fitted
        if self.by_others.confirms:
            return -np.inf if self.declared else fitted
        short = self.policy.confirming_errors - self.by_others.value / self.by_others.error
        return max(short, 1e-9)  # what is too small to confirm anything misses it too

    def __str__(self) -> str:
        more = " and those removed before it" if self.others else ""
        if self.by_others is None:
            return f"{self.loss}{more and f', without it{more}'}"
        error = "the weighted squared error on hold-out runs"
        return f"without it{more} {error} rises by {self.by_others}"


def judged_together(
    state: State,
    roles: Roles,
    numerics: Numerics,
    tests: float,
    notes: list[str],
    callback: ProgressCallback,
) -> State:
    """The state without effects that are not confirmed beside the others; itself for periodic runs.

    Parameters
    ----------
    state : State
        A final model.
    roles : Roles
    numerics : Numerics
    tests : float
        Effective number of effects that each was chosen from.
    notes : list of str
        Receives the removed effects with the reasons, and what is lost without each that stays.
    callback : callable
        Receives a message at each step.
    """
    if state.fit.all_periodic:
        return state
    notes[:] = [note for note in notes if not note.startswith(TOGETHER)]
    whole: _Whole | None = None
    while chosen := [step for step in state.assembly.steps if step.effect.family != FAMILY]:
        callback("judge the effects beside each other")
        base = state.base()
        found = _evidence(state, base, chosen, roles, numerics, tests)
        less = _without_one(state, base, found, whole, roles, numerics, notes, callback)
        if less is None:
            parts = [f"{one.loss.step.effect.id}: {one}" for one in found]
            notes += [f"{TOGETHER}; {'; '.join(parts)}"] if parts else []
            return state
        whole = whole or _Whole(state, base)
        state = less
    return state


@dataclass(frozen=True)
class _Whole:
    """A model before any of its effects is removed, which leaves least."""

    state: State
    base: Base

    def evidence(self, alone: Evidence, after: State) -> Evidence:
        """What the data say for an effect and all that a model lacks besides, as they do for one
        alone."""
        loss, fall = loss_of(self.base, alone.loss.step, after.fit), None
        policy = replace(alone.policy, false_confirmation=alone.policy.false_confirmation / 2.0)
        if self.state.hold_errors.entries and np.isfinite(loss.rise):
            fall = fall_on_hold_out(*judged(after, self.state), loss.noise.on_trial)
            fall = replace(fall, policy=policy)
        lacks = len(self.state.assembly.steps) - len(after.assembly.steps)
        tests = 2.0 * alone.tests**lacks
        return replace(alone, loss=loss, fall=fall, tests=tests, policy=policy, others=True)


def _without_one(
    state: State,
    base: Base,
    found: list[Evidence],
    whole: _Whole | None,
    roles: Roles,
    numerics: Numerics,
    notes: list[str],
    callback: ProgressCallback,
) -> State | None:
    """The state without the effect that misses most what keeps it; None where each is kept.

    What is said for an effect that is kept only together with those that were removed before
    takes the place of what was found for it alone.
    """
    for one in sorted(found, key=lambda item: -item.missing):
        if not one.missing > 0.0:
            break
        effect, step = one.loss.step.effect.id, one.loss.step
        callback(f"remove {effect}: {one}")
        assembly = state.assembly.without(step)
        start = start_from(base.fit, base.fit.values, assembly.model())
        less = fit_state(assembly, roles, numerics, start=start, progress=callback)
        joint = None if whole is None else whole.evidence(one, less)
        if joint is None or not joint.is_known or joint.missing > 0.0:
            notes.append(
                f"{effect} was removed again: beside the other effects of the final model it is not"
                f" confirmed, since {one}"
            )
            return less
        callback(f"keep {effect}: {joint}")
        found[found.index(one)] = joint
    return None


def _evidence(
    state: State,
    base: Base,
    chosen: Sequence[AddedEffect],
    roles: Roles,
    numerics: Numerics,
    tests: float,
) -> list[Evidence]:
    """Of each of some effects; of those without which the model cannot be solved there is none."""
    found = []
    for step in chosen:
        loss, fit = compared_without(state, base, step, numerics)
        fall = None
        if state.hold_errors.entries and np.isfinite(loss.rise):
            before = state_of(state.assembly.without(step), fit, roles)
            fall = fall_on_hold_out(*judged(before, state), loss.noise.on_trial)
        declared = roles.strategy == "declared"
        found.append(Evidence(loss, fall, tests, declared, state.policy))
    return [one for one in found if one.is_known]
