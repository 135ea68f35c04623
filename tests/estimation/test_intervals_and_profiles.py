"""Intervals where the answer is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesoleo.error_models._independent import output_counts
from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem, estimate, log_posterior
from bayesoleo.estimation._identifiability import over_variances
from bayesoleo.estimation._intervals import (
    linearised_covariance,
    linearised_intervals,
    over_experiments,
    supported_ends,
)
from bayesoleo.estimation._objectives import curvature, prior_precision
from bayesoleo.estimation._problem import Held
from bayesoleo.estimation._profile_likelihood import profile
from bayesoleo.model._correlated_priors import JointNormal
from bayesoleo.model._priors import LogNormal, LogUniform, Normal, TruncatedNormal, Uniform

SIZE = 40


@pytest.fixture(scope="module")
def line():
    rng = np.random.default_rng(3)
    design = rng.normal(size=(SIZE, 3)) * [1.0, 1e4, 1e-6]
    y = design @ [1.0, -2e-4, 3e6] + rng.normal(size=SIZE)
    priors = [Normal(0.0, 10.0), Normal(0.0, 1e-3), Normal(0.0, 1e7)]
    problem = FunctionProblem(lambda x, t: x @ t, design, y, priors, ["a", "b", "c"])
    return problem, design, estimate(problem, tolerance=1e-10)


@pytest.fixture(scope="module")
def bent():
    """A decay: nonlinear in its rate, with a residual large enough to count."""
    rng = np.random.default_rng(4)
    x = np.linspace(0.0, 3.0, 25)
    y = 2.0 * np.exp(-1.5 * x) + 0.1 * rng.normal(size=25)
    priors = [Normal(2.0, 1.0), LogNormal(1.5, 0.5)]
    problem = FunctionProblem(lambda x, t: t[0] * np.exp(-t[1] * x), x, y, priors, ["size", "rate"])
    return problem, estimate(problem, tolerance=1e-10), estimate(problem, "be", tolerance=1e-10)


def test_propagated_and_posterior_forms_of_a_linear_model(line):
    problem, design, point = line
    inverse = np.linalg.inv((design.T @ design) * np.outer(*[design.std(0) ** -1] * 2))
    inverse *= np.outer(*[design.std(0) ** -1] * 2)
    for form in ("propagated", "posterior"):
        covariance = linearised_covariance(problem, point, form, prior=False)
        np.testing.assert_allclose(covariance[:3, :3], point.variance[0] * inverse, rtol=1e-8)
    v = point.variance[0]
    # the variance's own: 2 v^2 / n by curvature; propagation linearises e^2 and so doubles it
    posterior = linearised_covariance(problem, point, "posterior", prior=False)[3, 3]
    propagated = linearised_covariance(problem, point, "propagated", prior=False)[3, 3]
    assert posterior == pytest.approx(2 * v**2 / SIZE)
    assert propagated == pytest.approx(4 * v**2 / SIZE)


def test_curvature_is_the_hessian_of_the_objective(bent):
    problem, _, mode = bent

    def objective(phi):
        e = problem.evaluate(phi[:2]).residual[0]
        counts = output_counts(problem.counts)
        return log_posterior(np.array([e @ e]), phi[2:], counts, problem.priors, phi[:2])

    phi = np.concatenate((mode.theta, mode.variance))
    steps = 1e-3 * phi
    expected = np.empty((3, 3))
    for i, j in np.ndindex(3, 3):
        a, b = np.eye(3)[i] * steps, np.eye(3)[j] * steps
        corners = [objective(phi + p * a + q * b) * p * q for p in (1, -1) for q in (1, -1)]
        expected[i, j] = -sum(corners) / (4 * steps[i] * steps[j])
    scale = np.sqrt(np.diag(expected))
    found = curvature(problem, mode.theta, mode.variance, exact=True)
    # second differences over a thousandth: 1e-6 of the fourth derivative, about 40 here
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-4
    )
    gauss_newton = curvature(problem, mode.theta, mode.variance)
    assert abs(gauss_newton[1, 1] / expected[1, 1] - 1) > 1e-3  # the residual does count here


def test_precision_of_a_joint_prior_is_its_inverse_covariance():
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    joint = JointNormal.of(["a", "b"], [0.0, 0.0], covariance)
    priors = [joint.prior("a"), Uniform(0.0, 1.0), joint.prior("b")]
    found = prior_precision(priors, np.array([0.1, 0.5, 0.2]))
    np.testing.assert_allclose(found[np.ix_([0, 2], [0, 2])], np.linalg.inv(covariance))
    np.testing.assert_array_equal(found[1], 0.0)


def test_holding_part_of_a_joint_prior_leaves_the_conditional():
    joint = JointNormal.of(["a", "b"], [1.0, 2.0], [[4.0, 1.0], [1.0, 2.0]])
    priors = [joint.prior("a"), joint.prior("b")]
    problem = FunctionProblem(lambda x, t: x * t[0] + t[1], np.ones(3), np.zeros(3), priors, "ab")
    (prior,) = Held(problem, np.array([0.0, 4.0]), [1]).priors
    assert prior.mean == pytest.approx(1.0 + 0.5 * (4.0 - 2.0))
    assert prior.sd == pytest.approx(np.sqrt(4.0 - 0.5))


@pytest.mark.parametrize(
    "prior", [LogNormal(1.0, 1.5), LogNormal(1.0, 5.0), LogUniform(1e-6, 10.0)]
)
def test_the_logarithm_counts_only_where_it_is_known(prior):
    """Of what is near zero the data say how large it is at most, and hardly its logarithm."""
    half = np.array([0.005])
    low, high = supported_ends([prior], np.array([1e-3]), half)
    assert low[0] == prior.support[0]
    assert high[0] == pytest.approx(6e-3)
    low, high = supported_ends([prior], np.array([0.1]), half)
    np.testing.assert_allclose([low[0], high[0]], 0.1 * np.exp([-0.05, 0.05]))


def test_intervals_end_at_the_support():
    """Five samples tell little of three constants of which only one may be negative."""
    x = np.linspace(0.0, 1.0, 5)
    y = 0.3 + 0.2 * x + 0.1 * x**2 + np.array([0.3, -0.4, 0.1, 0.5, -0.4])
    priors = [LogNormal(0.3, 1.5), Uniform(0.0, 2.0), Normal(0.0, 9.0)]
    problem = FunctionProblem(lambda x, t: t[0] + t[1] * x + t[2] * x**2, x, y, priors, "abc")
    point = estimate(problem, "be")
    found = linearised_intervals(problem, point, "posterior")
    low, high = found["low"].values, found["high"].values
    assert 0.0 <= low[0] < point["a"] < high[0]
    assert (low[1], high[1]) == (0.0, 2.0)
    assert low[2] < 0.0 < high[2]
    assert 0.0 < low[3] < point.variance[0] < high[3]
    half = 1.959964 * float(found["sd"][0])
    np.testing.assert_allclose(high[0], point["a"] + half, rtol=1e-6)
    lines = profile(problem, point, ["a", "b"])
    assert (lines["linear_low"].values >= 0.0).all()
    assert float(lines["linear_high"][1]) <= 2.0


def test_profile_of_a_linear_model_is_the_closed_form(line):
    problem, design, point = line
    found = profile(problem, point)
    scale = design.std(0)
    inverse = np.linalg.inv((design / scale).T @ (design / scale)) / np.outer(scale, scale)
    # the fall is n/2 log(1 + d^2 / (n v c)), since the variance follows
    reach = stats.chi2.isf(0.05, 1)
    half = np.sqrt(SIZE * point.variance[0] * np.diag(inverse) * np.expm1(reach / SIZE))
    np.testing.assert_allclose(found["low"], point.theta - half, rtol=1e-3)
    np.testing.assert_allclose(found["high"], point.theta + half, rtol=1e-3)
    one = found.data.isel(parameter=1)
    away = one["value"].values - point.theta[1]
    fall = 0.5 * SIZE * np.log1p(away**2 / (SIZE * point.variance[0] * inverse[1, 1]))
    known = np.isfinite(away)
    np.testing.assert_allclose(one["fall"].values[known], fall[known], atol=1e-6)
    assert known.sum() >= 7


def test_profile_tells_what_linearisation_does_not(bent):
    problem, point, mode = bent
    found = profile(problem, point, ["rate"])
    low, high = float(found["low"][0]), float(found["high"][0])
    rate = point["rate"]
    assert high - rate > 1.02 * (rate - low)  # skewed upwards
    # an independent answer: the least sum of squares over the other unknown is linear
    x, y = problem._x, problem._y
    for end in (low, high):
        shape = np.exp(-end * x)
        rest = y - shape * (shape @ y) / (shape @ shape)
        fall = 0.5 * y.size * np.log(rest @ rest / (y.size * point.variance[0]))
        assert 2 * fall == pytest.approx(stats.chi2.isf(0.05, 1), rel=5e-3)
    tighter = profile(problem, mode, ["rate"])
    assert tighter.data.attrs["kind"] == "posterior"
    assert float(tighter["high"][0] - tighter["low"][0]) < high - low


def test_limits_do_not_suffer_from_what_is_open_beside_them():
    """Only the quotient of area and volume is seen; the exponent's limits are those at any area."""
    x = np.linspace(0.0, 0.12, 60)

    def spring(stroke, t):
        with np.errstate(invalid="ignore"):
            return t[0] * (1 - 10 * t[2] * stroke / t[3]) ** -t[1]

    y = spring(x, [4.9, 1.1, 3.5, 9.2]) + 0.05 * np.random.default_rng(2).normal(size=60)
    priors = [Normal(4.9, 0.5), Normal(1.2, 0.15), Normal(3.5, 0.35), Normal(9.2, 0.9)]
    whole = FunctionProblem(spring, x, y, priors, ["pressure", "exponent", "area", "volume"])
    point = estimate(whole, tolerance=1e-8)
    area = point["area"]
    fixed = FunctionProblem(
        lambda s, t: spring(s, [t[0], t[1], area, t[2]]), x, y, [priors[k] for k in (0, 1, 3)]
    )
    found = profile(whole, point, ["exponent", "area"])
    expected = profile(fixed, estimate(fixed, tolerance=1e-8), ["theta2"])
    for end in ("low", "high"):
        assert float(found[end][0]) == pytest.approx(float(expected[end][0]), rel=1e-3)
    assert np.isinf(found["low"][1])
    assert np.isinf(found["high"][1])


def test_side_without_limit_is_open():
    """Beyond a slope of 50 all steps look alike at these samples."""
    x = np.linspace(-1.0, 1.0, 20)
    y = np.sign(x) + 0.05 * np.random.default_rng(0).normal(size=20)
    problem = FunctionProblem(lambda x, t: np.tanh(t[0] * x), x, y, [Normal(30.0, 20.0)], ["slope"])
    point = estimate(problem, "be")
    found = profile(problem, point, kind="likelihood")
    assert np.isfinite(found["low"][0])
    assert np.isinf(found["high"][0])
    assert "open" in str(found)


def test_intervals_over_experiments_are_student_t():
    rng = np.random.default_rng(9)
    table = rng.normal([3.0, -1.0], [0.5, 2.0], size=(14, 2))
    found = over_experiments(table, ["a", "b"])
    for k in range(2):
        expected = stats.ttest_1samp(table[:, k], 0.0).confidence_interval(0.95)
        assert float(found["low"][k]) == pytest.approx(expected.low)
        assert float(found["high"][k]) == pytest.approx(expected.high)
    wide = over_experiments(table, of="experiment", distribution="normal")
    half = stats.norm.isf(0.025) * table.std(axis=0, ddof=1) * np.sqrt(1 + 1 / 14)
    np.testing.assert_allclose(wide["high"] - wide["estimate"], half)
    np.testing.assert_allclose(wide["covariance"], np.cov(table.T))


@pytest.mark.statistical
@pytest.mark.parametrize(("of", "target"), [("mean", 0.0), ("experiment", None)])
def test_student_intervals_cover_as_often_as_they_say(of, target):
    rng = np.random.default_rng(11)
    hits = 0
    for _ in range(2000):
        table = rng.normal(size=(6, 1))
        found = over_experiments(table, of=of).data
        value = rng.normal() if target is None else target
        hits += float(found["low"][0]) <= value <= float(found["high"][0])
    assert hits / 2000 == pytest.approx(0.95, abs=3.5 * np.sqrt(0.95 * 0.05 / 2000))


def test_failed_estimates_are_left_out_and_counted(bent):
    problem, point, _ = bent
    lost = estimate(problem, max_iterations=1)
    found = over_experiments([point, point, lost])
    assert (found.data.attrs["experiments"], found.data.attrs["failed"]) == (2, 1)


def test_bad_requests_are_named(bent):
    problem, point, _ = bent
    with pytest.raises(InputError, match="two experiments or more"):
        over_experiments(np.ones((1, 2)))
    with pytest.raises(InputError, match="key level: must lie between 0 and 1"):
        linearised_intervals(problem, point, level=95)
    with pytest.raises(InputError, match="use 'propagated' or 'posterior'"):
        linearised_intervals(problem, point, "sandwich")
    with pytest.raises(InputError, match="one of: size, rate"):
        profile(problem, point, ["speed"])


@pytest.mark.parametrize("value", [0.6, 1.7, 3.0])
def test_precision_of_a_prior_that_is_not_normal_is_its_curvature(value):
    """Log-normal: second derivative by hand; truncated: that of the normal density inside."""
    away = np.log(value / 2.0)
    exact = ((1 - away) / 0.3**2 - 1) / value**2
    priors = [LogNormal(2.0, 0.3), TruncatedNormal(1.0, 0.8, 0.0, 9.0)]
    found = np.diag(prior_precision(priors, np.array([value, value])))
    # By second differences over 1e-3 sd; nowhere negative.
    np.testing.assert_allclose(found, [max(exact, 0.0), 0.8**-2], rtol=1e-4)


def test_information_with_the_variances_following_is_the_block_of_the_inverse():
    rows = np.random.default_rng(3).standard_normal((9, 5))
    whole = rows.T @ rows
    alone = np.linalg.inv(np.linalg.inv(whole)[:3, :3])
    np.testing.assert_allclose(over_variances(whole, 3), alone, rtol=1e-9)


def test_curvature_in_the_variances_away_from_their_optimum(line):
    """``n / (2 v^2)`` holds where ``v = M / n`` only; here by differences of the objective."""
    problem, _, point = line
    counts, sums = output_counts(problem.counts), np.array([SIZE * point.variance[0]])

    def objective(v):
        return log_posterior(sums, np.array([v]), counts, problem.priors, point.theta)

    for v in (0.6 * point.variance[0], 1.7 * point.variance[0]):
        step = 1e-3 * v
        second = (objective(v + step) - 2 * objective(v) + objective(v - step)) / step**2
        found = curvature(problem, point.theta, np.array([v]))[3, 3]
        # Differences over a thousandth: 1e-6 of the fourth derivative, about 20 here.
        assert found == pytest.approx(-second, rel=1e-4)
