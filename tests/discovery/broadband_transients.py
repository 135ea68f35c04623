"""Transients with a broadband input, of several kinds of system, solved on a fine mesh."""

from dataclasses import replace

import numpy as np
from scipy.fft import irfft

from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._mesh_steps import WHOLE
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import transient_record

STEP, COUNT = 1.0 / 600.0, 6000


def oscillator(stop="0"):
    """Measured force; with a stop that is touched in few samples."""
    parameters = {"d": Parameter(50.0, "1/s", sd=20.0), "w": Parameter(300.0, "1/s", sd=30.0)}
    if stop != "0":
        parameters["k"] = Parameter(8e5, "1/s**2", sd=8e5)
    return Model(
        "oscillator",
        inputs={"u": "V"},
        dofs={"y": Dof("V")},
        parameters=parameters,
        equations={"y": {"all": f"ddot(y) + d*dot(y) + w**2*y + {stop} - w**2*u"}},
        outputs={"out": Output("y", "V")},
    )


def lag():
    """First order."""
    return Model(
        "lag",
        inputs={"u": "V"},
        dofs={"y": Dof("V")},
        parameters={"t": Parameter(0.01, "s", sd=0.005)},
        equations={"y": {"all": "t*dot(y) + y - u"}},
        outputs={"out": Output("y", "V")},
    )


def friction():
    """A force by a measured motion, with friction that remembers the last reversal."""
    return Model(
        "friction",
        inputs={"u": "V"},
        dofs={"z": Dof("")},
        parameters={
            "c": Parameter(1e-3, "s", sd=1e-3),
            "f": Parameter(0.1, "V", sd=0.1),
            "r": Parameter(50.0, "1/V", sd=50.0),
        },
        equations={"z": {"all": "dot(z) - r*(dot(u) - abs(dot(u))*z)"}},
        outputs={"out": Output("c*dot(u) + f*z", "V")},
    )


STOP = "k*max(y - 0.21, 0)"
KINDS = {
    "oscillator": (oscillator(), [40.0, 320.0]),
    "stop": (oscillator(STOP), [40.0, 320.0, 6e5]),
    "lag": (lag(), [0.012]),
    "friction": (friction(), [1.2e-3, 0.12, 30.0]),
}


def record(model, truth, seed=0, noise=0.05):
    """Of a drive that fills a quarter of the band, solved on a fine mesh."""
    rng = np.random.default_rng(seed)
    lines = np.zeros(COUNT // 2 + 1, dtype=complex)
    lines[1 : COUNT // 8] = np.exp(2j * np.pi * rng.random(COUNT // 8 - 1))
    drive = irfft(lines, COUNT)
    drive *= 0.05 / drive.std()
    time = STEP * np.arange(COUNT - 1)
    empty = transient_record(f"r{seed}", time, {"u": drive[:-1], "out": np.zeros(COUNT - 1)})
    predictor = Predictor(model, [empty], steps=2 * WHOLE, jobs=1)
    predictor.set_anchor(np.array(truth))
    out = predictor.simulate(np.array([truth]), 0).y[0, 0]
    out = out + noise * out.std() * rng.standard_normal(out.size)
    return replace(empty, samples={**empty.samples, "out": out})
