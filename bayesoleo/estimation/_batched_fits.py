"""Fits of one problem to many data sets at once: simulated experiments or bootstrap samples.

Well-behaved data sets are iterated together, with one batch of linear algebra for each iteration
and full steps only. A data set leaves the batch when a step does not reduce its objective, when it
reaches a bound of the support, when a solve fails, or when its equations are nearly singular. It is
then fitted alone and from its start by :func:`~bayesoleo.estimation.estimate`. Both ways end at the
same point, and only difficult data sets cost more.

References
----------
Verbeek (1993), eqs. 2.18-2.20 (use of replications) and 3.17-3.23 (the steps).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo._parallel import single_blas_thread, thread_map
from bayesoleo._types import Array, Bool, Flags, Float, Int, Integers
from bayesoleo.error_models._independent import output_counts, staged_variance
from bayesoleo.errors import InputError
from bayesoleo.estimation._bayesian_estimators import Step, method as find_method
from bayesoleo.estimation._estimate import checked_start, estimate
from bayesoleo.estimation._least_squares import BatchNormalEquations, BatchProblem, PriorScale
from bayesoleo.estimation._nuisance import without_measured
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import measured_of
from bayesoleo.solvers._orbit import Status

# Largest condition number of scaled normal equations that are solved as such; the rest goes to the
# estimator that factorises the sensitivities instead.
_LARGEST_CONDITION = 1e10
# Part of the distance to a bound that one step may take.
_PART = 0.9
# Rounding of the merit function, by sample: a step that is worse by less is not worse.
_ROUNDING = 1e-13


@dataclass
class Lanes:
    """Where each data set of one batch stands; filled in place."""

    theta: Array
    variance: Array
    covariance: Array
    status: Integers
    iterations: Integers
    done: Flags

    def keep(self, lane: int, point: PointEstimate) -> None:
        """Take over the result of the estimator for single data sets."""
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
        """Objective with ``v`` held, up to terms that do not depend on theta, shape (L,)."""
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
    ) -> tuple[Array, Flags, Flags]:
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
        where: Integers,
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


def _rows_of(equations: BatchNormalEquations, which: Flags) -> BatchNormalEquations:
    return BatchNormalEquations(
        equations.gram[which],
        equations.slope[which],
        equations.sums[which],
        equations.status[which],
    )


def _only(
    which: Flags,
    alive: Integers,
    theta: Array,
    equations: BatchNormalEquations,
) -> tuple[Integers, Array, BatchNormalEquations]:
    return alive[which], theta[which], _rows_of(equations, which)


@dataclass(frozen=True, eq=False)
class Replications:
    """Estimates from ``R`` data sets.

    Parameters
    ----------
    names : tuple of str, length l
    outputs : tuple of str, length s
    theta : ndarray, shape (R, l)
        Estimates; where the status is not ``CONVERGED``, the best point that was reached.
    variance : ndarray, shape (R, s)
        Error variances staged there.
    covariance : ndarray, shape (R, l, l)
        Linearised, with the prior's precision where the method is BE, without it elsewhere.
    status : ndarray of int, shape (R,)
        Values of :class:`~bayesoleo.solvers.Status`.
    iterations : ndarray of int, shape (R,)
    together : ndarray of bool, shape (R,)
        Which ones never left the batch.
    method : str
    """

    names: tuple[str, ...]
    outputs: tuple[str, ...]
    theta: Float[Array, "replications unknowns"]
    variance: Float[Array, "replications outputs"]
    covariance: Float[Array, "replications unknowns unknowns"]
    status: Int[Integers, " replications"]
    iterations: Int[Integers, " replications"]
    together: Bool[Flags, " replications"]
    method: str

    def __len__(self) -> int:
        return len(self.theta)

    @property
    def ok(self) -> Flags:
        """Which estimates converged, shape (R,)."""
        return cast(Flags, self.status == Status.CONVERGED)

    @property
    def sd(self) -> Array:
        """Linearised standard deviations, shape (R, l)."""
        return cast(Array, np.sqrt(np.einsum("rkk->rk", self.covariance)))

    def __getitem__(self, name: str) -> Array:
        """Estimates of one unknown, shape (R,)."""
        return self.theta[:, self.names.index(name)]


def estimate_many(
    problem: BatchProblem,
    data_sets: ArrayLike | Sequence[ArrayLike],
    method: str | Step[Any] = "mbe",
    *,
    start: ArrayLike | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
    bias_corrected: bool = False,
    jobs: int | None = 1,
    progress: Callable[[int], None] | None = None,
) -> Replications:
    """Estimate the unknowns of a problem from each of many data sets.

    Parameters
    ----------
    problem : BatchProblem
        What is fitted; its own data are not used.
    data_sets : array_like, shape (R, n), or sequence over outputs of array_like, each (R, n_b)
        Measured samples, runs one after the other.
    method, tolerance, max_iterations, bias_corrected
        As in :func:`~bayesoleo.estimation.estimate`. BE, MBE and Gauss-Newton are computed
        together, the others one by one. What was measured beside the data is held by those that
        forget priors.
    start : array_like, shape (l,) or (R, l), optional
        One for all or one each; by default the problem's own.
    jobs : int, optional
        Threads over data sets; None for all cores. The default leaves the threads to the problem.
    progress : callable, optional
        Called with the number of data sets of each batch that is done.

    Returns
    -------
    Replications
        The same whatever ``jobs`` is. A failure is a status.

    Raises
    ------
    InputError
        If the data or the start do not fit the problem.
    """
    step = find_method(method)
    data = _checked_data(problem, data_sets)
    scale = PriorScale.of(problem.priors, problem.names)
    starts = _checked_starts(problem, scale, start, len(data[0]))
    measured = measured_of(problem)
    if (
        measured.any()
        and not step.fixed_prior
        and (starts[:, measured] == starts[0, measured]).all()
    ):
        section = without_measured(problem, starts[0], measured)
        if isinstance(section, BatchProblem):
            found = estimate_many(
                section,
                data,
                step,
                start=starts[:, ~measured],
                tolerance=tolerance,
                max_iterations=max_iterations,
                bias_corrected=bias_corrected,
                jobs=jobs,
                progress=progress,
            )
            return _with_measured(found, problem.names, starts, measured)
    walk = BatchedFit(problem, step, scale, tolerance, max_iterations, bias_corrected)
    together = step.steady and (step.fixed_prior or not measured.any())
    size = problem.lanes
    cuts = [slice(k, min(k + size, len(starts))) for k in range(0, len(starts), size)]

    def work(cut: slice) -> Lanes:
        rows = [column[cut] for column in data]
        lanes = walk.together(starts[cut], rows) if together else walk.nothing(starts[cut])
        for lane in map(int, np.flatnonzero(~lanes.done)):
            lanes.keep(lane, walk.alone(starts[cut][lane], [row[lane] for row in rows]))
        if progress is not None:
            progress(len(lanes.theta))
        return lanes

    with single_blas_thread():
        parts = thread_map(work, cuts, jobs)
    return Replications(
        names=tuple(problem.names),
        outputs=tuple(problem.outputs),
        theta=np.concatenate([part.theta for part in parts]),
        variance=np.concatenate([part.variance for part in parts]),
        covariance=np.concatenate([part.covariance for part in parts]),
        status=np.concatenate([part.status for part in parts]),
        iterations=np.concatenate([part.iterations for part in parts]),
        together=np.concatenate([part.done for part in parts]),
        method=step.name,
    )


def _with_measured(
    found: Replications, names: tuple[str, ...], starts: Array, measured: Flags
) -> Replications:
    """The same in all unknowns: those that were held are where they started, and have no scatter of
    their own."""
    theta, own = starts.copy(), np.flatnonzero(~measured)
    theta[:, own] = found.theta
    covariance = np.full((len(theta), len(names), len(names)), np.nan)
    covariance[:, own[:, None], own] = found.covariance
    return replace(found, names=tuple(names), theta=theta, covariance=covariance)


def _checked_data(problem: BatchProblem, data_sets: ArrayLike | Sequence[ArrayLike]) -> list[Array]:
    sizes = [column.size for column in problem.data]
    one = len(sizes) == 1 and np.ndim(data_sets[0]) == 1  # type: ignore[index]
    columns = [np.asarray(column) for column in ([data_sets] if one else data_sets)]  # type: ignore[union-attr]
    shapes = [column.shape for column in columns]
    fits = [
        len(shape) == 2 and shape[1] == size for shape, size in zip(shapes, sizes, strict=False)
    ]
    if len(columns) != len(sizes) or not all(fits) or len({shape[0] for shape in shapes}) > 1:
        wanted = ", ".join(f"(R, {size})" for size in sizes)
        raise InputError(
            "data sets do not fit the problem",
            key="data_sets",
            value=shapes,
            hint=f"give one array for each output, of shape {wanted}",
        )
    if not all(np.isfinite(column).all() for column in columns):
        raise InputError("data sets must be finite", key="data_sets")
    return columns


def _checked_starts(
    problem: BatchProblem, scale: PriorScale, start: ArrayLike | None, count: int
) -> Array:
    begin = np.asarray(problem.start if start is None else start, dtype=float)
    if begin.ndim == 2 and len(begin) == count:
        return np.stack([checked_start(problem.names, scale, row) for row in begin])
    return np.repeat(checked_start(problem.names, scale, begin)[None], count, axis=0)
