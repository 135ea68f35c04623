"""An explicit regression as a problem."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.model._priors import Normal, TruncatedNormal
from bayesoleo.solvers._orbit import Status

X = np.linspace(0.1, 2.0, 30)


def power(x, theta):
    return theta[0] * x ** theta[1] + np.exp(theta[2] * x)


def power_problem(start):
    return FunctionProblem(power, X, np.ones(30), [Normal(1, 2)] * 3, start=start)


@pytest.mark.parametrize("theta", [[1.0, 2.0, 0.5], [1e-3, 3.0, 0.0], [-20.0, 0.2, -1.0]])
def test_differences_agree_with_derivatives(theta):
    found = power_problem(theta).evaluate(np.array(theta)).sensitivity[0]
    a, n, k = theta
    expected = np.column_stack((X**n, a * X**n * np.log(X), X * np.exp(k * X)))
    # rounding 2e-16 of values to 10 over a step of 1e-3 or, at zero, of 2e-6
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_differences_are_of_sixth_order():
    """For a polynomial of degree six in the parameter they are exact, whatever the step."""
    problem = FunctionProblem(lambda x, t: x * t[0] ** 6, X, X, [Normal(1.3, 1.0)])
    found = problem.evaluate(np.array([1.3])).sensitivity[0][:, 0]
    np.testing.assert_allclose(found, 6 * 1.3**5 * X, rtol=1e-11)


def test_differences_stay_inside_the_support():
    problem = FunctionProblem(
        lambda x, t: x * np.sqrt(t[0]), X, X, [TruncatedNormal(1.0, 1.0, 0.0)]
    )
    evaluation = problem.evaluate(np.array([1e-7]))
    assert evaluation.status is Status.CONVERGED
    # a quarter of the way to the limit is a coarse step for a square root
    np.testing.assert_allclose(evaluation.sensitivity[0][:, 0], X / 2 / np.sqrt(1e-7), rtol=1e-2)


def test_misfit_is_the_sum_of_squares_bit_for_bit_in_any_batch():
    problem = power_problem([1, 1, 1])
    vectors = np.random.default_rng(0).normal(1.0, 0.3, (7, 3))
    batch = problem.misfit(vectors)
    assert batch.sum_of_squares.shape == (7, 1, 1)
    for row, vector in enumerate(vectors):
        alone = problem.misfit(vector[None])
        np.testing.assert_array_equal(alone.sum_of_squares[0], batch.sum_of_squares[row])
        residual = problem.evaluate(vector).residual[0]
        assert batch.sum_of_squares[row, 0, 0] == pytest.approx(residual @ residual, rel=1e-14)


def test_a_failed_vector_is_not_a_number_and_counted():
    problem = FunctionProblem(lambda x, t: np.log(t[0]) * x, X, X, [Normal(1.0, 1.0)])
    misfit = problem.misfit(np.array([[1.0], [-1.0]]))
    assert misfit.status.tolist() == [Status.CONVERGED, Status.NOT_FINITE]
    assert np.isfinite(misfit.sum_of_squares[0]).all()
    assert np.isnan(misfit.sum_of_squares[1]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"y": [1.0, np.nan]}, "key y: measured output must be one column of finite numbers"),
        ({"y": []}, "key y: measured output has no sample"),
        ({"names": ["a", "b"]}, "must have one entry per unknown"),
        ({"start": [1.0, 2.0]}, "must have one entry per unknown"),
    ],
)
def test_lengths_must_agree(change, message):
    options = {"y": [1.0, 2.0], "priors": [Normal(1, 1)]} | change
    with pytest.raises(InputError, match=message):
        FunctionProblem(lambda x, t: t[0], None, **options)


@pytest.mark.parametrize("x", [X[:-1], list(X[:-1]), np.append(X, 3.0)])
def test_inputs_of_another_length_than_the_output_are_refused(x):
    with pytest.raises(InputError, match=r"key x: .*each sample of y.*y has 30 samples"):
        FunctionProblem(lambda x, t: t[0] * np.asarray(x), x, X, [Normal(1, 1)])


def test_inputs_are_whatever_the_function_reads():
    """Constants, or two rows of inputs: only the predictions have to be as many as the samples."""
    line = FunctionProblem(lambda x, t: t[0] * x[0] * X, [2.0, 3.0], X, [Normal(1, 1)])
    assert estimate(line).theta[0] == pytest.approx(0.5)
    rows = FunctionProblem(lambda x, t: t[0] * x[0] + x[1], np.stack((X, X)), 3 * X, [Normal(1, 1)])
    assert estimate(rows).theta[0] == pytest.approx(2.0)


def test_a_function_that_changes_its_length_is_refused():
    problem = FunctionProblem(lambda x, t: t[0] * x["time"][:-1], {"time": X}, X, [Normal(1, 1)])
    with pytest.raises(InputError, match="one prediction for each sample of y"):
        estimate(problem)


def test_an_output_without_samples_is_not_estimated_from():
    class Unmeasured(FunctionProblem):
        @property
        def counts(self):
            return np.array([[0]])

    problem = Unmeasured(lambda x, t: t[0] * x, X, X, [Normal(1, 1)], output="force")
    with pytest.raises(InputError, match="column force: there is no sample to estimate from"):
        estimate(problem)
