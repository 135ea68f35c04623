"""Classes of effects, looked at again once all that was missing has been found.

While another effect is missing, its error blurs what two candidates would change, and they look
alike. With everything else in the model, noise alone says how sure their difference is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from bayesoleo.effects import Effect, catalogue
from bayesoleo.tracing.deciding.refit import Refit, refit
from bayesoleo.tracing.deciding.rounds import Ranked, Round
from bayesoleo.tracing.deciding.state import State, fit_state
from bayesoleo.tracing.fitting.assembly import Option, Step
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.fitting.roles import Roles
from bayesoleo.tracing.scoring.score import score_all

Say = Callable[[str], None]


def reviewed(
    rounds: Sequence[Round],
    final: State,
    roles: Roles,
    numerics: Numerics,
    effects: Sequence[Effect] | None,
    say: Say,
) -> tuple[Round, ...]:
    """Rounds whose accepted effects keep only those rivals that still look like them.

    Parameters
    ----------
    rounds : sequence of Round
        As they were decided.
    final : State
        With all effects in.
    roles : Roles
    numerics : Numerics
    effects : sequence of Effect or None
        Instead of the catalogue.
    say : callable
        Told what is being done.
    """
    pool = catalogue() if effects is None else effects
    steps = {(step.effect.id, step.target): step for step in final.assembly.steps[:-1]}
    found = []
    for item in rounds:
        accepted = item.accepted
        step = steps.get((accepted.effect, accepted.target)) if accepted else None
        if accepted is None or step is None or not accepted.same:
            found.append(item)
            continue
        say(f"look again at what was like {accepted.effect}")
        ids = {accepted.effect, *(name.split(" @ ")[0] for name in accepted.same)}
        alike = [effect for effect in pool if effect.id in ids]
        same = _still_alike(accepted, step, final, roles, numerics, alike)
        found.append(_with_class(item, accepted, replace(accepted, same=same)))
    return tuple(found)


def _still_alike(
    accepted: Ranked,
    step: Step,
    final: State,
    roles: Roles,
    numerics: Numerics,
    effects: Sequence[Effect],
) -> tuple[str, ...]:
    """Of an effect's class those that explain as well what is left without it."""
    without = fit_state(final.assembly.without(step), roles, numerics)
    options = without.assembly.options(step.scales, effects)
    wanted = [o for o in options if _called(o, accepted) in {"", *accepted.same}]
    base = without.base()
    refits = [refit(base, score, numerics) for score in score_all(base, wanted, numerics.jobs)[0]]
    own = next((r for r in refits if not _called(r.score.option, accepted)), None)
    if own is None or not np.isfinite(own.share):
        return accepted.same
    alike = {_called(r.score.option, accepted) for r in refits if _rivals(own, r)}
    return tuple(name for name in accepted.same if name in alike)


def _rivals(own: Refit, other: Refit) -> bool:
    return other is not own and own.resembles(other)


def _called(option: Option, accepted: Ranked) -> str:
    """What a class calls an effect; nothing for the accepted one itself."""
    effect, target = option.key
    if effect != accepted.effect:
        return effect
    return "" if target == accepted.target else f"{effect} @ {target}"


def _with_class(item: Round, old: Ranked, new: Ranked) -> Round:
    ranking = tuple(new if one is old else one for one in item.ranking)
    return replace(item, ranking=ranking, accepted=new)
