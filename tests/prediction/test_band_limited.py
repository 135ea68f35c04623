"""Inputs of transients: nothing is lost that could be signal, and what is cut off is noise."""

import numpy as np
import pytest
from scipy import signal

from bayesoleo.prediction import _filtering
from bayesoleo.prediction._band_limited import (
    band_limited,
    band_limited_channels,
    declared,
    sample_noise,
)
from bayesoleo.prediction._records import transient_record
from bayesoleo.prediction._run_errors import _noise_lines

STEP = 1e-3
TIME = STEP * np.arange(5000)
INSIDE = slice(250, -250)


def sines(*pairs):
    """A sum of sines with its derivatives, from frequencies in Hz and amplitudes."""
    return [
        sum(
            a * (2 * np.pi * f) ** d * np.sin(2 * np.pi * f * TIME + k + d * np.pi / 2)
            for k, (f, a) in enumerate(pairs)
        )
        for d in range(3)
    ]


def sweep():
    """From 1 to 200 Hz."""
    rate = 2 * np.pi * (1 + 199 / TIME[-1] * TIME)
    bend = 2 * np.pi * 199 / TIME[-1]
    phase = 2 * np.pi * (TIME + 199 / (2 * TIME[-1]) * TIME**2)
    return [
        np.sin(phase),
        rate * np.cos(phase),
        bend * np.cos(phase) - rate**2 * np.sin(phase),
    ]


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    "kind", ["white", "filtered", "step", "pink", "walk", "few"], ids=lambda kind: kind
)
def test_broadband_signals_stay_whole(kind):
    """Where there is no floor the curve goes through its samples."""
    rng = np.random.default_rng(1)
    white = rng.standard_normal(TIME.size)
    frequency = np.maximum(np.fft.rfftfreq(TIME.size), 1 / TIME.size)
    values = {
        "white": white,
        # The Silverbox's arrow: a steep filter at two thirds of half the rate, and growing.
        "filtered": signal.sosfilt(signal.butter(9, 0.65, output="sos"), white) * TIME,
        "step": (TIME > 2.0).astype(float),
        "pink": np.fft.irfft(np.fft.rfft(white) / np.sqrt(frequency), TIME.size),
        "walk": np.cumsum(white),
        "few": white[:20],
    }[kind]
    curve = band_limited(values, STEP)
    missing = curve.at(STEP * np.arange(values.size)) - values
    # Of the filtered one what lies below a three-hundredth of its size may go.
    assert rms(missing) < (3e-3 if kind == "filtered" else 1e-4) * np.std(values)


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("truth", [sines((2.3, 1.0), (7.1, 0.2)), sweep()], ids=["slow", "sweep"])
def test_errors_are_those_of_the_noise_that_stays(truth, noise):
    """Draws of errors are as large as errors are, in the value and in both derivatives."""
    rng = np.random.default_rng(2)
    curve = band_limited(truth[0] + noise * rng.standard_normal(TIME.size), STEP)
    for order in range(3):
        used = curve.for_derivative(order)
        error = rms((used.at(TIME, order) - truth[order])[INSIDE])
        drawn = rms([draw.at(TIME, order)[INSIDE] for draw in used.errors(8)])
        if noise == 0.0:
            # Rounding of the window's side lobes is all the noise there is.
            assert error < 1e-5 * rms(truth[order])
            continue
        # Of the sweep less than a tenth is cut off with the noise: the end of its band.
        assert 0.6 < drawn / error < 1.7
        # No more than all noise, differentiated up to the highest frequency of the signal.
        band = 250.0 if np.ptp(np.diff(truth[0])) > 0.5 else 18.0
        share = np.sqrt(band / 500.0 / (2 * order + 1))
        assert error < 1.5 * noise * (2 * np.pi * band) ** order * share


def test_ends_are_nearly_as_good_as_the_middle():
    """A parabola with noise: where a transform would ring, a spline goes on."""
    rng = np.random.default_rng(3)
    truth = [0.5 * TIME**2, TIME, np.ones(TIME.size)]
    curve = band_limited(truth[0] + 1e-3 * rng.standard_normal(TIME.size), STEP)
    for order in range(3):
        used = curve.for_derivative(order)
        error = np.abs(used.at(TIME, order) - truth[order])
        # Fifteen times the standard deviation inside: an end has neighbours on one side.
        assert error.max() < 15 * rms(error[INSIDE])


def test_two_tones_far_apart_both_stay():
    """A gap between them, ten times as wide as the first is high, is no end of the signal."""
    rng = np.random.default_rng(4)
    truth = sines((5.0, 1.0), (50.0, 0.1))
    curve = band_limited(truth[0] + 0.01 * rng.standard_normal(TIME.size), STEP)
    error = curve.for_derivative(2).at(TIME, 2) - truth[2]
    assert rms(error[INSIDE]) < 0.05 * rms(truth[2])


@pytest.mark.parametrize("quantum", [1e-3, 1e-1])
def test_an_encoder_differentiated_twice(quantum):
    """Steps of the encoder are no accelerations: unfiltered they are hundreds of times the true."""
    truth = sines((2.3, 1.0))
    curve = band_limited(np.round(truth[0] / quantum) * quantum, STEP, quantum)
    error = curve.for_derivative(2).at(TIME, 2) - truth[2]
    assert rms(error[INSIDE]) < (0.001 if quantum < 0.01 else 0.05) * rms(truth[2])


def test_what_another_channel_answers_to_stays():
    """White excitation far below a large slow one is signal if the rig moves with it."""
    rng = np.random.default_rng(5)
    dither = 0.03 * rng.standard_normal(TIME.size)
    drive = sines((2.0, 1.0))[0] + dither
    answer = signal.lfilter([0.1], [1, -0.9], drive) + 1e-4 * rng.standard_normal(TIME.size)
    noise = sines((2.0, 3.0))[0] + 1e-4 * rng.standard_normal(TIME.size)
    with_answer = band_limited_channels({"u": drive, "y": answer}, STEP)["u"]
    without = band_limited_channels({"u": drive, "y": noise}, STEP)["u"]
    assert rms(with_answer.at(TIME) - drive) < 1e-5
    assert rms(without.at(TIME) - drive) == pytest.approx(0.03, rel=0.05)
    # A derivative would be noise for the most part either way.
    assert with_answer.for_derivative(1).band.cut < 10.0


def test_a_declared_bandwidth_decides_alone():
    rng = np.random.default_rng(6)
    values = sines((5.0, 1.0), (50.0, 0.1))[0] + 0.01 * rng.standard_normal(TIME.size)
    limited = declared(values, STEP, 20.0)
    assert rms((limited.at(TIME) - sines((5.0, 1.0))[0])[INSIDE]) < 0.01
    assert rms(declared(values, STEP, np.inf).at(TIME) - values) < 1e-5


@pytest.mark.parametrize("order", [0, 1, 2])
def test_states_are_one_curve(order):
    """Value and derivatives belong together: differences of one give the next."""
    rng = np.random.default_rng(7)
    curve = band_limited(sines((2.3, 1.0))[0] + 0.01 * rng.standard_normal(TIME.size), STEP)
    used = curve.for_derivative(2)
    where, near = np.linspace(0.0, TIME[-1] - 1e-5, 4000), 1e-5
    slope = (used.at(where + near, order) - used.at(where, order)) / near
    expected = used.at(where + near / 2, order + 1)
    assert rms(slope - expected) < 1e-3 * rms(expected)


def test_noise_of_a_sample():
    rng = np.random.default_rng(8)
    values = sines((2.3, 1.0))[0] + 0.01 * rng.standard_normal(TIME.size)
    assert sample_noise(values, STEP) == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize(("noise", "most"), [(1e-6, 0.01), (1e-3, 0.06)])
def test_ends_go_on_as_the_spectrum_says(noise, most):
    """The second derivative of three sines, within five samples of an end, over its size.

    A spline with neighbours on one side only is off by a tenth, with and without noise.
    """
    squares = []
    for seed in range(10):
        rng, time = np.random.default_rng(seed), np.arange(300) / 50.0
        frequency, phase = rng.uniform(0.2, 1.5, 3), rng.uniform(0.0, 6.3, 3)
        waves = np.sin(2 * np.pi * np.multiply.outer(time, frequency) + phase)
        values, bends = waves.sum(axis=1), -(waves @ (2 * np.pi * frequency) ** 2)
        seen = values + noise * values.std() * rng.standard_normal(time.size)
        error = band_limited(seen, 0.02).for_derivative(2).at(time, 2) - bends
        squares.append(np.r_[error[:5], error[-5:]] / bends.std())
    assert rms(squares) < most


@pytest.mark.parametrize("order", [0, 1, 2])
def test_lines_of_noise_are_as_large_as_draws_of_it(order):
    """Two ways to the error of a curve: its lines, and what white noise leaves of itself."""
    rng, time = np.random.default_rng(5), np.arange(800) / 100.0
    values = np.sin(2 * np.pi * 1.1 * time) + 0.01 * rng.standard_normal(800)
    record = transient_record("a", time, {"x": values, "y": values})
    curve = record.smoothed["x"].for_derivative(2)
    omega, sd = _noise_lines(curve, record.span, record.time.size)
    inside = slice(100, -100)
    lines = sd[:, None] * omega[:, None] ** order
    lines = lines * np.cos(np.multiply.outer(omega, time) + order * np.pi / 2)
    expected = rms(np.sqrt(np.sum(lines**2, axis=0))[inside])
    drawn = rms([draw.at(time, order)[inside] for draw in curve.errors(40)])
    # Forty draws of some sixty lines each: three per cent.
    assert expected == pytest.approx(drawn, rel=0.1)


def test_ends_of_a_declared_band_do_not_follow_noise():
    """Where the band is stated nobody tells the noise: what lies beyond the band says it.

    One per cent of noise, differentiated twice; taken for signal, it is as large as the truth.
    """
    squares = []
    for seed in range(15):
        rng, time = np.random.default_rng(seed), np.arange(300) / 50.0
        frequency, phase = rng.uniform(0.2, 1.5, 3), rng.uniform(0.0, 6.3, 3)
        waves = np.sin(2 * np.pi * np.multiply.outer(time, frequency) + phase)
        values, bends = waves.sum(axis=1), -(waves @ (2 * np.pi * frequency) ** 2)
        seen = values + 0.01 * values.std() * rng.standard_normal(time.size)
        error = declared(seen, 0.02, 3.0).at(time, 2) - bends
        squares.append(np.r_[error[:5], error[-5:]] / bends.std())
    assert rms(squares) < 0.3


@pytest.mark.parametrize("noise", [1e-6, 1e-3])
def test_the_ends_of_a_long_record_need_no_line_of_each_of_its_harmonics(noise, monkeypatch):
    """A record of 60 s has 7 200 lines up to where its ends are looked at, and an end is 0.2 s."""
    rng, time = np.random.default_rng(2), STEP * np.arange(60_000)
    phases = rng.uniform(0.0, 2 * np.pi, 30)
    motion = sum(np.sin(2 * np.pi * (k + 0.37) * time + x) for k, x in enumerate(phases))
    values = motion + noise * rng.standard_normal(time.size)
    seen, svd = [], np.linalg.svd

    def watched(rows, **options):
        seen.append(rows.shape)
        return svd(rows, **options)

    monkeypatch.setattr(np.linalg, "svd", watched)
    grouped = _filtering._end_by_spectrum(values, STEP, 80.0, noise)
    lines = _filtering._LINES
    monkeypatch.setattr(_filtering, "_LINES", time.size)
    each = _filtering._end_by_spectrum(values, STEP, 80.0, noise)
    (few, samples), (many, _) = seen
    assert few == 2 * lines * samples + 2
    assert many == 2 * 7200 + 2
    # Far below the noise that the samples have themselves.
    assert rms(grouped[:, 0] - each[:, 0]) < 0.01 * noise
    assert rms(grouped[:, 2] - each[:, 2]) < 1e-3 * rms(each[:, 2])
