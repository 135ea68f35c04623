"""Many data sets at once give what each gives alone."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem, estimate, estimate_many
from bayesoleo.model._priors import LogNormal, Normal, TruncatedNormal, Uniform
from bayesoleo.solvers._orbit import Status

X = np.linspace(0.0, 2.0, 40)


def decay(x, theta):
    return theta[0] * np.exp(-theta[1] * x) + theta[2]


def problem_of(function=decay, priors=None, **options):
    priors = priors or [Normal(2.0, 1.0), LogNormal(1.0, 0.5), Normal(0.5, 0.5)]
    return FunctionProblem(function, X, decay(X, [2.5, 1.3, 0.4]), priors, **options)


def noisy(problem, count, sd=0.02, seed=1):
    return problem.data[0] + np.random.default_rng(seed).normal(0.0, sd, (count, X.size))


def stubborn(x, theta):
    """Refuses columns of numbers, as a function with a branch does."""
    return decay(x, theta) if theta[1] > 0 else np.full_like(x, np.nan)


@pytest.mark.parametrize("method", ["mbe", "be", "gauss-newton", "levenberg-marquardt"])
@pytest.mark.parametrize("function", [decay, stubborn])
def test_each_estimate_is_that_of_its_data_alone(method, function):
    problem = problem_of(function)
    data = noisy(problem, 6)
    found = estimate_many(problem, data, method, tolerance=1e-9)
    assert found.ok.all()
    assert found.together.all() == (method != "levenberg-marquardt")
    for theta, variance, covariance, y in zip(
        found.theta, found.variance, found.covariance, data, strict=True
    ):
        point = estimate(problem.with_data([y]), method, tolerance=1e-9)
        expected = point.covariance if method == "be" else point.covariance_likelihood
        # both stop where a step is 1e-9 of the value, after linear convergence at a rate below 1/2
        np.testing.assert_allclose(theta, point.theta, rtol=2e-9)
        np.testing.assert_allclose(variance, point.variance, rtol=1e-7)
        np.testing.assert_allclose(covariance, expected, rtol=1e-6)


def test_hard_data_sets_leave_the_batch_and_still_arrive():
    """An upside-down record drives its amplitude to the limit, where a full step must not go."""
    bounded = [TruncatedNormal(2.0, 1.0, 0.0), LogNormal(1.0, 0.5), Uniform(-1.0, 1.0)]
    problem = problem_of(priors=bounded)
    data = noisy(problem, 5)
    data[2] = -data[2] + 0.5
    found = estimate_many(problem, data, "be")
    assert found.together.tolist() == [True, True, False, True, True]
    alone = estimate(problem.with_data([data[2]]), "be", tolerance=1e-6)
    np.testing.assert_array_equal(found.theta[2], alone.theta)
    assert found.status[2] == alone.status


def test_a_data_set_that_cannot_be_fitted_is_a_status():
    problem = problem_of(lambda x, t: np.where(t[1] > 0, np.nan, 1.0) * decay(x, t))
    found = estimate_many(problem, noisy(problem, 3))
    assert (found.status == Status.NOT_FINITE).all()
    assert not found.ok.any()


def test_threads_and_batches_change_nothing():
    problem = problem_of()
    data = noisy(problem, 500)  # two batches
    assert problem.lanes < 500
    one, two = (estimate_many(problem, data, jobs=jobs) for jobs in (1, 2))
    np.testing.assert_array_equal(one.theta, two.theta)
    few = estimate_many(problem, data[480:])
    np.testing.assert_allclose(few.theta, one.theta[480:], rtol=1e-12)


def test_a_linear_model_is_solved_in_closed_form():
    basis = np.column_stack((np.ones_like(X), X))
    problem = FunctionProblem(lambda x, t: t[0] + t[1] * x, X, X, [Normal(0, 1e3), Normal(0, 1e3)])
    data = np.random.default_rng(2).normal(size=(30, X.size))
    found = estimate_many(problem, data, "gauss-newton", bias_corrected=True)
    expected, sums, *_ = np.linalg.lstsq(basis, data.T)
    np.testing.assert_allclose(found.theta, expected.T, atol=1e-12)
    np.testing.assert_allclose(found.variance[:, 0], sums / (X.size - 2), rtol=1e-10)
    inverse = np.linalg.inv(basis.T @ basis)
    np.testing.assert_allclose(found.covariance, found.variance[:, :, None] * inverse, rtol=1e-8)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (np.ones((3, 7)), r"data sets do not fit the problem.*\(R, 40\)"),
        (np.full((3, 40), np.nan), "data sets must be finite"),
    ],
)
def test_data_must_fit(data, message):
    with pytest.raises(InputError, match=message):
        estimate_many(problem_of(), data)
