"""Fit one problem to many data sets: replications of a simulated experiment, or bootstrap samples.

Well-behaved data sets walk together, one batch of linear algebra an iteration. One that needs more
than full steps - a step that does not help, a limit of the support, a solve that fails, equations
near singularity - is handed to :func:`~bayesoleo.estimation.estimate`, alone and from the start.
So both ways end at the same point, and only the hard cases pay for care.

References
----------
Verbeek (1993), eqs. 2.18-2.20 (what replications are for) and 3.17-3.23 (the steps).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesoleo._types import Array, Bool, Flags, Float, Int, Integers
from bayesoleo.errors import InputError
from bayesoleo.estimation.estimators.estimate import checked_start
from bayesoleo.estimation.estimators.known import without_measured
from bayesoleo.estimation.estimators.methods import method as find_method
from bayesoleo.estimation.estimators.steps import Step
from bayesoleo.estimation.problems.batch import BatchProblem
from bayesoleo.estimation.problems.problem import measured_of
from bayesoleo.estimation.problems.scaling import PriorScale
from bayesoleo.estimation.uncertainty.walk_together import BatchedFit, Lanes
from bayesoleo.parallel import single_blas_thread, thread_map
from bayesoleo.solvers.status import Status


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
        Values of :class:`~bayesoleo.solvers.status.Status`.
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
    def ok(self) -> NDArray[np.bool_]:
        """Which estimates converged, shape (R,)."""
        return cast(NDArray[np.bool_], self.status == Status.CONVERGED)

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
    found: Replications, names: tuple[str, ...], starts: Array, measured: NDArray[np.bool_]
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
