"""BayesBag over runs: laws where the model is right, and where it errs from run to run."""

from __future__ import annotations

import numpy as np
import pytest
from linear_runs import linear_runs

from bayesoleo.errors import InputError
from bayesoleo.posterior import bayesbag


def line(rng, runs, scatter=0.0):
    """A level and a wave in all runs; each run's level may be another one."""
    errors = [rng.standard_normal((1, 200)) + scatter * rng.standard_normal() for _ in range(runs)]
    return linear_runs(errors, levels=[0.5] * runs, by_run=False)


def estimate(problem):
    """Least squares, the prior being wide."""
    table = np.concatenate([problem.columns(r) for r in range(len(problem.y))])
    return np.linalg.lstsq(table, problem.data[0], rcond=None)[0]


def test_with_a_right_model_its_variance_is_about_twice_the_posterior_one():
    rng, ratios = np.random.default_rng(0), []
    for _ in range(20):
        problem = line(rng, 12)
        found = bayesbag(problem, estimate(problem), sets=300)
        ratios.append(np.diag(found.covariance) / np.diag(found.posterior))
    # Of twelve runs the scatter of resampled means is 11/12 of the variance, and C_k is larger by
    # a tenth because runs are drawn several times; the mean of twenty campaigns.
    assert np.mean(ratios) == pytest.approx(2.0, abs=0.25)


def test_levels_that_scatter_between_runs_are_covered():
    rng, inside, plain = np.random.default_rng(1), [], []
    for _ in range(100):
        problem = line(rng, 8, scatter=0.5)
        theta = estimate(problem)
        found = bayesbag(problem, theta, sets=200)
        for covariance, hits in ((found.covariance, inside), (found.posterior, plain)):
            hits.append(abs(found.mean[0] - 0.5) <= 1.645 * np.sqrt(covariance[0, 0]))
    # A resampled variance of eight runs is low by an eighth, and scatters.
    assert 0.78 <= np.mean(inside) <= 0.97
    assert np.mean(plain) < 0.5


def test_the_order_of_runs_does_not_matter_but_for_the_draws():
    rng = np.random.default_rng(2)
    problem = line(rng, 6)
    other = type(problem)(problem.y[::-1], problem.times[::-1], problem.by_run)
    theta = estimate(problem)
    one, two = (bayesbag(p, theta, sets=4000) for p in (problem, other))
    np.testing.assert_allclose(np.diag(one.covariance), np.diag(two.covariance), rtol=0.1)


def test_with_one_run_it_says_why_it_cannot():
    problem = line(np.random.default_rng(3), 1)
    with pytest.raises(InputError, match=r"whole runs.*too few \(got 1\); measure 3 or more"):
        bayesbag(problem, estimate(problem))
