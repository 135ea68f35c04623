"""Samples and their diagnostics: effective sample size, convergence, agreement of ensembles."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._types import Array, Bool, Flags, Float, Int, Integers
from bayesoleo.data._fourier import lagged_products
from bayesoleo.posterior._checkpoints import REASONS
from bayesoleo.posterior._log_density import LOG_VARIANCE
from bayesoleo.posterior._mixture import Mixture


def autocorrelation_time(draws: Array) -> Array:
    """Integrated autocorrelation time of every quantity.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws, d)
        Walkers of all ensembles.

    Returns
    -------
    ndarray, shape (d,)
        In draws; NaN for a quantity that never moves.

    Notes
    -----
    As ``emcee.autocorr``, but deviations are from the mean of all walkers: a walker that stays in
    one of two modes then counts as correlated, where deviations from its own mean would look like
    noise.

    References
    ----------
    Sokal (1996), "Monte Carlo methods in statistical mechanics", section 3 (window of five times).
    Goodman and Weare (2010), "Ensemble samplers with affine invariance", *CAMCoS* 5, section 5.
    """
    centred = draws - draws.mean(axis=(0, 1))
    length = draws.shape[1]
    covariance = lagged_products(centred, 2 * length)
    # The sum at lag t has length - t terms; dividing by that number makes short chains unbiased.
    covariance /= np.arange(length, 0, -1)[:, None]
    times = np.full(draws.shape[2], np.nan)
    for a in np.flatnonzero(covariance[0] > 0):
        sums = 2.0 * np.cumsum(covariance[:, a] / covariance[0, a]) - 1.0
        times[a] = sums[_window(sums)]
    return times


def _window(sums: Array) -> int:
    """First lag that is five times as long as the sum up to it.

    ``emcee.autocorr.auto_window`` returns zero where there is none, and so treats a walker that
    never leaves its mode as independent. Here it is half the chain, and so is the time.
    """
    long_enough = np.flatnonzero(np.arange(len(sums)) >= 5 * sums)
    return int(long_enough[0]) if long_enough.size else len(sums) // 2


def effective_size(draws: Array) -> Array:
    """Effective number of independent draws of every quantity: the smallest of the estimates.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws, d)
        Walkers of all ensembles.

    Returns
    -------
    ndarray, shape (d,)
        Zero for a quantity that never moves.

    References
    ----------
    Vehtari et al. (2021), "Rank-normalization, folding, and localization: an improved R-hat",
    *Bayesian Analysis* 16, section 3 (bulk and tail); and all draws over
    :func:`autocorrelation_time`.
    """
    import arviz_stats as az

    size = draws.shape[0] * draws.shape[1]
    times = autocorrelation_time(draws)
    out = np.zeros(draws.shape[2])
    for a in np.flatnonzero(np.isfinite(times)):
        ranked = [
            float(az.ess(draws[:, :, a], chain_axis=0, draw_axis=1, method=method, prob=prob))
            for method, prob in (("bulk", None), ("tail", (0.05, 0.95)))
        ]
        # Times below one are not used: estimates of anticorrelation are mostly noise.
        out[a] = np.nan_to_num(min(*ranked, size / max(times[a], 1.0)), nan=0.0)
    return out


def nested_rhat(draws: Array, ensemble: Integers) -> Array:
    """Agreement between ensembles of every quantity; one means that they agree.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws, d)
        Walkers of all ensembles.
    ensemble : ndarray of int, shape (chains,)
        Which ensemble a walker belongs to.

    Returns
    -------
    ndarray, shape (d,)
        Infinite for a quantity that never moves.

    References
    ----------
    Margossian et al. (2024), "Nested R-hat: assessing the convergence of Markov chain Monte Carlo
    when running many short chains", *Bayesian Analysis*.
    """
    import arviz_stats as az

    out = np.full(draws.shape[2], np.inf)
    for a in range(draws.shape[2]):
        if np.ptp(draws[:, :, a]) > 0:
            out[a] = az.rhat_nested(
                draws[:, :, a], superchain_ids=ensemble, chain_axis=0, draw_axis=1
            )
    return out


def rhat_limit(ensembles: int, size: float) -> float:
    """Largest nested R-hat of agreeing ensembles with this number of effective draws.

    Parameters
    ----------
    ensembles : int
        Number of ensembles.
    size : float
        Effective draws of all together.

    Returns
    -------
    float
        At least 1.01. The squared R-hat exceeds one by chi-square / (ensembles - 1) over the
        effective draws of one ensemble; the limit is that variable's 99.9 % quantile.
    """
    spread = distributions.chi2.ppf(0.999, ensembles - 1) / (ensembles - 1)
    return float(max(1.01, np.sqrt(1 + spread * ensembles / size)))


@dataclass(frozen=True)
class Samples:
    """Draws of the posterior with their diagnostics.

    Parameters
    ----------
    names : tuple of str
        Names of the ``d`` quantities: parameters, then those of the error model, the first of which
        are ``log_variance_<output>``.
    runs : tuple of str
        Labels of the ``N`` runs.
    draws : ndarray, shape (chains, draws, d)
        In natural units (``ln v`` for the variances). Under errors that runs have in common, only
        one draw of a few, closer together than a quarter of the autocorrelation time.
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
        Integrated autocorrelation time in steps, effective number of draws and nested R-hat.
    acceptance : dict of str to float
        Accepted part of the proposals by kind of move, and ``"all"``, among the kept draws.
    evaluations : int
        Rows of the log density, warm-up included.
    failures : dict of str to int
        Rows of density zero by reason.
    reached : bool
        Whether the requested effective size was reached and the ensembles agree.
    warning : str
        Criteria that were not met, and trajectories that diverged; empty otherwise.
    failed : ndarray of int, shape (draws, reasons)
        Proposals of density zero on the way to each kept draw, one
        column for each :class:`~bayesoleo.solvers.Status` that is a failure.
    branch_jumps : int
        Solutions of runs, warm-up included, that left the branch of the one they started from.
    jumped_part : float
        Those among the kept draws' proposals over the accepted ones: were all of them accepted,
        the density would be that of other answers of the model to this part.
    sampler : {"ensemble", "nuts"}
        Which one drew.
    diverging : ndarray of bool, shape (chains, draws), or None
        Of the no-U-turn sampler: whether a draw's trajectory diverged.
    divergences : int
        Those of all draws, also of ones that are not handed on.
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
    jumped_part: float = 0.0
    failed: Int[Integers, "_draws reasons"] = field(
        default_factory=lambda: np.zeros((0, len(REASONS)), dtype=np.int64)
    )
    sampler: str = "ensemble"
    diverging: Bool[Flags, "chains draws"] | None = None
    divergences: int = 0

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
            diverging=None if self.diverging is None else self.diverging[:, rows],
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
