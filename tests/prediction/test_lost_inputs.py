"""What of an input does not reach a model is said with figures, and only then."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from bayesoleo.data import HarmonicBasis, significant_harmonics
from bayesoleo.prediction._input_bandwidth import lost_inputs
from bayesoleo.prediction._records import Record, transient_record

STEP = 1e-3
TIME = STEP * np.arange(8000)
SLOW = np.sin(2 * np.pi * TIME) + 0.2 * np.sin(6 * np.pi * TIME)


def noise(size, seed):
    return size * np.random.default_rng(seed).standard_normal(TIME.size)


def transient(**samples):
    return transient_record("a", TIME, samples)


def periodic(**samples):
    """Eight periods of one second."""
    basis = HarmonicBasis(TIME.size, STEP)
    found = {name: significant_harmonics(basis, x) for name, x in samples.items()}
    sd = dict.fromkeys(samples, 0.01)
    return Record("a", "", "fit", "periodic", 1.0, 0.0, 8, TIME, samples, found, sd)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_white_noise_is_no_loss(order):
    record = transient(x=SLOW + noise(0.01, 0), y=SLOW + noise(0.01, 1))
    assert lost_inputs((("x", order),), ["y"], [record]) == ()


def test_a_hump_next_to_the_noise_is_named():
    """A resonance of the sensor, less than its noise in all but of size in the acceleration."""
    band = signal.butter(2, (440, 460), "bandpass", fs=1000, output="sos")
    hump = 4e-5 * signal.sosfilt(band, noise(1.0, 2))
    record = transient(x=SLOW + noise(2e-5, 0) + hump, y=SLOW + noise(0.01, 1))
    (item,) = lost_inputs((("x", 2), ("x", 0)), ["y"], [record])
    assert (item.run, item.channel, item.why, item.derivative) == ("a", "x", "floor", 2)
    assert item.where < 100.0
    assert item.lost == pytest.approx((2 * np.pi * 450) ** 2 * hump.std(), rel=0.3)
    assert lost_inputs((("x", 0),), ["y"], [record]) == ()


def test_what_does_not_repeat_but_acts():
    """An input that is random in part, taken as periodic: the output follows all of it."""
    drive = SLOW + noise(0.2, 3)
    answer = signal.lfilter([0.2], [1, -0.8], drive)
    (item,) = lost_inputs((("x", 0),), ["y"], [periodic(x=drive, y=answer + noise(0.01, 4))])
    assert (item.why, item.channel) == ("repeating", "x")
    # One part in eight of what does not repeat is in the average over eight periods.
    assert item.lost == pytest.approx(0.2, rel=0.1)
    alone = periodic(x=drive, y=signal.lfilter([0.2], [1, -0.8], SLOW) + noise(0.01, 4))
    assert lost_inputs((("x", 0),), ["y"], [alone]) == ()


@pytest.mark.parametrize(("length", "expected"), [(5, 0), (400, 1)])
def test_a_masked_stretch_is_a_straight_line(length, expected):
    kept = np.ones(TIME.size, dtype=bool)
    kept[3000 : 3000 + length] = False
    record = replace(transient(x=SLOW + noise(1e-3, 0), y=SLOW), kept=kept)
    found = lost_inputs((("x", 0),), ["y"], [record])
    assert [item.why for item in found] == ["masked"] * expected
    if found:
        assert found[0].where == pytest.approx(0.4, abs=2e-3)
