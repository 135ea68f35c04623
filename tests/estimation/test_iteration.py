"""What the loop promises whatever the problem: it never ends worse, outside or by raising."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from bayesoleo.errors import InputError
from bayesoleo.estimation import METHODS, FunctionProblem, estimate, multistart
from bayesoleo.model._priors import Normal, TruncatedNormal, Uniform
from bayesoleo.solvers._orbit import Status

TIME = np.linspace(0.0, 3.0, 60)


def decay(x, theta):
    return theta[0] * np.exp(-theta[1] * x)


def decay_problem(priors, start=None, unit=1.0, seed=4):
    """A decay whose rate is expressed in any unit: rate[unit] = rate / unit."""
    y = decay(TIME, [2.0, 1.5]) + np.random.default_rng(seed).normal(0.0, 0.05, TIME.size)
    return FunctionProblem(
        lambda x, t: decay(x, [t[0], t[1] * unit]), TIME, y, priors, ["height", "rate"], start
    )


@settings(deadline=None, max_examples=25)
@given(decades=st.floats(-12, 12), method=st.sampled_from(["be", "mve", "mmve", "mbe"]))
def test_the_unit_of_a_parameter_does_not_matter(decades, method):
    unit = 10.0**decades
    plain = estimate(decay_problem([Normal(1, 1), Normal(1, 1)]), method)
    other = estimate(decay_problem([Normal(1, 1), Normal(1 / unit, 1 / unit)], unit=unit), method)
    assert other.iterations == plain.iterations
    # differences of the two runs are rounding, 1e-16, amplified by the derivative step of 1e-3
    np.testing.assert_allclose(other.theta * [1, unit], plain.theta, rtol=1e-9)
    np.testing.assert_allclose(other.sd * [1, unit], plain.sd, rtol=1e-7)


@pytest.mark.slow
@settings(deadline=None, max_examples=40)
@example(start=(-6.8e-162, 0.0), method="gauss-newton")  # the rate's variance is beyond all numbers
@given(
    start=st.tuples(st.floats(-20, 20), st.floats(-4, 20)),
    method=st.sampled_from(sorted(METHODS)),
)
def test_an_estimate_is_never_worse_than_its_start(start, method):
    point = estimate(decay_problem([Normal(1, 3), Normal(1, 3)]), method, start=start)
    # a step within rounding, 1e-13 a sample, is not worse
    assert (np.diff(point.history_objective) >= -1e-10).all()
    assert np.isfinite(point.theta).all()
    np.testing.assert_array_equal(point.history[0], start)
    np.testing.assert_array_equal(point.history[-1], point.theta)


@pytest.mark.parametrize("method", ["be", "mbe", "mmve", "levenberg-marquardt"])
def test_an_estimate_stays_inside_the_support_and_names_the_limit(method):
    priors = [Normal(1, 1), Uniform(0.0, 1.2)]  # the truth, 1.5, is outside
    point = estimate(decay_problem(priors), method)
    assert point.status is Status.CONVERGED
    assert point.on_limit == ("rate",)
    assert (point.history[:, 1] <= 1.2).all()
    # the other unknown is at its optimum given the limit
    shape = np.exp(-point["rate"] * TIME)
    y = decay_problem(priors).evaluate(np.zeros(2)).residual[0]
    expected = shape @ y / (shape @ shape)
    if method == "be":  # the normal prior of the height pulls towards one
        weight = shape @ shape / point.variance[0]
        expected = (weight * expected + 1.0) / (weight + 1.0)
    assert point["height"] == pytest.approx(expected, rel=1e-6)


def test_a_step_into_failure_is_halved():
    def root(x, theta):
        return np.sqrt(theta[0] - x)  # not a number for theta < 3

    y = root(TIME, [3.05])
    problem = FunctionProblem(root, TIME, y, [Normal(10.0, 100.0)], jacobian=None)
    point = estimate(problem, tolerance=1e-8, max_iterations=200)
    assert point.halvings > 0
    assert point.status is Status.CONVERGED
    assert point.theta[0] == pytest.approx(3.05, rel=1e-6)


def test_a_start_that_cannot_be_evaluated_is_a_status():
    problem = FunctionProblem(lambda x, t: np.log(t[0]) + x, TIME, TIME, [Normal(-1.0, 1.0)])
    point = estimate(problem)
    assert point.status is Status.NOT_FINITE
    assert point.iterations == 0
    assert np.isnan(point.covariance).all()
    assert "not finite" in str(point)


def test_an_unknown_without_effect_keeps_its_prior():
    problem = FunctionProblem(
        lambda x, t: t[0] * x, TIME, 2 * TIME + np.cos(9 * TIME), [Normal(1, 1), Normal(5, 0.5)]
    )
    point = estimate(problem)
    assert point.status is Status.CONVERGED
    assert point.theta[1] == 5.0
    assert point.sd[1] == pytest.approx(0.5)
    # what is known of the other one does not suffer
    np.testing.assert_array_equal(
        np.isnan(point.covariance_likelihood), [[False, True], [True] * 2]
    )
    assert point.notes == ["the data say nothing of theta2: what is known beyond is the prior's"]


def test_a_product_is_not_taken_apart():
    """Only a*b is determined: rounding must not pass for a standard deviation of its factors."""
    y = 2 * TIME + 1 + 0.1 * np.cos(9 * TIME)
    priors = [Normal(1.0, 1.0), Normal(1.0, 1e6), Normal(0.0, 1.0)]
    problem = FunctionProblem(lambda x, t: t[0] * t[1] * x + t[2], TIME, y, priors, ["a", "b", "c"])
    point = estimate(problem)
    assert point.undetermined == ("a", "b")
    assert "the data do not determine a, b, at most combinations of these" in str(point)
    line = estimate(FunctionProblem(lambda x, t: t[0] * x + t[1], TIME, y, priors[1:], ["ab", "c"]))
    assert line.undetermined == ()
    np.testing.assert_allclose(
        point.covariance_likelihood[2, 2], line.covariance_likelihood[1, 1], rtol=1e-6
    )


def test_without_a_prior_what_is_open_has_no_standard_deviation():
    y = 2 * TIME + 0.1 * np.cos(9 * TIME)
    priors = [Normal(1.0, 1.0), Normal(1.0, 1.0)]
    problem = FunctionProblem(lambda x, t: t[0] * t[1] * x, TIME, y, priors, ["a", "b"])
    point = estimate(problem, "levenberg-marquardt", objective="unweighted")
    assert np.isnan(point.sd).all()
    assert point.notes[0].endswith("(see principal_axes): there is no standard deviation")


def test_a_fit_to_the_last_digit_is_said_to_be_one():
    y = decay(TIME, [2.0, 1.5])
    priors = [Normal(1, 1), Normal(1, 1)]
    exact = estimate(FunctionProblem(decay, TIME, y, priors))
    assert exact.exact == ("y",)
    assert "standard deviations mean nothing" in str(exact)
    # six digits as in a file are noise like any other
    assert estimate(FunctionProblem(decay, TIME, np.round(y, 6), priors)).notes == []


def test_exact_data_do_not_break_the_staged_variance():
    y = decay(TIME, [2.0, 1.5])
    problem = FunctionProblem(decay, TIME, y, [Normal(1, 1), Normal(1, 1)])
    point = estimate(problem)
    np.testing.assert_allclose(point.theta, [2.0, 1.5], rtol=1e-9)
    assert np.isfinite(point.objective)


def test_too_few_iterations_are_reported():
    point = estimate(decay_problem([Normal(1, 1), Normal(1, 1)]), max_iterations=2)
    assert point.status is Status.NO_CONVERGENCE
    assert point.iterations == 2


def test_progress_sees_every_iteration():
    seen = []
    point = estimate(decay_problem([Normal(1, 1), Normal(1, 1)]), progress=seen.append)
    assert [line.number for line in seen] == list(range(point.iterations + 1))
    np.testing.assert_array_equal([line.theta for line in seen], point.history)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "quasi"}, r"there is no such estimator .got 'quasi'.; use be, mve, mmve"),
        ({"start": [1.0]}, "one finite number per unknown.*height, rate"),
        ({"start": [1.0, np.nan]}, "one finite number per unknown"),
        ({"start": [1.0, -1.0]}, "key rate: start lies outside.*use a value between 0 and 4"),
    ],
)
def test_bad_input_says_what_to_write(options, message):
    problem = decay_problem([Normal(1, 1), TruncatedNormal(1, 1, 0, 4)])
    with pytest.raises(InputError, match=message):
        estimate(problem, **options)


def test_a_bias_correction_needs_samples():
    problem = FunctionProblem(lambda x, t: t[0] * x, TIME[:1], [1.0], [Normal(1, 1)])
    with pytest.raises(InputError, match="too few samples"):
        estimate(problem, bias_corrected=True)


def test_drawing_starts_needs_a_generator():
    with pytest.raises(InputError, match=r"needs a generator.*default_rng"):
        multistart(decay_problem([Normal(1, 1), Normal(1, 1)]), 2)


def test_given_starts_are_used_in_any_number_of_threads():
    problem = decay_problem([Normal(1, 1), Normal(1, 1)])
    starts = [[0.5, 0.5], [3.0, 2.0]]
    one, two = multistart(problem, starts), multistart(problem, starts, jobs=2)
    assert len(one) == len(two) == 1
    assert one.hits == two.hits == (6,)
    np.testing.assert_array_equal(one[0].theta, two[0].theta)


def misfit_problem(curvature):
    """Two groups, the second of which the model misses by more than one: Gauss-Newton overshoots.

    The sum of squares has ``1 + 2 k (1 + k t^2)/(1 + 4 k^2 t^2)`` times the curvature that the
    sensitivities show, with ``k`` the curvature given.
    """
    group = np.repeat([0.0, 1.0], 50)
    noise = np.random.default_rng(0).normal(0.0, 0.01, group.size)
    return FunctionProblem(
        lambda x, t: np.where(x < 0.5, t[0], 1 + curvature * t[0] ** 2),
        group,
        np.where(group < 0.5, 0.3, 0.0) + noise,
        [Normal(0.0, 100.0)],
        start=[0.8],
    )


@pytest.mark.parametrize("method", ["be", "mbe", "mmve", "gauss-newton", "levenberg-marquardt"])
@pytest.mark.parametrize("curvature", [0.3, 0.45, 0.49])
def test_overshooting_steps_are_shortened(method, curvature):
    point = estimate(misfit_problem(curvature), method)
    assert point.status is Status.CONVERGED
    # undamped, a curvature of 0.49 leaves 0.93 of the error in each iteration
    assert point.iterations <= 8
    first, second = misfit_problem(curvature).evaluate(point.theta).residual[0].reshape(2, 50)
    slope = first.sum() + 2 * curvature * point.theta[0] * second.sum()
    # the wide prior of BE moves the optimum by 1e-7
    assert slope / 50 == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("method", ["mbe", "gauss-newton"])
def test_small_steps_that_overshoot_a_little_are_shortened_too(method):
    """A sensitivity of seven eighths leaves -1/7 of the error: a tenth is noticed, nearby."""
    x, y = np.ones(50), np.random.default_rng(1).normal(1.0, 5.0, 50)
    problem = FunctionProblem(
        lambda x, t: t[0] * x, x, y, [Normal(0.0, 1e4)], start=[y.mean() + 0.5],
        jacobian=lambda x, _: 7 / 8 * x[:, None],
    )  # fmt: skip
    point = estimate(problem, method, tolerance=1e-10)
    assert point.status is Status.CONVERGED
    # one by one, 0.7 standard deviations fall to the tolerance in 12 iterations
    assert point.iterations <= 5
    assert point.theta[0] == pytest.approx(y.mean(), abs=1e-9)


@pytest.mark.parametrize("method", ["mbe", "gauss-newton"])
def test_creeping_steps_are_lengthened(method):
    """A sensitivity four times too large leaves 3/4 of the error in each iteration."""
    y = np.random.default_rng(1).normal(1.0, 5.0, 50)
    problem = FunctionProblem(
        lambda x, t: t[0] * x,
        np.ones(50),
        y,
        [Normal(0.0, 100.0)],
        start=[30.0],
        jacobian=lambda x, _: 4 * x[:, None],
    )
    point = estimate(problem, method)
    assert point.status is Status.CONVERGED
    # one by one, 40 standard deviations fall to the tolerance in 61 iterations
    assert point.iterations < 10
    assert point.theta[0] == pytest.approx(y.mean(), abs=1e-6)


@pytest.mark.parametrize("method", ["mbe", "gauss-newton"])
def test_slow_steps_that_gain_nothing_are_convergence(method):
    """Sensitivities turned by 45 degrees lead to the optimum along a spiral, 0.72 a step."""
    y = np.random.default_rng(1).normal(1.0, 5.0, 100)
    each = np.repeat(np.eye(2), 50, axis=0)
    turned = 1.2 * each @ np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2)
    problem = FunctionProblem(
        lambda x, t: each @ t,
        np.arange(100),
        y,
        [Normal(0.0, 100.0)] * 2,
        start=[20.0, 20.0],
        jacobian=lambda *_: turned,
    )
    best = y.reshape(2, 50).mean(axis=1)
    point = estimate(problem, method, tolerance=1e-6)
    assert point.status is Status.CONVERGED
    # 40 standard deviations, 0.7 each, fall to 0.001 in 33 iterations, and to the tolerance in 53
    assert 30 < point.iterations < 45
    np.testing.assert_allclose(point.theta, best, atol=1e-3)
    strict = estimate(problem, method, tolerance=1e-9, max_iterations=200)
    assert strict.status is Status.CONVERGED
    np.testing.assert_allclose(strict.theta, best, atol=1e-6)


def test_a_step_is_not_shortened_below_what_is_to_be_resolved():
    # Towards the jump the likelihood falls however short a step is, and its slope says it rises.
    def jump(x, t):
        return t[0] * x - (5.0 if t[0] > 1.0 else 0.0)

    problem = FunctionProblem(
        jump, TIME, 3.0 * TIME + 0.01 * np.sin(9 * TIME), [Normal(1.0, 5.0)],
        jacobian=lambda x, t: x[:, None],
    )  # fmt: skip
    patient = estimate(problem, "be", start=[1.0])
    resolved = estimate(problem, "be", start=[1.0], resolution=1e-3)
    assert resolved.theta == pytest.approx(patient.theta)
    assert not resolved.status.ok
    assert resolved.evaluations < patient.evaluations / 2


@pytest.mark.parametrize(
    ("away", "resolution", "status"),
    [
        (0.02, 1e-3, Status.CONVERGED),
        (0.05, 1e-3, Status.NO_CONVERGENCE),
        (0.02, 0.0, Status.NO_CONVERGENCE),  # who names no resolution gets certified digits
    ],
)
def test_a_start_that_scatter_hides_from_every_step_has_converged_if_it_is_near(
    away, resolution, status
):
    """Any other solution has an error that costs more than the optimum would gain."""
    y = np.random.default_rng(1).normal(1.0, 5.0, 50)
    best, sd = y.mean(), y.std() / np.sqrt(y.size)
    start = best + away * sd
    # The optimum gains away**2 / 2, at most 1.3e-3; the sum of squares grows by 2e-4 of itself, of
    # which the log likelihood falls by N/2 times as much, 5e-3.
    scatter = 1e-4 * (y - best)
    problem = FunctionProblem(
        lambda x, t: t[0] * x - (0.0 if t[0] == start else scatter),
        np.ones(y.size), y, [Normal(0.0, 1e4)], start=[start],
        jacobian=lambda x, _: x[:, None],
    )  # fmt: skip
    point = estimate(problem, "mbe", resolution=resolution)
    assert point.status is status
    assert point.theta[0] == start


def test_an_unknown_of_value_zero_is_known_by_its_standard_deviation():
    """Each step leaves an eighth of the error: against the value none would ever be small."""
    y = np.concatenate([np.full(25, 1.0), np.full(25, -1.0)])
    problem = FunctionProblem(
        lambda x, t: t[0] * x, np.ones(50), y, [Normal(0.0, 1e4)], start=[0.5],
        jacobian=lambda x, _: 9 / 8 * x[:, None],
    )  # fmt: skip
    point = estimate(problem, "mbe", tolerance=1e-4)
    assert point.status is Status.CONVERGED
    # 3.5 standard deviations, an eighth each, fall to the tolerance in five iterations.
    assert point.iterations <= 7
    assert abs(point.theta[0]) < 1e-4


@pytest.mark.parametrize("method", ["mbe", "be"])
def test_a_limit_is_reached_however_loose_the_tolerance(method):
    """Steps towards it become small because it cuts them, not because the optimum is near."""
    problem = decay_problem([Normal(1, 1), Uniform(0.0, 1.2)])
    point = estimate(problem, method, tolerance=0.05)
    assert point.on_limit == ("rate",)
    assert point["rate"] == pytest.approx(1.2, abs=1e-8)
