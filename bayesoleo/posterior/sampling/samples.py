"""What sampling returns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from bayesoleo import schema
from bayesoleo._types import Array, Float, Int, Integers
from bayesoleo.posterior.approximation.mixture import Mixture
from bayesoleo.posterior.density.log_density import LOG_VARIANCE
from bayesoleo.posterior.sampling.segment import REASONS


@dataclass(frozen=True)
class Samples:
    """Draws of the posterior and how good they are.

    Parameters
    ----------
    names : tuple of str
        Names of the ``d`` quantities: parameters, then those of the error model, the first of which
        are ``log_variance_<output>``.
    runs : tuple of str
        Labels of the ``N`` runs.
    draws : ndarray, shape (chains, draws, d)
        In natural units (``ln v`` for the variances).
    log_density : ndarray, shape (chains, draws)
        Log posterior density over the coordinates without bounds, Jacobian included, not
        normalised.
    log_likelihood : ndarray, shape (chains, draws, N)
        Normalised log-likelihood by run.
    ensemble : ndarray of int, shape (chains,)
        Which ensemble a chain (a walker) belongs to.
    start : ndarray, shape (chains, d)
        Where the walkers started, in natural units.
    mixture : Mixture
        What the independence move proposed from, in coordinates without bounds.
    autocorrelation_time, effective_size, rhat_nested : ndarray, shape (d,)
        Diagnostics of :mod:`bayesoleo.posterior.sampling.diagnostics`.
    acceptance : dict of str to float
        Accepted part of the proposals by kind of move, and ``"all"``, among the kept draws.
    evaluations : int
        Rows of the log density, warm-up included.
    failures : dict of str to int
        Rows of density zero by reason.
    reached : bool
        Whether the effective size asked for was reached and the ensembles agree.
    warning : str
        What was not reached; empty otherwise.
    failed : ndarray of int, shape (draws, reasons)
        Proposals of density zero on the way to each kept draw, by
        :data:`bayesoleo.posterior.sampling.segment.REASONS`.
    branch_jumps : int
        Solutions of runs, warm-up included, that left the branch of the one they started from.
        Where there are any, the density may be that of several answers of the model to one input.
    """

    names: tuple[str, ...]
    runs: tuple[str, ...]
    draws: Float[Array, "chains draws quantities"]
    log_density: Float[Array, "chains draws"]
    log_likelihood: Float[Array, "chains draws runs"]
    ensemble: Int[Integers, " chains"]
    start: Float[Array, "chains quantities"]
    mixture: Mixture
    autocorrelation_time: Float[Array, " quantities"]
    effective_size: Float[Array, " quantities"]
    rhat_nested: Float[Array, " quantities"]
    acceptance: dict[str, float]
    evaluations: int
    failures: dict[str, int]
    reached: bool
    warning: str
    branch_jumps: int = 0
    failed: Int[Integers, "_draws reasons"] = field(
        default_factory=lambda: np.zeros((0, len(REASONS)), dtype=np.int64)
    )

    def thinned(self, most: int) -> Samples:
        """Equally spaced draws of each chain, so that about ``most`` draws remain.

        Fewer than twice as many are left as they are. Diagnostics stay those of all draws.
        """
        stride = self.log_density.size // most
        if stride < 2:
            return self
        rows = slice(None, None, stride)
        failed = self.failed
        if len(failed):  # proposals on the way to each draw that is left
            failed = np.add.reduceat(failed, np.arange(0, len(failed), stride), axis=0)
        return replace(
            self,
            draws=self.draws[:, rows],
            log_density=self.log_density[:, rows],
            log_likelihood=self.log_likelihood[:, rows],
            failed=failed,
        )

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the model's parameters, with mean and spread of those that scatter."""
        return tuple(name for name in self.names if not schema.of_errors(name))

    @property
    def theta(self) -> Array:
        """Draws of the parameters in their units, shape (chains, draws, l)."""
        return self.draws[:, :, : len(self.parameters)]

    @property
    def of_errors(self) -> Array:
        """Draws of the error model's ``m`` quantities, shape (chains, draws, m)."""
        return self.draws[:, :, len(self.parameters) :]

    @property
    def log_variance(self) -> Array:
        """Draws of the logarithms of the outputs' variances, shape (chains, draws, s)."""
        names = self.names[len(self.parameters) :]
        count = sum(name.startswith(LOG_VARIANCE) and not name.endswith("]") for name in names)
        return self.of_errors[:, :, :count]

    def log_variance_of(self, run: str | None) -> Array:
        """The same of a run, where the error model has variances of each run's own."""
        end = f"[{run}]"
        pairs = enumerate(self.names)
        own = [k for k, n in pairs if n.startswith(LOG_VARIANCE) and n.endswith(end)]
        return self.draws[:, :, own] if own else self.log_variance
