"""An input that a model differentiates into what was not measured is cut off, and that is said."""

import warnings

import numpy as np
import pytest

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.errors import DataWarning
from bayesoleo.model import Model, Output, Parameter

TIME = 1e-3 * np.arange(6000)
MODEL = Model(
    "mass",
    inputs={"x": "m"},
    parameters={"mass": Parameter(5.0, "kg", sd=1.0)},
    outputs={"force": Output("mass*ddot(x)", "N")},
)


@pytest.fixture
def campaign(tmp_path):
    """A mass on an encoder that hums at 180 Hz, periodic or not."""

    def write(kind, more=""):
        rng = np.random.default_rng(0)
        turn = 2 * np.pi * TIME
        x = 0.1 * np.sin(turn) + 0.03 * np.sin(3 * turn)
        force = -5.0 * (2 * np.pi) ** 2 * (0.1 * np.sin(turn) + 0.27 * np.sin(3 * turn))
        x += 3e-6 * np.sin(180 * turn) + 1e-7 * rng.standard_normal(x.size)
        force += 0.02 * rng.standard_normal(x.size)
        np.savetxt(
            tmp_path / "a.csv",
            np.stack([TIME, x, force], axis=1),
            "%.10g",
            ",",
            header="time,x,force",
            comments="",
        )
        frequency = "frequency = 1.0\n" if kind == "periodic" else ""
        (tmp_path / "campaign.toml").write_text(
            'format = 1\nname = "hum"\n'
            f'[channels.x]\ncolumn = "x"\nunit = "m"\n{more}\n'
            '[channels.force]\ncolumn = "force"\nunit = "N"\n'
            f'[[runs]]\nlabel = "a"\nfile = "a.csv"\nkind = "{kind}"\n{frequency}role = "fit"\n',
            encoding="utf-8",
        )
        return tmp_path

    return write


@pytest.mark.parametrize("kind", ["periodic", "transient"])
def test_what_is_invented_is_said_and_cut_off(campaign, kind):
    sentence = r"run a: above [\d.]+ Hz the model makes 14 N of force out of 2.1e-06 m of x by"
    with pytest.warns(DataWarning, match=sentence):
        task = prepare(campaign(kind), MODEL, Settings(drive="model"))
    record = task.roles.fitted[0]
    signal = record.signals["x"].for_derivative(2)
    found = signal.evaluate(record.position, record.rate, 2)
    assert np.abs(found[300:-300]).max() < 18.0  # 180 Hz alone are 3.8, on 15 of the motion


@pytest.mark.parametrize("kind", ["periodic", "transient"])
def test_a_declared_bandwidth_silences_it(campaign, kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        task = prepare(campaign(kind, "bandwidth = inf"), MODEL, Settings(drive="model"))
        lower = prepare(campaign(kind, "bandwidth = 50"), MODEL, Settings(drive="model"))
    for done, hum in ((task, 2.7), (lower, 0.0)):
        record = done.roles.fitted[0]
        signal = record.signals["x"].for_derivative(2)
        bend = signal.evaluate(record.position, record.rate, 2)[300:-300]
        turn = 2 * np.pi * record.time[300:-300]
        true = -((2 * np.pi) ** 2) * (0.1 * np.sin(turn) + 0.27 * np.sin(3 * turn))
        assert np.std(bend - true) == pytest.approx(hum, abs=0.4)
