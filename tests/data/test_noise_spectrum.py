"""The noise at harmonics, from what lies between them: laws of white and of coloured noise."""

import numpy as np
import pytest

from bayesoleo.data import periodic_average
from bayesoleo.data._noise import NoiseSpectrum, noise_spectrum

SAMPLES, PERIODS, STEP = 2000, 4, 0.002


def ar1(rng, coefficient, size):
    """Unit variance."""
    from scipy.signal import lfilter

    drive = np.sqrt(1 - coefficient**2) * rng.standard_normal(size + 400)
    return lfilter([1.0], [1.0, -coefficient], drive)[400:]


def average_and_spectrum(signal):
    average = periodic_average(signal, STEP, PERIODS / (SAMPLES * STEP))
    return average, noise_spectrum(signal - average.values, PERIODS)


@pytest.mark.parametrize("coefficient", [0.0, 0.9, 0.97])
def test_the_average_scatters_as_its_noise_says(coefficient):
    """Squared ratios have mean one, and the variance of an F variate with the stated freedom."""
    rng = np.random.default_rng(4)
    ratios, expected = [], []
    for _ in range(150):
        average, spectrum = average_and_spectrum(ar1(rng, coefficient, SAMPLES))
        ratios.append((average.repeating / spectrum.noise) ** 2)
        expected.append(2 / spectrum.coefficients + 2 / spectrum.free)
    spread = np.std(ratios)
    # The level near zero frequency is taken from its neighbours: 10 % where noise is steepest.
    assert np.mean(ratios) == pytest.approx(1.0, abs=4 * spread / np.sqrt(150) + 0.1 * coefficient)
    assert spread**2 == pytest.approx(np.mean(expected), rel=0.5 if coefficient else 0.3)


def test_white_noise_keeps_its_degrees_of_freedom():
    rng = np.random.default_rng(0)
    average, spectrum = average_and_spectrum(rng.standard_normal(SAMPLES))
    # Estimated levels scatter, which costs a few.
    assert spectrum.coefficients == pytest.approx(average.number, rel=0.05)
    assert spectrum.free == pytest.approx(SAMPLES - average.number, rel=0.15)
    assert spectrum.noise == pytest.approx(average.noise, rel=0.03)


def test_what_repeats_does_not_count():
    rng = np.random.default_rng(1)
    noise = rng.standard_normal(SAMPLES)
    repeating = 50 * np.sin(2 * np.pi * 3 * PERIODS * np.arange(SAMPLES) / SAMPLES)
    plain, loud = (average_and_spectrum(x)[1] for x in (noise, noise + repeating))
    np.testing.assert_allclose(loud.level, plain.level, rtol=1e-6)


@pytest.mark.parametrize("coefficient", [0.0, 0.97])
def test_variance_of_a_projection_on_a_periodic_direction(coefficient):
    """``Var(d @ noise)`` from the spectrum against its scatter over seeds, and ``d @ C @ d``."""
    rng = np.random.default_rng(2)
    phase = 2 * np.pi * PERIODS * np.arange(SAMPLES) / SAMPLES
    direction = np.sin(phase) + 0.3 * np.cos(3 * phase) ** 3
    lags = np.abs(np.subtract.outer(np.arange(SAMPLES), np.arange(SAMPLES)))
    exact = direction @ (coefficient**lags if coefficient else np.eye(SAMPLES)) @ direction
    found, freedom = [], []
    for _ in range(60):
        spectrum = average_and_spectrum(ar1(rng, coefficient, SAMPLES))[1]
        power = spectrum.power(direction)
        found.append(power @ spectrum.level)
        freedom.append(spectrum.freedom(power))
    assert np.mean(found) == pytest.approx(exact, rel=4 * np.std(found) / exact / 60**0.5 + 0.05)
    assert np.var(found) / np.mean(found) ** 2 == pytest.approx(2 / np.mean(freedom), rel=0.6)


@pytest.mark.parametrize("size", [40, 41])
def test_the_power_of_all_lines_is_that_of_the_signal(size):
    """Parseval: white noise of unit variance gives a projection the variance of its square."""
    signal = np.random.default_rng(0).standard_normal(size) + (-1.0) ** np.arange(size)
    spectrum = NoiseSpectrum(np.ones(size // 2 + 1), 4, size)
    assert spectrum.power(signal).sum() == pytest.approx(signal @ signal, rel=1e-12)
    assert spectrum.weights.sum() == size
