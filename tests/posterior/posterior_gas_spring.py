"""The gas spring of Verbeek (1993), section 3.4.2, and its posterior by quadrature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo.estimation._problem import Evaluation, Misfit
from bayesoleo.model._priors import Normal
from bayesoleo.solvers._orbit import Status

COMPRESSION = np.linspace(0.0, 0.9, 100)


def measured(seed: int) -> np.ndarray:
    """``(1 / (1 - x)) ** 1.2`` with noise of 2 sigma = 1 % of full scale."""
    noise = 0.005 * 10**1.2 * np.random.default_rng(seed).standard_normal(len(COMPRESSION))
    return (1.0 / (1.0 - COMPRESSION)) ** 1.2 + noise


@dataclass(frozen=True)
class GasSpring:
    """``0.95 (1 / (1 - x)) ** theta``: the 0.95 is an error that nobody declared."""

    y: np.ndarray
    prior: object

    names = ("theta",)
    outputs = ("force",)
    runs = ("run 1",)

    @property
    def priors(self):
        return (self.prior,)

    @property
    def start(self):
        return np.array([self.prior.mean])

    @property
    def counts(self):
        return np.array([[len(self.y)]])

    def evaluate(self, theta):
        log_ratio = -np.log1p(-COMPRESSION)
        prediction = 0.95 * np.exp(theta[0] * log_ratio)
        sensitivity = (prediction * log_ratio)[:, None]
        return Evaluation((self.y - prediction,), (sensitivity,), Status.CONVERGED)

    def misfit(self, theta):
        log_ratio = -np.log1p(-COMPRESSION)
        sums = [np.sum((self.y - 0.95 * np.exp(t * log_ratio)) ** 2) for t in theta[:, 0]]
        return Misfit(np.array(sums).reshape(-1, 1, 1), np.zeros(len(theta), dtype=int))


def gas_spring(*, relative_sd: float, seed: int) -> GasSpring:
    """The example with prior mean 1 and the given standard deviation."""
    return GasSpring(measured(seed), Normal(1.0, relative_sd))


def quadrature(problem: GasSpring, theta: np.ndarray, log_v: np.ndarray):
    """Posterior on a grid by its definition, shape (theta, log_v), normalised by trapezoids."""
    squares = problem.misfit(theta[:, None]).sum_of_squares[:, 0, 0]
    n = len(problem.y)
    exponent = -0.5 * n * log_v - 0.5 * squares[:, None] * np.exp(-log_v)
    exponent += problem.prior.log_density(theta)[:, None]
    density = np.exp(exponent - exponent.max())
    return density / np.trapezoid(np.trapezoid(density, log_v, axis=1), theta)
