"""An estimate that ended where nobody expected it is looked for again from other starts.

The equations of several resonances or contacts have several answers, and the nominal values may lie
next to a wrong one. Such an answer gives itself away: it stands on a limit of a prior's support, or
where the priors have next to no mass. Only then are other starts worth their time.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from bayesoleo._types import Array
from bayesoleo.estimation import PointEstimate, estimate, polish
from bayesoleo.estimation.problems.campaign_problem import CampaignProblem
from bayesoleo.estimation.problems.scaling import PriorScale
from bayesoleo.tracing.policy import SearchPolicy


def doubtful(problem: CampaignProblem, point: PointEstimate, policy: SearchPolicy) -> bool:
    """Whether an estimate stands where its priors hardly allow it, or did not converge."""
    if point.on_limit or not point.status.ok:
        return True
    scale = PriorScale.of(problem.priors, problem.names)
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.where(
            scale.logarithmic, np.log(point.theta / scale.mean), point.theta - scale.mean
        )
    return bool(np.any(np.abs(away / scale.spread) > stats.norm.isf(policy.doubtful_prior / 2)))


def from_other_starts(
    problem: CampaignProblem,
    mbe: PointEstimate,
    point: PointEstimate,
    *,
    tolerance: float,
    max_iterations: int,
    resolution: float,
    policy: SearchPolicy,
) -> tuple[PointEstimate, PointEstimate]:
    """The best of an estimate and those from starts drawn from the priors.

    The search ends with the first answer that is better and that the priors allow.

    Parameters
    ----------
    problem : CampaignProblem
    mbe, point : PointEstimate
        MBE's estimate from the declared start, and the mode reached from it.
    tolerance, max_iterations, resolution
        As in :func:`~bayesoleo.estimation.estimate`.
    policy : SearchPolicy

    Returns
    -------
    mbe, point : PointEstimate
        Those that were given, where no other start leads to a mode that is clearly more likely.
    """
    options = {"tolerance": tolerance, "max_iterations": max_iterations, "resolution": resolution}
    least = policy.better_optimum
    for start in promising(problem, problem.start, policy):
        first = estimate(problem, "mbe", start=start, **options)  # type: ignore[arg-type]
        if not first.status.ok:
            continue
        found = polish(problem, first, **options)  # type: ignore[arg-type]
        if found.status.ok and (not point.status.ok or found.objective > point.objective + least):
            mbe, point = first, found
            if not doubtful(problem, point, policy):
                break
    return mbe, point


def promising(problem: CampaignProblem, theta: Array, policy: SearchPolicy) -> list[Array]:
    """The most likely of many draws from the priors.

    Parameters
    ----------
    problem : CampaignProblem
        Its solver starts from where it stands.
    theta : ndarray, shape (l,)
        Where unknowns of single runs stay.
    policy : SearchPolicy
        How many are drawn and kept.

    Returns
    -------
    list of ndarray, shape (l,)
        Those that could not be solved are left out.
    """
    rng, shared = np.random.default_rng(0), problem.predictor.model.parameters
    draws = np.repeat(np.asarray(theta, dtype=float)[None], policy.prior_draws, axis=0)
    for k, (name, prior) in enumerate(zip(problem.names, problem.priors, strict=True)):
        if name in shared:
            draws[:, k] = prior.sample(rng, policy.prior_draws)
    sums = problem.misfit(draws).sum_of_squares.sum(axis=1)
    counts = problem.counts.sum(axis=0)
    cost = np.sum(counts * np.log(np.maximum(sums, 1e-300)), axis=1)
    order = np.argsort(np.where(np.isfinite(cost), cost, np.inf))[: policy.prior_starts]
    return [draws[k] for k in order if np.isfinite(cost[k])]
