"""Whether runs that were not used confirm an effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bayesoleo.prediction.input_noise import input_columns
from bayesoleo.tracing.deciding.refit import Refit
from bayesoleo.tracing.deciding.state import State, fit_state
from bayesoleo.tracing.errors.holdout import crossed
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.fitting.masked import weights
from bayesoleo.tracing.fitting.roles import Roles, in_halves

if TYPE_CHECKING:
    from bayesoleo.tracing.deciding.rounds import Ranked

#: Least part of the present excess that is worth another effect.
LEAST_SHARE = 0.05
#: The same of an effect that leaves more than noise. Of four that are missing, as many as are added
#: by default, the one that explains most explains a quarter where they do different things; half of
#: that is asked for. What explains less is near to something that is there rather than there.
FAIR_SHARE = 0.125
#: Runs held out that an effect changes by fewer standard deviations of noise than this cannot
#: judge it alone. If it is real and changes them by ``d``, the error falls by ``d^2`` with standard
#: error ``2 d``, and so by more than its error in all but the part ``Phi(1 - d/2)`` of cases: one
#: in forty at six, one in two at two.
SILENT = 6.0

Say = Callable[[str], None]


def confirmed(
    state: State, item: Ranked, result: Refit, roles: Roles, numerics: Numerics, say: Say
) -> tuple[State | None, str]:
    """The state with an estimated effect in, if runs that were not used confirm it, and why."""
    if not np.isfinite(result.share):
        return None, f"{item.effect} could not be estimated"
    if result.share < (LEAST_SHARE if result.reached else FAIR_SHARE):
        share = f"{100 * result.share:.0f} % of the excess"
        return None, f"{item.effect} would explain only {share}"
    if not result.excludes_null():
        return None, f"the posterior of {item.effect} does not exclude its null"
    say(f"confirm {item.effect} on runs that were not used")
    after = fit_state(result.assembly, roles, numerics, start=result.fit.point.theta)
    if not after.hold_errors.entries:
        return after, _explains(item)
    pairs = [judged(state, after)]
    fall, error = fall_on_hold_out(*pairs[0])
    where = "hold-out runs"
    halves = in_halves(roles) if error < 2 * SILENT else None
    if halves is not None:
        # What happens at the end of the stroke shows only in runs that get there.
        say(f"runs held out hardly show {item.effect}: confirm it on the other half of the periods")
        pairs.append(_on_halves(state, after, halves, numerics))
        more_fall, more_error = fall_on_hold_out(*pairs[1])
        fall, error = fall + more_fall, float(np.hypot(error, more_error))
        where = "hold-out runs, which hardly show it, and the second half of fitted ones"
    # Parameters estimated on the very samples that they are judged by fit their noise: each lowers
    # the sum by one on average, and by more where noise is coloured, which scatters the sum more
    # too.
    more = sum(_re_estimated(new) - _re_estimated(old) for old, new in pairs)
    error *= float(np.sqrt(result.inflation))
    if not after.at_floor and all(record.periodic for record in roles.fitted):
        # What still repeats scatters the fall as noise of its size would (McCullagh and Nelder
        # 1989, section 4.5): a curve that happens to run along it proves nothing. Of transients the
        # inflation is measured on all that is left.
        error *= max(1.0, after.worst_ratio)
    if not fall - result.inflation * more > error:
        return None, f"{item.effect} does not lower the error on {where}"
    lowers = f" and lowers the weighted squared error on {where} by {fall:.3g} ± {error:.1g}"
    return after, _explains(item) + lowers


def _re_estimated(state: State) -> int:
    return sum(prediction.re_estimated for prediction in state.held_out)


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


def fall_on_hold_out(before: State, after: State) -> tuple[float, float]:
    """Fall of the weighted sum of squares on held-out runs, and its standard error.

    With predictions ``a`` and ``b`` the fall is ``sum w ((y - a)^2 - (y - b)^2)``; noise with the
    covariance ``1/w + B B'`` in ``y - a``, the input's included, gives it the variance
    ``4 d' w (1/w + B B') w d`` with ``d = b - a``. Runs that could not be solved in both states do
    not count.
    """
    fall = variance = 0.0
    for old, new in zip(before.held_out, after.held_out, strict=True):
        if not (old.status.ok and new.status.ok):
            continue
        predictor = old.predictor
        p = predictor.constants(old.vector[None], 0)[0]
        moved = 0.0
        from_input = input_columns(predictor.runs[0], p)
        for b, output in enumerate(new.predictor.outputs):
            weight = before.hold_errors.at(output, old.record.label).average.sigma ** -2
            measured, counts = old.record.samples[output], weights(old.record)
            squares = (measured - old.y[b]) ** 2 - (measured - new.y[b]) ** 2
            fall += weight * float(counts @ squares)
            change = (new.y[b] - old.y[b]) * counts
            variance += 4 * weight * float(change @ change)
            moved = moved + weight * (from_input[b] @ change)
        variance += 4 * float(np.sum(np.square(moved)))
    return fall, float(np.sqrt(variance))


def _explains(item: Ranked) -> str:
    return f"{item.effect} explains {100 * item.gain:.0f} % of the excess"
