"""Sensitivities of features against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from small_campaigns import damper, damper_campaign, spring_damper_force

from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._sensitivity import global_sensitivity, local_sensitivity, quantile, sobol
from bayesoleo.model._correlated_priors import JointNormal
from bayesoleo.model._priors import LogNormal, Normal, TruncatedNormal, Uniform
from bayesoleo.prediction._predictor import Predictor


@pytest.mark.slow
def test_ishigami_function():
    a, b = 7.0, 0.1

    def function(t):
        return (np.sin(t[:, 0]) * (1 + b * t[:, 2] ** 4) + a * np.sin(t[:, 1]) ** 2)[:, None]

    found = sobol(function, [Uniform(-np.pi, np.pi)] * 3, list("abc"), ["y"], samples=4096)
    # Ishigami and Homma (1990): the variance and its parts in closed form
    v1, v2, v13 = 0.5 * (1 + b * np.pi**4 / 5) ** 2, a**2 / 8, b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    total = v1 + v2 + v13
    np.testing.assert_allclose(found["first"][0], np.array([v1, v2, 0]) / total, atol=0.02)
    np.testing.assert_allclose(found["total"][0], np.array([v1 + v13, v2, v13]) / total, atol=0.02)
    assert float(found["variance"][0]) == pytest.approx(total, rel=0.02)
    assert (found["total_low"] <= found["total"]).all()


def test_linear_function_has_variance_shares():
    priors, weights = (
        [Normal(1.0, 1.0), Normal(0.0, 2.0), Uniform(0.0, 12.0)],
        np.array([3.0, 1, 0.5]),
    )
    found = sobol(lambda t: (t @ weights)[:, None], priors, list("abc"), ["y"], samples=2048)
    shares = (weights * [prior.sd for prior in priors]) ** 2
    np.testing.assert_allclose(found["first"][0], shares / shares.sum(), atol=0.02)
    np.testing.assert_allclose(found["total"][0], shares / shares.sum(), atol=0.02)


def test_failures_are_left_out_and_counted():
    def function(t):
        y = t[:, :1] + t[:, 1:]
        y[t[:, 0] > 1.5] = np.nan
        return y

    found = sobol(function, [Normal(0, 1), Normal(0, 1)], ["a", "b"], ["y"], samples=1024)
    # each sample needs the first parameter twice: (1 - 0.067)**2 of them survive
    assert found.data.attrs["failed"] == pytest.approx(
        1024 * (1 - stats.norm.cdf(1.5) ** 2), rel=0.1
    )
    assert found.data.attrs["samples"] == 512
    assert "left out" in str(found)
    with pytest.raises(InputError, match="only 0 of 64 samples can be predicted"):
        sobol(lambda t: np.full((len(t), 1), np.nan), [Normal(0, 1)], ["a"], ["y"], samples=64)
    with pytest.raises(InputError, match="power of two"):
        sobol(function, [Normal(0, 1)] * 2, ["a", "b"], ["y"], samples=1000)


@pytest.mark.parametrize(
    "prior",
    [
        Normal(2.0, 3.0),
        Uniform(-1.0, 4.0),
        LogNormal(3.0, 0.4),
        TruncatedNormal(0.0, 1.0, low=0.5, high=3.0),
        JointNormal.of(["a", "b"], [1.0, 2.0], [[4.0, 1.0], [1.0, 2.0]]).prior("a"),
    ],
    ids=lambda prior: type(prior).__name__,
)
def test_quantiles_are_those_of_the_draws(prior):
    draws = prior.sample(np.random.default_rng(5), 20_000)
    part = stats.rankdata(draws) / draws.size
    # Kolmogorov's distance of 20 000 draws exceeds 0.0115 once in a hundred
    values = quantile(prior, np.linspace(0.01, 0.99, 99))
    below = np.searchsorted(np.sort(draws), values) / part.size
    assert np.abs(below - np.linspace(0.01, 0.99, 99)).max() < 0.0115


def test_local_sensitivity_of_a_power_law():
    x = np.array([1.0, 2.0, 4.0])
    problem = FunctionProblem(
        lambda x, t: t[0] * x ** t[1],
        x,
        np.ones(3),
        [Normal(2.0, 0.4), Normal(1.5, 0.1)],
        ["k", "n"],
    )
    features = {"last": lambda outputs: outputs["y"][-1]}
    found = local_sensitivity(problem, [2.0, 1.5], features)
    np.testing.assert_allclose(found["value"], 2.0 * 4**1.5)
    # d y / y = dk / k + n ln x; central differences err by the square of 2 %
    np.testing.assert_allclose(
        found["percent"][0], [100 * 0.4 / 2, 100 * 0.1 * np.log(4)], rtol=1e-3
    )
    one = local_sensitivity(problem, [2.0, 1.5], features, per="percent")
    np.testing.assert_allclose(one["percent"][0], [1.0, 1.5 * np.log(4)], rtol=1e-3)
    with pytest.raises(InputError, match="use per='prior'"):
        local_sensitivity(problem, [2.0, 0.0], features, per="percent")


def test_features_of_a_campaign_are_labelled_by_run(tmp_path):
    reduced = damper_campaign(tmp_path, spring_damper_force, periods=3)
    predictor = Predictor(damper(), reduced.records[:2], backend="numpy", jobs=1)
    problem = CampaignProblem(predictor)
    found = local_sensitivity(problem, problem.start, {"peak": lambda y: y["force"].max()})
    assert list(found["feature"].values) == ["peak[a]", "peak[b]"]
    y = predictor.simulate(problem.start[None], 1).y[0, 0]
    assert float(found["value"][1]) == pytest.approx(y.max())
    shares = global_sensitivity(problem, samples=64)
    rms = shares["first"].sel(feature="rms of force[b]")
    # a prior sd of damping changes a force of 15 N by 38 N, one of stiffness by 18 N
    assert float(rms.sel(parameter="damping")) > 3 * float(rms.sel(parameter="stiffness")) > 0.1
    assert shares.data.attrs["failed"] == 0
