"""Corner of dry friction at zero velocity, once other effects are in the model.

An effect of friction is estimated with the corner that fits best beside the effects that are in the
model then. Those that come later may change which one that is.
"""

from __future__ import annotations

from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Roles
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._refit import clearly_better, compare, inflation_along, other_corners
from bayesoleo.discovery._score_tests import Score, score_all
from bayesoleo.discovery._state import State, fit_state
from bayesoleo.effects._forces import has_corner


def cornered(state: State, roles: Roles, numerics: Numerics, callback: ProgressCallback) -> State:
    """The state with the corner of dry friction that makes the data clearly likelier.

    Parameters
    ----------
    state : State
        With an effect just added.
    roles : Roles
    numerics : Numerics
    callback : callable
        Receives a message at each step.
    """
    # An estimate of friction that was just added has tried the other corners.
    if state.at_floor or not state.assembly.has_corner or state.assembly.ends_in_corner:
        return state
    base, best = state.base(), 0.0
    names = [name for step in state.assembly.steps for name in step.amplitudes]
    for assembly, fit in other_corners(base, state.assembly, state.fit, numerics):
        share, changes = compare(base, fit)
        noise = inflation_along(base, fit, names, changes)
        fall = share * base.fall_back
        if noise is None or not clearly_better(base, best, fall, noise.value):
            continue
        callback(f"friction has the corner of the {assembly.corner}")
        other = fit_state(assembly.with_values(fit.shared), roles, numerics, start=fit.point.theta)
        state, best = other, fall
    return state


def scored_with(state: State, scores: list[Score], corner: str, jobs: int | None) -> list[Score]:
    """Scores about a model, those of dry friction with another corner than they were made with.

    Parameters
    ----------
    state : State
        The model.
    scores : list of Score
        Of its candidates.
    corner : str
    jobs : int or None
        Processes.
    """
    assembly = state.assembly
    if corner == assembly.corner:
        return scores
    steps = {score.option.key: score.option.assembly.steps[-1] for score in scores}
    turned = assembly.with_corner(corner)
    options = [
        turned.option(step.effect, step.target, step.scales)
        for step in steps.values()
        if has_corner(step.effect, assembly.native)
    ]
    found, _ = score_all(state.base(), options, jobs)
    again = {score.option.key: score for score in found}
    return [again.get(score.option.key, score) for score in scores]
