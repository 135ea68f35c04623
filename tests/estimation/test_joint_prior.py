"""The posterior of an earlier campaign as prior: what is tied there stays tied."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from bayesoleo.errors import ModelError
from bayesoleo.estimation import FunctionProblem, estimate, estimate_many, log_prior
from bayesoleo.model import Model, Output, Parameter, with_joint_prior
from bayesoleo.model._correlated_priors import JointNormal, log_density_of, sample_of
from bayesoleo.model._priors import Normal
from bayesoleo.posterior import LogDensity

MEAN = np.array([1.0, 2.0])
COVARIANCE = np.array([[0.04, -0.054], [-0.054, 0.09]])
X = np.linspace(0.0, 1.0, 30)


def line(x, theta):
    return theta[0] + theta[1] * x


def line_problem(y, priors):
    return FunctionProblem(line, X, y, priors, ["level", "slope"])


@pytest.fixture
def joint():
    return JointNormal.of(["level", "slope"], MEAN, COVARIANCE)


@pytest.fixture
def priors(joint):
    return [joint.prior("level"), joint.prior("slope")]


def test_density_and_draws_are_those_of_scipy(priors):
    theta = np.random.default_rng(0).normal(1.5, 0.5, (7, 2))
    expected = multivariate_normal(MEAN, COVARIANCE).logpdf(theta)
    np.testing.assert_allclose(log_density_of(priors, theta), expected, rtol=1e-12)
    assert log_prior(priors, theta[0]) == pytest.approx(expected[0])
    draws = sample_of(priors, np.random.default_rng(1), 20_000)
    # standard error of a correlation of -0.9 from 20 000 draws: (1 - 0.81) / 141
    assert np.corrcoef(draws.T)[0, 1] == pytest.approx(-0.9, abs=4 * 0.0014)


def test_one_parameter_alone_has_its_marginal(joint):
    alone = [joint.prior("slope"), Normal(0.0, 1.0)]
    theta = np.array([[1.7, 0.3]])
    expected = Normal(2.0, 0.3).log_density(1.7) + Normal(0.0, 1.0).log_density(0.3)
    assert log_density_of(alone, theta)[0] == pytest.approx(float(expected))


def test_two_campaigns_in_turn_are_one_campaign_of_both():
    """The mode with the first campaign as prior is the weighted fit of both, in closed form."""
    rng = np.random.default_rng(4)
    first, second = (line(X, [0.7, 1.4]) + rng.normal(0, 0.1, X.size) for _ in range(2))
    wide = [Normal(0, 1e4), Normal(0, 1e4)]
    known = {"objective": "given", "error_covariance": [0.01], "tolerance": 1e-12}
    earlier = estimate(line_problem(first, wide), "be", **known)
    carried = JointNormal.of(earlier.names, earlier.theta, earlier.covariance)
    tied = [carried.prior(name) for name in earlier.names]
    both = np.polynomial.polynomial.polyfit(np.tile(X, 2), np.concatenate((first, second)), 1)
    for method in ("be", "newton", "scipy:trf"):
        point = estimate(line_problem(second, tied), method, **known)
        np.testing.assert_allclose(point.theta, both, rtol=1e-6)
    basis = np.column_stack((np.ones_like(X), X))
    expected = np.linalg.inv(2 * basis.T @ basis) * 0.01
    np.testing.assert_allclose(point.covariance, expected, rtol=1e-6)


@pytest.mark.parametrize("method", ["mbe", "mve", "mmve", "levenberg-marquardt", "gauss-newton"])
def test_estimators_that_move_the_prior_still_end_in_the_likelihood(priors, method):
    y = line(X, [0.5, 3.0]) + np.random.default_rng(5).normal(0, 0.05, X.size)
    point = estimate(line_problem(y, priors), method, tolerance=1e-10)
    expected = np.polynomial.polynomial.polyfit(X, y, 1)
    # MVE's steps shrink like 1/i, so it stops a little early and says so
    np.testing.assert_allclose(point.theta, expected, rtol=2e-2 if method == "mve" else 1e-7)


def test_batches_and_the_posterior_density_know_the_ties(priors):
    y = line(X, [0.8, 2.2]) + np.random.default_rng(6).normal(0, 0.3, X.size)
    problem = line_problem(y, priors)
    alone = estimate(problem, "be", tolerance=1e-10)
    together = estimate_many(problem, [y], "be", tolerance=1e-10)
    np.testing.assert_allclose(together.theta[0], alone.theta, rtol=1e-8)
    density = LogDensity(problem)
    here, away = np.append(alone.theta, np.log(alone.variance)), np.array([0.02, -0.03, 0.0])
    value, _ = density(np.array([here, here + away, here - away]))
    assert value[0] == max(value)  # the mode that BE found is the density's


def test_bounds_hold_in_density_and_draws():
    bounds = [(0.9, np.inf), (-np.inf, 2.1)]
    joint = JointNormal.of(["level", "slope"], MEAN, COVARIANCE, bounds)
    priors = [joint.prior("level"), joint.prior("slope")]
    assert priors[0].support == (0.9, np.inf)
    assert log_density_of(priors, np.array([[0.8, 2.0]]))[0] == -np.inf
    draws = sample_of(priors, np.random.default_rng(2), 500)
    assert (draws[:, 0] >= 0.9).all()
    assert (draws[:, 1] <= 2.1).all()


def test_draws_are_condensed_and_widened():
    draws = np.random.default_rng(3).multivariate_normal(MEAN, COVARIANCE, 5000)
    joint = JointNormal.from_draws(["level", "slope"], draws)
    np.testing.assert_allclose(joint.covariance, np.cov(draws.T))
    assert joint.widened(2.0).prior("level").sd == pytest.approx(2 * joint.prior("level").sd)


@pytest.mark.parametrize(
    ("mean", "covariance", "message"),
    [
        (MEAN, [[1.0, 1.0], [1.0, 1.0]], "must be positive definite.*leave out a parameter"),
        (MEAN, [[1.0, 0.0], [0.0, np.nan]], "finite numbers and positive variances"),
        (MEAN[:1], COVARIANCE, "disagree"),
    ],
)
def test_what_is_no_density_is_refused(mean, covariance, message):
    with pytest.raises(ModelError, match=message):
        JointNormal.of(["level", "slope"], mean, covariance)


def test_a_name_it_does_not_have_is_named(joint):
    with pytest.raises(ModelError, match=r"not in the joint prior.*level, slope"):
        joint.prior("curve")


@pytest.fixture
def spring():
    return Model(
        "spring",
        inputs={"displacement": "m"},
        parameters={
            "level": Parameter(1.0, "N", sd=1.0),
            "slope": Parameter(2.0, "N/m", fixed=True),
            "offset": Parameter(0.0, "N", sd=1.0, by_run=True),
        },
        outputs={"force": Output("level + slope*displacement + offset", unit="N")},
    )


def test_an_earlier_campaign_is_the_prior_of_a_model(spring, joint):
    later = with_joint_prior(spring, joint)
    assert later.estimated() == ("level", "slope", "offset")
    assert [later.parameters[name].value for name in joint.names] == list(joint.mean)
    members = [later.parameters[name].prior for name in joint.names]
    away = MEAN + np.array([0.1, -0.2])
    expected = multivariate_normal(joint.mean, joint.covariance)
    fall = log_density_of(members, [away])[0] - log_density_of(members, [joint.mean])[0]
    assert fall == pytest.approx(expected.logpdf(away) - expected.logpdf(joint.mean))
    assert later.parameters["offset"] == spring.parameters["offset"]


@pytest.mark.parametrize(
    ("name", "message"),
    [("mass", r"no such parameter.*level"), ("offset", r"by run.*leave it out")],
)
def test_a_parameter_without_an_earlier_value_is_named(spring, name, message):
    with pytest.raises(ModelError, match=message):
        with_joint_prior(spring, JointNormal.of([name], [1.0], [[1.0]]))
