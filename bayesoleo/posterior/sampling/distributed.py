"""A log density whose rows are evaluated by the workers of a cluster.

Every row depends on itself alone, so the draws are the same on one machine and on many, whatever
the number of ensembles or workers and whichever of them are lost.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bayesoleo._types import Array
from bayesoleo.machines import WorkerPool
from bayesoleo.posterior.density.log_density import Density

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class _Rows:
    """What a worker does: some rows, and what became of them."""

    log_density: Density

    def __call__(self, phi: Array) -> tuple[Array, Array, Counter[str], int]:
        before = Counter(self.log_density.failures)
        jumps = getattr(self.log_density, "branch_jumps", 0)
        values, by_run = self.log_density(phi)
        failures = Counter(self.log_density.failures) - before
        return values, by_run, failures, getattr(self.log_density, "branch_jumps", 0) - jumps


class DistributedDensity:
    """Sends rows to workers and puts together what they return.

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
