"""The log posterior density of many vectors at once, over coordinates without bounds."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bayesoleo.estimation.problem import Misfit, Problem
from bayesoleo.model.correlated import log_density_of
from bayesoleo.parallel import thread_map
from bayesoleo.posterior.likelihood import log_likelihood_by_run
from bayesoleo.posterior.transforms import Transforms
from bayesoleo.solvers.status import Status

Array = NDArray[np.float64]

#: Prefix of the names of the error variances' coordinates.
LOG_VARIANCE = "log_variance_"


class Density(Protocol):
    """What the sampler needs to know of a log density over ``d`` coordinates."""

    evaluations: int
    failures: Counter[str]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the ``d`` coordinates' quantities."""

    @property
    def runs(self) -> tuple[str, ...]:
        """Labels of the ``N`` parts of the log-likelihood."""

    def natural(self, phi: Array) -> Array:
        """Quantities in natural units, shape (W, d), from coordinates, shape (W, d)."""

    def __call__(self, phi: Array) -> tuple[Array, Array]:
        """Log density, shape (W,), and log-likelihood by run, shape (W, N)."""


class LogDensity:
    """Log posterior of ``phi = (theta in coordinates without bounds, ln v of each output)``.

    Parameters
    ----------
    problem : Problem
        What is fitted: ``l`` unknowns, ``N`` runs, ``s`` outputs.
    jobs : int, optional
        Threads over which the rows are spread. By default the problem's ``misfit`` is called once
        for all rows and spreads its own work. The result does not depend on it.

    Attributes
    ----------
    evaluations : int
        Rows evaluated so far.
    failures : collections.Counter
        Rows of density zero so far, by the lower-case name of their
        :class:`~bayesoleo.solvers.status.Status`.

    Notes
    -----
    The prior is uniform in ``ln v``. Each row's value depends on that row alone, bit for bit.

    References
    ----------
    Verbeek (1993), eq. 2.29.
    """

    def __init__(self, problem: Problem, jobs: int | None = None) -> None:
        self.problem, self.jobs = problem, jobs
        self.transforms = Transforms.of(problem.priors)
        self.evaluations = 0
        self.failures: Counter[str] = Counter()
        self._counts = np.asarray(problem.counts)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the ``l + s`` quantities: the problem's, then ``log_variance_<output>``."""
        return (*self.problem.names, *(LOG_VARIANCE + output for output in self.problem.outputs))

    @property
    def runs(self) -> tuple[str, ...]:
        """Labels of the ``N`` runs."""
        return self.problem.runs

    @property
    def dimension(self) -> int:
        """Number of coordinates, ``l + s``."""
        return len(self.names)

    def natural(self, phi: Array) -> Array:
        """Parameters in their units and ``ln v``, from coordinates, both of shape (W, l + s)."""
        phi = np.asarray(phi, dtype=float)
        unknowns = len(self.problem.names)
        theta = self.transforms.natural(phi[:, :unknowns])
        return np.concatenate([theta, phi[:, unknowns:]], axis=1)

    def coordinates(self, natural: Array) -> Array:
        """Coordinates of parameters in their units and ``ln v``, both of shape (W, l + s)."""
        natural = np.asarray(natural, dtype=float)
        unknowns = len(self.problem.names)
        u = self.transforms.unbounded(natural[:, :unknowns])
        return np.concatenate([u, natural[:, unknowns:]], axis=1)

    def __call__(self, phi: Array) -> tuple[Array, Array]:
        """Evaluate all rows.

        Parameters
        ----------
        phi : ndarray, shape (W, l + s)
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
        unknowns = len(self.problem.names)
        theta, log_variance = self.natural(phi)[:, :unknowns], phi[:, unknowns:]
        prior = self._log_prior(phi[:, :unknowns], theta)
        status = np.full(len(phi), int(Status.CONVERGED))
        status[~np.isfinite(prior)] = Status.OUT_OF_BOUNDS
        status[~np.all(np.isfinite(phi), axis=1)] = Status.NOT_FINITE

        by_run = np.full((len(phi), len(self._counts)), -np.inf)
        inside = np.flatnonzero(status == Status.CONVERGED)
        if inside.size:
            misfit = self._misfit(theta[inside])
            status[inside] = misfit.status
            # Infinite or overflowing terms are told apart below by their status.
            with np.errstate(over="ignore", invalid="ignore"):
                by_run[inside] = log_likelihood_by_run(
                    misfit.sum_of_squares, self._counts, log_variance[inside]
                )
        total = prior.copy()
        with np.errstate(invalid="ignore"):
            for run in by_run.T:
                total += run
        return self._mark_failures(total, by_run, status)

    def _log_prior(self, u: Array, theta: Array) -> Array:
        with np.errstate(invalid="ignore"):
            return self.transforms.log_jacobian(u) + log_density_of(self.problem.priors, theta)

    def _misfit(self, theta: Array) -> Misfit:
        if self.jobs is None or self.jobs <= 1 or len(theta) < 2:
            return self.problem.misfit(theta)
        chunks = np.array_split(theta, min(self.jobs, len(theta)))
        parts = thread_map(self.problem.misfit, chunks, self.jobs)
        return Misfit(
            np.concatenate([part.sum_of_squares for part in parts]),
            np.concatenate([part.status for part in parts]),
        )

    def _mark_failures(
        self, total: Array, by_run: Array, status: NDArray[np.int64]
    ) -> tuple[Array, Array]:
        status[(status == Status.CONVERGED) & ~np.isfinite(total)] = Status.NOT_FINITE
        failed = status != Status.CONVERGED
        total[failed], by_run[failed] = -np.inf, -np.inf
        self.evaluations += len(total)
        self.failures.update(Status(value).name.lower() for value in status[failed])
        return total, by_run
