"""Weighted draws against densities of known quantiles, and where they must not be believed."""

import numpy as np
import pytest
from posterior_targets import Banana, Gaussian
from scipy import stats

from bayesoleo.error_models._fitting import climb, derivatives
from bayesoleo.errors import InputError
from bayesoleo.posterior import Mixture, importance_sample
from bayesoleo.posterior._laplace import Weighted, _weights

TAILS = np.array([0.05, 0.5, 0.95])


def shifted(dimension: int, away: float, sd: float) -> Mixture:
    """A mixture of one component that is off by so much and so wide."""
    return Mixture(
        np.full((1, dimension), away), sd**2 * np.eye(dimension)[None], np.zeros(1), degrees=6.0
    )


def weighted_error(found, probability: float) -> float:
    """Standard error of a normal variable's quantile, in its standard deviations."""
    at = stats.norm.ppf(probability)
    spread = np.sqrt(probability * (1 - probability) / found.effective_size)
    return spread / stats.norm.pdf(at)


@pytest.mark.parametrize(("away", "sd"), [(0.0, 1.0), (0.7, 1.3), (-0.5, 0.8)])
def test_quantiles_are_the_target_s_whatever_was_proposed(away, sd):
    target = Gaussian([1.0, 3.0, 0.2])
    scale = np.diag(target.sd)
    start = shifted(3, away, sd)
    start = Mixture(start.centres @ scale, scale @ start.covariances @ scale, np.zeros(1))
    found = importance_sample(target, start, seed=1, effective_size=1500)
    assert found.reached
    assert found.evaluations == target.evaluations
    np.testing.assert_allclose(found.weights.sum(), 1)
    for probability, row in zip(TAILS, found.quantiles(TAILS), strict=True):
        exact = stats.norm.ppf(probability) * target.sd
        # Nine comparisons in three cases: four standard errors.
        error = 4 * weighted_error(found, probability) * target.sd
        assert (np.abs(row - exact) < error).all()


def test_adaptation_finds_a_curved_target():
    """Mean and variance of ``x1 = z + (x0^2 - 1) / 2`` are 0 and 1.5."""
    found = importance_sample(
        Banana(np.ones(2)), shifted(2, 0.0, 1.0), seed=2, effective_size=2000, rounds=10
    )
    assert found.reached
    mean = found.weights @ found.draws
    variance = found.weights @ (found.draws - mean) ** 2
    # x1 has a kurtosis of 9: four standard errors of a variance 1.5 from 2000 draws.
    np.testing.assert_allclose(mean, 0, atol=4 * np.sqrt(1.5 / 2000))
    np.testing.assert_allclose(variance, [1.0, 1.5], atol=4 * 1.5 * np.sqrt(8 / 2000))


def test_a_target_far_from_the_proposals_is_not_believed():
    """One in which the mixture has no draw at all."""
    found = importance_sample(
        Gaussian(np.full(12, 1e-3)), shifted(12, 0.3, 0.3), seed=3, rounds=2, draws=300
    )
    assert not found.reached
    assert found.effective_size < 100


def test_the_same_seed_gives_the_same_draws():
    pair = [
        importance_sample(Gaussian(np.ones(2)), shifted(2, 0.2, 1.1), seed=5, draws=200)
        for _ in range(2)
    ]
    assert np.array_equal(pair[0].draws, pair[1].draws)
    assert np.array_equal(pair[0].weights, pair[1].weights)


class Half(Gaussian):
    """Normal above zero, nothing below."""

    def __call__(self, phi):
        height, by_run = super().__call__(phi)
        height[phi[:, 0] < 0] = -np.inf
        return height, by_run


def test_draws_without_density_weigh_nothing():
    found = importance_sample(Half(np.ones(1)), shifted(1, 0.5, 1.0), seed=6, effective_size=1000)
    assert found.reached
    assert (found.weights[found.draws[:, 0] < 0] == 0).all()
    # Half-normal: mean sqrt(2 / pi), sd 0.6.
    mean = float(found.weights @ found.draws[:, 0])
    assert mean == pytest.approx(np.sqrt(2 / np.pi), abs=4 * 0.6 / np.sqrt(1000))


class Nowhere(Gaussian):
    """No density anywhere."""

    def __call__(self, phi):
        return np.full(len(phi), -np.inf), np.zeros((len(phi), 2))


def test_a_density_that_is_zero_everywhere_is_said_to_be():
    with pytest.raises(InputError, match="no draw has a finite log density"):
        importance_sample(Nowhere(np.ones(1)), shifted(1, 0.0, 1.0), seed=1)


def test_differences_of_a_quadratic_are_exact():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((4, 4))
    hessian, slope = -root @ root.T - np.eye(4), rng.standard_normal(4)
    at, factor = rng.standard_normal(4), np.tril(rng.standard_normal((4, 4))) + 2 * np.eye(4)
    value, gradient, curvature = derivatives(
        lambda x: x @ slope + 0.5 * np.einsum("wi,ij,wj->w", x, hessian, x), at, factor
    )
    assert value == pytest.approx(at @ slope + 0.5 * at @ hessian @ at)
    np.testing.assert_allclose(gradient, factor.T @ (slope + hessian @ at), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(curvature, factor.T @ hessian @ factor, rtol=1e-9, atol=1e-9)


def test_the_climb_takes_the_higher_of_two_tops():
    """Of two bumps, from starts beside both, one of them where the density is convex."""

    def height(rows):
        low = -np.sum((rows - 2.0) ** 2, axis=1)
        high = 0.5 - 4 * np.sum((rows + 1.5) ** 2, axis=1)
        return np.logaddexp(low, high)

    found = climb(height, [np.array([1.0, 3.0, 2.0]), np.array([-0.4, -1.0, -2.5])])
    np.testing.assert_allclose(found, -1.5, atol=0.02)


def test_a_draw_s_probability_is_the_middle_of_its_step():
    """Quantiles of a symmetric sample are symmetric, whatever its weights."""
    draws, weights = np.array([[-2.0], [-1.0], [1.0], [2.0]]), np.array([0.1, 0.4, 0.4, 0.1])
    found = Weighted(("x",), draws, weights, 3.0, 0.1, 4, True).quantiles([0.2, 0.5, 0.8])
    assert found[1, 0] == pytest.approx(0.0, abs=1e-12)
    assert found[0, 0] == pytest.approx(-found[2, 0])


def test_draws_of_all_rounds_have_the_mean_of_all_proposals():
    """The mixture of two far proposals, drawn from both: all draws weigh alike."""
    rng = np.random.default_rng(0)
    proposals = [shifted(1, away, 1.0) for away in (-8.0, 8.0)]
    phi = np.concatenate([one.sample(rng, 400) for one in proposals])
    height = np.logaddexp(*(one.log_density(phi) for one in proposals))
    height = height + 1e-6 * rng.standard_normal(800)  # of equal weights a tail has no shape
    weights, _ = _weights(proposals, phi, height)
    np.testing.assert_allclose(weights, 1 / 800, rtol=1e-4)
