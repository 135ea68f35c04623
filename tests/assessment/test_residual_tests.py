"""Each test against its law under noise alone, and against what it is there to find."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesoleo.assessment import (
    autocorrelation,
    autocorrelation_time,
    dependence,
    intraclass_correlation,
    lack_of_fit,
    normality,
    outliers,
    runs_of_signs,
)
from bayesoleo.data import periodic_average


def coloured(rng, size, coefficient):
    white = rng.standard_normal(size + 200)
    for k in range(1, white.size):
        white[k] += coefficient * white[k - 1]
    return white[200:] * np.sqrt(1 - coefficient**2)


def test_runs_of_a_known_sequence():
    # 6 runs among 8 above and 4 below: mean 1 + 64/12, variance (64/12)(64/12 - 1)/11
    signs = np.array([1, 1, -1, 1, 1, 1, -1, -1, 1, 1, 1, -1.0])
    mean = 1 + 64 / 12
    expected = (6 - mean) / np.sqrt((mean - 1) * (mean - 2) / 11)
    found = runs_of_signs(signs * np.linspace(1, 2, 12))
    assert found.statistic == pytest.approx(expected)
    assert found.p_value == pytest.approx(2 * stats.norm.sf(abs(expected)))


def test_one_sign_only_is_as_far_out_as_can_be():
    found = runs_of_signs(np.ones(50))
    assert found.statistic == pytest.approx(-7.0)
    assert found.p_value < 1e-11


def test_runs_find_order_that_the_spread_hides():
    wave = np.sin(np.linspace(0, 20, 400))
    rng = np.random.default_rng(0)
    assert runs_of_signs(wave + 0.5 * rng.standard_normal(400)).p_value < 1e-6
    assert runs_of_signs(rng.permutation(wave)).p_value > 0.01


@pytest.mark.statistical
@pytest.mark.parametrize("coefficient", [0.0, 0.8])
def test_probabilities_are_uniform_where_nothing_is_wrong(coefficient):
    rng = np.random.default_rng(1)
    runs, normal = [], []
    for _ in range(400):
        noise = coloured(rng, 1500, coefficient)
        runs.append(runs_of_signs(noise).p_value)
        normal.append(normality(noise)[2].p_value)
    # Kolmogorov's distance of 400 draws exceeds 0.098 once in a thousand; the chi-square of the
    # moments is asymptotic, which costs another 0.05
    assert stats.kstest(normal, "uniform").statistic < 0.15
    if coefficient == 0:
        assert stats.kstest(runs, "uniform").statistic < 0.1


@pytest.mark.statistical
def test_dependence_on_nothing_is_rarely_found():
    rng = np.random.default_rng(2)
    found = []
    for _ in range(300):
        noise = coloured(rng, 2000, 0.6)
        time = np.arange(2000.0)
        found.append(dependence(noise, time, autocorrelation_time(noise)).outcome.p_value)
    # the memory is estimated, so that the law holds nearly
    assert np.mean(np.array(found) < 0.05) < 0.12
    assert stats.kstest(found, "uniform").statistic < 0.15


def test_autocorrelation_time_of_an_autoregression():
    noise = coloured(np.random.default_rng(3), 40_000, 0.9)
    # (1 + a) / (1 - a), of which 40 000 samples know a tenth
    assert autocorrelation_time(noise) == pytest.approx(19.0, rel=0.15)
    assert autocorrelation_time(np.random.default_rng(3).standard_normal(5000)) == pytest.approx(
        1.0, abs=0.1
    )


def test_autocorrelation_of_an_autoregression():
    noise = coloured(np.random.default_rng(4), 100_000, 0.7)
    np.testing.assert_allclose(autocorrelation(noise, 3), 0.7 ** np.arange(4), atol=0.02)


def test_normality_sees_tails_and_skewness():
    rng = np.random.default_rng(5)
    skewness, kurtosis, outcome = normality(rng.exponential(size=2000))
    assert (skewness, kurtosis) == (pytest.approx(2, abs=0.5), pytest.approx(6, abs=3))
    assert outcome.p_value < 1e-10
    assert normality(rng.standard_t(4, size=2000))[2].p_value < 1e-3
    # without allowing for the memory the moments of so slow a noise would look abnormal
    slow = coloured(np.random.default_rng(6), 3000, 0.98)
    assert normality(slow)[2].p_value > 0.01 > stats.jarque_bera(slow).pvalue


def record(rng, error, noise, periods=5):
    time = np.arange(periods * 200)
    phase = time / 200.0
    residual = error * np.sin(4 * np.pi * phase) + noise * rng.standard_normal(time.size)
    return residual, periodic_average(residual, 1.0, 1 / 200.0)


@pytest.mark.parametrize("error", [0.0, 0.5, 2.0])
def test_correlation_of_the_same_phase_is_the_part_that_repeats(error):
    _, average = record(np.random.default_rng(7), error, 1.0, periods=40)
    size = average.repeating, average.sigma, average.samples, average.number
    expected = 0.5 * error**2 / (0.5 * error**2 + 1)
    assert intraclass_correlation(*size) == pytest.approx(expected, abs=0.02)


@pytest.mark.statistical
def test_lack_of_fit_is_f_distributed_under_pure_noise():
    rng = np.random.default_rng(8)
    found = []
    for _ in range(300):
        _, average = record(rng, 0.0, 1.0)
        size = average.repeating, average.sigma, average.samples, average.number
        found.append(lack_of_fit(*size).p_value)
    assert stats.kstest(found, "uniform").statistic < 0.1


def test_lack_of_fit_is_found_unless_the_input_explains_it():
    _, average = record(np.random.default_rng(9), 0.5, 1.0)
    size = average.repeating, average.sigma, average.samples, average.number
    assert lack_of_fit(*size).p_value < 1e-4
    assert lack_of_fit(*size, input_noise=0.35).p_value > 0.01


def test_outliers_are_named_and_do_not_hide_each_other():
    noise = np.random.default_rng(10).standard_normal(1000)
    noise[[100, 500, 501]] += [40.0, -60.0, -55.0]
    scores, places, limit = outliers(noise)
    assert list(places) == [500, 501, 100]
    assert limit == pytest.approx(stats.norm.isf(0.05 / 2000))
    assert scores[100] == pytest.approx(40, abs=4)


def test_dependence_is_the_share_of_the_variance():
    rng = np.random.default_rng(11)
    variable = rng.uniform(-1, 1, 4000)
    residual = variable**2 + 0.2 * rng.standard_normal(4000)
    found = dependence(residual, variable, 1.0)
    variance = 4 / 45  # of the square of a uniform variate
    assert found.share == pytest.approx(variance / (variance + 0.04), abs=0.03)
    assert found.outcome.p_value < 1e-12
    np.testing.assert_allclose(found.means, found.centres**2, atol=4 * found.errors.max())
    assert dependence(residual, rng.uniform(size=4000), 1.0).outcome.p_value > 0.01
