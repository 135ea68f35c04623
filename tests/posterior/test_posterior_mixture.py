"""Student-t mixtures and the Laplace approximations that they are made of."""

from dataclasses import dataclass

import numpy as np
import pytest
from posterior_gas_spring import GasSpring, gas_spring, measured
from scipy import stats

from bayesoleo.errors import InputError
from bayesoleo.model._priors import LogNormal, Normal, Transforms
from bayesoleo.posterior import (
    LogDensity,
    Mixture,
    Mode,
    _laplace as laplace,
    find_mode,
    laplace_mixture,
)
from bayesoleo.posterior._laplace import gauss_newton_covariance, mixture_of
from bayesoleo.posterior._log_density import prior_curvature
from bayesoleo.posterior._mixture import DEGREES_OF_FREEDOM
from bayesoleo.solvers._orbit import Status


@pytest.fixture
def two() -> Mixture:
    covariances = np.array([[[1.0, 0.3], [0.3, 0.5]], [[0.1, 0.0], [0.0, 2.0]]])
    return Mixture(np.array([[0.0, 0.0], [4.0, 1.0]]), covariances, np.log([3.0, 1.0]))


def test_density_is_that_of_scipy(two):
    phi = np.random.default_rng(0).normal(size=(20, 2)) * 3
    parts = [
        stats.multivariate_t(centre, covariance, DEGREES_OF_FREEDOM).pdf(phi)
        for centre, covariance in zip(two.centres, two.covariances, strict=True)
    ]
    np.testing.assert_allclose(
        two.log_density(phi), np.log(0.75 * parts[0] + 0.25 * parts[1]), rtol=1e-12
    )


def test_draws_have_the_mixture_s_moments(two):
    draws = two.sample(np.random.default_rng(0), 200_000)
    mean = 0.75 * two.centres[0] + 0.25 * two.centres[1]
    # sd of a coordinate is below 2; 4 standard errors
    np.testing.assert_allclose(draws.mean(axis=0), mean, atol=4 * 2 / np.sqrt(200_000))


@pytest.mark.slow
def test_refitting_recovers_the_mixture(two):
    draws = two.sample(np.random.default_rng(0), 40_000)
    wrong = Mixture(two.centres + 0.5, 2 * two.covariances, np.zeros(2))
    fitted = wrong.refitted(draws, rounds=200)
    # 10 000 draws in the lighter component: 4 % is four standard errors of a variance.
    np.testing.assert_allclose(fitted.weights, [0.75, 0.25], atol=0.02)
    np.testing.assert_allclose(fitted.centres, two.centres, atol=0.06)
    np.testing.assert_allclose(fitted.covariances, two.covariances, rtol=0.06, atol=0.04)


def test_a_component_without_draws_keeps_its_shape_and_a_little_weight(two):
    draws = np.random.default_rng(0).normal(size=(500, 2)) * 0.1
    far = Mixture(np.add(two.centres, [[0, 0], [1e3, 0]]), two.covariances, two.log_weights)
    fitted = far.refitted(draws)
    np.testing.assert_allclose(fitted.covariances[1], two.covariances[1], rtol=1e-3, atol=1e-12)
    assert fitted.weights[1] == pytest.approx(0.02, rel=0.05)


def test_a_mixture_refuses_what_is_not_one():
    with pytest.raises(InputError, match="centres"):
        Mixture(np.zeros((1, 2)), np.eye(2), np.zeros(1))
    with pytest.raises(InputError, match="not positive definite"):
        Mixture(np.zeros((1, 2)), -np.eye(2)[None], np.zeros(1))


def test_the_mode_is_found_and_its_curvature():
    log_density = LogDensity(gas_spring(relative_sd=0.1, seed=1))
    mode = find_mode(log_density, np.array([1.15, -2.0]))
    assert mode.status is Status.CONVERGED
    around = mode.centre + 0.05 * np.sqrt(np.diag(mode.covariance)) * np.array(
        [[1, 0], [-1, 0], [0, 1], [0, -1]]
    )
    top, _ = log_density(mode.centre[None])
    assert np.all(log_density(around)[0] < top)
    # Verbeek (1993), Appendix A: at the mode the two blocks decouple but for the weak prior.
    approximate = gauss_newton_covariance(log_density, mode.centre)
    np.testing.assert_allclose(np.diag(mode.covariance), np.diag(approximate), rtol=0.03)


def test_both_modes_of_the_narrow_prior_are_components_once():
    log_density = LogDensity(gas_spring(relative_sd=0.01, seed=1))
    mixture = laplace_mixture(log_density, np.array([[1.227], [1.04], [1.22]]))
    np.testing.assert_allclose(sorted(mixture.centres[:, 0]), [1.0460, 1.2230], atol=1e-3)


def test_without_a_maximum_the_covariance_is_gauss_newton_s_and_says_so():
    @dataclass(frozen=True)
    class Saddle(GasSpring):
        def misfit(self, theta):
            fine = super().misfit(np.full_like(theta, 1.2))
            fine.sum_of_squares[:, 0, 0] -= 0.05 * (theta[:, 0] - 1.2) ** 2
            return fine

    log_density = LogDensity(Saddle(measured(1), Normal(1.2, 100.0)))
    mode = find_mode(log_density, np.array([1.2, -4.0]), iterations=1)
    assert mode.status is Status.SINGULAR
    assert np.all(np.linalg.eigvalsh(mode.covariance) > 0)


def test_a_start_that_cannot_be_evaluated_is_refused():
    @dataclass(frozen=True)
    class Nothing(GasSpring):
        def misfit(self, theta):
            fine = super().misfit(theta)
            fine.status[:] = Status.INADMISSIBLE
            return fine

    log_density = LogDensity(Nothing(measured(1), Normal(1.0, 0.1)))
    with pytest.raises(InputError, match="admissible"):
        laplace_mixture(log_density, np.array([[1.2]]))
    dead = Mode(np.zeros(2), np.eye(2), -np.inf, Status.NOT_FINITE)
    with pytest.raises(InputError, match="no mode"):
        mixture_of([dead])


def test_a_defended_mixture_is_nearly_normal_and_bounds_the_ratio_far_out(two):
    defended = two.defended()
    draws = np.random.default_rng(1).normal(size=(4000, 2)) * 3
    np.testing.assert_allclose(defended.weights.sum(), 1.0)
    parts = [
        share * weight * stats.multivariate_t(centre, covariance, degrees).pdf(draws)
        for share, degrees in ((0.9, 50.0), (0.1, 4.0))
        for weight, centre, covariance in zip(
            two.weights, two.centres, two.covariances, strict=True
        )
    ]
    np.testing.assert_allclose(defended.log_density(draws), np.log(np.sum(parts, axis=0)))
    # Along a ray the density of heavy tails falls like r^-(4 + 2).
    near, far = defended.log_density(np.array([[1e3, 0.0], [1e4, 0.0]]))
    assert near - far == pytest.approx(6 * np.log(10), rel=0.01)


def test_the_weight_of_tails_follows_the_draws(two):
    rng = np.random.default_rng(2)
    normal = rng.standard_normal((20_000, 2))
    heavy = normal / np.sqrt(rng.chisquare(3, size=20_000) / 3)[:, None]
    one = Mixture(np.zeros((1, 2)), np.eye(2)[None], np.zeros(1)).defended()
    assert one.refitted(normal, rounds=50).weights[1] < 0.05
    assert one.refitted(heavy, rounds=50).weights[1] > 0.3


def test_a_mode_a_hundred_standard_deviations_away_is_reached():
    log_density = LogDensity(gas_spring(relative_sd=0.1, seed=0))
    found = find_mode(log_density, np.array([1.05, -4.4]))
    near = find_mode(log_density, np.array([1.22, -4.4]))
    assert found.status is Status.CONVERGED
    assert (near.centre[0] - 1.05) / np.sqrt(near.covariance[0, 0]) > 100
    # Newton's method stops at steps of a thousandth of a standard deviation.
    off = (found.centre - near.centre) / np.sqrt(np.diag(near.covariance))
    np.testing.assert_allclose(off, 0.0, atol=2e-3)


def test_the_weight_of_a_normal_mode_is_its_integral(monkeypatch):
    """Laplace's approximation is exact there: of a density times e^3 the integral is e^3."""
    covariance = np.array([[2.0, 0.3, 0.0], [0.3, 0.5, 0.1], [0.0, 0.1, 0.05]])
    normal = stats.multivariate_normal([1.0, -2.0, 0.5], covariance)
    monkeypatch.setattr(laplace, "gauss_newton_covariance", lambda *_: 0.3 * np.eye(3))
    mode = find_mode(lambda rows: (normal.logpdf(rows) + 3.0, None), np.zeros(3))
    assert mode.status is Status.CONVERGED
    np.testing.assert_allclose(mode.covariance, covariance, rtol=1e-6, atol=1e-9)
    assert mode.log_weight == pytest.approx(3.0, abs=1e-6)


def test_modes_three_standard_deviations_apart_are_two():
    def at(place):
        return Mode(np.array([place]), np.eye(1), 0.0, Status.CONVERGED)

    assert len(mixture_of([at(0.0), at(3.0)]).centres) == 2
    assert len(mixture_of([at(0.0), at(0.3)]).centres) == 1


def test_the_curvature_of_a_normal_prior_is_its_precision():
    priors = [Normal(1.0, 2.0), LogNormal(3.0, 0.4)]
    found = prior_curvature(priors, Transforms.of(priors), np.array([0.3, np.log(2.0)]))
    # A log-normal prior is normal in the logarithm.
    np.testing.assert_allclose(found, [1 / 4, 1 / 0.16], rtol=1e-9)
