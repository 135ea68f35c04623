"""Candidate effects, scored and ranked: what the search makes of each of them."""

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

#: Families of effects that take up a part of whatever is missing: what varies from run to run, and
#: what repeats with the drive.
ABSORBING_FAMILIES = frozenset({"run-to-run", "clock"})


@dataclass(frozen=True)
class Ranked:
    """A scored candidate with what the search makes of it.

    Parameters
    ----------
    score : Score
    p_value : float
        Corrected for the search.
    gain : float
        Share of the excess, after estimation where it was estimated.
    refitted : bool
        Whether it was.
    same : tuple of str
        Ids of effects that these data cannot tell from it.
    refit : Refit or None
        The extended model, where it was estimated.
    closest : tuple of (str, float)
        Of a nonparametric effect: the named ones most like it, with the cosine between the
        changes.
    beside : Refit or None
        Its estimate beside the other effects of the final model, where these are others than when
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
        """Where it sits."""
        return self.score.option.candidate.target

    @property
    def absorbs(self) -> bool:
        """Whether it takes up a part of whatever is missing, and names no cause."""
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
        What they are scored against.
    assembly : Assembly
        The same model.
    effects : sequence of Effect or None
        Instead of the catalogue.
    jobs : int or None
        Threads.
    order : callable (option, place in the catalogue) -> int, optional
        Of effects that are one in other words the first in this order is kept; by default the one
        with the largest share.
    callback : callable, optional
        Told what is being done.

    Returns
    -------
    scores : list of Score
        In that order, and by falling share.
    failed : dict of str to str
        Reason by effect where there is no score.
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
    """Scores with what the search makes of them, those first that were estimated.

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
            fitted = None  # an estimate that failed says no more than the score
        # The excess is known up to noise: what explains all of it must not seem to explain more.
        gain = min(score.share if fitted is None else max(fitted.share, 0.0), 1.0)
        p = corrected_p(score if fitted is None else _estimated(score, fitted), tests)
        ranked.append(Ranked(score, p, gain, fitted is not None, same, fitted))
    # What was estimated is known better than what was only scored, and comes first.
    return tuple(sorted(ranked, key=lambda item: (not item.refitted, -item.gain)))


def _estimated(score: Score, fitted: Refit) -> Score:
    """A score with what was found by estimation in place of what was expected at the null."""
    return replace(score, fall=fitted.fall, inflation=fitted.inflation, freedom=fitted.freedom)


def _same(
    scores: Sequence[Score], k: int, group: Sequence[int], refits: dict[int, Refit]
) -> tuple[str, ...]:
    """Effects that look like number ``k``, by their estimates where both have one."""
    own, found = refits.get(id(scores[k])), []
    for j, other in enumerate(scores):
        estimated = refits.get(id(other))
        if j == k:
            continue
        if own is not None and estimated is not None and np.isfinite(estimated.share):
            alike = own.resembles(estimated)
        elif own is not None and estimated is not None and own.reached:
            # An estimate that failed tells nothing apart from what its score promises.
            alike = not own.outdoes(other)
        else:
            alike = j in group and not (own is not None and own.outdoes(other))
        if alike:
            found.append(name_among(scores[k], other))
    return tuple(dict.fromkeys(found))


def name_among(own: Score, other: Score) -> str:
    """What the class of an effect calls another one: by its place as well if the id is the same."""
    effect, target = other.option.key
    return f"{effect} @ {target}" if effect == own.option.key[0] else effect
