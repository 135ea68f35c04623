"""Multisine runs of a campaign are diagnosed before any model, in check, result and report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from multisines import ODD_GRID, PER_PERIOD, campaign, multisine, run
from small_campaigns import CUBIC, DAMPER_CHANNELS, DAMPING, STIFFNESS, damper, damper_campaign

from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._session.campaign import check_text
from bayesoleo._storage.result_files import read_tree
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import multisine_response, prepare
from bayesoleo.data import ReducedCampaign, SimulatedRun, reduce_campaign, write_campaign
from bayesoleo.model import Model, Output, Parameter

LINES, SAMPLES, PERIODS, RATE = tuple(range(1, 20, 2)), 200, 6, 1.0


def broadband(folder: Path, seed: int = 0) -> Path:
    """Three realisations on a damper with a cubic spring, displacement controlled."""
    rng, made = np.random.default_rng(seed), []
    time = np.arange(PERIODS * SAMPLES) / (SAMPLES * RATE)
    for label in "abc":
        x = np.tile(multisine(LINES, rng, 0.004, SAMPLES), PERIODS)
        order = np.fft.rfftfreq(time.size, time[1])
        v = np.fft.irfft(2j * np.pi * order * np.fft.rfft(x), time.size)
        force = DAMPING * v + STIFFNESS * x + 20 * CUBIC * x**3
        samples = {"displacement": x, "force": force + 0.5 * rng.standard_normal(time.size)}
        made.append(SimulatedRun(label, time, samples, RATE, role="fit"))
    write_campaign(
        folder, name="broadband", channels=DAMPER_CHANNELS, runs=made, controlled="displacement"
    )
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return broadband(tmp_path_factory.mktemp("broadband"))


def test_check_says_what_the_runs_show_without_a_model(folder):
    plan = workflow.check(folder, damper(), Settings(jobs=1))
    (sentence,) = plan[schema.FREQUENCY_RESPONSE]
    assert sentence.startswith("from displacement to force at 4.000 mm rms (3 realisations, 10 ex")
    assert "even distortion" in sentence
    assert "scatter between realisations" in sentence
    assert sentence in check_text(plan).splitlines()


@pytest.mark.slow
def test_result_summary_and_report_hold_the_diagnosis(folder, tmp_path):
    tree = workflow.trace(folder, damper(), Settings(jobs=1), out=tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    (entry,) = summary[schema.FREQUENCY_RESPONSE]
    assert (entry["drive"], entry["output"], entry["lines"]) == ("displacement", "force", 10)
    assert entry["runs"] == ["a", "b", "c"]
    assert entry["distortion"]["even"]["p_value"] > 0.001
    assert entry["stochastic"]["p_value"] < 1e-6
    back = read_tree(tmp_path / "out" / "results.nc")[schema.FREQUENCY_RESPONSE].to_dataset()
    assert back.equals(tree[schema.FREQUENCY_RESPONSE].to_dataset())
    assert back["response"].dims == ("output", "level", "line", "part")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Noise and distortion by frequency, without a model" in page
    assert "could not be drawn" not in page


def test_sines_with_harmonics_are_no_multisines(tmp_path):
    reduced = damper_campaign(tmp_path)
    task = prepare(reduced, damper(), Settings(jobs=1))
    assert task.frequency_response is None
    assert schema.FREQUENCY_RESPONSE not in workflow.check(reduced, damper(), Settings(jobs=1))


def two_inputs(second) -> ReducedCampaign:
    """Two runs with ``force`` and ``second``, of which one has the values that are given."""
    rng, made = np.random.default_rng(0), []
    for label, values in (("both", second), ("one", np.zeros(PER_PERIOD))):
        u = multisine(ODD_GRID, rng)
        one = run(label, u, u + values, rng, noise=0.01, input_noise=1e-4)
        more = np.tile(values, 4) + 1e-4 * rng.standard_normal(one.time.size)
        made.append(replace(one, samples={**one.samples, "second": more}))
    return reduce_campaign(campaign(made, controlled=None), jobs=1)


MODEL = Model(
    "two inputs",
    inputs={"force": "N", "second": "N"},
    parameters={"k": Parameter(1.0, "m/N", sd=1.0)},
    outputs={"displacement": Output({"spring": "k*(force + second)"}, "m")},
)


def test_a_run_that_two_inputs_share_is_left_out_and_said_so():
    shared = two_inputs(multisine(ODD_GRID, np.random.default_rng(1)))
    data, notes = multisine_response(shared, MODEL)
    assert json.loads(str(data["runs"].values[0])) == ["one"]
    (note,) = notes
    assert note.startswith("run both takes no part in the frequency response: force and another")
    both = replace(shared, records=shared.records[:1])
    data, (note,) = multisine_response(both, MODEL)
    assert data is None
    assert note.startswith("multisine runs were not looked at: ")


def test_the_first_input_that_is_a_multisine_is_the_drive():
    sine = two_inputs(multisine((2,), np.random.default_rng(1)))
    swapped = replace(MODEL, inputs={"second": "N", "force": "N"})
    data, notes = multisine_response(sine, swapped)
    assert data.attrs["drive"] == "force"
    assert data["output"].values.tolist() == ["displacement"]
    assert notes == []
    assert (data["kind"].values == "other input").any()
