r"""Scatter of parameters between runs: common mean and spread of the estimates of each run.

The estimate of run :math:`\kappa` is taken as normal about the run's own parameters, and these as
normal about a common mean:

.. math:: \hat\theta_\kappa \sim N(\theta_\kappa, S_\kappa), \qquad \theta_\kappa \sim N(\mu, T).

The spread :math:`T` is estimated by restricted maximum likelihood, the mean by generalised least
squares. The parameters of each run are shrunk towards the mean according to their own uncertainty
(empirical Bayes). Computations are in units of order one. No model is solved, so this takes
milliseconds.

References
----------
Jackson, Riley and White (2011), "Multivariate meta-analysis: potential and promise", *Statistics in
Medicine* 30, eqs. 2-5 (the likelihood). Viechtbauer (2007), "Confidence intervals for the amount of
heterogeneity in meta-analysis", *Statistics in Medicine* 26 (the interval of a spread). Jackson and
Riley (2014), "A refined method for multivariate meta-analysis and meta-regression", *Statistics in
Medicine* 33 (the interval of the mean).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from scipy import optimize

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._types import Array, Float
from bayesoleo.errors import InputError
from bayesoleo.estimation._per_run import check_definite, comparable

_MIXED = "unit of each parameter"


def generalised_mean(y: Array, S: Array, T: Array) -> tuple[Array, Array, Array]:
    """Mean (l,), its covariance (l, l) and the weights ``(S + T)^-1`` (N, l, l)."""
    W = np.linalg.inv(S + T)
    C = np.linalg.inv(W.sum(axis=0))
    return C @ np.einsum("nij,nj->i", W, y), C, W


def restricted_maximum_likelihood(y: Array, S: Array) -> Array:
    """Spread T, shape (l, l), through its Cholesky factor, so that it is no negative variance."""
    n = y.shape[1]
    rows, columns = np.tril_indices(n)

    def spread(x: Array) -> tuple[Array, Array]:
        L = np.zeros((n, n))
        L[rows, columns] = x
        return L @ L.T, L

    def negative(x: Array) -> tuple[float, Array]:
        T, L = spread(x)
        mean, C, W = generalised_mean(y, S, T)
        Wr = np.einsum("nij,nj->ni", W, y - mean)
        value = np.sum((y - mean) * Wr) - np.linalg.slogdet(W)[1].sum() - np.linalg.slogdet(C)[1]
        slope = W.sum(axis=0) - Wr.T @ Wr - np.einsum("nij,jk,nkl->il", W, C, W)
        return 0.5 * float(value), (slope @ L)[rows, columns]

    # Start from a large and from a small spread, because zero spread is a stationary point.
    starts = [factor * np.eye(n)[rows, columns] for factor in (1.0, 0.1)]
    found = [optimize.minimize(negative, x, jac=True, method="BFGS") for x in starts]
    return spread(min(found, key=lambda item: item.fun).x)[0]


def spread_interval(y: Array, variance: Array, level: float) -> tuple[tuple[float, float], float]:
    """Interval of one parameter's spread by Q-profile, and the probability of Cochran's Q."""
    freedom = y.size - 1

    def q(spread_squared: float) -> float:
        w = 1.0 / (variance + spread_squared)
        return float(np.sum(w * (y - np.sum(w * y) / w.sum()) ** 2))

    def crossing(target: float) -> float:
        if q(0.0) <= target:
            return 0.0
        high = 1.0
        while q(high) > target:
            high *= 4.0
        return float(np.sqrt(optimize.brentq(lambda t: q(t) - target, 0.0, high, xtol=1e-14)))

    low, high = (distributions.chi2.ppf(p, freedom) for p in (0.5 + 0.5 * level, 0.5 - 0.5 * level))
    return (crossing(low), crossing(high)), float(distributions.chi2.sf(q(0.0), freedom))


@dataclass(frozen=True)
class Hierarchy:
    """Runs, their common mean, and their scatter about it.

    Parameters
    ----------
    names, runs : tuple of str, lengths l and N
    mean : ndarray, shape (l,)
        Common mean.
    mean_covariance : ndarray, shape (l, l)
        Of the mean, refined by the observed scatter.
    mean_interval : ndarray, shape (l, 2)
        By Student's t with N - 1 degrees of freedom.
    spread : ndarray, shape (l,)
        Standard deviation between runs.
    spread_covariance : ndarray, shape (l, l)
        Covariance between runs.
    spread_interval : ndarray, shape (l, 2)
        Of each spread by itself (Q-profile): exact for normal estimates.
    p_value : ndarray, shape (l,)
        Probability of at least this scatter if the parameter were equal in all runs (Cochran's Q).
    shrunken, shrunken_sd : ndarray, shape (N, l)
        Each run's parameters given all runs.
    level : float
        Of the intervals.
    left_out : tuple of str
        Parameters and runs that are not compared, each with the reason.
    """

    names: tuple[str, ...]
    runs: tuple[str, ...]
    mean: Float[Array, " parameters"]
    mean_covariance: Float[Array, "parameters parameters"]
    mean_interval: Float[Array, "parameters 2"]
    spread: Float[Array, " parameters"]
    spread_covariance: Float[Array, "parameters parameters"]
    spread_interval: Float[Array, "parameters 2"]
    p_value: Float[Array, " parameters"]
    shrunken: Float[Array, "runs parameters"]
    shrunken_sd: Float[Array, "runs parameters"]
    level: float
    left_out: tuple[str, ...] = ()

    @property
    def mean_sd(self) -> Array:
        """Standard deviation of the mean, shape (l,)."""
        return np.sqrt(np.diag(self.mean_covariance))

    @property
    def new_run_sd(self) -> Array:
        """Standard deviation of the parameters of a future run, shape (l,)."""
        return np.sqrt(self.spread**2 + np.diag(self.mean_covariance))

    def to_dataset(self) -> xr.Dataset:
        """The same as labelled arrays; dims ``parameter``, ``run`` and ``bound`` (low, high)."""
        one, ends = (schema.PARAMETER,), (schema.PARAMETER, "bound")
        rows = (schema.RUN, schema.PARAMETER)
        square = (schema.PARAMETER, schema.PARAMETER_COLUMN)
        table = {
            "mean": (one, self.mean, "mean over runs"),
            "mean_sd": (one, self.mean_sd, "standard deviation of the mean"),
            "mean_interval": (ends, self.mean_interval, "interval of the mean"),
            "spread": (one, self.spread, "standard deviation between runs"),
            "spread_interval": (ends, self.spread_interval, "interval of the spread"),
            "spread_covariance": (square, self.spread_covariance, "covariance between runs"),
            "new_run_sd": (one, self.new_run_sd, "standard deviation for a new run"),
            schema.P_VALUE: (one, self.p_value, "probability of so much scatter by noise"),
            "shrunken": (rows, self.shrunken, "estimate of a run given all"),
            "shrunken_sd": (rows, self.shrunken_sd, "its standard deviation"),
        }
        return xr.Dataset(
            {
                name: (dims, values, {schema.LONG_NAME: text, schema.UNITS: _MIXED})
                for name, (dims, values, text) in table.items()
            },
            coords={
                schema.PARAMETER: list(self.names),
                schema.PARAMETER_COLUMN: list(self.names),
                schema.RUN: list(self.runs),
                "bound": ["low", "high"],
            },
            attrs={"level": self.level, "left_out": "; ".join(self.left_out)},
        )

    def __str__(self) -> str:
        width = max(9, *map(len, self.names))
        head = f"{'parameter':<{width}}  {'mean':>11}  {'interval':>25}  {'spread':>9}"
        lines = [f"{head}  {'interval':>21}  {'p equal':>8}"]
        for k, name in enumerate(self.names):
            low, high = self.mean_interval[k]
            least, most = self.spread_interval[k]
            lines.append(
                f"{name:<{width}}  {self.mean[k]:>11.5g}  {low:>11.5g} … {high:>11.5g}"
                f"  {self.spread[k]:>9.3g}  {least:>9.3g} … {most:>9.3g}  {self.p_value[k]:>8.2g}"
            )
        return "\n".join((*lines, *(f"left out: {item}" for item in self.left_out)))


def between_runs(each: xr.Dataset, *, level: float = 0.95) -> Hierarchy:
    """Mean and spread of per-run estimates, and the runs given both.

    Parameters
    ----------
    each : xarray.Dataset
        From :func:`~bayesoleo.estimation.estimate_each`, estimated by a method that ends in the
        maximum-likelihood point: a prior would otherwise be counted once for
        each run. Runs that did not converge, parameters that at most half of the runs determine,
        and runs that do not determine one of the others are left out and listed. An estimate on
        a limit of its prior's support (``on_limit``) is taken as if it were free.
    level : float, optional
        Of the intervals.

    Returns
    -------
    Hierarchy

    Raises
    ------
    InputError
        If fewer than two runs or no parameter is left, or the estimates are posterior modes.
    """
    if each.attrs.get("method") == "be":
        raise InputError(
            "these estimates hold their prior already, and would count it once a run",
            key="method",
            value="be",
            hint='estimate each run with "mbe"',
        )
    chosen = comparable(each)
    runs, kept = chosen.runs, chosen.parameters
    if runs.sum() < 2 or not kept.any():
        raise InputError(
            "a scatter between runs needs two runs that were estimated and determine a parameter",
            value=each[schema.RUN].values[runs].tolist(),
            hint="left out: " + "; ".join(chosen.left_out) if chosen.left_out else None,
        )
    view = pooled(
        each[schema.ESTIMATE].values[runs][:, kept],
        each["covariance_likelihood"].values[runs][:, kept][:, :, kept],
        names=each[schema.PARAMETER].values[kept].astype(str).tolist(),
        runs=each[schema.RUN].values[runs].astype(str).tolist(),
        level=level,
    )
    return replace(view, left_out=chosen.left_out)


def pooled(
    estimates: Array,
    covariances: Array,
    *,
    names: Sequence[str],
    runs: Sequence[str],
    level: float = 0.95,
) -> Hierarchy:
    """The same from arrays.

    Parameters
    ----------
    estimates : ndarray, shape (N, l)
        By run.
    covariances : ndarray, shape (N, l, l)
        Of each run's estimate.
    names, runs : sequence of str, lengths l and N
    level : float, optional

    Returns
    -------
    Hierarchy

    Raises
    ------
    InputError
        If there are fewer than two runs, or a covariance is not positive definite.
    """
    y, S = np.asarray(estimates, dtype=float), np.asarray(covariances, dtype=float)
    if len(y) < 2:
        raise InputError(
            "a scatter between runs needs two runs that were estimated", value=list(runs)
        )
    for run, covariance in zip(runs, S, strict=True):
        check_definite(run, covariance, names)
    diagonal = np.diagonal(S, axis1=1, axis2=2)
    # In units of each parameter's own scatter and error, so that all are of order one.
    unit = np.sqrt(np.var(y, axis=0, ddof=1) + np.mean(diagonal, axis=0))
    y, S = y / unit, S / np.outer(unit, unit)
    T = restricted_maximum_likelihood(y, S)
    mean, C, W = generalised_mean(y, S, T)
    r, (N, n) = y - mean, y.shape
    # Refined by the standardised scatter, whose expectation is one.
    C_refined = C * np.einsum("ni,nij,nj->", r, W, r) / (n * (N - 1))
    quantile = distributions.t.ppf(0.5 + 0.5 * level, N - 1)
    half = quantile * np.sqrt(np.diag(C_refined))
    pull = T @ W
    rest = np.eye(n) - pull
    left = T - pull @ T + rest @ C @ rest.mT
    alone = [spread_interval(y[:, k], S[:, k, k], level) for k in range(n)]
    return Hierarchy(
        names=tuple(names),
        runs=tuple(runs),
        mean=mean * unit,
        mean_covariance=C_refined * np.outer(unit, unit),
        mean_interval=np.column_stack((mean - half, mean + half)) * unit[:, None],
        spread=np.sqrt(np.diag(T)) * unit,
        spread_covariance=T * np.outer(unit, unit),
        spread_interval=np.array([ends for ends, _ in alone]) * unit[:, None],
        p_value=np.array([p for _, p in alone]),
        shrunken=(mean + np.einsum("nij,nj->ni", pull, r)) * unit,
        shrunken_sd=np.sqrt(np.diagonal(left, axis1=1, axis2=2)) * unit,
        level=level,
    )
