"""Priors agree with SciPy's distributions, and stay exact where differences of them cancel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from bayesoleo.errors import ModelError
from bayesoleo.model import LogNormal, Normal, Parameter, Prior, TruncatedNormal, Uniform

CENTRE = st.floats(-50.0, 50.0)
SPREAD = st.floats(0.01, 100.0)
LEVELS = np.array([1e-6, 0.01, 0.2, 0.5, 0.9, 0.999])


def agree(prior, reference, tolerance=1e-10):
    """Same moments, support and density, at quantiles and outside."""
    assert isinstance(prior, Prior)
    assert prior.mean == pytest.approx(reference.mean(), rel=tolerance, abs=tolerance * prior.sd)
    assert prior.sd == pytest.approx(reference.std(), rel=tolerance)
    np.testing.assert_allclose(prior.support, reference.support(), rtol=1e-12)
    low, high = prior.support
    values = np.append(reference.ppf(LEVELS), [low - 1.0, high + 1.0])
    density = prior.log_density(values)
    np.testing.assert_allclose(density, reference.logpdf(values), rtol=1e-9, atol=1e-9)
    assert float(prior.log_density(values[2])) == density[2]
    np.testing.assert_array_equal(prior.log_density(values[:6].reshape(2, 3)).ravel(), density[:6])


@given(centre=CENTRE, spread=SPREAD)
def test_normal(centre, spread):
    agree(Normal(centre, spread), stats.norm(centre, spread))


@given(low=CENTRE, width=SPREAD)
def test_uniform(low, width):
    agree(Uniform(low, low + width), stats.uniform(low, width))


@given(median=SPREAD, spread=st.floats(0.01, 2.0))
def test_log_normal(median, spread):
    agree(LogNormal(median, spread), stats.lognorm(spread, scale=median))


@settings(deadline=None)
@given(
    centre=CENTRE,
    spread=SPREAD,
    low=st.floats(-6.0, 6.0),
    width=st.floats(0.1, 10.0) | st.just(np.inf),
    flipped=st.booleans(),
)
def test_truncated_normal(centre, spread, low, width, flipped):
    a, b = (-low - width, -low) if flipped else (low, low + width)
    prior = TruncatedNormal(centre, spread, centre + a * spread, centre + b * spread)
    # SciPy's own variance is a difference that loses the digits of sd**2/spread**2 or more
    agree(prior, stats.truncnorm(a, b, centre, spread), 1e-7)


@pytest.mark.parametrize("spread", [1e-9, 1.0, 1e7])
def test_half_normal(spread):
    prior = TruncatedNormal(0.0, spread, 0.0)
    agree(prior, stats.halfnorm(0.0, spread), 1e-13)


@pytest.mark.parametrize("tail", [1e3, 1e6, 1e9])
def test_far_tail_is_exponential(tail):
    """Asymptotically, mean and sd of the excess are the spread over the tail's distance."""
    prior = TruncatedNormal(-tail, 1.0, 0.0)
    assert prior.mean == pytest.approx(1 / tail, rel=3 / tail**2 + 1e-13)
    assert prior.sd == pytest.approx(1 / tail, rel=4 / tail**2 + 1e-13)
    assert prior.log_density(2 / tail) == pytest.approx(np.log(tail) - 2, rel=3 / tail**2 + 1e-13)
    drawn = prior.sample(np.random.default_rng(0), 4000)
    assert (drawn >= 0).all()
    if tail < 1e9:  # beyond, the logarithm of the distribution function has no digits left for it
        assert np.mean(drawn) * tail == pytest.approx(1, abs=4 / np.sqrt(4000))


@pytest.mark.parametrize("width", [1e-3, 1e-6, 1e-9])
def test_narrow_interval_is_uniform(width):
    prior = TruncatedNormal(0.0, 1.0, 2.0, 2.0 + width)
    # the density varies by 2 width over the interval; bounds are rounded by 4e-16
    assert prior.sd == pytest.approx((prior.high - prior.low) / np.sqrt(12), rel=width**2 + 1e-12)
    assert prior.log_density(2.0) == pytest.approx(-np.log(prior.high - prior.low), abs=2 * width)


@pytest.mark.parametrize(
    "prior",
    [
        Normal(3.0, 2.0),
        Uniform(-1.0, 4.0),
        LogNormal(2.0, 0.5),
        TruncatedNormal(3400.0, 1700.0, 100.0, 1e5),
        TruncatedNormal(0.0, 1.0, 3.0),
        TruncatedNormal(0.0, 1.0, -7.0, -6.0),
    ],
)
def test_draws_follow_the_density(prior):
    drawn = prior.sample(np.random.default_rng(5), 20000)
    assert drawn.shape == (20000,)
    assert np.isfinite(prior.log_density(drawn)).all()
    # four standard errors of a mean, and of a sd with a kurtosis up to nine
    assert np.mean(drawn) == pytest.approx(prior.mean, abs=4 * prior.sd / np.sqrt(20000))
    assert np.std(drawn) == pytest.approx(prior.sd, rel=4 * np.sqrt(2 / 20000))
    np.testing.assert_array_equal(drawn, prior.sample(np.random.default_rng(5), 20000))


@pytest.mark.parametrize("prior", [Normal(1, 2), Uniform(0, 2), LogNormal(1, 1)])
def test_what_is_not_a_number_stays_so(prior):
    assert np.isnan(prior.log_density(np.nan))
    assert prior.log_density(np.inf) == -np.inf
    assert prior.log_density(-1e300) == -np.inf or isinstance(prior, Normal)


def test_values_a_truncation_excludes():
    prior = TruncatedNormal(0.0, 1.0, 0.0)
    density = prior.log_density([-1e-300, 0.0, 1e200, np.inf, np.nan])
    assert density[1] == pytest.approx(0.5 * np.log(2 / np.pi))
    np.testing.assert_array_equal(density[[0, 2, 3]], -np.inf)
    assert np.isnan(density[4])


def test_priors_are_values():
    prior = TruncatedNormal(1.0, 2.0, 0.0)
    twin = TruncatedNormal(1.0, 2.0, 0.0)
    assert prior.mean > 1.0  # moments are remembered, and are no part of the value
    assert prior == twin
    assert hash(prior) == hash(twin)
    assert Normal.band(1.0, 2.0).sd == pytest.approx(2.0 / stats.norm.ppf(0.995))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Normal(0.0, 0.0), "positive, finite standard deviation"),
        (lambda: Uniform(1.0, 1.0), "uniform prior needs low < high"),
        (lambda: LogNormal(-1.0, 1.0), "positive, finite median"),
        (lambda: LogNormal(1.0, np.inf), "positive, finite logarithmic standard deviation"),
        (lambda: TruncatedNormal(0.0, 1.0, 2.0, 1.0), "truncated prior needs low < high"),
        (lambda: Parameter(-1.0, sd=1.0, bounds=(0.0, 2.0)), "the bounds exclude the start"),
    ],
)
def test_a_prior_that_is_none(make, message):
    with pytest.raises(ModelError, match=message):
        make()
