"""The band that uniform ranks stay inside, and ranks of posteriors that are right or wrong."""

import numpy as np
import pytest
from posterior_targets import Gaussian

from bayesoleo.posterior import Mixture, sample
from bayesoleo.posterior._comparison import DRAWS, rank_of, uniformity


def test_uniform_ranks_leave_the_band_as_often_as_they_should():
    rng = np.random.default_rng(0)
    outside = [not uniformity(rng.integers(0, DRAWS + 1, 300), seed=1).inside for _ in range(200)]
    # Binomial(200, 0.05): three standard deviations either side of ten.
    assert 1 <= sum(outside) <= 19


@pytest.mark.parametrize("width", [0.7, 1.4])
def test_posteriors_of_a_wrong_width_leave_it(width):
    rng = np.random.default_rng(1)
    truth = rng.standard_normal(1000)
    draws = width * rng.standard_normal((1000, DRAWS))
    ranks = np.sum(draws < truth[:, None], axis=1)
    found = uniformity(ranks)
    assert not found.inside
    assert found.p_value < 0.001
    assert found.difference.shape == found.low.shape == (DRAWS,)
    assert (found.low <= 0).all()
    assert (found.high >= 0).all()


def test_a_rank_counts_draws_below():
    mixture = Mixture(np.zeros((1, 1)), np.eye(1)[None], np.zeros(1))
    samples = sample(Gaussian(np.ones(1)), mixture, seed=1, quick=True, progress=False)
    rng = np.random.default_rng(0)
    assert rank_of(samples, [-9.0], rng) == 0
    assert rank_of(samples, [9.0], rng) == DRAWS
    assert abs(rank_of(samples, [0.0], rng)[0] - DRAWS / 2) < 20
