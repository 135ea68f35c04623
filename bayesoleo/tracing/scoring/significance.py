"""How sure an effect is, given that the best of many was picked; and which effects the data cannot
tell apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bayesoleo.parallel import single_blas_thread
from bayesoleo.tracing.scoring.score import Score

Array = NDArray[np.float64]

#: Effects whose contributions agree to this squared cosine are one class.
SAME = 0.95
DRAWS = 4000


def effective_tests(scores: Sequence[Score], seed: int) -> float:
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
        draws = np.random.default_rng(seed).standard_normal((DRAWS, values.size))
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


def classes(scores: Sequence[Score]) -> list[list[int]]:
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
            if cosine > 0 and cosine**2 > SAME:
                found[i].append(j)
                found[j].append(i)
    return found
