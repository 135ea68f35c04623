r"""BayesBag over runs: the mean of the posteriors of runs that are drawn anew with replacement.

Where a model is wrong in a way that differs from run to run, estimates from other runs would have
been others, by more than the posterior of these runs says. BayesBag shows how much: its covariance
is the mean covariance of the posteriors of resampled campaigns plus the covariance of their means,

.. math:: C = E[C_k] + \operatorname{cov}[m_k].

Where the model is right, both are equal, so that the variance is about twice that of the posterior.
An error that all runs have in common is not seen. All posteriors are linearised about the estimate,
which makes them normal.

References
----------
Bühlmann (2014), Statistica Sinica 24, 59-74; Huggins and Miller (2023), Bayesian Analysis 18, eqs.
1 and 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._problem import EstimationProblem

#: Fewest runs: of two, half of the resampled campaigns hold one run only.
FEWEST_RUNS = 3


@dataclass(frozen=True)
class BayesBag:
    """Mean and covariance of the unknowns over resampled campaigns.

    Parameters
    ----------
    mean : ndarray, shape (l,)
        In the units of the unknowns.
    covariance : ndarray, shape (l, l)
    posterior : ndarray, shape (l, l)
        Covariance of the linearised posterior of the runs themselves.
    names : tuple of str
        The ``l`` unknowns.
    """

    mean: Array
    covariance: Array
    posterior: Array
    names: tuple[str, ...]


def bayesbag(
    problem: EstimationProblem, theta: Array, *, sets: int = 400, seed: int = 0
) -> BayesBag:
    """Average the posterior over campaigns whose runs are drawn with replacement.

    Errors are independent, with the variances of the outputs that the residual at the estimate has.

    Parameters
    ----------
    problem : EstimationProblem
        Of three runs or more.
    theta : ndarray, shape (l,)
        The estimate.
    sets : int
        Number of resampled campaigns.
    seed : int
        Draws them.

    Raises
    ------
    InputError
        If there are too few runs, or the problem cannot be evaluated at the estimate.
    """
    runs = len(problem.runs)
    if runs < FEWEST_RUNS:
        raise InputError(
            "BayesBag draws whole runs with replacement, and these are too few",
            key="runs",
            value=runs,
            hint=f"measure {FEWEST_RUNS} or more, or use the error model power",
        )
    grams, gradients, scale = _by_run(problem, np.asarray(theta, dtype=float))
    prior, slope = scale.root.T @ scale.root, np.nan_to_num(scale.slope(theta))
    rng = np.random.default_rng(seed)
    means, covariances = [], []
    for counts in rng.multinomial(runs, np.full(runs, 1.0 / runs), sets):
        covariance = np.linalg.inv(prior + np.einsum("r,rij->ij", counts, grams))
        covariances.append(covariance)
        means.append(covariance @ (counts @ gradients + slope))
    unit = scale.unit(theta)
    whole = np.mean(covariances, axis=0) + np.cov(np.array(means).T, ddof=1)
    own = np.linalg.inv(prior + grams.sum(axis=0))
    square = np.outer(unit, unit)
    centre = theta + unit * np.mean(means, axis=0)
    return BayesBag(centre, whole * square, own * square, tuple(problem.names))


def _by_run(problem: EstimationProblem, theta: Array) -> tuple[Array, Array, PriorScale]:
    """Information (N, l, l) and gradient (N, l) of each run's log-likelihood, per unit of prior."""
    scale = PriorScale.of(problem.priors, problem.names)
    found = problem.evaluate(theta)
    if not found.status.ok:
        raise InputError("the model cannot be solved at the estimate", value=found.status.message)
    unit, runs, size = scale.unit(theta), len(problem.runs), theta.size
    grams, gradients = np.zeros((runs, size, size)), np.zeros((runs, size))
    for b, (e, j) in enumerate(zip(found.residual, found.sensitivity, strict=True)):
        variance = max(float(np.mean(e * e)), 1e-300)
        ends = np.cumsum(np.asarray(problem.counts)[:, b])
        for r, (rows, left) in enumerate(
            zip(np.split(j * unit, ends[:-1]), np.split(e, ends[:-1]), strict=True)
        ):
            grams[r] += rows.T @ rows / variance
            gradients[r] += rows.T @ left / variance
    return grams, gradients, scale
