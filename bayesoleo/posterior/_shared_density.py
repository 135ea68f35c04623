"""A log density whose rows are evaluated by other processes, or by workers of a cluster.

Each row depends on itself alone, so the draws are the same on one machine and on many, whatever the
number of ensembles or workers, and even if workers are lost. What the other processes load for it
is here: emcee, which they do not need, brings all of ``scipy.stats``.
"""

from __future__ import annotations

import time
from collections import Counter
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bayesoleo._parallel import WorkerPool, single_blas_thread
from bayesoleo._types import Array
from bayesoleo._worker_processes import StandingCall
from bayesoleo.error_models._base import ErrorModel
from bayesoleo.posterior._log_density import Density, LogDensity

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class _Rows:
    """Rows evaluated by a worker, with their results and counters."""

    log_density: Density

    def __call__(self, phi: Array) -> tuple[Array, Array, Counter[str], int]:
        before = Counter(self.log_density.failures)
        jumps = getattr(self.log_density, "branch_jumps", 0)
        values, by_run = self.log_density(phi)
        failures = Counter(self.log_density.failures) - before
        return values, by_run, failures, getattr(self.log_density, "branch_jumps", 0) - jumps


class DistributedDensity:
    """Log density that sends rows to workers and collects the results.

    Parameters
    ----------
    log_density : Density
        Sent once to each worker, with the anchors that it has.
    client : distributed.Client
        Connection to the workers.
    """

    def __init__(self, log_density: Density, client: Client) -> None:
        self.log_density = log_density
        self.evaluations, self.branch_jumps = log_density.evaluations, 0
        self.failures: Counter[str] = Counter(log_density.failures)
        self._crew = WorkerPool(client, _Rows(log_density), keep=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the ``d`` coordinates' quantities."""
        return self.log_density.names

    @property
    def runs(self) -> tuple[str, ...]:
        """Labels of the ``N`` parts of the log-likelihood."""
        return self.log_density.runs

    def natural(self, phi: Array) -> Array:
        """Quantities in natural units, shape (W, d), from coordinates, shape (W, d)."""
        return self.log_density.natural(phi)

    def __call__(self, phi: Array) -> tuple[Array, Array]:
        """Log density, shape (W,), and log-likelihood by run, shape (W, N)."""
        pieces = np.array_split(phi, min(self._crew.size, len(phi)))
        found = dict(self._crew.each(pieces))
        parts = [found[index] for index in range(len(pieces))]
        self.evaluations += len(phi)
        for _, _, failures, jumps in parts:
            self.failures.update(failures)
            self.branch_jumps += jumps
        return (
            np.concatenate([part[0] for part in parts]),
            np.concatenate([part[1] for part in parts]),
        )


class SharedDensity:
    """Log density whose rows this process and others of this machine evaluate.

    Where a density spends its time in Python, threads wait for each other. Each row depends on
    itself alone, so the draws are the same.

    Parameters
    ----------
    log_density : LogDensity
        Sent once to each process, with the anchors that it has, when it has taken so long here
        that this seems worth it.
    """

    def __init__(self, log_density: LogDensity) -> None:
        self.log_density, self._took, self._elsewhere = log_density, 0.0, 0
        self.evaluations, self.failures = log_density.evaluations, log_density.failures
        alone = copy(log_density)
        alone.jobs, alone.failures = 1, Counter()
        self._rows = StandingCall(_evaluated, _Rows(alone), log_density.jobs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the ``d`` coordinates' quantities."""
        return self.log_density.names

    @property
    def runs(self) -> tuple[str, ...]:
        """Labels of the ``N`` parts of the log-likelihood."""
        return self.log_density.runs

    @property
    def errors(self) -> ErrorModel:
        """The error model."""
        return self.log_density.errors

    @property
    def branch_jumps(self) -> int:
        """Number of solutions, by run, that left the branch from which they started."""
        return self.log_density.branch_jumps + self._elsewhere

    def natural(self, phi: Array) -> Array:
        """Quantities in natural units, shape (W, d), from coordinates, shape (W, d)."""
        return self.log_density.natural(phi)

    def __call__(self, phi: Array) -> tuple[Array, Array]:
        """Log density, shape (W,), and log-likelihood by run, shape (W, N)."""
        self.evaluations += len(phi)
        if not self._rows.others or len(phi) < 2:
            begun = time.perf_counter()
            found = self.log_density(phi)
            self._took += time.perf_counter() - begun
            self._rows.begin(self._took, phi[:2])
            return found
        jumps = self.log_density.branch_jumps
        with single_blas_thread():
            parts = self._rows(np.array_split(phi, min(1 + self._rows.others, len(phi))))
        for _, _, failures, _ in parts:
            self.failures.update(failures)
        self._elsewhere += sum(part[3] for part in parts) - self.log_density.branch_jumps + jumps
        return (
            np.concatenate([part[0] for part in parts]),
            np.concatenate([part[1] for part in parts]),
        )

    def end(self) -> None:
        """Let the other processes forget the density."""
        self._rows.end()


def _evaluated(rows: _Rows, phi: Array) -> tuple[Array, Array, Counter[str], int]:
    return rows(phi)
