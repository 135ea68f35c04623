"""Averages of a transient over neighbouring samples keep what is as fast as the motion."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.data._noise import (
    FEWEST_SAMPLES,
    MOST_AVERAGES,
    local_average,
    local_means,
    samples_in_average,
)

SAMPLES = 20_000
PLACE = np.arange(SAMPLES)


@pytest.mark.parametrize("noise", [0.0, 0.03])
@pytest.mark.parametrize("period", [25.0, 80.0, 400.0])
@pytest.mark.parametrize("slope", [0.0, 5.0])
def test_errors_at_three_times_the_frequency_of_the_motion_are_kept(noise, period, slope):
    rng = np.random.default_rng(2)
    motion = np.sin(2 * np.pi * PLACE / period) + slope * PLACE / SAMPLES
    size = samples_in_average([motion + noise * rng.standard_normal(SAMPLES)])
    for order, kept in ((1, 0.94), (3, 0.55)):
        error = np.sin(2 * np.pi * order * PLACE / period + 0.3)
        assert np.mean(local_means(error, size) ** 2) > kept * np.mean(error**2)


def test_what_is_slow_is_averaged_over_two_hundredths_of_the_record():
    slow = np.sin(2 * np.pi * 3.3 * PLACE / SAMPLES)
    assert samples_in_average([slow]) == SAMPLES // MOST_AVERAGES
    # The fastest signal decides, and noise is none.
    rng = np.random.default_rng(3)
    noisy = slow + 0.3 * rng.standard_normal(SAMPLES)
    assert samples_in_average([noisy]) > SAMPLES // MOST_AVERAGES // 2
    fast = np.sin(2 * np.pi * PLACE / 30.0)
    assert samples_in_average([slow, fast]) == 3
    assert samples_in_average([slow, np.sin(PLACE)]) == 1
    assert samples_in_average([np.ones(SAMPLES)]) == SAMPLES // MOST_AVERAGES
    assert samples_in_average([slow[:100]]) == FEWEST_SAMPLES


@pytest.mark.parametrize("size", [1, 4, 7, 100])
def test_averages_of_noise_have_the_noise_that_is_stated(size):
    rng = np.random.default_rng(5)
    found = [local_average(rng.standard_normal(2000), size) for _ in range(60)]
    # Sixty records of twenty averages at least: their mean square is known to 4 %.
    assert np.mean([one.ratio**2 for one in found]) == pytest.approx(1.0, abs=0.12)
    assert found[0].number == 2000 // size
