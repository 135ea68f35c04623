"""The log density: its value, its determinism, and failures that are counted."""

from dataclasses import dataclass

import numpy as np
import pytest
from posterior_gas_spring import GasSpring, gas_spring, measured
from scipy import stats

from bayesoleo.estimation._problem import Misfit
from bayesoleo.model._priors import LogNormal, Normal
from bayesoleo.posterior import LogDensity
from bayesoleo.solvers._orbit import Status


def test_value_is_likelihood_times_prior():
    problem = gas_spring(relative_sd=0.1, seed=1)
    log_density = LogDensity(problem)
    value, by_run = log_density(np.array([[1.21, -4.0]]))
    residual = problem.evaluate(np.array([1.21])).residual[0]
    likelihood = stats.norm(0, np.exp(-2.0)).logpdf(residual).sum()
    np.testing.assert_allclose(by_run, [[likelihood]], rtol=1e-12)
    prior = stats.norm(1.0, 0.1).logpdf(1.21)
    np.testing.assert_allclose(value, [likelihood + prior], rtol=1e-12)
    assert log_density.names == ("theta", "log_variance_force")


def test_a_bounded_parameter_brings_its_jacobian():
    problem = GasSpring(measured(1), LogNormal(1.2, 0.1))
    log_density = LogDensity(problem)
    phi = log_density.coordinates(np.array([[1.21, -4.0]]))
    value, by_run = log_density(phi)
    # The density of ln theta under a log-normal prior is a normal one.
    prior = stats.norm(np.log(1.2), 0.1).logpdf(np.log(1.21))
    np.testing.assert_allclose(value, by_run[:, 0] + prior, rtol=1e-12)
    np.testing.assert_allclose(log_density.natural(phi), [[1.21, -4.0]], rtol=1e-13)


@pytest.mark.parametrize("jobs", [None, 2, 3])
def test_a_row_depends_on_itself_alone(jobs):
    problem = GasSpring(measured(1), LogNormal(1.2, 0.1))
    phi = np.random.default_rng(0).normal([0.2, -4.0], [0.05, 0.3], size=(37, 2))
    value, by_run = LogDensity(problem, jobs)(phi)
    order = np.random.default_rng(1).permutation(37)
    shuffled, _ = LogDensity(problem)(phi[order])
    np.testing.assert_array_equal(shuffled, value[order])
    for k in (0, 17, 36):
        single, single_by_run = LogDensity(problem)(phi[k : k + 1])
        np.testing.assert_array_equal(single, value[k : k + 1])
        np.testing.assert_array_equal(single_by_run, by_run[k : k + 1])


@dataclass(frozen=True)
class Failing(GasSpring):
    """Has no solution above 1.3, and a result that is not finite below 1.1."""

    def misfit(self, theta):
        fine = super().misfit(theta)
        squares, status = fine.sum_of_squares.copy(), fine.status.copy()
        status[theta[:, 0] > 1.3] = Status.NO_CONVERGENCE
        squares[theta[:, 0] > 1.3] = np.nan
        squares[theta[:, 0] < 1.1] = np.nan
        return Misfit(squares, status)


def test_failures_are_minus_infinity_and_counted_by_reason():
    log_density = LogDensity(Failing(measured(1), Normal(1.0, 0.1)))
    rows = [[1.2, -4.0], [1.4, -4.0], [1.0, -4.0], [np.nan, 0.0], [1.2, -2e3], [1.35, -4.0]]
    value, by_run = log_density(np.array(rows))
    assert np.isfinite(value[0])
    assert np.all(value[1:] == -np.inf)
    assert np.all(by_run[1:] == -np.inf)
    assert log_density.failures == {"no_convergence": 2, "not_finite": 3}
    assert log_density.evaluations == 6


def test_outside_the_support_is_its_own_reason():
    log_density = LogDensity(GasSpring(measured(1), LogNormal(1.2, 0.1)))
    # exp(-800) is zero: the bound itself, where the density is zero.
    value, _ = log_density(np.array([[-800.0, -4.0]]))
    assert value[0] == -np.inf
    assert log_density.failures == {"out_of_bounds": 1}
