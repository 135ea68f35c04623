"""Do mean residuals differ from run to run, and from group to group?

What a model leaves out differs between runs more than within one, and shows as means that noise
cannot explain (Verbeek 1993, section 6.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from bayesoleo._types import Array
from bayesoleo.assessment.residual_tests import autocorrelation_time
from bayesoleo.assessment.series import Series

#: What is found, in words.
ACROSS = {
    "share_of_runs": "part of the variance that differs from run to run",
    "share_of_runs_p": "its probability",
    "share_of_groups": "part of the variance of run means that differs from group to group",
    "share_of_groups_p": "its probability",
}
_TINY = np.finfo(float).tiny


def between_means(chosen: Sequence[Series]) -> dict[str, float]:
    """Shares of the variance that differ between runs and groups, with their probabilities.

    Parameters
    ----------
    chosen : sequence of Series
        Of one output, one a run.

    Returns
    -------
    dict
        The keys of ``ACROSS``; NaN where there are too few runs or groups.
    """
    found = dict.fromkeys(ACROSS, np.nan)
    if len(chosen) < 2:
        return found
    means = np.array([one.residual.mean() for one in chosen])
    whole = np.concatenate([one.residual for one in chosen])
    sizes = np.array([one.residual.size for one in chosen])
    total = max(float(np.sum((whole - whole.mean()) ** 2)), _TINY)
    found["share_of_runs"] = float(np.sum(sizes * (means - whole.mean()) ** 2)) / total
    found["share_of_runs_p"] = _runs_differ(chosen, means)
    labels = np.array([one.group for one in chosen])
    members = [means[labels == label] for label in dict.fromkeys(labels)]
    if 1 < len(members) < len(chosen):
        share, p_value = _groups_differ(means, members)
        found |= {"share_of_groups": share, "share_of_groups_p": p_value}
    return found


def _runs_differ(chosen: Sequence[Series], means: Array) -> float:
    """Probability of means so far apart, each with an error of its own.

    Errors follow from the autocorrelation time of the noise, which a short record knows badly.
    Periods are replicates; the scatter of their means corrects all errors by a common factor.
    """
    noise = [one.noise() for one in chosen]
    effective = np.array([e.size / autocorrelation_time(e) for e in noise])
    weight = effective / np.maximum([float(np.var(e)) for e in noise], _TINY)
    centre = float(np.sum(weight * means) / weight.sum())
    chi_square = float(np.sum(weight * (means - centre) ** 2))
    periods = [one.period_means() for one in chosen]
    free = sum(part.size - 1 for part in periods)
    if free == 0:
        return float(stats.chi2.sf(chi_square, len(chosen) - 1))
    scatter = sum(
        w * np.sum((part - part.mean()) ** 2) / part.size
        for w, part in zip(weight, periods, strict=True)
    )
    ratio = chi_square / (len(chosen) - 1) / max(float(scatter) / free, _TINY)
    return float(stats.f.sf(ratio, len(chosen) - 1, free))


def _groups_differ(means: Array, members: Sequence[Array]) -> tuple[float, float]:
    """Share of the variance of run means between groups, and its probability."""
    total = float(np.sum((means - means.mean()) ** 2))
    inside = float(sum(np.sum((part - part.mean()) ** 2) for part in members))
    between, free = len(members) - 1, means.size - len(members)
    ratio = (total - inside) / between / max(inside / free, _TINY)
    return 1 - inside / max(total, _TINY), float(stats.f.sf(ratio, between, free))
