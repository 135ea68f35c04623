"""Scatter between few stretches: unbiased under white noise, right under slow noise."""

import numpy as np
import pytest
from scipy import stats

from bayesoleo.discovery._refit import clustered_variance

SAMPLES, STRETCHES, DRAWS = 240, 6, 3000


def regression():
    """Three columns; the last one acts at one end mostly, so that stretches differ."""
    t = np.linspace(0, 1, SAMPLES)
    return np.stack([np.ones(SAMPLES), np.sin(7 * t), t**4], axis=1)


def parts(noise):
    """Pulls on the last coefficient, sizes and overlap of a regression of noise (D, N)."""
    J = regression()
    inverse = np.linalg.inv(J.T @ J)
    influence = J @ inverse[2]
    residual = noise - noise @ J @ inverse @ J.T
    stretch = np.arange(SAMPLES) * STRETCHES // SAMPLES
    edges = np.flatnonzero(np.diff(stretch, prepend=-1))
    pulls = np.add.reduceat(influence * residual, edges, axis=-1)
    sizes = np.add.reduceat(influence**2, edges)
    mixed = np.add.reduceat(influence[:, None] * J, edges, axis=0)
    return pulls, sizes, mixed @ inverse @ mixed.T, noise @ influence


def test_unbiased_under_white_noise_with_the_stated_freedom():
    rng = np.random.default_rng(0)
    pulls, sizes, overlap, moved = parts(rng.standard_normal((DRAWS, SAMPLES)))
    variances = np.array([clustered_variance(row, sizes, overlap)[0] for row in pulls])
    freedom = clustered_variance(pulls[0], sizes, overlap)[1]
    assert np.mean(variances) == pytest.approx(sizes.sum(), rel=4 * np.sqrt(2 / freedom / DRAWS))
    assert np.var(moved) == pytest.approx(sizes.sum(), rel=0.1)
    # The plain sum of squared pulls is far too small: the fit has followed the noise.
    assert np.mean(np.sum(pulls**2, axis=1)) < 0.75 * sizes.sum()
    # The squares' own variance is what makes the degrees of freedom: fourth moments, loosely.
    assert 2 / (np.var(variances) / np.mean(variances) ** 2) == pytest.approx(freedom, rel=0.2)
    # At most the stretches beyond those that the three columns take.
    assert 1 < freedom < STRETCHES


def test_t_statistics_are_no_larger_than_they_say():
    """Studentised estimates exceed the 5 % point of t in five draws of a hundred at most.

    With two degrees of freedom Satterthwaite's variate has a longer tail than the true one.
    """
    rng = np.random.default_rng(1)
    pulls, sizes, overlap, moved = parts(rng.standard_normal((DRAWS, SAMPLES)))
    found = [clustered_variance(row, sizes, overlap) for row in pulls]
    t = np.array([m / np.sqrt(v) for m, (v, _) in zip(moved, found, strict=True)])
    beyond = np.mean(np.abs(t) > stats.t.isf(0.025, found[0][1]))
    assert 0.002 < beyond < 0.06
    # Taken as normal they exceed it far too often.
    assert np.mean(np.abs(t) > 1.96) > 0.08


def test_stretches_that_say_nothing():
    sizes = np.array([1.0, 1.0])
    assert clustered_variance(np.zeros(2), sizes, np.diag(sizes))[1] == 0.0
