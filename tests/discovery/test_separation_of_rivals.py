"""Separation of rival predictions against closed forms and against simulated outcomes."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy import stats

from bayesoleo.discovery._expected_information import (
    Component,
    PredictiveDistribution,
    entropy,
    in_common_directions,
    precision_gain,
    separate,
)

SIZE = 6


def rivals(rng, count, apart=1.0, unknown=3):
    return [
        PredictiveDistribution(
            apart * rng.standard_normal(SIZE), rng.standard_normal((unknown, SIZE))
        )
        for _ in range(count)
    ]


def density(item):
    return stats.multivariate_normal(item.mean, np.eye(SIZE) + item.spread.T @ item.spread)


def test_rivals_that_foresee_the_same_are_not_separated():
    one = rivals(np.random.default_rng(0), 1)[0]
    found = separate([one, one, one])
    assert found.information == pytest.approx(0.0, abs=1e-9)
    assert found.weakest == pytest.approx(0.0, abs=1e-5)


def test_with_all_parameters_known_it_is_the_distance_in_units_of_the_noise():
    nothing = np.zeros((0, SIZE))
    moved = np.array([3.0, 0, -4.0, 0, 0, 0])
    found = separate(
        [PredictiveDistribution(np.zeros(SIZE), nothing), PredictiveDistribution(moved, nothing)]
    )
    assert found.weakest == pytest.approx(5.0)
    assert found.log_bayes_factor[0, 1] == pytest.approx(12.5)


def test_a_difference_that_an_unknown_parameter_can_make_up_counts_no_more():
    known = np.zeros((1, SIZE))
    unknown = np.array([[100.0, 0, 0, 0, 0, 0]])
    moved = np.array([3.0, 0, 0, 0, 0, 0])
    sure = separate(
        [PredictiveDistribution(np.zeros(SIZE), known), PredictiveDistribution(moved, known)]
    )
    unsure = separate(
        [PredictiveDistribution(np.zeros(SIZE), unknown), PredictiveDistribution(moved, unknown)]
    )
    assert sure.weakest == pytest.approx(3.0)
    assert unsure.weakest < 0.05


def test_expected_log_bayes_factors_are_the_divergences_of_the_densities():
    """Against the dense formula with all directions kept."""
    found = rivals(np.random.default_rng(1), 3)
    separation = separate(found)
    for i, a in enumerate(found):
        for j, b in enumerate(found):
            S, T = density(a).cov, density(b).cov
            inverse, d = np.linalg.inv(T), a.mean - b.mean
            expected = 0.5 * (
                np.trace(inverse @ S)
                - SIZE
                + d @ inverse @ d
                + np.log(np.linalg.det(T) / np.linalg.det(S))
            )
            assert separation.log_bayes_factor[i, j] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("apart", [0.5, 2.0, 6.0])
def test_simulated_outcomes_tell_as_much_as_was_foreseen(apart):
    """Bayes factors of drawn data have the expected mean; what they say of which rival is true is
    no less than the bound, and no more than there is to know."""
    rng = np.random.default_rng(2)
    found, draws = rivals(rng, 3, apart), 20_000
    separation, surprise = separate(found), []
    for i, true in enumerate(found):
        outcome = density(true).rvs(draws, random_state=rng)
        logs = np.stack([density(item).logpdf(outcome) for item in found], axis=1)
        for j in range(3):
            factor = logs[:, i] - logs[:, j]
            error = factor.std() / np.sqrt(draws)
            # Five standard errors of the mean of this many draws, in nine comparisons.
            assert abs(factor.mean() - separation.log_bayes_factor[i, j]) < 5 * error + 1e-12
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        surprise.append(-np.log2(weights[:, i] / weights.sum(axis=1)))
    left, error = np.mean(surprise), np.std(surprise) / np.sqrt(3 * draws)
    information = np.log2(3) - left
    # 256 draws by rival know the information to a few parts in a hundred of what is open.
    assert separation.information == pytest.approx(information, abs=0.04 * np.log2(3) + 5 * error)


def test_order_of_rivals_does_not_matter():
    found = rivals(np.random.default_rng(3), 3)
    one, other = separate(found), separate(found[::-1])
    # The draws differ, so that the mean over 256 by rival does.
    assert one.information == pytest.approx(other.information, abs=0.05)
    np.testing.assert_allclose(one.sigma, other.sigma[::-1, ::-1], atol=1e-9)


@pytest.mark.parametrize("weights", [(0.5, 0.5), (0.9, 0.1), (0.97, 0.03)])
@pytest.mark.parametrize("distance", [0.3, 1.0, 3.0])
def test_information_of_two_known_predictions_is_the_integral(weights, distance):
    """In one direction, without unknown parameters, the mutual information is an integral."""
    nothing = np.zeros((0, SIZE))
    moved = np.zeros(SIZE)
    moved[2] = distance
    found = separate(
        [PredictiveDistribution(np.zeros(SIZE), nothing), PredictiveDistribution(moved, nothing)],
        weights,
    )
    y = np.linspace(-10, 10 + distance, 20_001)
    parts = np.array([stats.norm.pdf(y), stats.norm.pdf(y, distance)])
    mixture = np.array(weights) @ parts
    expected = sum(
        w * np.trapezoid(p * np.log2(np.maximum(p, 1e-300) / mixture), y)
        for w, p in zip(weights, parts, strict=True)
    )
    # A mean over 256 mirrored draws by rival; the bits that are open are known to two in a hundred.
    assert found.information == pytest.approx(expected, rel=0.2, abs=0.005)


def test_information_agrees_with_nested_monte_carlo():
    """Drawn outputs, the density of each rival itself a mean over draws of its parameters."""
    rng = np.random.default_rng(5)
    found, weights = rivals(rng, 3, 1.2, unknown=1), np.array([0.6, 0.3, 0.1])
    inner = np.array([item.mean for item in found])[:, None, :] + np.array(
        [rng.standard_normal((2000, 1)) @ item.spread for item in found]
    )
    total, outer = 0.0, 800
    for i, w in enumerate(weights):
        parameters = rng.standard_normal((outer, 1)) @ found[i].spread
        y = found[i].mean + parameters + rng.standard_normal((outer, SIZE))
        squares = np.sum(y**2, axis=1)[:, None, None] - 2 * np.einsum("on,kmn->okm", y, inner)
        logs = -0.5 * (squares + np.sum(inner**2, axis=2)[None])
        top = logs.max(axis=(1, 2))
        likelihood = np.exp(logs - top[:, None, None]).mean(axis=2)
        total += w * np.mean(np.log2(likelihood[:, i] / (likelihood @ weights)))
    # The scatter of 800 draws of a logarithm that varies by about one bit.
    assert separate(found, weights).information == pytest.approx(total, abs=0.12)


def test_information_lies_between_nothing_and_the_entropy_of_the_probabilities():
    rng, weights = np.random.default_rng(6), np.array([0.7, 0.2, 0.1])
    one = rivals(rng, 1)[0]
    assert separate([one, one, one], weights).information == pytest.approx(0.0, abs=1e-12)
    apart = [
        PredictiveDistribution(100.0 * k * np.ones(SIZE), np.zeros((0, SIZE))) for k in range(3)
    ]
    assert separate(apart, weights).information == pytest.approx(entropy(weights), abs=1e-9)
    assert entropy(weights) == pytest.approx(stats.entropy(weights, base=2))


def test_a_small_information_is_positive_and_quadratic_in_the_distance():
    nothing = np.zeros((0, SIZE))
    apart = [PredictiveDistribution(d * np.eye(SIZE)[0], nothing) for d in (0.0, 0.01, 0.02)]
    small = separate([apart[0], apart[1]]).information
    large = separate([apart[0], apart[2]]).information
    assert large == pytest.approx(4 * small, rel=1e-2)
    # For equal probabilities d^2 / 8 nats.
    assert small == pytest.approx(1e-4 / 8 / np.log(2), rel=0.2)


def test_gain_of_precision_is_that_of_a_linear_regression():
    """Against covariances computed by inverting information matrices."""
    rng = np.random.default_rng(7)
    J, root = rng.standard_normal((3, SIZE)), rng.standard_normal((3, 3))
    inputs = rng.standard_normal((2, SIZE))
    before = root.T @ root
    noise = np.eye(SIZE) + inputs.T @ inputs
    after = np.linalg.inv(np.linalg.inv(before) + J @ np.linalg.solve(noise, J.T))
    predicted = PredictiveDistribution(np.zeros(SIZE), np.concatenate([root @ J, inputs]), 3)
    for of in ([0, 1, 2], [0, 2], [1]):
        found = precision_gain(predicted, root, ["a", "b", "c"], of)
        pick = np.ix_(of, of)
        fall = np.log2(np.linalg.det(before[pick]) / np.linalg.det(after[pick])) / 2
        assert found.information == pytest.approx(fall, rel=1e-9)
        ratios = np.sqrt(np.diag(after) / np.diag(before))[of]
        np.testing.assert_allclose(list(found.ratio.values()), ratios, rtol=1e-9)


@pytest.mark.parametrize("size", [1e3, 1e6, 1e9])
def test_an_uncertainty_far_above_the_noise_leaves_the_noise(size):
    """Against the divergence in fifty digits: in doubles the sum of both loses the noise."""
    rng = np.random.default_rng(5)
    spreads = [size * rng.standard_normal((2, SIZE)) for _ in range(2)]
    moved = size * rng.standard_normal(SIZE)
    items = [
        PredictiveDistribution(np.zeros(SIZE), spreads[0]),
        PredictiveDistribution(moved, spreads[1]),
    ]
    found = separate(items).log_bayes_factor[0, 1]
    with mpmath.workdps(50):
        wide = [
            mpmath.eye(SIZE) + mpmath.matrix(a.tolist()).T * mpmath.matrix(a.tolist())
            for a in spreads
        ]
        away = mpmath.matrix(moved.tolist())
        inverse = wide[1] ** -1
        product = inverse * wide[0]
        trace = sum(product[k, k] for k in range(SIZE))
        logs = mpmath.log(mpmath.det(wide[1])) - mpmath.log(mpmath.det(wide[0]))
        expected = (trace + (away.T * inverse * away)[0] - SIZE + logs) / 2
    assert found == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("samples", [SIZE, 400])
def test_common_directions_separate_rivals_and_their_mixtures_as_all_samples_do(samples):
    rng = np.random.default_rng(2)
    direction = np.array([0.5, -0.2, 0.1])
    whole = [
        PredictiveDistribution(
            5.0 + rng.standard_normal(samples) / samples**0.5,
            rng.standard_normal((5, samples)) / samples**0.5,
            parameters=3,
        )
        for _ in range(3)
    ]

    def told(rivals):
        mixed = [
            Component(k, 0.5, one.given(direction, shift, ratio))
            for k, one in enumerate(rivals)
            for shift, ratio in ((-1.0, 0.5), (1.0, 2.0))
        ]
        return separate(rivals, [0.5, 0.3, 0.2], mixed)

    few = in_common_directions(whole)
    assert few[0].mean.size == min(samples, 3 + 3 * 5)
    expected, found = told(whole), told(few)
    np.testing.assert_allclose(found.log_bayes_factor, expected.log_bayes_factor, rtol=1e-9)
    # The same normal draws stand for other outcomes: both are means over a few hundred of them.
    assert found.information == pytest.approx(expected.information, rel=0.15)
