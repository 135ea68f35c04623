"""Whether runs that were not used confirm an effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.tracing.deciding.fall import fall_on_hold_out, with_error
from bayesoleo.tracing.deciding.ranking import Ranked
from bayesoleo.tracing.deciding.refit import Refit
from bayesoleo.tracing.deciding.state import State, fit_state
from bayesoleo.tracing.errors.holdout import crossed
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.fitting.roles import Roles, in_halves


def confirmed(
    state: State,
    item: Ranked,
    result: Refit,
    roles: Roles,
    numerics: Numerics,
    callback: ProgressCallback,
) -> tuple[State | None, str]:
    """The state with an estimated effect in, if runs that were not used confirm it, and why."""
    if not np.isfinite(result.share):
        return None, f"{item.effect} could not be estimated"
    policy = numerics.policy
    if result.share < (policy.least_share if result.reached else policy.fair_share):
        share = f"{100 * result.share:.0f} % of the excess, {_on_fitted(result)}"
        return None, f"{item.effect} would explain only {share}"
    if not result.excludes_null():
        return (
            None,
            f"the posterior of {item.effect} does not exclude its null: {_on_fitted(result)}",
        )
    callback(f"confirm {item.effect} on runs that were not used")
    after = fit_state(result.assembly, roles, numerics, start=result.fit.point.theta)
    if not after.hold_errors.entries:
        return after, f"{_explains(item)}, {_on_fitted(result)}; no run was held out"
    fall = fall_on_hold_out(*judged(state, after), result.inflation)
    if fall.error == 0.0:
        return None, f"{item.effect} cannot be confirmed: it changes no hold-out run that is solved"
    where = f"hold-out runs: the weighted squared error falls by {fall}"
    # Halves of a run share whatever is odd in it. They show that a parameter of its own repeats,
    # which is no news where that leaves more than noise.
    alike = item.absorbs and not result.reached
    able = fall.undecided and not fall.speaks_against and not alike
    halves = in_halves(roles) if able else None
    if halves is not None:
        # What happens at the end of the stroke shows only in runs that get there.
        callback(
            f"runs held out hardly show {item.effect}: confirm it on the other half of the periods"
        )
        pair = _on_halves(state, after, halves, numerics)
        other = fall_on_hold_out(*pair, result.inflation)
        fall = fall.and_by(other)
        where += f", which hardly shows it, and by {other} on the second half of fitted ones"
    if not fall.confirms:
        errors, alarms = policy.confirming_errors, 100 * policy.false_confirmation
        asked = f"{errors:.2f} standard errors are asked for (false alarms {alarms:g} %)"
        return None, f"{item.effect} does not lower the error on {where}; {asked}"
    return after, f"{_explains(item)} and lowers the error on {where}"


def speak_against(one: State, other: State, inflation: float) -> bool:
    """Whether runs that were not used speak against another model instead of one.

    Parameters
    ----------
    one, other : State
    inflation : float
        Variance of the noise along what tells them apart, over that of white noise.
    """
    if not one.hold_errors.entries:
        return False
    return fall_on_hold_out(*judged(other, one), inflation).confirms


def _on_fitted(result: Refit) -> str:
    """By how much an estimate lowers the error on the runs that it was made from."""
    # The fall is a non-central chi-square, of variance 2 k + 4 times its non-centrality.
    error = float(np.sqrt(result.inflation * (4.0 * max(result.fall, 0.0) + 2.0 * result.size)))
    fall = with_error(result.fall, error)
    return f"lowering the weighted squared error on fitted runs by {fall}"


def _on_halves(
    before: State, after: State, halves: Roles, numerics: Numerics
) -> tuple[State, State]:
    """Both models estimated on the first half of each fitted run and held against the second."""
    quick = replace(numerics, steps=after.fit.steps)
    old, new = (
        fit_state(state.assembly, halves, quick, start=state.fit.point.theta)
        for state in (before, after)
    )
    return judged(old, new)


def judged(before: State, after: State) -> tuple[State, State]:
    """Both states as an effect is judged by them: where it brings parameters of single runs, with
    each half of a run predicted by what the other half says, alike before and after."""
    pairs = []
    for old, new in zip(before.held_out, after.held_out, strict=True):
        if new.re_estimated > old.re_estimated:
            across = crossed(old) if old.re_estimated else old, crossed(new)
            if across[0] is not None and across[1] is not None:
                old, new = across[0], across[1]
        pairs.append((old, new))
    return (
        replace(before, held_out=[old for old, _ in pairs]),
        replace(after, held_out=[new for _, new in pairs]),
    )


def _explains(item: Ranked) -> str:
    return f"{item.effect} explains {100 * item.gain:.0f} % of the excess"
