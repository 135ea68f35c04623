r"""Whether a residual has come down to what is expected of it.

The squared ratio to the expected error is a sum of squares: of the noise's coefficients, which are
many, and of what the unknowns' errors do, which may be one direction that rules all. Its mean is
one; variance and skewness follow from the quadratic form, over runs that share their unknowns too,
and a shifted :math:`\chi^2` variate with these three moments stands for it. Noise that is measured
divides it, which makes it an F variate.

References
----------
Buckley and Eagleson (1988), Australian Journal of Statistics 30A(1), 150-159: three moments.
Satterthwaite (1946), Biometrics Bulletin 2(6), 110-114.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from bayesoleo.tracing.errors.errors_table import ErrorTable, RunError
from bayesoleo.tracing.policy import SearchPolicy


def limit(
    entries: Sequence[RunError], tests: int = 1, *, policy: SearchPolicy = SearchPolicy()
) -> float:
    """Ratio to what is expected that chance hardly exceeds, at least the policy's ``floor_ratio``.

    Parameters
    ----------
    entries : sequence of RunError
        Over which the squared ratio is averaged.
    tests : int
        Ratios that are looked at together.
    policy : SearchPolicy
    """
    level = policy.floor_false_alarm / tests
    return max(policy.floor_ratio, math.sqrt(_quantile(entries, level)))


def lowest(
    entries: Sequence[RunError], tests: int = 1, *, policy: SearchPolicy = SearchPolicy()
) -> float:
    """Ratio to what is expected that chance hardly falls below.

    The unknowns' errors may be nothing by chance, but noise is always there: the limit is that of
    the noise alone.

    Parameters
    ----------
    entries : sequence of RunError
        Over which the squared ratio is averaged.
    tests : int
        Ratios that are looked at together.
    policy : SearchPolicy
    """
    own = float(np.mean([entry.own_share for entry in entries]))
    none = np.zeros((0, 0))
    noise = [replace(e, parameters=none, own_share=e.own_share / own) for e in entries]
    share, number, free = _variate(noise)
    level = policy.floor_false_alarm / tests
    square = 1.0 + share * (float(stats.f.ppf(level, number, free)) - 1.0)
    return math.sqrt(own * max(square, 0.0))


def chance(entries: Sequence[RunError]) -> float:
    """Probability that chance alone gives a squared ratio to what is expected as large.

    Parameters
    ----------
    entries : sequence of RunError
        Over which it is averaged; not a number where a run could not be solved.
    """
    square = float(np.mean([entry.ratio_to_expected**2 for entry in entries]))
    share, number, free = _variate(entries)
    return float(stats.f.sf(1.0 + (square - 1.0) / share, number, free))


def _quantile(entries: Sequence[RunError], above: float) -> float:
    """Squared ratio that is exceeded with a probability."""
    share, number, free = _variate(entries)
    return 1.0 + share * (float(stats.f.isf(above, number, free)) - 1.0)


def _variate(entries: Sequence[RunError]) -> tuple[float, float, float]:
    """``b`` and degrees of freedom of an F variate, ``1 - b + b F`` being the squared ratio."""
    second, third = _moments(entries)
    # Mean one, variance 2 second, third cumulant 8 third.
    number = max(second**3 / third**2, 1e-3)
    free = len(entries) ** 2 / sum(entry.own_share**2 / entry.free for entry in entries)
    return second**2 / third, number, max(free, 1e-3)


def _moments(entries: Sequence[RunError]) -> tuple[float, float]:
    """Sums of the second and third powers of the quadratic form's eigenvalues, for the mean."""
    second = third = 0.0
    together: dict[int, np.ndarray] = {}
    for entry in entries:
        own, count = entry.own_share, entry.own_coefficients or entry.coefficients
        gram = entry.parameters
        trace, square = float(np.trace(gram)), float(np.sum(gram * gram))
        # Where the unknowns' errors lie in one coefficient of the noise it is more by its own.
        second += own**2 / count + 2.0 * own * trace / count
        third += own**3 / count**2 + 3.0 * (own**2 * trace / count**2 + own * square / count)
        if gram.size:
            together[len(gram)] = together.get(len(gram), 0.0) + gram
    for gram in together.values():  # the same errors of the unknowns in all runs
        second += float(np.sum(gram * gram))
        third += float(np.sum((gram @ gram) * gram))
    size = len(entries)
    return max(second / size**2, 1e-12), max(third / size**3, 1e-18)


def is_at_floor(table: ErrorTable, *, policy: SearchPolicy = SearchPolicy()) -> bool:
    """Whether every output, pooled over each role and in each run, is down to what is expected.

    A run that could not be solved is not.
    """
    entries = table.entries
    for role in {entry.role for entry in entries}:
        for output in table.outputs:
            chosen = [e for e in entries if e.role == role and e.output == output]
            pooled = float(np.sqrt(np.mean([entry.ratio_to_expected**2 for entry in chosen])))
            if not pooled < limit(chosen, policy=policy):
                return False
    together = len(entries)
    return all(e.ratio_to_expected < limit([e], together, policy=policy) for e in entries)


def too_quiet(table: ErrorTable, *, policy: SearchPolicy = SearchPolicy()) -> tuple[str, ...]:
    """Sentences on outputs that leave less than chance allows, pooled over the runs of a role.

    A residual below the noise says that the noise is not what was measured, not that all is well.
    """
    found = []
    for role in dict.fromkeys(entry.role for entry in table.entries):
        for output in table.outputs:
            chosen = [e for e in table.entries if e.role == role and e.output == output]
            numbers = table.pooled(role, output)
            ratio = numbers["ratio_to_expected"]
            least = lowest(chosen, policy=policy)
            if ratio < min(least, policy.least_ratio):
                found.append(
                    f"{output}: the error of the {role} runs is {numbers['repeating']:.3g},"
                    f" {ratio:.2f} times the expected {numbers['expected']:.3g}, and chance allows"
                    f" {least:.2f} at least: the noise was measured too large"
                )
    return tuple(found)
