"""Many data sets on their way to their estimates, one batch of linear algebra an iteration.

Full steps only: what needs more care is given up here, and left to the estimator for one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.error_models.independent import output_counts, staged_variance
from bayesoleo.estimation.estimators.estimate import estimate
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.estimation.estimators.steps import Step
from bayesoleo.estimation.problems.batch import BatchNormalEquations, BatchProblem
from bayesoleo.estimation.problems.scaling import PriorScale
from bayesoleo.solvers.status import Status

# Largest condition number of scaled normal equations that are solved as such; the rest goes to the
# estimator that factorises the sensitivities instead.
_LARGEST_CONDITION = 1e10
# Of the way to a limit, the part that a step may go here.
_PART = 0.9
# Rounding of the merit function, by sample: a step that is worse by less is not worse.
_ROUNDING = 1e-13


@dataclass
class Lanes:
    """Where each data set of one batch stands; filled in place."""

    theta: Array
    variance: Array
    covariance: Array
    status: NDArray[np.int64]
    iterations: NDArray[np.int64]
    done: NDArray[np.bool_]

    def keep(self, lane: int, point: PointEstimate) -> None:
        """Take over what the careful estimator found."""
        self.theta[lane], self.variance[lane] = point.theta, point.variance
        fixed = point.method == "be"
        self.covariance[lane] = point.covariance if fixed else point.covariance_likelihood
        self.status[lane], self.iterations[lane] = point.status, point.iterations


@dataclass(frozen=True)
class BatchedFit:
    """The iteration of one batch."""

    problem: BatchProblem
    step: Step[Any]
    scale: PriorScale
    tolerance: float
    max_iterations: int
    bias_corrected: bool

    def nothing(self, starts: Array) -> Lanes:
        """A batch in which nothing is done yet."""
        count, unknowns = starts.shape
        return Lanes(
            starts.copy(),
            np.full((count, len(self.problem.outputs)), np.nan),
            np.full((count, unknowns, unknowns), np.nan),
            np.full(count, int(Status.NO_CONVERGENCE)),
            np.zeros(count, dtype=np.int64),
            np.zeros(count, dtype=bool),
        )

    def alone(self, start: Array, data: Sequence[Array]) -> PointEstimate:
        """One data set by the estimator that halves, turns and factorises."""
        return estimate(
            self.problem.with_data(data),
            self.step,
            start=start,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            bias_corrected=self.bias_corrected,
        )

    def together(self, starts: Array, data: Sequence[Array]) -> Lanes:
        """Full steps for all data sets of a batch, until each has converged or is given up."""
        lanes, alive = self.nothing(starts), np.arange(len(starts))
        theta = starts
        equations = self.problem.normal_equations(theta, data)
        alive, theta, equations = _only(equations.status == 0, alive, theta, equations)
        for iteration in range(1, self.max_iterations + 1):
            if not alive.size:
                break
            variance = self._variance(equations.sums)
            proposal, usable, small = self._proposal(theta, equations, variance)
            moved = self.scale.moved(theta, proposal)
            rows = [column[alive] for column in data]
            ahead = self.problem.normal_equations(np.where(usable[:, None], moved, theta), rows)
            better = self._merit(moved, ahead.sums, variance) >= (
                self._merit(theta, equations.sums, variance) - self._allowance
            )
            good = usable & better & (ahead.status == 0)
            alive, theta, equations = _only(good, alive, moved, ahead)
            small = small[good]
            self._store(lanes, alive[small], theta[small], _rows_of(equations, small), iteration)
            alive, theta, equations = _only(~small, alive, theta, equations)
        return lanes

    @property
    def _allowance(self) -> float:
        return _ROUNDING * float(np.sum(self.problem.counts))

    def _variance(self, sums: Array) -> Array:
        counts = output_counts(self.problem.counts)
        unknowns = len(self.problem.names)
        return staged_variance(sums, counts, unknowns, bias_corrected=self.bias_corrected)

    def _merit(self, theta: Array, sums: Array, variance: Array) -> Array:
        """Objective with ``v`` held, up to what does not depend on theta, shape (L,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            merit = -0.5 * (sums / variance).sum(axis=1)
        if self.step.fixed_prior:
            merit = merit + self.scale.log_density(theta)
        return merit

    def _precision(self, theta: Array, equations: BatchNormalEquations, variance: Array) -> Array:
        """``A`` in scaled unknowns, shape (L, l, l)."""
        unit = self.scale.unit(theta)
        gram = np.einsum("lbjk,lb->ljk", equations.gram, 1 / variance)
        return cast(Array, gram * unit[:, :, None] * unit[:, None, :])

    def _proposal(
        self, theta: Array, equations: BatchNormalEquations, variance: Array
    ) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Scaled steps (L, l), which of them may be taken in full, and which are small."""
        scale, step = self.scale, self.step
        unit = scale.unit(theta)
        pull = scale.slope(theta) if step.fixed_prior else 0.0
        gradient = unit * np.einsum("lbk,lb->lk", equations.slope, 1 / variance) + pull
        precision = self._precision(theta, equations, variance)
        if step.weighted:
            precision = precision + scale.root.T @ scale.root
        sound = np.isfinite(precision).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1)
        precision[~sound] = np.eye(theta.shape[1])
        diagonal = np.sqrt(np.maximum(np.einsum("lkk->lk", precision), np.finfo(float).tiny))
        balanced = precision / diagonal[:, :, None] / diagonal[:, None, :]
        sound &= np.linalg.cond(balanced) <= _LARGEST_CONDITION
        balanced[~sound] = np.eye(theta.shape[1])
        inverse = np.linalg.inv(balanced) / diagonal[:, :, None] / diagonal[:, None, :]
        proposal = (inverse @ gradient[..., None])[..., 0]
        down, up = scale.room(theta)
        sound &= ((proposal >= -_PART * down) & (proposal <= _PART * up)).all(axis=1)
        sd = np.sqrt(np.einsum("lkk->lk", inverse))
        least = np.maximum(np.abs(theta), unit * sd)
        small = (np.abs(unit * proposal) <= self.tolerance * least).all(axis=1)
        return proposal, sound, small

    def _store(
        self,
        lanes: Lanes,
        where: NDArray[np.int64],
        theta: Array,
        equations: BatchNormalEquations,
        iteration: int,
    ) -> None:
        if not where.size:
            return
        variance = self._variance(equations.sums)
        precision = self._precision(theta, equations, variance)
        if self.step.fixed_prior:
            precision = precision + self.scale.root.T @ self.scale.root
        unit = self.scale.unit(theta)
        lanes.theta[where], lanes.variance[where] = theta, variance
        lanes.covariance[where] = _inverse(precision) * unit[:, :, None] * unit[:, None, :]
        lanes.status[where], lanes.iterations[where] = Status.CONVERGED, iteration
        lanes.done[where] = True


def _inverse(precision: Array) -> Array:
    """Inverses (L, l, l); NaN where singular."""
    try:
        return np.linalg.inv(precision)
    except np.linalg.LinAlgError:
        missing = np.full_like(precision[0], np.nan)
        return np.stack(
            [missing if np.linalg.cond(p) > 1e15 else np.linalg.inv(p) for p in precision]
        )


def _rows_of(equations: BatchNormalEquations, which: NDArray[np.bool_]) -> BatchNormalEquations:
    return BatchNormalEquations(
        equations.gram[which],
        equations.slope[which],
        equations.sums[which],
        equations.status[which],
    )


def _only(
    which: NDArray[np.bool_],
    alive: NDArray[np.int64],
    theta: Array,
    equations: BatchNormalEquations,
) -> tuple[NDArray[np.int64], Array, BatchNormalEquations]:
    return alive[which], theta[which], _rows_of(equations, which)
