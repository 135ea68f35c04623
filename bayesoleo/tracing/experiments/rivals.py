"""Which models a round of the search leaves standing, and which it leaves open."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches

import numpy as np

from bayesoleo.errors import InputError
from bayesoleo.parallel import thread_map
from bayesoleo.tracing.deciding.ranking import Ranked
from bayesoleo.tracing.deciding.refit import Refit, refit
from bayesoleo.tracing.deciding.rounds import Round
from bayesoleo.tracing.experiments.foresee import Rival
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.policy import SearchPolicy


def standing(item: Round, *, policy: SearchPolicy = SearchPolicy()) -> tuple[Ranked, ...]:
    """Candidates that a round leaves to be told apart, the best first.

    Where an effect was accepted, it and those that the data cannot tell from it; else those that
    are significant and explain a part of the excess, what merely varies from run to run left out.
    Fewer than two are no question.
    """
    if item.accepted is not None:
        names = set(item.accepted.same)
        alike = [
            other
            for other in item.ranking
            if other is not item.accepted
            and names & {other.effect, f"{other.effect} @ {other.target}"}
        ]
        chosen = [item.accepted, *alike]
    else:
        chosen = [
            other
            for other in item.ranking
            if other.p_value < policy.significance
            and other.gain >= policy.least_share
            and not other.absorbs
        ]
    return tuple(chosen[: policy.proposal_rivals]) if len(chosen) > 1 else ()


def named(item: Round, effects: Sequence[str]) -> tuple[Ranked, ...]:
    """Candidates by their ids, or by ``effect@target`` where there are several with one id.

    Raises
    ------
    InputError
        If a round has no such candidate.
    """
    return tuple(_named(item, text) for text in effects)


def _named(item: Round, text: str) -> Ranked:
    wanted = text.replace(" ", "")
    for one in item.ranking:
        if wanted in (one.effect, f"{one.effect}@{one.target}"):
            return one
    known = dict.fromkeys(one.effect for one in item.ranking)
    close = get_close_matches(wanted, known, 3)
    hint = f"write one of: {', '.join(close or known)}"
    raise InputError("no such candidate in the last round", value=text, hint=hint)


def rivals_of(
    item: Round, chosen: Sequence[Ranked], numerics: Numerics
) -> tuple[list[Rival], Mapping[str, str]]:
    """The extended models of some candidates of a round, estimated where they were not.

    Parameters
    ----------
    item : Round
    chosen : sequence of Ranked
        Of that round.
    numerics : Numerics
        Scheme, threads.

    Returns
    -------
    rivals : list of Rival
    failed : dict of str to str
        Candidates that could not be estimated, with the reason.
    """
    missing = [one for one in chosen if one.refit is None]
    base = item.before.base() if missing else None

    def estimated(one: Ranked) -> Refit:
        assert base is not None
        return refit(base, one.score, numerics)

    fresh = dict(zip(map(id, missing), thread_map(estimated, missing, numerics.jobs), strict=True))
    rivals, failed = [], {}
    for one in chosen:
        fit = (one.refit or fresh[id(one)]).fit
        name = label(one, chosen)
        if fit.point.status.ok and np.isfinite(fit.point.covariance).all():
            rivals.append(Rival(name, fit))
        else:
            failed[name] = fit.point.status.message
    return rivals, failed


def label(one: Ranked, among: Sequence[Ranked]) -> str:
    """The effect's id, with its target where another one has the same id."""
    several = sum(other.effect == one.effect for other in among) > 1
    return f"{one.effect} @ {one.target}" if several else one.effect
