"""Unknowns with log-normal priors are stepped in their logarithm, and told in their own unit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from bayesoleo.error_models._independent import output_counts, sums_of_squares
from bayesoleo.errors import InputError
from bayesoleo.estimation import (
    METHODS,
    FunctionProblem,
    estimate,
    log_posterior,
    mode_covariance,
    polish,
)
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.model._priors import LogNormal, LogUniform, Normal
from bayesoleo.solvers._orbit import Status

VELOCITY = np.sin(np.linspace(0.0, 2 * np.pi, 200, endpoint=False))
TRUTH = np.array([60.0, 20.0])
NOISE = 2.0


def friction(velocity, theta):
    return theta[0] * np.arctan(theta[1] * velocity)


def friction_problem(median, start=None, unit=1.0, truth=TRUTH):
    """Friction whose slope is expressed in any unit: slope[unit] = slope / unit."""
    noise = np.random.default_rng(3).normal(0.0, NOISE, VELOCITY.size)
    return FunctionProblem(
        lambda v, t: friction(v, [t[0], t[1] * unit]),
        VELOCITY,
        friction(VELOCITY, truth) + noise,
        [Normal(60.0, 30.0), LogNormal(median / unit, 0.7)],
        ["base", "slope"],
        None if start is None else [60.0, start / unit],
    )


@settings(deadline=None, max_examples=25)
@given(decades=st.floats(-9, 9), method=st.sampled_from(sorted(METHODS)))
def test_the_unit_of_a_logarithm_does_not_matter(decades, method):
    unit = 10.0**decades
    plain = estimate(friction_problem(40.0), method)
    other = estimate(friction_problem(40.0, unit=unit), method)
    assert other.iterations == plain.iterations
    # differences of the two runs are rounding, 1e-16, amplified by the derivative step of 1e-3
    np.testing.assert_allclose(other.theta * [1, unit], plain.theta, rtol=1e-8)
    np.testing.assert_allclose(other.sd * [1, unit], plain.sd, rtol=1e-7)
    np.testing.assert_allclose(other.history * [1, unit], plain.history, rtol=1e-6)


@pytest.mark.parametrize("method", ["be", "mbe", "mmve", "gauss-newton", "levenberg-marquardt"])
@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_slope_started_a_decade_off_converges(method, factor):
    point = estimate(friction_problem(20.0 * factor, start=20.0 * factor), method)
    assert point.status is Status.CONVERGED
    assert point.iterations <= 15
    assert (point.history[:, 1] > 0).all()
    # five standard deviations; BE is pulled by a prior 3.3 of its own away
    assert abs(point["slope"] - 20.0) < 5 * point.sd[1]


@pytest.mark.parametrize("method", ["mbe", "gauss-newton"])
def test_a_step_goes_at_most_by_a_factor_of_six(method):
    point = estimate(friction_problem(20.0, start=2e4), method)
    factors = np.exp(np.abs(np.diff(np.log(point.history[:, 1]))))
    # 0.9 of a room of 2
    assert factors.max() <= np.exp(1.8) * (1 + 1e-9)
    assert point.status is Status.CONVERGED
    assert point["slope"] == pytest.approx(estimate(friction_problem(20.0))["slope"], rel=1e-5)


@pytest.mark.parametrize("median", [10.0, 20.0, 200.0])
def test_the_prior_does_not_move_the_maximum_likelihood_point(median):
    point = estimate(friction_problem(median, start=20.0), "mbe", tolerance=1e-9)
    reference = estimate(friction_problem(20.0), "levenberg-marquardt", tolerance=1e-12)
    np.testing.assert_allclose(point.theta, reference.theta, rtol=1e-7)


def objective(problem, augmented):
    """``Phi_B`` of the parameters in their own units and the log variance."""
    theta, variance = augmented[:2], np.exp(augmented[2:])
    sums = sums_of_squares(problem.evaluate(theta))
    return log_posterior(sums, variance, output_counts(problem.counts), problem.priors, theta)


def test_be_ends_in_the_mode_of_the_density_per_unit_of_the_parameter():
    problem = friction_problem(60.0)
    mode = polish(problem, estimate(problem), tolerance=1e-10)
    top = np.append(mode.theta, np.log(mode.variance))
    assert mode.status is Status.CONVERGED
    for index, sd in enumerate(mode.sd):
        step = np.eye(3)[index] * sd * 1e-3
        slope = (objective(problem, top + step) - objective(problem, top - step)) / 2e-3
        # slope per sd; second-order differences leave 1e-6 of the third derivative
        assert slope == pytest.approx(0.0, abs=1e-5)


def test_joint_covariance_is_the_inverse_hessian_in_the_parameters_own_unit():
    """Of a shift by the logarithm, so that Gauss-Newton leaves nothing out."""
    rng = np.random.default_rng(5)
    y = np.log(3.0) + rng.normal(0.0, 0.5, 12)
    prior = LogNormal(2.0, 0.4)
    problem = FunctionProblem(lambda x, t: np.log(t[0]) + 0 * y, None, y, [prior])
    mode = estimate(problem, "be", tolerance=1e-12)
    covariance = mode_covariance(problem, mode.theta)
    # in u = ln theta: quadratic, with the mode shifted by the density's unit
    weight, v = y.size / mode.variance[0], mode.variance[0]
    u = (weight * y.mean() + np.log(2.0) / 0.16 - 1) / (weight + 1 / 0.16)
    assert np.log(mode.theta[0]) == pytest.approx(u, abs=1e-9)
    cross = np.sum(y - u) / v
    hessian = np.array([[weight + 1 / 0.16, cross], [cross, y.size / 2]])
    chain = np.diag([mode.theta[0], 1.0])
    np.testing.assert_allclose(covariance, chain @ np.linalg.inv(hessian) @ chain, rtol=1e-7)
    assert mode.sd[0] == pytest.approx(mode.theta[0] / np.sqrt(weight + 1 / 0.16), rel=1e-7)


@pytest.mark.parametrize("method", ["mbe", "mmve", "gauss-newton", "levenberg-marquardt"])
def test_a_slope_without_optimum_ends_where_the_likelihood_is_level(method):
    """No sample lies where so steep a friction is not constant, so any steeper one fits as well."""
    problem = friction_problem(20.0, truth=np.array([60.0, 1e7]))
    point = estimate(problem, method)
    level = estimate(friction_problem(1e12, truth=np.array([60.0, 1e7])), "levenberg-marquardt")
    assert point.status is Status.CONVERGED
    assert np.isfinite(point.theta).all()
    assert point["slope"] > 0
    # nearer than 0.1 sd, 0.005 in the log likelihood, with as much for what is beyond one prior sd
    assert point.objective >= level.objective - 0.02


@pytest.mark.parametrize("start", [0.0, -1.0])
def test_a_start_without_logarithm_is_refused(start):
    with pytest.raises(InputError, match="key slope: start lies outside the prior's support"):
        estimate(friction_problem(20.0, start=start))


@pytest.mark.parametrize("value", [0.02, 0.3, 1.0, 4.0])
def test_a_prior_of_a_logarithm_is_a_parabola_about_any_value(value):
    """So steps that data ask for cost what the density says, however small the value is."""
    prior = LogNormal(1.0, 0.8)
    scale = PriorScale.of((prior, Normal(2.0, 3.0)), ("small", "other"))
    slope, precision = scale.quadratic(np.array([value, 5.0]))
    assert precision[0, 1] == 0.0
    for part in (-0.05, 0.05):
        step = np.array([part * value / scale.sd[0], 0.3])
        change = slope @ step - 0.5 * step @ precision @ step
        exact = prior.log_density(value * (1 + part)) - prior.log_density(value)
        exact += Normal(2.0, 3.0).log_density(5.9) - Normal(2.0, 3.0).log_density(5.0)
        # The third derivative over so small a step.
        assert change == pytest.approx(exact, abs=0.02)
    # A fall to nothing is no gain.
    step = np.array([-value / scale.sd[0], 0.0])
    assert slope @ step - 0.5 * step @ precision @ step < abs(np.log(value)) / 0.8**2 + 1.0


def test_what_is_flat_in_its_logarithm_does_not_pull_a_small_value_to_nothing():
    prior = LogUniform(1e-4, 1.0)
    scale = PriorScale.of((prior,), ("rate",))
    slope, precision = scale.quadratic(np.array([3e-4]))
    best = float(slope[0] / precision[0, 0]) * scale.sd[0] + 3e-4
    # The most that the parabola could gain is the square of a distance of 1.7 deviations at most.
    assert 0.5 * slope[0] ** 2 / precision[0, 0] < 0.5 * 3.0
    assert 3e-4 < best < 3e-3
