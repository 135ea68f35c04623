"""How far the objective falls from an estimate: the function that regions and profiles cut.

The error variances follow the parameters, ``v_b = M_bb / n_b``, so that a fall of the objective is
one of the profile over ``v`` (Verbeek 1993, eq. 3.17 in 2.29).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models.independent import output_counts, staged_variance
from bayesoleo.errors import InputError
from bayesoleo.estimation.estimators.estimate import estimate
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.estimation.objectives.objective import log_prior
from bayesoleo.estimation.problems.held import Held
from bayesoleo.estimation.problems.problem import Problem, measured_of

Kind = Literal["likelihood", "posterior"]


class LogLikelihoodRatio:
    """Fall of the objective from an estimate, positive away from it.

    Parameters
    ----------
    problem : Problem
    point : PointEstimate
        An optimum of the objective.
    kind : {"likelihood", "posterior"}
        Whether the prior counts. By default it does where the point is the Bayesian estimator's.
    """

    def __init__(self, problem: Problem, point: PointEstimate, kind: Kind | None = None) -> None:
        self.problem, self.point = problem, point
        self.kind: Kind = kind or ("posterior" if point.method == "be" else "likelihood")
        if self.kind not in ("likelihood", "posterior"):
            raise InputError(
                "unknown kind", key="kind", value=kind, hint="use 'likelihood' or 'posterior'"
            )
        measured = measured_of(problem)
        if self.kind == "likelihood" and measured.any():
            known = [
                name for name, is_known in zip(problem.names, measured, strict=True) if is_known
            ]
            raise InputError(
                f"the likelihood forgets what is known of {', '.join(known)}", key="kind",
                value=self.kind, hint="use kind='posterior' with an estimate by 'be'",
            )  # fmt: skip
        if tuple(point.names) != tuple(problem.names):
            raise InputError("the estimate is of another problem", value=point.names)
        self.counts = output_counts(problem.counts)
        freeze = getattr(problem, "freeze", None)
        if freeze is not None:
            freeze(point.theta)
        self.top = float(self._height(point.theta[None])[0])
        if not np.isfinite(self.top):
            raise InputError(
                "cannot be evaluated at the estimate", value=point.theta.tolist(),
                hint="give an estimate that converged",
            )  # fmt: skip

    def _height(self, theta: Array) -> Array:
        """Objective with its own variances at vectors (L, l); minus infinity where it fails."""
        sums = self.problem.misfit(theta).sum_of_squares.sum(axis=1)
        height = np.full(len(theta), -np.inf)
        for row in np.flatnonzero(np.isfinite(sums).all(axis=1)):
            variance = staged_variance(sums[row], self.counts)
            height[row] = -0.5 * float(np.sum(self.counts * np.log(variance)))
            if self.kind == "posterior":
                height[row] += log_prior(self.problem.priors, theta[row])
        return height

    def __call__(self, theta: Array) -> Array:
        """Fall at vectors (L, l), shape (L,); infinite outside the support or where it fails."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        inside = np.array([self._supported(row) for row in theta])
        fall = np.full(len(theta), np.inf)
        if inside.any():
            fall[inside] = self.top - self._height(theta[inside])
        return fall

    def _supported(self, theta: Array) -> bool:
        limits = [prior.support for prior in self.problem.priors]
        return all(low <= t <= high for t, (low, high) in zip(theta, limits, strict=True))

    def profiled(self, theta: Array, held: Sequence[int]) -> tuple[float, Array]:
        """Least fall with some unknowns held, and where it is, shape (l,).

        Parameters
        ----------
        theta : ndarray, shape (l,)
            The held values, and where the others start.
        held : sequence of int
            Which are held.
        """
        theta = np.array(theta, dtype=float)
        if not self._supported(theta):
            return np.inf, theta
        if len(held) == len(theta):
            return float(self._fresh(theta)), theta
        section = Held(self.problem, theta, held)
        method = "be" if self.kind == "posterior" else "mbe"
        found = estimate(section, method, tolerance=1e-5)
        if not found.status.ok:  # the start was foreseen badly; the estimate itself is another
            again = estimate(section, method, tolerance=1e-5, start=self.point.theta[section.free])
            # A loop that stopped short is still a point of the section: it bounds the least fall.
            objectives = np.nan_to_num([found.objective, again.objective], nan=-np.inf)
            found = again if objectives[1] > objectives[0] or again.status.ok else found
        whole = section.full(found.theta)
        if not np.isfinite(found.objective):
            return np.inf, theta
        return float(self._fresh(whole)), whole

    def _fresh(self, theta: Array) -> float:
        """Fall at one vector, solved from where the solver stands."""
        evaluation = self.problem.evaluate(theta)
        if not evaluation.status.ok:
            return np.inf
        sums = np.array([float(e @ e) for e in evaluation.residual])
        height = -0.5 * float(np.sum(self.counts * np.log(staged_variance(sums, self.counts))))
        if self.kind == "posterior":
            height += log_prior(self.problem.priors, theta)
        return self.top - height
