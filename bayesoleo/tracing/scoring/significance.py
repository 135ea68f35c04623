"""How sure an effect is, given that the best of many was picked; and which effects the data cannot
tell apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from bayesoleo.parallel import single_blas_thread
from bayesoleo.tracing.policy import SearchPolicy
from bayesoleo.tracing.scoring.score import Score


def effective_tests(
    scores: Sequence[Score], seed: int, *, policy: SearchPolicy = SearchPolicy()
) -> float:
    """Number of independent tests that a search over correlated candidates amounts to.

    Noise is drawn in the space of all candidates' columns, scanned shapes included; its largest
    statistic has the distribution of the largest of ``m`` independent ones, and ``m`` is read off
    at the median (Westfall and Young 1993, max-T; Sidak 1967).
    """
    columns = np.concatenate([score.columns for score in scores]) if scores else np.zeros((0, 1))
    if columns.shape[0] < 2:
        return 1.0
    with single_blas_thread():  # of a few hundred columns threads only get in each other's way
        values, vectors = np.linalg.eigh(columns @ columns.T)
        root = vectors * np.sqrt(np.clip(values, 0.0, None))
        draws = np.random.default_rng(seed).standard_normal((policy.search_draws, values.size))
        largest = np.abs(draws @ root.T).max(axis=1)
    smallest_p = 2 * stats.norm.sf(np.median(largest))
    return float(max(1.0, np.log(0.5) / np.log1p(-smallest_p)))


def corrected_p(score: Score, tests: float) -> float:
    """p-value of a score for the best of ``tests`` independent ones."""
    if score.inflation > 1.0 and score.freedom > 0:
        # The noise was measured between few periods, and is itself uncertain.
        local = float(stats.f.sf(score.statistic / score.rank, score.rank, score.freedom))
    else:
        local = float(stats.chi2.sf(score.statistic, score.rank))
    one_sided = score.rank == 1 and any(score.option.candidate.sign.values())
    local = local / 2 if one_sided and score.fall > 0 else local
    return float(-np.expm1(tests * np.log1p(-min(local, 1 - 1e-16))))


def without_twins(
    scores: Sequence[Score], *, policy: SearchPolicy = SearchPolicy()
) -> tuple[list[Score], dict[str, str]]:
    """Scores without effects that are another one in other words, and which those are.

    Where damping is a parameter of the model, more of it in extension is less of it in compression:
    beside the model's own terms both do the same, whatever the data. Effects of different causes
    that do the same are no twins, but a class.

    Parameters
    ----------
    scores : sequence of Score
        In the catalogue's order, which says what twins are called.
    policy : SearchPolicy

    Returns
    -------
    kept : list of Score
    twins : dict of str to str
        Reason by effect.
    """
    kept: list[Score] = []
    twins: dict[str, str] = {}
    for score in scores:
        effect, target = score.option.key
        like = next((other for other in kept if _are_twins(score, other, policy)), None)
        if like is None:
            kept.append(score)
        else:
            twins[f"{effect} at {target}"] = f"the same as {like.option.key[0]} in other words"
    return kept, twins


def _are_twins(one: Score, other: Score, policy: SearchPolicy) -> bool:
    here, there = one.option.candidate, other.option.candidate
    if (here.family, here.target) != (there.family, there.target):
        return False
    if len(one.columns) != 1 or len(other.columns) != 1:
        return False  # effects with shapes, or with several unknowns
    return float(one.columns[0] @ other.columns[0]) ** 2 > policy.twin_cosine


def classes(scores: Sequence[Score], *, policy: SearchPolicy = SearchPolicy()) -> list[list[int]]:
    """For each score the others that these data cannot distinguish from it."""
    size = len(scores)
    found: list[list[int]] = [[] for _ in range(size)]
    lengths = [float(np.linalg.norm(score.contribution)) for score in scores]
    for i in range(size):
        for j in range(i + 1, size):
            if lengths[i] == 0 or lengths[j] == 0:
                continue
            cosine = float(scores[i].contribution @ scores[j].contribution) / (
                lengths[i] * lengths[j]
            )
            if cosine > 0 and cosine**2 > policy.same_cosine:
                found[i].append(j)
                found[j].append(i)
    return found
