"""Whether another first effect may lead as far as the one that was taken: one effect ahead, on the
fitted runs alone.

A search carried to its end takes minutes; what the best second effect leaves beside the first tells
in seconds whether it can come out better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.effects import Effect
from bayesoleo.effects.unnamed import FAMILY
from bayesoleo.parallel import thread_map
from bayesoleo.tracing.deciding.elimination import dispersion
from bayesoleo.tracing.deciding.progress import Progress
from bayesoleo.tracing.deciding.ranking import Ranked, score_candidates
from bayesoleo.tracing.deciding.refit import Refit, fall_from, refit, schwarz_price
from bayesoleo.tracing.deciding.state import State, state_of
from bayesoleo.tracing.fitting.fit import Fit, Numerics
from bayesoleo.tracing.fitting.roles import Roles
from bayesoleo.tracing.scoring.base import Base


def leads_as_far(
    progress: Progress,
    first: Ranked,
    roles: Roles,
    numerics: Numerics,
    effects: Sequence[Effect] | None,
    callback: ProgressCallback,
) -> bool:
    """Whether a first effect with the best second one beside it leaves about as little as the first
    two that were added, unknowns counted, or as the noise.

    Parameters
    ----------
    progress : Progress
        A finished search.
    first : Ranked
        Estimated in its first round.
    roles : Roles
    numerics : Numerics
    effects : sequence of Effect or None
        Instead of the catalogue.
    callback : callable
        Told what is being done.
    """
    result = first.refit
    assert result is not None
    callback(f"look how far {first.effect} leads as the first effect instead")
    fitted = replace(roles, held_out=(), strategy="none")
    state = state_of(result.assembly, result.fit, fitted)
    if state.at_floor:
        return True
    reference = progress.first.base()
    seconds = _best_seconds(state, numerics, effects)
    if any(second.reached for second in seconds):
        return True
    tried = (result, *seconds)
    falls = [fall_from(reference, one.fit) for one in tried]
    worths = [_worth(reference, fall, one.fit) for fall, one in zip(falls, tried, strict=True)]
    present = _with_two(progress).fit
    fall = fall_from(reference, present)
    left = replace(reference, excess=reference.excess - max(fall, *falls))
    best = int(np.argmax(worths))
    # Of what is compared: a rival that moves the mean alone may lie in far more noise.
    scale = dispersion(left) * max(result.inflation, tried[best].inflation)
    return (
        worths[best] > _worth(reference, fall, present) - numerics.policy.equal_likelihood * scale
    )


def _best_seconds(
    state: State, numerics: Numerics, effects: Sequence[Effect] | None
) -> list[Refit]:
    """The effects that score best beside a first one, estimated."""
    base = state.base()
    scores, _ = score_candidates(base, state.assembly, effects, numerics.jobs)
    named = [score for score in scores if score.option.candidate.family != FAMILY]
    chosen = sorted(named, key=lambda score: -score.fall)[: numerics.policy.seconds]
    return thread_map(lambda score: refit(base, score, numerics), chosen, numerics.jobs)


def _with_two(progress: Progress) -> State:
    """The model with the first two effects that were added, or the final one if it has fewer."""
    after = [entry.after for entry in progress.rounds if entry.after is not None]
    return after[1] if len(after) > 1 else progress.state


def _worth(reference: Base, fall: float, fit: Fit) -> float:
    return fall - schwarz_price(reference) * len(fit.problem.names)
