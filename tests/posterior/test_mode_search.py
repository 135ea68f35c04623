"""A sampler that starts in one of several modes finds the others, or there are none to be found."""

import numpy as np
import pytest
from posterior_gas_spring import gas_spring
from posterior_targets import Banana, Bimodal, Gaussian
from test_posterior_sample import grid

from bayesoleo.posterior import (
    LogDensity,
    Mixture,
    _mode_search as mode_search,
    laplace_mixture,
    sample,
)
from bayesoleo.posterior._mode_search import with_other_modes


def at_rest(dimension: int) -> Mixture:
    """One normal component at the origin."""
    return Mixture(np.zeros((1, dimension)), np.eye(dimension)[None], np.zeros(1))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
@pytest.mark.parametrize(
    ("dimension", "distance", "width"),
    [(1, 6.0, 1.0), (1, 40.0, 0.2), (2, 10.0, 0.5), (5, 12.0, 1.0), (5, 100.0, 3.0)],
)
def test_the_second_mode_is_found_with_its_weight(dimension, distance, width, share):
    target = Bimodal(dimension, distance, width, share, seed=3)
    samples = sample(target, at_rest(dimension), seed=1, progress=False)
    assert samples.reached
    there = np.mean(target.in_second(samples.draws))
    # Between modes this far apart nothing but the share matters, so its effective size is at least
    # the smallest; four standard errors of a fixed seed.
    error = np.sqrt(share * (1 - share) / samples.effective_size.min())
    assert there == pytest.approx(share, abs=4 * error)


def test_without_climbs_the_other_mode_stays_unknown():
    """What the search is for: everything says that all is well."""
    target = Bimodal(2, 60.0, 1.0, 0.5, seed=3)
    samples = sample(target, at_rest(2), seed=1, progress=False, climbs=0)
    assert samples.reached
    assert not target.in_second(samples.draws).any()


@pytest.mark.parametrize("target", [Gaussian(np.ones(4)), Banana(np.ones(4))])
def test_where_there_is_one_mode_nothing_changes(target):
    rng = np.random.default_rng(1)
    start = at_rest(4)
    mixture, rows = with_other_modes(target, start, 32, rng)
    assert mixture is start
    assert rows == target.evaluations
    # A thousand effective draws of four normal quantities take seven thousand rows, of the banana
    # more than ten times as many, and a bent valley is climbed in more steps.
    assert rows < (3000 if type(target) is Gaussian else 6000)


def test_draws_are_those_without_a_search_where_it_finds_nothing():
    searched = sample(Gaussian(np.ones(2)), at_rest(2), seed=4, progress=False)
    plain = sample(Gaussian(np.ones(2)), at_rest(2), seed=4, progress=False, climbs=0)
    assert searched.draws.tobytes() == plain.draws.tobytes()
    assert searched.evaluations > plain.evaluations


@pytest.mark.parametrize("start", [1.227, 1.04])
def test_a_posterior_started_in_either_mode_has_both(start):
    """A gas spring whose exponent is 1.04 or 1.23: by data and prior, both with a variance."""
    problem = gas_spring(relative_sd=0.01, seed=19)
    log_density = LogDensity(problem)
    mixture = laplace_mixture(log_density, np.array([[start]]))
    assert len(mixture.centres) == 1
    samples = sample(log_density, mixture, seed=3, effective_size=1000, progress=False)
    _, upper = grid(problem)
    error = np.sqrt(upper * (1 - upper) / samples.effective_size[0])
    assert samples.reached
    assert np.mean(samples.theta > 1.13) == pytest.approx(upper, abs=4 * error)


def test_a_mode_that_does_not_weigh_is_left_out():
    target = Bimodal(2, 12.0, 1.0, 1e-9, seed=3)
    start = at_rest(2)
    mixture, _ = with_other_modes(target, start, 32, np.random.default_rng(0))
    assert mixture is start


def test_heavier_modes_take_over():
    """The start is a mode of a ten-thousandth: the mixture says so, up to a floor."""
    target = Bimodal(2, 12.0, 1.0, 0.9999, seed=3)
    mixture, _ = with_other_modes(target, at_rest(2), 32, np.random.default_rng(0))
    assert len(mixture.centres) == 2
    np.testing.assert_allclose(mixture.centres[1], target.second, atol=0.05)
    # Covariances by differences over a quarter of a standard deviation are exact for a normal.
    np.testing.assert_allclose(mixture.covariances[1], np.eye(2), atol=1e-3)
    np.testing.assert_allclose(mixture.weights, [0.05, 0.95], atol=1e-6)


def test_a_search_is_bounded_by_the_evaluations_allowed():
    target = Gaussian(np.ones(3))
    samples = sample(target, at_rest(3), seed=1, progress=False, max_evaluations=6000)
    assert target.evaluations <= 6000
    assert samples.evaluations == target.evaluations


@pytest.mark.parametrize("most", [200, 1000, 5000])
def test_a_search_takes_no_more_than_its_share(most):
    """Climbs and Newton steps end before it is used up, and the highest places come first."""
    target = Bimodal(6, 12.0, 1.0, 0.5, seed=3)
    mixture, spent = with_other_modes(target, at_rest(6), 4, np.random.default_rng(0), most)
    assert spent == target.evaluations
    # What begins a search, a few points about the start, is always looked at.
    assert spent <= max(most, 250)
    assert len(mixture.centres) == (1 if most == 200 else 2)


def test_points_are_scattered_at_all_distances():
    target = Gaussian(np.ones(3))
    height = mode_search._Counted(target, np.zeros(3), np.eye(3), np.inf)
    rng = np.random.default_rng(2)
    y, values = mode_search._scattered(height, at_rest(3), 32, rng)
    distance = np.linalg.norm(y, axis=1)
    assert len(y) == 32
    np.testing.assert_allclose(values, -0.5 * distance**2)
    assert distance.min() < 2 * mode_search.NEAREST
    assert distance.max() > mode_search.FARTHEST / 2
