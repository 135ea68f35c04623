"""Candidate effects, scored and ranked for one round of the search."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Assembly, Option
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._refit import Refit
from bayesoleo.discovery._scales import scales_of
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import Score, classes, corrected_p, score_all, without_twins
from bayesoleo.effects._effect import Effect

#: Absorbing families, whose effects absorb a part of any model error: parameters that vary from run
#: to run, and forces that repeat with the drive.
ABSORBING_FAMILIES = frozenset({"run-to-run", "clock"})


@dataclass(frozen=True)
class Ranked:
    """A scored candidate with its place in the search.

    Parameters
    ----------
    score : Score
    p_value : float
        Corrected for the search.
    gain : float
        Share of the excess, after estimation where it was estimated.
    refitted : bool
        Whether it was estimated.
    same : tuple of str
        Ids of effects that these data cannot distinguish from it.
    refit : Refit or None
        The extended model, where it was estimated.
    closest : tuple of (str, float)
        For a nonparametric effect: the most similar named effects, with the cosine between the
        changes.
    beside : Refit or None
        Its estimate beside the other effects of the final model, where these have changed since
        it was added.
    """

    score: Score
    p_value: float
    gain: float
    refitted: bool
    same: tuple[str, ...]
    refit: Refit | None = None
    closest: tuple[tuple[str, float], ...] = ()
    beside: Refit | None = None

    @property
    def effect(self) -> str:
        """Canonical id."""
        return self.score.option.candidate.effect

    @property
    def target(self) -> str:
        """Its place in the model."""
        return self.score.option.candidate.target

    @property
    def absorbs(self) -> bool:
        """Whether it is of an absorbing family, which names no cause."""
        return self.score.option.candidate.family in ABSORBING_FAMILIES


def score_candidates(
    base: Base,
    assembly: Assembly,
    effects: Sequence[Effect] | None,
    jobs: int | None,
    *,
    order: Callable[[Option, int], int | bool] = lambda option, place: 0,
    callback: ProgressCallback = lambda _: None,
) -> tuple[list[Score], dict[str, str]]:
    """Score every effect at every place, each effect once.

    Parameters
    ----------
    base : Base
        Residuals and sensitivities of the present model.
    assembly : Assembly
        The present model.
    effects : sequence of Effect or None
        Instead of the catalogue.
    jobs : int or None
        Threads.
    order : callable (option, place in the catalogue) -> int, optional
        Of equivalent effects the first in this order is kept; by default the one with the largest
        share.
    callback : callable, optional
        Receives a message at each step.

    Returns
    -------
    scores : list of Score
        In that order, and by falling share.
    failed : dict of str to str
        Reason by effect without a score.
    """
    scales = scales_of(base.fit, assembly.drive, tuple(assembly.native.dofs))
    options = assembly.options(scales, None if effects is None else tuple(effects))
    callback(f"score {len(options)} candidates")
    scores, failed = score_all(base, options, jobs)
    places = {option.key: k for k, option in enumerate(options)}
    scores.sort(key=lambda score: order(score.option, places[score.option.key]))
    kept, twins = without_twins(scores, policy=base.policy)
    return kept, failed | twins


def rank(
    scores: Sequence[Score],
    tests: float,
    refits: dict[int, Refit],
    *,
    policy: SearchPolicy = SearchPolicy(),
) -> tuple[Ranked, ...]:
    """Candidates in the order of the search, estimated ones first.

    Parameters
    ----------
    scores : sequence of Score
    tests : float
        Effective number of independent tests.
    refits : dict of int to Refit
        By the ``id`` of the score.
    policy : SearchPolicy
    """
    groups = classes(scores, policy=policy)
    ranked = []
    for k, score in enumerate(scores):
        same = _same(scores, k, groups[k], refits)
        fitted = refits.get(id(score))
        if fitted is not None and not np.isfinite(fitted.share):
            fitted = None  # a failed estimate adds nothing to the score
        # The excess is known up to noise, so that a share may exceed one; it is limited to one.
        gain = min(score.share if fitted is None else max(fitted.share, 0.0), 1.0)
        p = corrected_p(score if fitted is None else _estimated(score, fitted), tests)
        ranked.append(Ranked(score, p, gain, fitted is not None, same, fitted))
    # Estimates are more reliable than scores and come first.
    return tuple(sorted(ranked, key=lambda item: (not item.refitted, -item.gain)))


def _estimated(score: Score, fitted: Refit) -> Score:
    """A score with the estimated values in place of those expected at the null."""
    return replace(score, fall=fitted.fall, inflation=fitted.inflation, freedom=fitted.freedom)


def _same(
    scores: Sequence[Score], k: int, group: Sequence[int], refits: dict[int, Refit]
) -> tuple[str, ...]:
    """Effects that are indistinguishable from number ``k``, by their estimates if both have one."""
    own, found = refits.get(id(scores[k])), []
    for j, other in enumerate(scores):
        estimated = refits.get(id(other))
        if j == k:
            continue
        if own is not None and estimated is not None and np.isfinite(estimated.share):
            alike = own.resembles(estimated)
        elif own is not None and estimated is not None and own.reached:
            # After a failed estimate only the score can distinguish the two.
            alike = not own.outdoes(other)
        else:
            alike = j in group and not (own is not None and own.outdoes(other))
        if alike:
            found.append(name_among(scores[k], other))
    return tuple(dict.fromkeys(found))


def name_among(own: Score, other: Score) -> str:
    """Name of another effect in the class of an effect; with its place if the ids are equal."""
    effect, target = other.option.key
    return f"{effect} @ {target}" if effect == own.option.key[0] else effect
