"""Log posterior density of many parameter vectors at once, over unbounded coordinates.

The unknowns of a problem are unbounded coordinates, in which their prior is written too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from contextlib import AbstractContextManager
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, cast

import numpy as np

from bayesoleo import _schema as schema
from bayesoleo._parallel import available_cores, shared_size, thread_map
from bayesoleo._types import Array, Float, Integers
from bayesoleo.error_models._base import ErrorModel
from bayesoleo.error_models._registry import error_model
from bayesoleo.errors import InputError
from bayesoleo.estimation._problem import (
    EstimationProblem,
    Misfit,
    ResidualProblem,
    for_thread,
    jumps_of,
    unwatched,
)
from bayesoleo.model._correlated_priors import log_density_of, sample_of
from bayesoleo.model._priors import Prior, Transforms
from bayesoleo.posterior._same_unknowns import Block, SameUnknowns
from bayesoleo.solvers._orbit import Status, first_failure

#: Finite-difference step in prior standard deviations.
STEP = 0.25


class Unknowns(ABC):
    """Map of ``p`` coordinates to the ``l`` unknowns of a problem, with their prior."""

    #: Parameters that scatter between runs.
    scattering: tuple[str, ...] = ()

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the ``p`` quantities, the problem's first."""

    @abstractmethod
    def theta(self, block: Float[Array, "walkers coordinates"]) -> Float[Array, "walkers unknowns"]:
        """Unknowns of the problem in their units, shape (W, l), from coordinates (W, p)."""

    @abstractmethod
    def natural(
        self, block: Float[Array, "walkers coordinates"]
    ) -> Float[Array, "walkers coordinates"]:
        """All quantities in their units from coordinates, both of shape (W, p)."""

    @abstractmethod
    def coordinates(
        self, natural: Float[Array, "walkers coordinates"]
    ) -> Float[Array, "walkers coordinates"]:
        """Coordinates of quantities in their units, both of shape (W, p)."""

    @abstractmethod
    def log_prior(self, block: Float[Array, "walkers coordinates"]) -> Float[Array, " walkers"]:
        """Log prior density of the coordinates, Jacobian included, shape (W,)."""

    @abstractmethod
    def natural_log_prior(
        self, natural: Float[Array, "walkers coordinates"]
    ) -> dict[str, Float[Array, " walkers"]]:
        """Log prior density of each quantity, shape (W,), over quantities in their units (W, p)."""

    @abstractmethod
    def sample_prior(self, rng: np.random.Generator, size: int) -> Float[Array, "size coordinates"]:
        """Draws of the quantities, shape (size, p)."""

    @abstractmethod
    def start(self, theta: Float[Array, " unknowns"]) -> Float[Array, " coordinates"]:
        """Coordinates, shape (p,), of a parameter vector, shape (l,)."""

    @abstractmethod
    def jacobian(self, block: Float[Array, " coordinates"]) -> Float[Array, "unknowns coordinates"]:
        """Derivatives of the unknowns with respect to the coordinates at (p,), shape (l, p)."""

    @abstractmethod
    def precision(
        self, block: Float[Array, " coordinates"]
    ) -> Float[Array, "coordinates coordinates"]:
        """Rough curvature of the log prior over the coordinates at (p,): (p, p), positive."""


@dataclass(frozen=True)
class PlainUnknowns(Unknowns):
    """Each unknown is a coordinate of its own.

    Parameters
    ----------
    labels : tuple of str, length l
    priors : tuple of Prior, length l
    """

    labels: tuple[str, ...]
    priors: tuple[Prior, ...]

    @cached_property
    def transforms(self) -> Transforms:
        """From coordinates to units."""
        return Transforms.of(self.priors)

    @property
    def names(self) -> tuple[str, ...]:
        return self.labels

    def theta(self, block: Array) -> Array:
        return self.transforms.natural(block)

    def natural(self, block: Array) -> Array:
        return self.transforms.natural(block)

    def coordinates(self, natural: Array) -> Array:
        return self.transforms.unbounded(natural)

    def log_prior(self, block: Array) -> Array:
        with np.errstate(invalid="ignore"):
            theta = self.transforms.natural(block)
            return self.transforms.log_jacobian(block) + log_density_of(self.priors, theta)

    def natural_log_prior(self, natural: Array) -> dict[str, Array]:
        columns = zip(self.labels, self.priors, natural.T, strict=True)
        return {name: prior.log_density(column) for name, prior, column in columns}

    def sample_prior(self, rng: np.random.Generator, size: int) -> Array:
        return sample_of(self.priors, rng, size)

    def start(self, theta: Array) -> Array:
        return cast(Array, self.transforms.unbounded(np.asarray(theta, dtype=float)[None])[0])

    def jacobian(self, block: Array) -> Array:
        return np.diag(self.transforms.derivative(block[None])[0])

    def precision(self, block: Array) -> Array:
        return np.diag(prior_curvature(self.priors, self.transforms, block))


def prior_curvature(priors: Sequence[Prior], transforms: Transforms, u: Array) -> Array:
    """Negative second derivatives of log prior plus log Jacobian, one for each coordinate."""
    precision = np.empty(len(u))
    for a, (prior, transform) in enumerate(zip(priors, transforms.each, strict=True)):
        step = STEP * prior.sd / abs(float(transform.derivative(u[a : a + 1])[0]))
        # A quarter of the prior's width in u; at most 1/4 where u is a logarithm, whose unit is a
        # factor e.
        step = step if transform.low == -np.inf and transform.high == np.inf else min(step, STEP)
        points = u[a] + step * np.array([-1.0, 0.0, 1.0])
        values = prior.log_density(transform.natural(points)) + transform.log_jacobian(points)
        curvature = -(values[0] - 2 * values[1] + values[2]) / step**2
        floor = 1e-3 / step**2  # flat or convex: wide, but not improper
        precision[a] = max(curvature, floor) if np.isfinite(curvature) else floor
    return precision


#: Prefix of the coordinate names of error variances.
LOG_VARIANCE = schema.log_variance("")
#: Parameter vectors whose residuals are held at once, so that they stay in the cache.
LANES = 8


def residuals_at(problem: EstimationProblem, errors: ErrorModel, theta: Array) -> list[Array]:
    """Residuals (s, n) of every run; equivalent columns where sums of squares suffice.

    Raises
    ------
    InputError
        If they cannot be computed.
    """
    parts, status = [], Status.CONVERGED
    theta = errors.moved(theta[None])[0]
    if errors.by_sums:
        misfit = problem.misfit(theta[None])
        status = Status(int(misfit.status[0]))
        if status.ok:
            counts = np.asarray(problem.counts)
            sizes = np.sqrt(misfit.sum_of_squares[0] / counts)
            for row, n in zip(sizes, counts, strict=True):
                parts.append(np.repeat(row[:, None], n[0], axis=1))
    else:
        for run in range(len(problem.runs)):
            residual, found = cast(ResidualProblem, problem).residuals(theta[None], run)
            status = max(status, Status(int(found[0])))
            parts.append(residual[0])
    if not status.ok:
        raise InputError(f"a start cannot be evaluated: {status.message}", value=theta.tolist())
    return parts


def information_at(
    problem: EstimationProblem, errors: ErrorModel, theta: Array, eta: Array
) -> Array:
    """``sum J' V^-1 J`` over runs and outputs, shape (l, l); zero where it cannot be computed.

    Parameters
    ----------
    problem : EstimationProblem
        Its ``evaluate`` is called once.
    errors : ErrorModel
        Gives ``V``.
    theta : ndarray, shape (l,)
        Unknowns in their units.
    eta : ndarray, shape (m,)
        Coordinates of the error model.

    References
    ----------
    Verbeek (1993), eq. 3.19: ``A``.
    """
    evaluation = problem.evaluate(errors.moved(theta[None])[0])
    if not evaluation.status.ok:
        return np.zeros((len(theta), len(theta)))
    counts = np.asarray(problem.counts)
    ends = np.cumsum(counts, axis=0)
    by_run = [
        [j[a:b].T for j, a, b in zip(evaluation.sensitivity, first, last, strict=True)]
        for first, last in zip(ends - counts, ends, strict=True)
    ]
    slope = errors.slope(theta)
    return slope.T @ errors.products_of_all(by_run, eta) @ slope


class Density(Protocol):
    """Interface of a log density over ``d`` coordinates, as the sampler uses it."""

    evaluations: int
    failures: Counter[str]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the ``d`` coordinates' quantities."""

    @property
    def runs(self) -> tuple[str, ...]:
        """Labels of the ``N`` parts of the log-likelihood."""

    def natural(
        self, phi: Float[Array, "walkers quantities"]
    ) -> Float[Array, "walkers quantities"]:
        """Quantities in natural units, shape (W, d), from coordinates, shape (W, d)."""

    def __call__(
        self, phi: Float[Array, "walkers quantities"]
    ) -> tuple[Float[Array, " walkers"], Float[Array, "walkers runs"]]:
        """Log density, shape (W,), and log-likelihood by run, shape (W, N)."""


class LogDensity:
    """Log posterior of ``phi = (unknowns in coordinates without bounds, those of the errors)``.

    Parameters
    ----------
    problem : EstimationProblem
        Problem with ``l`` unknowns, ``N`` runs and ``s`` outputs.
    jobs : int, optional
        Threads over which the rows are distributed. By default the problem's ``misfit`` is called
        once for all rows and distributes its own work. The result does not depend on it.
    errors : ErrorModel or str, optional
        Error model with ``m`` quantities; see
        :mod:`bayesoleo.error_models`. By default one variance for each output.
    unknowns : Unknowns, optional
        Map from ``p`` coordinates to the problem's unknowns, and their prior; by default one
        coordinate for each unknown, with the problem's prior. See
        :func:`bayesoleo.posterior.hierarchical`.

    Attributes
    ----------
    evaluations : int
        Rows evaluated so far.
    failures : collections.Counter
        Rows of density zero so far, by the lower-case name of their
        :class:`~bayesoleo.solvers.Status`.
    reason : str
        Why this error model was chosen; empty where nobody said.

    Raises
    ------
    InputError
        If the error model does not suit the problem, or two quantities have one name.

    Notes
    -----
    Each row's value depends on that row alone, bit for bit.

    References
    ----------
    Verbeek (1993), eq. 2.29.
    """

    def __init__(
        self,
        problem: EstimationProblem,
        jobs: int | None = None,
        *,
        errors: ErrorModel | str = "independent",
        unknowns: Unknowns | None = None,
    ) -> None:
        self.problem, self.jobs = problem, jobs
        self.errors = error_model(errors, problem) if isinstance(errors, str) else errors
        self.unknowns = unknowns or PlainUnknowns(tuple(problem.names), tuple(problem.priors))
        self.transforms = Transforms.of(problem.priors)
        self.evaluations = 0
        self.failures: Counter[str] = Counter()
        self.reason = ""
        self._size = len(self.unknowns.names)
        for name in self.unknowns.names:
            if schema.of_errors(name) or name in self.errors.names:
                raise InputError(
                    "a parameter has the name of an error model's quantity",
                    key=name,
                    hint="give it another name in the model",
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the ``p + m`` quantities: the unknowns', then the error model's."""
        return (*self.unknowns.names, *self.errors.names)

    @property
    def runs(self) -> tuple[str, ...]:
        """Labels of the ``N`` runs."""
        return self.problem.runs

    @property
    def dimension(self) -> int:
        """Number of coordinates, ``p + m``."""
        return len(self.names)

    def split(self, phi: Array) -> tuple[Array, Array]:
        """Coordinates of the unknowns, (W, p), and of the errors, (W, m)."""
        return (
            np.ascontiguousarray(phi[:, : self._size]),
            np.ascontiguousarray(phi[:, self._size :]),
        )

    def for_thread(self) -> LogDensity:
        """A copy that may be evaluated beside others, in one thread, with counts of its own."""
        other = copy(self)
        other.problem, other.jobs = for_thread(self.problem), 1
        other.evaluations, other.failures = 0, Counter()
        return other

    @property
    def branch_jumps(self) -> int:
        """Number of solutions, by run, that left the branch from which they started."""
        return int(jumps_of(self.problem).sum())

    def unwatched(self) -> AbstractContextManager[None]:
        """Only compare solutions meanwhile; fewer vectors may have one."""
        return unwatched(self.problem)

    def natural(
        self, phi: Float[Array, "walkers quantities"]
    ) -> Float[Array, "walkers quantities"]:
        """All quantities in their units, from coordinates, both of shape (W, p + m)."""
        block, eta = self.split(np.asarray(phi, dtype=float))
        return np.concatenate([self.unknowns.natural(block), self.errors.natural(eta)], axis=1)

    def coordinates(
        self, natural: Float[Array, "walkers quantities"]
    ) -> Float[Array, "walkers quantities"]:
        """Coordinates of quantities in their units, both of shape (W, p + m)."""
        block, eta = self.split(np.asarray(natural, dtype=float))
        return np.concatenate(
            [self.unknowns.coordinates(block), self.errors.coordinates(eta)], axis=1
        )

    def __call__(
        self, phi: Float[Array, "walkers quantities"]
    ) -> tuple[Float[Array, " walkers"], Float[Array, "walkers runs"]]:
        """Evaluate all rows.

        Parameters
        ----------
        phi : ndarray, shape (W, p + m)
            Coordinates.

        Returns
        -------
        log_density : ndarray, shape (W,)
            Log-likelihood + log prior + log Jacobian; minus infinity where it cannot be evaluated,
            never NaN.
        by_run : ndarray, shape (W, N)
            Normalised log-likelihood of every run; minus infinity likewise.
        """
        phi = np.ascontiguousarray(phi, dtype=float)
        block, eta = self.split(phi)
        prior = self.log_prior(phi)
        status = np.full(len(phi), int(Status.CONVERGED))
        status[~np.isfinite(prior)] = Status.OUT_OF_BOUNDS
        status[~np.all(np.isfinite(phi), axis=1)] = Status.NOT_FINITE

        by_run = np.full((len(phi), len(self.runs)), -np.inf)
        inside = np.flatnonzero(status == Status.CONVERGED)
        if inside.size:
            theta = self.errors.moved(self.unknowns.theta(block[inside]))
            # Infinite or overflowing terms are identified below by their status.
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                likelihood = self._of_sums if self.errors.by_sums else self._of_residuals
                by_run[inside], status[inside] = likelihood(theta, eta[inside])
        total = prior.copy()
        with np.errstate(invalid="ignore"):
            for run in by_run.T:
                total += run
        return self._mark_failures(total, by_run, status)

    def dispersed(self, rng: np.random.Generator, count: int) -> Float[Array, "count coordinates"]:
        """Draws of the unknowns' prior as coordinates, shape (count, p)."""
        return self.unknowns.coordinates(self.unknowns.sample_prior(rng, count))

    def log_prior(self, phi: Float[Array, "walkers quantities"]) -> Float[Array, " walkers"]:
        """Log prior density of the coordinates, shape (W,), Jacobian included."""
        block, eta = self.split(phi)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            return self.unknowns.log_prior(block) + self.errors.log_prior(eta)

    def _of_sums(self, theta: Array, eta: Array) -> tuple[Array, Integers]:
        same = SameUnknowns.of(theta)
        misfit = self._misfit(same.theta)
        sums = misfit.sum_of_squares[same.of_row]
        return self.errors.of_sums(sums, eta), misfit.status[same.of_row]

    def _misfit(self, theta: Array) -> Misfit:
        if self.jobs is None or self.jobs <= 1 or len(theta) < 2:
            return self.problem.misfit(theta)
        chunks = np.array_split(theta, min(self.jobs, len(theta)))
        parts = thread_map(self.problem.misfit, chunks, self.jobs)
        return Misfit(
            np.concatenate([part.sum_of_squares for part in parts]),
            np.concatenate([part.status for part in parts]),
        )

    def _of_residuals(self, theta: Array, eta: Array) -> tuple[Array, Integers]:
        """Log-likelihood by run (W, N) and statuses (W,), in blocks of rows."""
        same, runs = SameUnknowns.of(theta), len(self.runs)
        by_run = np.full((len(theta), runs), np.nan)
        status = np.zeros((len(theta), runs), dtype=np.int64)

        def work(block: Block) -> None:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                self._of_block(block, same.theta, eta, by_run, status)

        size = shared_size(len(same.theta), LANES, self.jobs or available_cores())
        thread_map(work, same.blocks(size), self.jobs)
        return by_run, first_failure(status)

    def _of_block(
        self,
        block: Block,
        theta: Array,
        eta: Array,
        by_run: Array,
        status: Integers,
    ) -> None:
        """Write the log-likelihoods and statuses of a block; a row that has no solution of one run
        needs none of those after it."""
        problem, errors = cast(ResidualProblem, self.problem), self.errors
        found: list[Array] = []
        for run in range(len(self.runs)):
            residual, failed = problem.residuals(theta[block.lanes], run)
            if failed.any():
                status[block.rows, run] = failed[block.of_row]
                good = failed == Status.CONVERGED
                block, residual = block.only(good), residual[good]
                found = [part[good] for part in found]
            if not block.rows.size:
                return
            if errors.over_runs:
                found.append(residual)
            else:
                rows = block.rows
                by_run[rows, run] = errors.of_run(run, block.by_row(residual), eta[rows])
        if found:
            by_row = [block.by_row(part) for part in found]
            by_run[block.rows] = errors.of_runs(by_row, eta[block.rows])

    def _mark_failures(self, total: Array, by_run: Array, status: Integers) -> tuple[Array, Array]:
        status[(status == Status.CONVERGED) & ~np.isfinite(total)] = Status.NOT_FINITE
        failed = status != Status.CONVERGED
        total[failed], by_run[failed] = -np.inf, -np.inf
        self.evaluations += len(total)
        self.failures.update(Status(value).name.lower() for value in status[failed])
        return total, by_run
