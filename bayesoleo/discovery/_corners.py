"""Corner of dry friction at zero velocity.

The catalogue's is the arctangent of Verbeek (1993). It comes with tails: at ten transition
velocities a fifteenth of the friction is still to come. The corner of measured friction may end
sooner, and effects that nothing has are then found in the difference.

Candidates are estimated with the corner that the model has. With the best of several corners for
each, friction of a flexible form explains what two other effects do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Assembly, Roles
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._refit import compare, inflation_along, price_in, quick_fit
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import Score, score_all
from bayesoleo.discovery._state import State, fit_state
from bayesoleo.effects._forces import CORNERS, TRANSITION, has_corner

#: Factors of the velocity of a corner from which another corner's estimate may start: an arctangent
#: makes up for its tails by a smaller one.
WIDER = (0.5, 4.0, 2.0, 1.0)


def cornered(state: State, roles: Roles, numerics: Numerics, callback: ProgressCallback) -> State:
    """The state with the corner of dry friction that makes the data clearly likelier, without an
    effect that only made up for it.

    It is taken only where noise explains all that is left with it. Beside an effect that is missing
    another corner makes up for a part of that.

    Where noise explains what one effect with the present corner leaves, the tails of an arctangent
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
    callback("test whether friction has another corner")
    found = _likelier(state, numerics)
    if found is None:
        return state
    assembly, fit = found
    other = fit_state(assembly.with_values(fit.shared), roles, numerics, start=fit.point.theta)
    if np.isnan(other.worst_ratio) or not other.at_floor:
        return state  # finer steps, or runs that were not fitted, speak against it
    callback(f"take {assembly.corner} for the sign of the velocity in dry friction")
    return other


def _likelier(state: State, numerics: Numerics) -> tuple[Assembly, ModelFit] | None:
    """The state's model, or that without one of its effects, with the corner that makes the data
    clearly likeliest, unknowns counted, and leaves only noise; None if none does.

    Two effects may make up for a corner down to the noise, as friction at breakaway and damping by
    a power law do.
    """
    steps, base = state.assembly.steps, state.base()
    several = len(steps) > 1
    less = [state.assembly.without(step) for step in steps if several]
    less = [form for form in less if form.has_corner]
    others = other_corners(state.assembly.corner)[: None if several or not state.at_floor else 1]
    # That an effect is not worth its unknowns is no merit of another corner.
    present = [_against(base, form, state.fit, form.corner, numerics) for form in less]
    best, found = max([0.0, *(one.worth for one in present)]), None
    for form in (state.assembly, *less):
        for corner in others:
            tried = _against(base, form, state.fit, corner, numerics)
            if tried.worth - best > base.policy.equal_likelihood:
                best, found = tried.worth, tried
    return None if found is None else (found.assembly, found.fit)


@dataclass(frozen=True)
class _Tried:
    """A model with a corner of friction, its estimate, and how much likelier than the present model
    it makes the data, in the units of :func:`~bayesoleo.discovery._alternatives.loss_of`; minus
    infinity where more than noise is left."""

    assembly: Assembly
    fit: ModelFit
    worth: float


def _against(
    base: Base, form: Assembly, present: ModelFit, corner: str, numerics: Numerics
) -> _Tried:
    assembly, fit = with_other_corner(base, form, present, corner, numerics)
    share, changes = compare(base, fit)
    fall = share * base.fall_back
    names = [name for step in form.steps for name in step.amplitudes]
    noise = inflation_along(base, fit, names, changes)
    if noise is None or not base.excess - fall < base.feigned:
        return _Tried(assembly, fit, -np.inf)
    # They are told apart as two effects are.
    saved = len(base.fit.problem.names) - len(fit.problem.names)
    return _Tried(assembly, fit, fall / noise.value + saved * price_in(base, noise))


def other_corners(corner: str) -> list[str]:
    """Corners of dry friction that are tried where a model has another one, in this order."""
    return [other for other in CORNERS if other != corner]


def with_other_corner(
    base: Base, assembly: Assembly, fit: ModelFit, corner: str, numerics: Numerics
) -> tuple[Assembly, ModelFit]:
    """A model with another corner of dry friction, and its estimate from the present one."""
    present = assembly.model().parameters
    widths = [
        name for name in fit.shared if name in present and present[name].description == TRANSITION
    ]
    starts = [fit.values | {name: factor * fit.shared[name] for name in widths} for factor in WIDER]
    other = assembly.with_corner(corner)
    return other, quick_fit(base, other.model(), starts, numerics)


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
