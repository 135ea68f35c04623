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
