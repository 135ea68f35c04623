"""Fundamental frequency: unbiased, with an honest deviation, refused where there is none."""

import numpy as np
import pytest

from bayesoleo.data import autocovariance, find_frequency, residual_time_shift
from bayesoleo.errors import CampaignError


def record(rng, frequency, samples=1650, noise=0.02):
    """Two channels at 400 samples a second: a sine and a friction-like square wave."""
    time = np.arange(samples) / 400 + 0.37
    sine = np.sin(2 * np.pi * frequency * time)
    square = np.tanh(5 * np.cos(2 * np.pi * frequency * time))
    return np.array([sine, 1e3 * square]) + noise * rng.normal(size=(2, samples)) * [[1], [1e3]]


def test_shift_function_and_autocovariance_agree_on_the_period():
    rng = np.random.default_rng(1)
    values = record(rng, 1.0)[0]
    shifts = np.arange(350, 450)
    assert abs(shifts[np.argmin(residual_time_shift(values, shifts))] - 400) <= 3
    assert abs(shifts[np.argmax(autocovariance(values, shifts))] - 400) <= 6


def test_autocovariance_is_the_sum_it_stands_for():
    values = np.random.default_rng(2).normal(size=50)
    centred = values - values.mean()
    expected = [np.mean(centred[: 50 - lag] * centred[lag:]) for lag in (0, 3, 20)]
    np.testing.assert_allclose(autocovariance(values, np.array([0, 3, 20])), expected, atol=1e-12)


@pytest.mark.parametrize("off", [-0.05, 0.0, 0.002, 0.05])
def test_frequency_is_found_from_a_nominal_one_that_is_off(off):
    rng = np.random.default_rng(3)
    found = find_frequency(record(rng, 1.0023), 1 / 400, 1.0023 * (1 + off))
    assert abs(found.value - 1.0023) < 4 * found.sd
    assert found.sd / found.value < 1e-4


def test_start_does_not_move_the_answer():
    values = record(np.random.default_rng(4), 1.0)
    found = [find_frequency(values, 1 / 400, nominal) for nominal in (0.97, 1.0, 1.04)]
    assert np.ptp([each.value for each in found]) < 0.02 * found[0].sd


def test_standard_deviation_is_that_of_the_estimate():
    rng = np.random.default_rng(5)
    found = [find_frequency(record(rng, 1.0, 825, 0.05), 1 / 400, 1.0) for _ in range(60)]
    score = np.array([(each.value - 1.0) / each.sd for each in found])
    # The mean of 60 scores has standard error 0.13, their standard deviation 0.09.
    assert abs(score.mean()) < 0.4
    assert 0.73 < score.std() < 1.27


def test_clean_record_is_found_to_rounding():
    time = np.arange(1234) / 400
    values = np.array(
        [np.cos(2 * np.pi * 1.00321 * time) + 0.2 * np.sin(4 * np.pi * 1.00321 * time)]
    )
    assert find_frequency(values, 1 / 400, 1.0).value == pytest.approx(1.00321, rel=1e-9)


@pytest.mark.parametrize("nominal", [1.5, 0.65, 2.0])
def test_wrong_frequency_is_refused_with_the_right_one(nominal):
    rng = np.random.default_rng(6)
    with pytest.raises(
        CampaignError, match=r"does not repeat near .* repeats at about 1(\.00\d)? Hz"
    ):
        find_frequency(record(rng, 1.0, 3300), 1 / 400, nominal)


def test_noise_has_no_frequency():
    with pytest.raises(CampaignError, match="declare the run as kind = 'transient'"):
        find_frequency(np.random.default_rng(7).normal(size=(1, 1600)), 1 / 400, 1.0)
