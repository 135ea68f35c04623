"""Autocorrelation, effective size and agreement of chains whose answers are known."""

import numpy as np
import pytest
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo.posterior import compare
from bayesoleo.posterior._diagnostics import (
    autocorrelation_time,
    effective_size,
    nested_rhat,
    rhat_limit,
)
from bayesoleo.posterior._sampler import Quality, Schedule


def autoregressive(coefficient: float, chains: int = 32, draws: int = 2000, seed: int = 0):
    """Stationary AR(1) chains, whose time is (1 + c) / (1 - c)."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((chains, draws)) * np.sqrt(1 - coefficient**2)
    out = np.empty((chains, draws))
    out[:, 0] = rng.standard_normal(chains)
    for t in range(1, draws):
        out[:, t] = coefficient * out[:, t - 1] + noise[:, t]
    return out[:, :, None]


@pytest.mark.parametrize("coefficient", [0.0, 0.5, 0.9])
def test_the_time_of_an_autoregression(coefficient):
    draws = autoregressive(coefficient)
    truth = (1 + coefficient) / (1 - coefficient)
    # Sokal: relative variance 2 (2 W + 1) / n with a window W of five times; four errors, and the
    # window cuts off exp(-5 * 2) and less.
    error = 4 * np.sqrt(2 * (10 * truth + 1) / draws.size)
    assert autocorrelation_time(draws)[0] == pytest.approx(truth, rel=error)
    # ArviZ's estimators differ by as much again.
    assert effective_size(draws)[0] == pytest.approx(draws.size / truth, rel=0.05 + 2 * error)


def test_walkers_that_stay_in_their_modes_count_as_correlated():
    draws = autoregressive(0.0, draws=200)
    draws[::2] += 20.0
    assert autocorrelation_time(draws)[0] > 50


def test_a_quantity_that_never_moves_has_no_size():
    draws = np.concatenate([autoregressive(0.0, draws=50), np.ones((32, 50, 1))], axis=2)
    assert np.isnan(autocorrelation_time(draws)[1])
    assert effective_size(draws)[1] == 0
    assert nested_rhat(draws, np.repeat(np.arange(4), 8))[1] == np.inf


def test_ensembles_that_disagree_are_noticed():
    draws = autoregressive(0.0, draws=200)
    ensemble = np.repeat(np.arange(4), 8)
    assert nested_rhat(draws, ensemble)[0] < rhat_limit(4, 1000)
    draws[:8] += 1.0
    assert nested_rhat(draws, ensemble)[0] > rhat_limit(4, 1000)


def test_a_point_beside_draws():
    rng = np.random.default_rng(0)
    theta = np.stack([rng.normal(3, 2, (8, 5000)), rng.exponential(1, (8, 5000))], axis=2)
    names = ["normal", "exponential"]
    drawn = {n: (("chain", "draw"), theta[..., k]) for k, n in enumerate(names)}
    point = xr.Dataset(
        {
            schema.ESTIMATE: ("parameter", [1.0, 1.0]),
            schema.COVARIANCE: (("parameter", "parameter_column"), np.diag([1.0, 0.25])),
        },
        coords={"parameter": names, "parameter_column": names},
    )
    comparison = compare({"posterior": xr.Dataset(drawn), "point": point})
    # 40 000 draws: errors 0.01, 0.007 and, for the exponential's skewness, about 0.06
    np.testing.assert_allclose(comparison["shift"], [2.0, 0.0], atol=0.05)
    np.testing.assert_allclose(comparison["sd_ratio"][0], [2.0, 2.0], atol=0.05)
    np.testing.assert_allclose(comparison["skewness"], [0.0, 2.0], atol=0.2)


def test_walkers_that_never_leave_their_modes_are_worth_one_draw_each():
    """Their autocovariance is the same at all lags, however few products it is made of."""
    draws = np.repeat(np.repeat([-1.0, 1.0], 16)[:, None], 200, axis=1)[:, :, None]
    assert draws.size / autocorrelation_time(draws)[0] == pytest.approx(32, rel=0.01)


def test_ensembles_that_agree_pass_the_limit():
    """R-hat of 20 000 groups of four ensembles, whose means scatter by 100 effective draws each."""
    means = np.random.default_rng(1).standard_normal((20_000, 4)) / np.sqrt(100)
    rhat = np.sqrt(1 + np.var(means, axis=1, ddof=1))
    # The limit is a quantile of 99.9 %: 20 above it, and 4.5 more or less.
    assert 2 <= np.sum(rhat > rhat_limit(4, 400)) <= 38


ONCE = Schedule(1000.0, 10**6, 20, 6, 2, 50, 20.0, 100)


@pytest.mark.parametrize(
    ("times", "sizes", "rhat", "draws", "short"),
    [
        ((2.0, 5.0), (1500.0, 1001.0), (1.0, 1.005), 100, ""),
        ((2.0, 5.1), (1500.0, 1001.0), (1.0, 1.005), 100, "100 draws are fewer"),
        ((2.0, 5.0), (1500.0, 999.0), (1.0, 1.005), 100, "the effective size is 999"),
        ((2.0, 5.0), (1500.0, 1001.0), (1.0, 1.2), 100, "the ensembles disagree"),
        ((2.0, np.nan), (1500.0, 1001.0), (1.0, 1.0), 100, "never moved"),
    ],
)
def test_sampling_goes_on_until_the_worst_quantity_is_known(times, sizes, rhat, draws, short):
    quality = Quality(np.array(times), np.array(sizes), np.array(rhat), draws)
    found = quality.shortfalls(ONCE, 4)
    assert len(found) == bool(short)
    assert short in " ".join(found)
