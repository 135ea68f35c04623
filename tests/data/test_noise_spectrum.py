"""The noise at harmonics, from what lies between them: laws of white and of coloured noise."""

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy import stats

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
    # Near half the sampling rate fewer lines are averaged, which costs a tenth. Where powers
    # scatter more by chance it is counted, where they scatter less it is not: as much again.
    free = SAMPLES - average.number
    assert replace(spectrum, dispersion=None).free == pytest.approx(free, rel=0.2)
    assert 0.6 * free < spectrum.free < free
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


def with_powers(powers, size):
    """A signal whose lines have these powers and no phase."""
    return np.fft.irfft(np.sqrt(size * powers), size)


@pytest.mark.parametrize("first", [1, 4, 7], ids=["all", "half", "the last"])
def test_a_slope_cancels_however_many_lines_are_left_below(first):
    """Power in proportion to frequency: at the first harmonics the level is the line's own."""
    periods, size = 8, 800
    line = np.arange(size // 2 + 1)
    emptied = line < first
    powers = np.where(emptied | (line % periods == 0), 0.0, 1.0 * line)
    level = noise_spectrum(with_powers(powers, size), periods, emptied).level
    np.testing.assert_allclose(level[[periods, 2 * periods]], [periods, 2 * periods], rtol=1e-9)


def test_the_freedom_of_a_level_is_that_by_which_it_scatters():
    """``power @ level`` is linear in the powers: its variance follows from what each line gives."""
    periods, size = 6, 600
    emptied = np.arange(size // 2 + 1) < 3
    spectrum = NoiseSpectrum(np.ones(size // 2 + 1), periods, size, emptied)
    wanted = np.zeros(size // 2 + 1)
    wanted[[periods, 3 * periods]] = 1.0, 2.0
    slope = []
    for k in range(4 * periods):
        powers = np.zeros(size // 2 + 1)
        powers[k] = 1.0
        slope.append(wanted @ noise_spectrum(with_powers(powers, size), periods, emptied).level)
    # Each power is a chi-square variate of two degrees of freedom over two.
    free = 2 * np.sum(slope) ** 2 / np.sum(np.square(slope))
    assert spectrum.freedom(wanted) == pytest.approx(free, rel=1e-9)


def lines_at_random(rng, size, periods):
    """Twelve sinusoids anywhere between a third of the fundamental and three times it."""
    places = periods / size * rng.uniform(0.3, 3.0, 12)
    turns = 2 * np.pi * np.outer(places, np.arange(size)) + rng.uniform(0, 2 * np.pi, (12, 1))
    return rng.standard_normal(12) @ np.sin(turns) + 0.02 * rng.standard_normal(size)


@pytest.mark.parametrize(("noise", "free"), [("white", (14, 20)), ("lines", (4, 10))])
def test_noise_made_of_lines_is_known_with_few_degrees_of_freedom(noise, free):
    """F variates of the first three harmonics: few lie beyond the highest one in a thousand."""
    rng, periods, size = np.random.default_rng(5), 6, 600
    p_values, freedom = [], []
    for _ in range(200):
        white = noise == "white"
        signal = rng.standard_normal(size) if white else lines_at_random(rng, size, periods)
        average = periodic_average(signal, 1.0, periods / size)
        spectrum = noise_spectrum(signal - average.values, periods)
        for k in periods * np.array([1, 2, 3]):
            ratio = np.abs(np.fft.rfft(signal)[k]) ** 2 / size / spectrum.level[k]
            freedom.append(spectrum.freedom(1.0 * (np.arange(size // 2 + 1) == k)))
            p_values.append(stats.f.sf(ratio, 2, freedom[-1]))
    # Ten lines of two, less what chance takes; twelve sinusoids of random size are some six normal
    # variates.
    assert free[0] < np.median(freedom) < free[1]
    # Of six hundred white ones, five or more come once in 2000 times. Lines have heavier tails than
    # any normal noise; judged by ten lines of two degrees, 25 of theirs were beyond.
    assert np.sum(np.array(p_values) < 0.001) < (5 if white else 14)


def test_a_loud_line_does_not_let_an_excess_elsewhere_pass():
    """Mains hum between two periods: the noise away from it is known as well as without it."""
    rng, size = np.random.default_rng(0), 4096
    rest = rng.standard_normal(size)
    hum = 5.0 * np.cos(2 * np.pi * 301.0 * np.arange(size) / size)
    quiet, loud = (noise_spectrum(values, 2) for values in (rest, rest + hum))
    # The hum's part of the level comes from some 80 lines on either side.
    assert quiet.free > 1000.0
    assert loud.free > 50.0
    about = np.zeros(loud.level.size)
    about[296:308:2] = 1.0
    assert loud.freedom(about) < 5.0


@pytest.mark.parametrize("emptied", [False, True])
def test_a_spectrum_is_kept_without_what_follows_from_it(emptied):
    rest = np.random.default_rng(2).standard_normal(4000)
    lines = np.arange(2001) % 97 == 5 if emptied else None
    spectrum, power = noise_spectrum(rest, 10, lines), np.linspace(1.0, 0.0, 2001)
    free = spectrum.freedom(power)
    found = pickle.loads(pickle.dumps(spectrum))
    assert set(vars(found)) == {item.name for item in fields(NoiseSpectrum)} < set(vars(spectrum))
    assert found.freedom(power) == free
    np.testing.assert_array_equal(found.weights, spectrum.weights)
    np.testing.assert_array_equal(found.level, spectrum.level)
