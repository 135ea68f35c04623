"""What a search comes to in one word, and how sure the names are that it gives.

An effect counts as found where the model predicts all runs down to what is expected, or where
effects of physics explain nine tenths of what was missing. What varies by run, what repeats with
the drive and curves without a name take up a part of whatever is missing; what they explain is no
evidence that a cause was found.
"""

from __future__ import annotations

from collections.abc import Sequence

from bayesoleo import schema
from bayesoleo.effects.unnamed import FAMILY
from bayesoleo.tracing.deciding.ranking import ABSORBING_FAMILIES
from bayesoleo.tracing.deciding.rounds import Round
from bayesoleo.tracing.deciding.state import State
from bayesoleo.tracing.fitting.assembly import Added
from bayesoleo.tracing.policy import SearchPolicy

#: Families of effects that name no cause.
NO_CAUSE = ABSORBING_FAMILIES | {FAMILY}


def verdict_of(
    rounds: Sequence[Round], first: State, final: State, *, policy: SearchPolicy = SearchPolicy()
) -> str:
    """One of the three verdicts of the summary.

    Parameters
    ----------
    rounds : sequence of Round
        In order.
    first, final : State
        The model as declared, and with all effects.
    policy : SearchPolicy
        Its ``explained`` is the part of the excess that effects of physics must explain where more
        than is expected is left.
    """
    if _as_expected(final):
        return schema.EFFECT_ADDED if final.assembly.added else schema.NOTHING_MISSING
    if final.too_quiet:
        return schema.UNEXPLAINED  # by a noise that is too large all is explained
    found = explained_by_physics(rounds, first, final) > policy.explained
    return schema.EFFECT_ADDED if found else schema.UNEXPLAINED


def certainty_of(final: State, certain: bool) -> str | None:
    """How sure the names of the added effects are; None where none was added.

    Parameters
    ----------
    final : State
        With all effects.
    certain : bool
        Whether the data leave no doubt of its only effect.
    """
    steps = final.assembly.steps
    if not steps:
        return None
    if all(step.effect.family in NO_CAUSE for step in steps):
        return schema.NO_CAUSE
    if not _as_expected(final):
        return schema.LIKENESS
    return schema.CERTAIN if certain else schema.PROBABLE


def _as_expected(final: State) -> bool:
    """Whether all errors are what is expected: less than chance allows is a fault of the noise, and
    proves nothing."""
    return final.at_floor and not final.too_quiet


def explained_by_physics(rounds: Sequence[Round], first: State, final: State) -> float:
    """Part of the excess that effects of physics explain, of those that stayed.

    Each effect gets what the error fell by in the round that added it.
    """
    added = final.assembly.added
    whole = max(excess(first), 1e-300)
    if all(step.effect.family not in NO_CAUSE for step in final.assembly.steps):
        return (excess(first) - excess(final)) / whole if added else 0.0
    # A round that replaced an effect begins without it, not where the round before it ended.
    return sum(
        (excess(item.before) - excess(item.after)) / whole
        for item in rounds
        if item.after is not None and _is_physics(item, added)
    )


def _is_physics(item: Round, added: Sequence[Added]) -> bool:
    """Whether a round added an effect of physics that stayed."""
    found = item.accepted
    if found is None or (found.effect, found.target) not in added:
        return False
    return found.score.option.candidate.family not in NO_CAUSE


def excess(state: State) -> float:
    """Squared ratio to what is expected beyond one, of held-out runs where there are any."""
    table = state.hold_errors if state.hold_errors.entries else state.fit_errors
    return float(sum(max(entry.ratio_to_expected**2 - 1.0, 0.0) for entry in table.entries))
