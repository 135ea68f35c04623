"""Averages over periods: calibrated on noise, exact on signals."""

import numpy as np
import pytest

from bayesoleo.data import periodic_average
from bayesoleo.errors import InputError


@pytest.mark.parametrize(
    ("period", "samples"), [(97.37, 390), (101.0, 404), (250.6, 501), (33.3, 666)]
)
def test_white_noise_repeats_no_more_than_its_standard_error(period, samples):
    rng = np.random.default_rng(11)
    averages = [periodic_average(rng.normal(size=samples), 0.01, 100 / period) for _ in range(200)]
    ratio = np.mean([average.ratio**2 for average in averages])
    sigma = np.mean([average.sigma**2 for average in averages])
    # Mean squares of 200 seeds with at least 33 and 250 degrees of freedom: 3 standard errors.
    assert ratio == pytest.approx(1.0, abs=3 * np.sqrt(4 / 33 / 200))
    assert sigma == pytest.approx(1.0, abs=3 * np.sqrt(2 / 250 / 200))


def test_signal_is_recovered_with_its_noise():
    rng = np.random.default_rng(12)
    time = np.arange(2007) * 1e-3
    signal = 2 + np.cos(2 * np.pi * 2 * time) + 0.3 * np.sin(2 * np.pi * 14 * time)
    average = periodic_average(signal + 0.05 * rng.normal(size=2007), 1e-3, 2.0)
    assert average.number == 2 * 249 + 1
    assert average.sigma == pytest.approx(0.05, rel=3 / np.sqrt(2 * 1500))
    assert np.std(average.values - signal) == pytest.approx(average.noise, rel=0.1)


def test_phase_grid_is_the_average():
    time = np.arange(400) / 100.3
    signal = 2 + np.cos(2 * np.pi * time) + 0.3 * np.sin(2 * np.pi * 14 * time)
    phase = np.arange(64) / 64
    expected = 2 + np.cos(2 * np.pi * phase) + 0.3 * np.sin(2 * np.pi * 14 * phase)
    average = periodic_average(signal, 1 / 100.3, 1.0)
    np.testing.assert_allclose(average.on_phase(64), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("frequency", "message"), [(1.5, "fewer than two periods"), (30.0, "four samples or more")]
)
def test_too_little_is_refused(frequency, message):
    with pytest.raises(InputError, match=message):
        periodic_average(np.ones(100), 0.01, frequency)
