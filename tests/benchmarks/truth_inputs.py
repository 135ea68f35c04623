"""Whether inputs reach a model as they were measured: the Silverbox and EMPS.

**Silverbox.** The cubic oscillator ``y'' + d y' + k y + a y³ = g u`` is fitted to the two periodic
Schroeder blocks and then predicts the arrow and the ten multisines of the other file as transients:
broadband inputs up to two thirds of half the sampling rate. An independent Runge-Kutta of fourth
order with the same parameters and the same start takes the input from a Fourier series of the whole
file, at eight steps a sample. Offsets of both channels are removed as the set's authors say, over
the whole file.

**EMPS.** Force is an output of the measured position: mass, viscous and Coulomb friction, offset.
The position comes from an encoder and is differentiated twice. The same record is taken as periodic
(6.24 s) and as a transient.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import fft, io

import bayesoleo
import bayesoleo._workflow
from bayesoleo.data import load_campaign, reduce_campaign
from bayesoleo.errors import DataWarning
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._orbit import Status

Array = NDArray[np.float64]

RATE = 1e7 / 2**14
#: First and last sample of the arrow, and of the multisines from the rest before each.
ARROW = (100, 40575)
MULTISINES = tuple((40560 + 8692 * k, 49160 + 8692 * k) for k in range(10))
#: Steps of the Runge-Kutta in a sampling interval: its error is below a microvolt.
FINE = 8
SETTINGS = bayesoleo.Settings(seed=0, drive="model", quick=True)

OSCILLATOR = Model(
    "cubic circuit",
    inputs={"input_voltage": "V"},
    dofs={"y": "V"},
    parameters={
        "damping": Parameter(50.0, "1/s", sd=50.0, bounds=(0.0, 1e4)),
        "stiffness": Parameter(2.0e5, "1/s**2", sd=1e5),
        "cubic": Parameter(5.0e5, "1/(V**2*s**2)", sd=5e5),
        "gain": Parameter(2.0e5, "1/s**2", sd=1e5),
    },
    equations={
        "y": {
            "inertia": "ddot(y)",
            "damping": "damping*dot(y)",
            "spring": "stiffness*y + cubic*y**3",
            "drive": "-gain*input_voltage",
        }
    },
    outputs={"output_voltage": Output("y", "V")},
)

DRIVE = Model(
    "positioning drive",
    inputs={"position": "m"},
    parameters={
        "mass": Parameter(90.0, "kg", sd=30.0),
        "viscous": Parameter(200.0, "N*s/m", sd=100.0),
        "coulomb": Parameter(20.0, "N", sd=10.0),
        "offset": Parameter(0.0, "N", sd=10.0),
    },
    outputs={
        "force": Output(
            "mass*ddot(position) + viscous*dot(position) + coulomb*sign(dot(position)) + offset",
            "N",
        )
    },
)

HEAD = 'format = 1\nname = "{}"\n'
CHANNEL = '[channels.{}]\ncolumn = "{}"\nunit = "{}"\noffset = {!r}\n'


def figures(fraction: float = 1.0, say: Callable[[str], Any] = print) -> dict[str, float]:
    """Errors of predictions from measured inputs.

    Parameters
    ----------
    fraction : float
        Part of the arrow that is predicted, from its beginning, and of the multisines.
    say : callable

    Returns
    -------
    dict of str to float
        ``arrow_mV`` and ``multisine_mV``, raw root mean square of prediction minus measurement;
        ``arrow_reference_mV`` and ``multisine_reference_mV``, the same of the Runge-Kutta;
        ``arrow_apart_mV`` and ``multisine_apart_mV``, root mean square of the difference of the
        two; ``emps_periodic_N`` and ``emps_transient_N``, the residual of the first model.
    """
    folder = Path(os.environ["BAYESOLEO_DATA"]) / "measured"
    with tempfile.TemporaryDirectory() as room:
        return {
            **_silverbox(folder / "silverbox", Path(room), fraction, say),
            **_emps(folder / "emps", Path(room), say),
        }


def _silverbox(data: Path, room: Path, fraction: float, say: Callable[[str], Any]) -> dict:
    theta = _fitted_to_schroeder(data, room / "schroeder")
    say(f"cubic circuit: {', '.join(f'{x:.6g}' for x in theta)}")
    last = ARROW[0] + int(fraction * (ARROW[1] - ARROW[0]))
    count = max(int(fraction * len(MULTISINES)), 1)
    parts = {"arrow": ((ARROW[0], last),), "multisine": MULTISINES[:count]}
    file = io.loadmat(data / "SNLS80mV.mat")
    raw = np.stack([np.ravel(file[name]) for name in ("V1", "V2")])
    raw -= raw.mean(axis=1, keepdims=True)
    found = {}
    for name, runs in parts.items():
        toml = _voltages("SNLS80mV", raw_means(file)) + "".join(
            _run(f"{name} {k}", "SNLS80mV.mat", a / RATE, (b - 0.5) / RATE)
            for k, (a, b) in enumerate(runs)
        )
        records = reduce_campaign(_campaign(room / name, toml, data / "SNLS80mV.mat")).records
        predictor = Predictor(OSCILLATOR, records)
        assert predictor.set_anchor(theta) == [Status.CONVERGED] * len(records)
        errors, others, apart = [], [], []
        for r, ((a, _), record) in enumerate(zip(runs, records, strict=True)):
            y = predictor.simulate(theta[None], r).y[0, 0]
            start = predictor.runs[r].initial(predictor.constants(theta[None], r)).state[0]
            reference = _runge_kutta(raw[0], a, y.size, theta, start)
            measured = record.samples["output_voltage"]
            errors.append(y - measured)
            others.append(reference - measured)
            apart.append(y - reference)
        for key, values in (("", errors), ("_reference", others), ("_apart", apart)):
            found[f"{name}{key}_mV"] = 1e3 * float(np.sqrt(np.mean(np.concatenate(values) ** 2)))
        say(f"{name}: {found}")
    return found


def raw_means(file: dict[str, Array]) -> tuple[float, float]:
    """Offsets of both channels over a file, V."""
    return float(np.mean(file["V1"])), float(np.mean(file["V2"]))


def _fitted_to_schroeder(data: Path, folder: Path) -> Array:
    file = io.loadmat(data / "Schroeder80mV.mat")
    toml = _voltages("Schroeder80mV", raw_means(file)) + "".join(
        _run(f"block {k}", "Schroeder80mV.mat", *span, frequency=0.596)
        for k, span in enumerate(((17.354, 35.799), (195.584, 214.030)), 1)
    )
    campaign = _campaign(folder, toml, data / "Schroeder80mV.mat")
    return _estimate(campaign, OSCILLATOR)


def _voltages(name: str, means: tuple[float, float]) -> str:
    return HEAD.format(name) + "".join(
        CHANNEL.format(channel, column, "V", -mean)
        for channel, column, mean in zip(
            ("input_voltage", "output_voltage"), ("V1", "V2"), means, strict=True
        )
    )


def _run(label: str, file: str, start: float, stop: float, frequency: float | None = None) -> str:
    kind = 'kind = "transient"' if frequency is None else f"frequency = {frequency}"
    if frequency is not None:
        kind = f'kind = "periodic"\n{kind}'
    return (
        f'[[runs]]\nlabel = "{label}"\nfile = "{file}"\n{kind}\nsample_rate = {RATE!r}\n'
        f'start = {start!r}\nstop = {stop!r}\nrole = "fit"\n'
    )


def _campaign(folder: Path, toml: str, *files: Path) -> Any:
    folder.mkdir()
    for file in files:
        (folder / file.name).symlink_to(file)
    (folder / "campaign.toml").write_text(toml, encoding="utf-8")
    return load_campaign(folder)


def _estimate(campaign: Any, model: Model) -> Array:
    tree = bayesoleo._workflow.estimating.estimate(campaign, model, SETTINGS)
    point = tree["point"].to_dataset()
    return np.array([float(point.estimate.sel(parameter=name)) for name in model.estimated()])


def _runge_kutta(whole: Array, first: int, count: int, theta: Array, start: Array) -> Array:
    """The output at `count` samples from `first` on, V."""
    # Half a second of nothing at the end: the series would go on with the beginning.
    padded = np.concatenate([whole, np.zeros(fft.next_fast_len(whole.size + 300) - whole.size)])
    factor = 2 * FINE
    fine = fft.irfft(fft.rfft(padded), padded.size * factor) * factor
    u = fine[first * factor : (first + count) * factor]
    return _walk(u, 1.0 / (RATE * FINE), theta, float(start[0]), float(start[1]), FINE)


@numba.njit
def _rate(u, theta, y, v):
    return theta[3] * u - theta[0] * v - theta[1] * y - theta[2] * y**3


@numba.njit
def _walk(u, h, theta, y, v, every):
    out = np.empty((u.size // 2 + every - 1) // every)
    for n in range(u.size // 2):
        if n % every == 0:
            out[n // every] = y
        if 2 * n + 2 >= u.size:
            break
        a1 = _rate(u[2 * n], theta, y, v)
        v2 = v + 0.5 * h * a1
        a2 = _rate(u[2 * n + 1], theta, y + 0.5 * h * v, v2)
        v3 = v + 0.5 * h * a2
        a3 = _rate(u[2 * n + 1], theta, y + 0.5 * h * v2, v3)
        v4 = v + h * a3
        a4 = _rate(u[2 * n + 2], theta, y + h * v3, v4)
        y, v = y + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return out


def _emps(data: Path, room: Path, say: Callable[[str], Any]) -> dict[str, float]:
    file = io.loadmat(data / "DATA_EMPS.mat")
    force = np.ravel(file["gtau"] * file["vir"])
    table = np.stack([np.ravel(file["t"]), np.ravel(file["qm"]), force], axis=1)
    np.savetxt(room / "emps.csv", table, "%.10g", ",", header="time,position,force", comments="")
    channels = CHANNEL.format("position", "position", "m", 0.0)
    channels += CHANNEL.format("force", "force", "N", 0.0)
    found = {}
    for kind, more in (("periodic", "frequency = 0.16025641\n"), ("transient", "")):
        run = f'[[runs]]\nlabel = "main"\nfile = "emps.csv"\nkind = "{kind}"\n{more}role = "fit"\n'
        toml = HEAD.format("EMPS") + channels + run
        campaign = _campaign(room / kind, toml, room / "emps.csv")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", DataWarning)
            tree = bayesoleo._workflow.estimating.estimate(campaign, DRIVE, SETTINGS)
        for item in said:
            say(str(item.message))
        found[f"emps_{kind}_N"] = float(np.sqrt(tree["point"]["variance"].values[0]))
        point = tree["point"].to_dataset()
        say(str(dict(zip(DRIVE.estimated(), point.estimate.values.tolist(), strict=True))))
    return found


if __name__ == "__main__":
    print(figures())
