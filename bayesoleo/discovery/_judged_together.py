"""Effects in transients, judged beside each other.

In a transient, slow noise and the error of a model look alike. Of several missing effects each
leaves the others, and beside what they leave none of them would be significant. An effect is
therefore added on trial first. When no further one is found, each is judged in the final model,
which leaves least: without it, all else estimated anew, the hold-out error must be significantly
higher. Where no hold-out run is declared, the error on the fitted runs must be, after the
correction for the search. The effect that misses this most is removed, and the others are judged
again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._alternatives import Loss, compared_without
from bayesoleo.discovery._assembly import AddedEffect, Roles
from bayesoleo.discovery._fit import Numerics
from bayesoleo.discovery._hold_out_confirmation import Fall, fall_on_hold_out, judged
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
        Whether hold-out runs are declared, so that no sample of them chose the effect.
    policy : SearchPolicy
    """

    loss: Loss
    fall: Fall | None
    tests: float
    declared: bool
    policy: SearchPolicy = SearchPolicy()

    @property
    def is_known(self) -> bool:
        """Whether the model could be solved without the effect."""
        known = self.fall is None or (np.isfinite(self.fall.value) and self.fall.error > 0)
        return bool(np.isfinite(self.loss.rise) and known)

    @property
    def log_p(self) -> float:
        """Logarithm of the p-value on the fitted runs, corrected for the search."""
        loss = self.loss
        statistic = loss.rise / loss.noise / loss.size
        local = stats.f.sf(statistic, loss.size, loss.freedom or np.inf)
        return float(np.log(max(-np.expm1(self.tests * np.log1p(-min(local, 1 - 1e-16))), 1e-300)))

    @property
    def missing(self) -> float:
        """How far an effect is from being kept, on a scale where none is missing below zero."""
        fitted = self.log_p - float(np.log(self.policy.significance))
        if self.fall is None:
            return fitted
        if self.fall.confirms:
            return -np.inf if self.declared else fitted
        return max(self.policy.confirming_errors - self.fall.value / self.fall.error, 1e-9)

    def __str__(self) -> str:
        if self.fall is None:
            return str(self.loss)
        return f"without it the weighted squared error on hold-out runs rises by {self.fall}"


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
    if all(record.periodic for record in state.fit.records):
        return state
    while chosen := [step for step in state.assembly.steps if step.effect.family != FAMILY]:
        callback("judge the effects beside each other")
        base = state.base()
        found = _evidence(state, base, chosen, roles, numerics, tests)
        worst = max(found, key=lambda one: one.missing, default=None)
        if worst is None or not worst.missing > 0.0:
            _note(found, notes)
            return state
        effect = worst.loss.step.effect.id
        callback(f"remove {effect}: {worst}")
        notes.append(
            f"{effect} was added on trial and removed again: beside the other effects of the final"
            f" model it is not confirmed, since {worst}"
        )
        assembly = state.assembly.without(worst.loss.step)
        start = start_from(base, base.fit.values, assembly.model())
        state = fit_state(assembly, roles, numerics, start=start, progress=callback)
    return state


def _note(found: Sequence[Evidence], notes: list[str]) -> None:
    """Note what confirms the effects of a final model, in place of what did so before."""
    notes[:] = [note for note in notes if not note.startswith(TOGETHER)]
    if found:
        parts = [f"{one.loss.step.effect.id}: {one}" for one in found]
        notes.append(f"{TOGETHER}; {'; '.join(parts)}")


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
            fall = fall_on_hold_out(*judged(before, state))
        declared = roles.strategy == "declared"
        found.append(Evidence(loss, fall, tests, declared, state.policy))
    return [one for one in found if one.is_known]
