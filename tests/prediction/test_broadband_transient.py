"""A transient with an input that fills the band agrees with independent integration."""

import numpy as np
import pytest
from scipy.fft import irfft, rfft
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import transient_record
from bayesoleo.solvers._orbit import Status

STEP, COUNT = 1.0 / 600.0, 3000
OMEGA = 2 * np.pi * 60.0


def model():
    return Model(
        "hardening oscillator",
        inputs={"u": "V"},
        dofs={"y": Dof("V")},
        parameters={
            "d": Parameter(40.0, "1/s", sd=1.0),
            "a": Parameter(5e5, "1/(V**2*s**2)", sd=1.0),
        },
        conditions={},
        equations={"y": {"all": f"ddot(y) + d*dot(y) + {OMEGA**2}*y + a*y**3 - {OMEGA**2}*u"}},
        outputs={"out": Output("y", "V")},
    )


@pytest.fixture(scope="module")
def drive():
    """Periodic noise up to two thirds of half the sampling rate: its series is the truth."""
    rng = np.random.default_rng(0)
    lines = np.zeros(COUNT // 2 + 1, dtype=complex)
    lines[1 : COUNT // 3] = np.exp(2j * np.pi * rng.random(COUNT // 3 - 1))
    values = irfft(lines, COUNT)
    return 0.05 * values / values.std()


def reference(drive):
    """By SciPy, the input by its Fourier series on a grid that a spline of it follows."""
    fine = irfft(rfft(drive), COUNT * 16) * 16
    time = STEP / 16 * np.arange(fine.size)
    u = make_interp_spline(time, fine, k=5)

    def rates(t, s):
        force = OMEGA**2 * (u(t) - s[0]) - 40.0 * s[1] - 5e5 * s[0] ** 3
        return [s[1], force]

    where = STEP * np.arange(COUNT - 1)
    return solve_ivp(
        rates, (0, where[-1]), [0.0, 0.0], "DOP853", where, rtol=1e-8, atol=1e-10, max_step=STEP
    ).y[0]


@pytest.mark.slow
def test_broadband_input_arrives(drive):
    expected = reference(drive)
    time = STEP * np.arange(COUNT - 1)
    record = transient_record("a", time, {"u": drive[:-1], "out": expected})
    predictor = Predictor(model(), [record], jobs=1)
    theta = np.array([40.0, 5e5])
    assert predictor.set_anchor(theta) == [Status.CONVERGED]
    found = predictor.simulate(theta[None], 0).y[0, 0]
    # Near both ends the record does not say how the input went on; it is forgotten within 0.2 s.
    inside = slice(120, -12)
    assert np.std((found - expected)[inside]) < 2e-4 * np.std(expected)
    assert np.std(found - expected) < 1e-2 * np.std(expected)


def test_steps_follow_the_input(drive):
    """No step is longer than an angle and a half of the highest frequency that is left."""
    time = STEP * np.arange(400)
    record = transient_record("a", time, {"u": drive[:400], "out": drive[:400]})
    predictor = Predictor(model(), [record], steps=128, jobs=1, backend="numpy")
    assert predictor.set_anchor(np.array([40.0, 5e5])) == [Status.CONVERGED]
    highest = record.smoothed["u"].band.upper
    longest = np.diff(predictor.runs[0].chosen.edges).max() * time[-1]
    assert 2 * np.pi * highest * longest < 1.6
