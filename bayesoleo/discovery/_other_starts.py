"""Starts of an estimate, and which of them leads nearest to the data.

The equations of several resonances or contacts have several solutions, and the nominal values may
lie next to a wrong one. A wrong solution usually lies at a limit of a prior's support, or where the
priors have almost no mass. Only then is the time for other starts well spent.
"""

from __future__ import annotations

from typing import cast

import numpy as np

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._estimate import estimate, polish
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.solvers._orbit import Status

#: Starts of one estimate, each farther from the present one, that are worse than the best before
#: the others are not looked at.
GIVEN_UP = 2


def doubtful(problem: CampaignProblem, point: PointEstimate, policy: SearchPolicy) -> bool:
    """Whether an estimate stands where its priors hardly allow it, or did not converge."""
    if point.on_limit or not point.status.ok:
        return True
    scale = PriorScale.of(problem.priors, problem.names)
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.where(
            scale.logarithmic, np.log(point.theta / scale.mean), point.theta - scale.mean
        )
    return bool(
        np.any(np.abs(away / scale.spread) > distributions.norm.isf(policy.doubtful_prior / 2))
    )


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
    cost = _cost(problem, draws)
    order = np.argsort(cost)[: policy.prior_starts]
    return [draws[k] for k in order if np.isfinite(cost[k])]


def likeliest(problem: CampaignProblem, starts: Array) -> Array:
    """Of starts ``(m, l)`` the one that makes the data most likely; the first where that cannot be
    told.

    They lead from far away to the last, where the motion is known. Those beyond a few that are
    worse than the best so far are not looked at: a motion far from what it is solved from takes ten
    times as long, and the farther the less likely it is.
    """
    if problem.freeze(starts[-1]) is not Status.CONVERGED:
        return cast(Array, starts[0])
    best, least, worse = 0, np.inf, 0
    for k in reversed(range(len(starts))):
        (cost,) = _cost(problem, starts[k : k + 1])
        if cost < least:
            best, least, worse = k, float(cost), 0
        else:
            worse += int(np.isfinite(least))
        if worse == GIVEN_UP:
            break
    return cast(Array, starts[best])


def _cost(problem: CampaignProblem, vectors: Array) -> Array:
    """Twice the negative logarithm of the likelihood, variances eliminated, of vectors ``(L, l)``;
    infinite for those that could not be solved.

    They lie far apart: a motion of another branch is as good as any, and no jump of the estimate.
    """
    with problem.unwatched():
        sums = problem.misfit(vectors).sum_of_squares.sum(axis=1)
    counts = problem.counts.sum(axis=0)
    cost = np.sum(counts * np.log(np.maximum(sums, 1e-300)), axis=1)
    return np.where(np.isfinite(cost), cost, np.inf)
