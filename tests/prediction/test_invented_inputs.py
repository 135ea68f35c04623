"""Inputs that a model turns into what was not measured are cut off; others are left alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from bayesoleo.model import Model, Output, Parameter
from bayesoleo.prediction._input_bandwidth import without_invented
from bayesoleo.prediction._inputs import signal_of
from bayesoleo.prediction._records import transient_record

STEP = 1e-3
TIME = STEP * np.arange(6000)
MASS = 5.0


def model(mass=MASS):
    return Model(
        "mass",
        inputs={"x": "m"},
        parameters={"mass": Parameter(mass, "kg", sd=1.0)},
        outputs={"force": Output("mass*ddot(x)", "N")},
    )


def oscillator():
    return Model(
        "base excitation",
        inputs={"x": "m"},
        dofs={"z": "m"},
        parameters={"k": Parameter(1e3, "1/s**2", sd=1.0)},
        equations={"z": {"all": "ddot(z) + 20*dot(z) + k*z + ddot(x)"}},
        outputs={"z_measured": Output("z", "m")},
    )


def motion(*pairs):
    x = sum(a * np.sin(2 * np.pi * f * TIME + f) for f, a in pairs)
    bend = sum(-a * (2 * np.pi * f) ** 2 * np.sin(2 * np.pi * f * TIME + f) for f, a in pairs)
    return x, bend


def record(x, **outputs):
    rng = np.random.default_rng(0)
    noisy = {"x": x + 1e-7 * rng.standard_normal(TIME.size)}
    for name, values in outputs.items():
        noisy[name] = values + 1e-3 * np.std(values) * rng.standard_normal(TIME.size)
    return transient_record("a", TIME, noisy)


def test_vibration_of_a_sensor_is_no_inertia():
    """The encoder hums at 180 Hz with a hundred-thousandth of the motion; the force does not."""
    x, bend = motion((1.0, 0.1), (3.0, 0.03))
    hum, _ = motion((180.0, 3e-6))
    made = record(x + hum, force=MASS * bend)
    (cut,), (item,) = without_invented(model(), [made])
    assert (item.channel, item.output, item.derivative) == ("x", "force", 2)
    assert 20.0 < item.low < 180.0
    assert item.held == pytest.approx(3e-6 / np.sqrt(2), rel=0.1)
    assert item.predicted == pytest.approx(MASS * (2 * np.pi * 180) ** 2 * item.held, rel=0.1)
    assert item.measured < 0.05 * item.predicted
    found = cut.smoothed["x"].for_derivative(2).at(TIME, 2)
    assert np.std((found - bend)[300:-300]) < 2e-3 * np.std(bend)


@pytest.mark.parametrize("start", [MASS, 100 * MASS, 0.01 * MASS])
def test_force_that_was_measured_stays(start):
    """Whatever the parameters start from."""
    x, bend = motion((1.0, 0.1), (3.0, 0.03), (180.0, 3e-6))
    made = record(x, force=MASS * bend)
    (kept,), found = without_invented(model(start), [made])
    assert found == ()
    assert kept is made


def test_declared_channels_stay():
    x, bend = motion((1.0, 0.1))
    hum, _ = motion((180.0, 3e-6))
    made = record(x + hum, force=MASS * bend)
    assert without_invented(model(), [made], ["x"])[1] == ()


def test_a_system_that_does_not_follow_keeps_its_input():
    """An isolator's output falls off with frequency, and so does what its model predicts."""
    rng = np.random.default_rng(1)
    x = signal.sosfiltfilt(
        signal.butter(4, 0.3, output="sos"), 1e-3 * rng.standard_normal(TIME.size)
    )
    system = signal.TransferFunction([-1, 0, 0], [1, 20, 1e3])
    z = signal.lsim(system, x, TIME)[1]
    assert without_invented(oscillator(), [record(x, z_measured=z)])[1] == ()


def test_a_channel_in_the_band_of_another_is_cut_off_once():
    """Many candidates feed the force back; other samples of that name are another curve."""
    x, bend = motion((1.0, 0.1))
    _, hum = motion((80.0, 1e-4))
    made = record(x, force=MASS * (bend + hum))
    within = "force_within_x"
    first = signal_of(made, within, 2)
    assert first.band.cut < 60.0 < made.signals["force"].for_derivative(2).band.cut
    assert signal_of(made, within, 2) is first
    twice = replace(made, samples={**made.samples, "force": 2.0 * made.samples["force"]})
    other, place = signal_of(twice, within, 2), np.array([0.4])
    assert other.evaluate(place, made.rate) == pytest.approx(2 * first.evaluate(place, made.rate))
