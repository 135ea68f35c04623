"""Where the posterior has a closed form, BE must give it."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.error_models._independent import output_counts, staged_variance, sums_of_squares
from bayesoleo.estimation import FunctionProblem, estimate, log_posterior, mode_covariance, polish
from bayesoleo.estimation._problem import Evaluation
from bayesoleo.model._priors import LogNormal, Normal
from bayesoleo.solvers._orbit import Status

CENTRE = np.array([1.0, -2e4, 3e-7])
SPREAD = np.array([0.5, 1e4, 1e-7])


@pytest.fixture
def line():
    rng = np.random.default_rng(5)
    design = rng.normal(size=(40, 3)) / SPREAD
    y = design @ (CENTRE + 0.3 * SPREAD) + rng.normal(0.0, 2.0, 40)
    priors = [Normal(c, s) for c, s in zip(CENTRE, SPREAD, strict=True)]
    problem = FunctionProblem(lambda x, t: x @ t, design, y, priors, jacobian=lambda x, t: x)
    return problem, design, y


def test_be_is_the_posterior_of_a_linear_model(line):
    problem, design, y = line
    point = estimate(problem, "be", tolerance=1e-12)
    weight = np.diag(SPREAD**-2.0)
    covariance = np.linalg.inv(design.T @ design / point.variance[0] + weight)
    mean = covariance @ (design.T @ y / point.variance[0] + weight @ CENTRE)
    # the closed form inverts a matrix of condition 1e23 in these units, but diagonally scaled
    np.testing.assert_allclose(point.theta, mean, rtol=1e-9)
    np.testing.assert_allclose(point.covariance, covariance, rtol=1e-8)
    assert point.variance[0] == pytest.approx(np.mean((y - design @ point.theta) ** 2))


def test_mbe_is_ordinary_least_squares(line):
    problem, design, y = line
    point = estimate(problem, "mbe", tolerance=1e-12, bias_corrected=True)
    scaled = design * SPREAD  # unscaled, NumPy's solution has five digits only
    solution, rss = np.linalg.lstsq(scaled, y)[:2]
    np.testing.assert_allclose(point.theta, solution * SPREAD, rtol=1e-9)
    expected = rss[0] / 37 * np.linalg.inv(scaled.T @ scaled) * np.outer(SPREAD, SPREAD)
    np.testing.assert_allclose(point.covariance_likelihood, expected, rtol=1e-8)


def numerical_hessian(function, centre, steps):
    size = len(centre)
    hessian = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            a, b = np.eye(size)[i] * steps, np.eye(size)[j] * steps
            corners = [function(centre + p * a + q * b) * p * q for p in (1, -1) for q in (1, -1)]
            hessian[i, j] = sum(corners) / (4 * steps[i] * steps[j])
    return hessian


def test_joint_covariance_is_the_inverse_hessian_of_the_objective(line):
    problem, _, _ = line
    mode = estimate(problem, "be", tolerance=1e-12)

    def objective(augmented):
        theta, variance = augmented[:3], np.exp(augmented[3:])
        sums = sums_of_squares(problem.evaluate(theta))
        return log_posterior(sums, variance, output_counts(problem.counts), problem.priors, theta)

    steps = np.append(mode.sd, 0.2) * 1e-3
    centre = np.append(mode.theta, np.log(mode.variance))
    expected = np.linalg.inv(-numerical_hessian(objective, centre, steps))
    # second differences at 1e-3 sd of an objective near 100 are good to 1e-14 * 100 / 1e-6
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        mode_covariance(problem, mode.theta) / np.outer(scale, scale),
        expected / np.outer(scale, scale),
        atol=1e-5,
    )


def test_be_finds_the_mode_under_a_prior_that_is_not_normal():
    """One location with known closed gradient: the slope of the objective vanishes at the mode."""
    rng = np.random.default_rng(2)
    y = rng.normal(2.0, 1.0, 6)
    prior = LogNormal(0.5, 0.4)
    problem = FunctionProblem(lambda x, t: t[0] + 0 * y, None, y, [prior])
    mode = polish(problem, estimate(problem, tolerance=1e-10), tolerance=1e-10)
    value = mode.theta[0]
    slope = np.sum(y - value) / mode.variance[0] - (1 + np.log(value / 0.5) / 0.4**2) / value
    assert mode.status is Status.CONVERGED
    # the prior's slope is a difference over 1e-4 sd, good to 1e-8 of itself
    assert abs(slope) < 1e-6


class TwoOutputs:
    """The mean of two channels of unequal length, measured with unequal noise, in two runs."""

    names, outputs, runs = ("level",), ("coarse", "fine"), ("a", "b")
    priors = (Normal(0.0, 10.0),)
    start = np.zeros(1)
    counts = np.array([[30, 100], [20, 300]])

    def __init__(self):
        rng = np.random.default_rng(8)
        self.y = rng.normal(3.0, 2.0, 50), rng.normal(3.0, 0.1, 400)

    def evaluate(self, theta):
        residual = tuple(y - theta[0] for y in self.y)
        return Evaluation(residual, tuple(np.ones((y.size, 1)) for y in self.y), Status.CONVERGED)


def test_each_output_is_weighted_by_its_own_staged_variance():
    problem = TwoOutputs()
    point = estimate(problem, "mbe", tolerance=1e-12)
    weights = [y.size / v for y, v in zip(problem.y, point.variance, strict=True)]
    expected = np.average([y.mean() for y in problem.y], weights=weights)
    assert point["level"] == pytest.approx(expected, rel=1e-10)
    variances = [np.mean((y - expected) ** 2) for y in problem.y]
    np.testing.assert_allclose(point.variance, variances, rtol=1e-10)


def test_bias_correction_shares_the_unknowns_between_outputs():
    variance = staged_variance(np.array([9.0, 18.0]), np.array([10, 20]), 2, bias_corrected=True)
    np.testing.assert_allclose(variance, [1.0, 18 / 19])
