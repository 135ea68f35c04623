"""Every objective against what it means: closed forms, other objectives, and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize

from bayesoleo.error_models._full import GivenErrors, ProfiledFullErrors
from bayesoleo.error_models._independent import ProfiledIndependentErrors
from bayesoleo.errors import InputError
from bayesoleo.estimation import OBJECTIVES, Evaluation, Misfit, estimate
from bayesoleo.model._priors import Normal
from bayesoleo.solvers._orbit import Status

TIME = np.linspace(0.0, 3.0, 60)
TRUTH = np.array([2.0, 0.8])


class TwoOutputs:
    """A decay and its running integral, measured together with correlated errors."""

    names, outputs, runs = ("height", "rate"), ("decay", "integral"), ("1",)

    def __init__(self, covariance, seed=0, prior_sd=10.0):
        self.priors = (Normal(1.5, prior_sd), Normal(1.0, prior_sd))
        self.start = np.array([1.5, 1.0])
        self.counts = np.array([[TIME.size, TIME.size]])
        errors = np.random.default_rng(seed).multivariate_normal([0, 0], covariance, TIME.size)
        self.y = self.predict(TRUTH) + errors.T

    @staticmethod
    def predict(theta):
        height, rate = theta
        with np.errstate(over="ignore"):  # a trial step far out is refused, not an error
            decay = np.exp(-rate * TIME)
            return height * np.array([decay, (1 - decay) / rate])

    def evaluate(self, theta):
        step = 1e-6
        with np.errstate(invalid="ignore"):
            columns = [
                (self.predict(theta + step * e) - self.predict(theta - step * e)) / (2 * step)
                for e in np.eye(2)
            ]
        jacobian, residual = np.stack(columns, axis=-1), self.y - self.predict(theta)
        finite = np.isfinite(jacobian).all() and np.isfinite(residual).all()
        status = Status.CONVERGED if finite else Status.NOT_FINITE
        return Evaluation(tuple(residual), tuple(jacobian), status)

    def misfit(self, theta):
        sums = [[np.sum((self.y - self.predict(t)) ** 2, axis=1)] for t in theta]
        return Misfit(np.array(sums), np.zeros(len(theta), dtype=np.int64))


COVARIANCE = np.array([[0.04, 0.018], [0.018, 0.01]])


@pytest.fixture(scope="module")
def problem():
    return TwoOutputs(COVARIANCE)


def best(function, start=TRUTH):
    """Where a function is smallest, by a method that shares nothing with the estimators."""
    found = minimize(
        function, start, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-13}
    )
    return minimize(
        function, found.x, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-13}
    ).x


def residual(problem, theta):
    return problem.y - problem.predict(theta)


BY_HAND = {
    "likelihood": lambda e: np.log((e**2).sum(axis=1)).sum(),
    "determinant": lambda e: np.linalg.slogdet(e @ e.T)[1],
    "unweighted": lambda e: (e**2).sum(),
    "weighted": lambda e: np.einsum("an,ab,bn", e, np.linalg.inv(COVARIANCE), e),
}


@pytest.mark.parametrize("name", BY_HAND)
@pytest.mark.parametrize("method", ["mbe", "gauss-newton", "levenberg-marquardt", "newton"])
def test_each_objective_is_largest_where_its_formula_says(problem, name, method):
    error = COVARIANCE if name == "weighted" else None
    point = estimate(problem, method, objective=name, error_covariance=error)
    assert point.status is Status.CONVERGED
    expected = best(lambda theta: BY_HAND[name](residual(problem, theta)))
    # the simplex stops where the function is flat to rounding: half of its digits
    np.testing.assert_allclose(point.theta, expected, rtol=3e-7)


@pytest.mark.parametrize(
    ("name", "by_hand"),
    [("diagonal", "likelihood"), ("full", "determinant"), ("given", "weighted")],
)
@pytest.mark.parametrize("method", ["be", "newton", "scipy:trf", "scipy:BFGS"])
def test_the_prior_moves_the_mode_of_a_posterior(name, by_hand, method):
    problem = TwoOutputs(COVARIANCE, prior_sd=0.1)
    error = COVARIANCE if name == "given" else None
    point = estimate(problem, method, objective=name, error_covariance=error, tolerance=1e-9)
    factor = 0.5 if name == "given" else 0.5 * TIME.size
    centre = np.array([1.5, 1.0])

    def depth(theta):
        prior = 0.5 * np.sum(((theta - centre) / 0.1) ** 2)
        return factor * BY_HAND[by_hand](residual(problem, theta)) + prior

    np.testing.assert_allclose(point.theta, best(depth), rtol=3e-6)


def test_the_covariance_of_the_errors_is_found(problem):
    full = estimate(problem, objective="full")
    diagonal = estimate(problem)
    n = TIME.size
    # standard errors of a covariance's entries, n samples
    error = np.sqrt((np.outer(np.diag(COVARIANCE), np.diag(COVARIANCE)) + COVARIANCE**2) / n)
    assert (np.abs(full.error_covariance - COVARIANCE) < 4 * error).all()
    assert diagonal.error_covariance[0, 1] == 0.0
    np.testing.assert_array_equal(full.variance, np.diag(full.error_covariance))


def test_variances_that_were_staged_change_nothing_when_given():
    problem = TwoOutputs(np.diag([0.04, 0.01]))
    staged = estimate(problem, objective="likelihood", tolerance=1e-10)
    given = estimate(
        problem, objective="weighted", error_covariance=staged.variance, tolerance=1e-10
    )
    np.testing.assert_allclose(given.theta, staged.theta, rtol=1e-8)
    np.testing.assert_allclose(given.covariance, staged.covariance_likelihood, rtol=1e-6)


@pytest.mark.parametrize("shape", ["samples", "matrices"])
def test_errors_by_sample_leave_out_what_is_infinitely_uncertain(shape):
    """A sample of enormous variance does not count; the rest is fitted as if it were not there."""
    problem = TwoOutputs(np.diag([0.04, 0.01]))
    cut = TIME < 2.0
    variance = np.where(cut, [[0.04], [0.01]], 1e12)
    error = tuple(variance) if shape == "samples" else np.stack([np.diag(v) for v in variance.T])
    point = estimate(problem, objective="weighted", error_covariance=error)

    def depth(theta):
        e = residual(problem, theta)[:, cut]
        return np.sum(e[0] ** 2 / 0.04 + e[1] ** 2 / 0.01)

    np.testing.assert_allclose(point.theta, best(depth), rtol=1e-6)


@pytest.mark.statistical
def test_unweighted_intervals_hold_although_the_weights_are_wrong():
    """Eq. 2.41 at work: the spread of unweighted estimates over 300 experiments."""
    points = [
        estimate(TwoOutputs(np.diag([0.09, 1e-4]), seed), objective="unweighted")
        for seed in range(300)
    ]
    spread = np.std([point.theta for point in points], axis=0)
    stated = np.mean([point.sd for point in points], axis=0)
    # a standard deviation of 300 draws is known to 4 %; three of them
    np.testing.assert_allclose(stated, spread, rtol=0.13)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objective": "quick"}, f"there is no such objective.*{', '.join(OBJECTIVES)}"),
        ({"objective": "weighted"}, "needs known errors.*give error_covariance"),
        ({"error_covariance": [1, 1]}, "this objective estimates the errors' covariance"),
        ({"objective": "given", "error_covariance": [1.0, -1.0]}, "must be positive"),
        ({"objective": "given", "error_covariance": np.ones((3, 3))}, "does not fit the outputs"),
        ({"objective": "given", "error_covariance": [[1, 2], [2, 1]]}, "must be positive definite"),
        ({"objective": "likelihood", "method": "be"}, "has no prior, which BE would weigh"),
        ({"method": "scipy:magic"}, "SciPy has no such optimiser.*trf"),
    ],
)
def test_bad_input_says_what_to_write(problem, options, message):
    with pytest.raises(InputError, match=message):
        estimate(problem, **options)


def test_one_variance_for_all_samples_is_the_same_by_sample():
    """Of two outputs with unlike numbers of samples, or of a covariance between them."""
    rng, counts = np.random.default_rng(0), np.array([30, 30])
    variances, residual = (0.5, 3.0), tuple(rng.normal(size=(2, 30)))
    evaluation = Evaluation(residual, tuple(np.ones((30, 1)) for _ in residual), Status.CONVERGED)
    by_sample = GivenErrors.of([np.full(30, v) for v in variances], 2)
    pairs = zip(variances, residual, strict=True)
    exact = sum(stats.norm(0, v**0.5).logpdf(e).sum() for v, e in pairs)
    exact += 30 * np.log(2 * np.pi)  # the constant is left out
    for errors in (by_sample, GivenErrors.of(variances, 2), GivenErrors.of(np.diag(variances), 2)):
        found = errors.log_likelihood(errors.moments(evaluation), np.zeros(0), counts)
        assert found == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("errors", [ProfiledFullErrors(), ProfiledIndependentErrors()])
def test_what_is_eliminated_is_the_difference_of_two_curvatures(errors):
    """Of the likelihood with its covariance held, and with it following; linear outputs."""
    rng, counts, n = np.random.default_rng(1), np.array([40, 40]), 40
    sensitivity, y = tuple(rng.normal(size=(2, n, 3))), rng.normal(size=(2, n)) + 1.0
    y[1] += 0.8 * y[0]

    def at(theta):
        residual = tuple(e - j @ theta for e, j in zip(y, sensitivity, strict=True))
        return Evaluation(residual, sensitivity, Status.CONVERGED)

    def height(theta, held=None):
        moments = errors.moments(at(theta))
        covariance = errors.stage(moments, counts, 3, False) if held is None else held
        return errors.log_likelihood(moments, covariance, counts)

    here, step = np.array([0.1, -0.3, 0.2]), 1e-3
    staged = errors.stage(errors.moments(at(here)), counts, 3, False)
    difference = np.empty((3, 3))
    for i, j in np.ndindex(3, 3):
        corners = 0.0
        for p, q in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            theta = here + step * (p * np.eye(3)[i] + q * np.eye(3)[j])
            corners += p * q * (height(theta) - height(theta, staged))
        difference[i, j] = corners / (4 * step**2)
    found = errors.eliminated(at(here), np.ones(3), staged, counts)
    # Second differences over 1e-3: rounding of heights near 100, and the fourth derivative.
    np.testing.assert_allclose(found, difference, atol=1e-3 * np.abs(difference).max())
