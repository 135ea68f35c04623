"""Two effects of which neither alone predicts runs that were not fitted.

A search adds one effect after the other, and confirms each on the hold-out runs. Where two are
missing that both matter, such as dry friction and drag of one swing, a model with one of them may
fit better and predict worse than one with none. All that is confirmed then may be a parameter that
differs from run to run, which explains nothing. So before such a parameter is added, the few named
effects that fit best are followed one round further. The first of a pair is added on trial: the
next round must confirm another one, or it is taken back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from bayesoleo import _distributions as distributions
from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Roles
from bayesoleo.discovery._hold_out_confirmation import (
    Fall,
    fall_on_hold_out,
    judged,
    lacks_input,
)
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._refit import Refit
from bayesoleo.discovery._state import State, fit_state

#: Effects that are followed.
MOST = 3


def confirmed_together(
    state: State,
    ranking: Sequence[Ranked],
    refits: Mapping[int, Refit],
    roles: Roles,
    numerics: Numerics,
    follow: Callable[[State], tuple[Ranked | None, State | None]],
    callback: ProgressCallback,
    fitted: Mapping[int, State] = MappingProxyType({}),
) -> tuple[Ranked, State, str] | None:
    """An effect that with the one found after it lowers the error on hold-out runs.

    Parameters
    ----------
    state : State
        The model that was examined.
    ranking : sequence of Ranked
        Best first.
    refits : mapping of int to Refit
        Estimates, by the id of their scores.
    roles : Roles
    numerics : Numerics
    follow : callable
        Of a model: the effect that the next round adds to it, and the model with both.
    callback : callable
        Receives a message at each step.
    fitted : mapping of int to State
        Models with some of the effects on all runs, by the id of their estimates.

    Returns
    -------
    (Ranked, State, str) or None
        The effect, the model with it, and why it is added: that of the pair which lowers the error
        most. None where no pair does.
    """
    level, best = numerics.policy.significance, None
    if not state.hold_errors.entries:
        return None
    able = [
        item for item in ranking if item.refitted and not item.absorbs and item.may_be_tried(level)
    ]
    for item in [one for one in able if _may_be(refits[id(one.score)])][:MOST]:
        result = refits[id(item.score)]
        if lacks_input(result, roles) is not None:
            continue
        callback(f"follow {item.effect} one round further")
        one = fitted.get(id(result)) or fit_state(
            result.assembly, roles, numerics, start=result.fit.point.theta
        )
        if np.isnan(one.worst_ratio):
            continue
        other, both = follow(one)
        if other is None or both is None or other.absorbs:
            continue
        inflation = max(result.inflation, 0.0 if other.refit is None else other.refit.inflation)
        fall = fall_on_hold_out(*judged(state, both), inflation)
        if _confirms(fall) and (best is None or fall.value > best[3].value):
            best = item, one, other.effect, fall
    return None if best is None else (best[0], best[1], _reason(*best))


def _may_be(result: Refit) -> bool:
    """Whether an estimate explains enough, is not as good as none, and is no stopgap itself."""
    enough = result.share >= result.policy.fair_share and not result.unusual
    return bool(enough and result.excludes_null())


def _confirms(fall: Fall) -> bool:
    """Whether the fall by two effects is significant, although a few pairs are tried."""
    enough = float(distributions.norm.isf(fall.policy.false_confirmation / MOST))
    return bool(fall.value > max(enough * fall.error, 2.0 * enough**2))


def _reason(item: Ranked, _: State, other: str, fall: Fall) -> str:
    return (
        f"{item.effect} explains {100 * item.gain:.0f} % of the excess, and with {other} lowers the"
        f" error on hold-out runs: the weighted squared error falls by {fall}"
    )
