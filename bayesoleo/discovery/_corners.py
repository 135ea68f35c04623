"""Corner of dry friction at zero velocity, once other effects are in the model.

An effect of friction is estimated with the corner that fits best beside the effects that are in the
model then. Those that come later may change which one that is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Assembly, Roles
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._refit import (
    clearly_better,
    compare,
    inflation_along,
    other_corners,
    with_other_corner,
)
from bayesoleo.discovery._score_tests import Score, score_all
from bayesoleo.discovery._state import State, fit_state
from bayesoleo.effects._forces import has_corner


def cornered(state: State, roles: Roles, numerics: Numerics, callback: ProgressCallback) -> State:
    """The state with the corner of dry friction that makes the data clearly likelier.

    Where more than noise is left, every corner is tried. Where noise is, the tails of an arctangent
    may still be a part of it that shows in runs which were not fitted, and one other is tried.

    Parameters
    ----------
    state : State
        With an effect just added.
    roles : Roles
    numerics : Numerics
    callback : callable
        Receives a message at each step.
    """
    if not state.assembly.has_corner:
        return state
    others = other_corners(state.assembly.corner)[: 1 if state.at_floor else None]
    base, best, found = state.base(), 0.0, None
    names = [name for step in state.assembly.steps for name in step.amplitudes]
    callback("test whether friction has another corner")
    for corner in others:
        assembly, fit = with_other_corner(base, state.assembly, state.fit, corner, numerics)
        share, changes = compare(base, fit)
        noise = inflation_along(base, fit, names, changes)
        fall = share * base.fall_back
        if noise is not None and clearly_better(base, best, fall, noise.value):
            found, best = (assembly, fit), fall
    if found is None:
        return state
    assembly, fit = found
    other = fit_state(assembly.with_values(fit.shared), roles, numerics, start=fit.point.theta)
    if np.isnan(other.worst_ratio) or (state.at_floor and not other.at_floor):
        return state  # runs that were not fitted speak against it
    callback(f"take {assembly.corner} for the sign of the velocity in dry friction")
    return other


def beginning(
    first: State, ranking: Sequence[Ranked], corner: str, jobs: int | None
) -> tuple[Assembly, list[Score]]:
    """The declared model and the scores of its candidates with a corner of dry friction.

    Parameters
    ----------
    first : State
        The model.
    ranking : sequence of Ranked
        Its candidates, as they were scored.
    corner : str
        Dry friction that was scored with another one is scored again.
    jobs : int or None
        Processes.
    """
    scores, assembly = [item.score for item in ranking], first.assembly
    turned = assembly.with_corner(corner)
    if corner == assembly.corner:
        return turned, scores
    steps = {score.option.key: score.option.assembly.steps[-1] for score in scores}
    options = [
        turned.option(step.effect, step.target, step.scales)
        for step in steps.values()
        if has_corner(step.effect, assembly.native)
    ]
    found, _ = score_all(first.base(), options, jobs)
    again = {score.option.key: score for score in found}
    return turned, [again.get(score.option.key, score) for score in scores]
