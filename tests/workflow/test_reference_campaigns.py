"""The marks on measured and simulated campaigns that everybody is held to."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._workflow.closing import run_loop
from bayesoleo._workflow.model_files import load_model
from bayesoleo._workflow.output import ResultFolder, Stages, write_result
from bayesoleo._workflow.settings import Settings

pytestmark = pytest.mark.reference
STUDIES = Path(__file__).parents[2] / "studies" / "measured"


def summary_of(folder: Path, model: str) -> dict:
    """Close the loop but for the sampling, which changes no error and no verdict."""
    reduced = workflow.reduce(folder)
    task = workflow.prepare(reduced, load_model(model), Settings())
    stages = Stages()
    loop = run_loop(task, Settings().max_effects, stages, ResultFolder(None))
    assert stages.failed == []
    tree = write_result(task, loop, None, ResultFolder(None), stages)
    return json.loads(tree.attrs[schema.SUMMARY])


def on_hold_out(summary: dict, key: str, when: int = -1) -> dict[tuple[str, str], float]:
    """A figure of every held-out run by output and run, of the last round or another."""
    return {
        (output, run): entry[key]
        for output, runs in summary["rounds"][when]["error"].items()
        for run, entry in runs.items()
        if entry["role"] == schema.HOLD_OUT
    }


@pytest.mark.slow
def test_a_complete_oleo_lacks_nothing(data_set):
    folder = data_set("campaigns/shaker-plain")
    summary = summary_of(folder, "f16n2d2")
    assert summary["verdict"] == schema.NOTHING_MISSING
    assert summary["effects"] == []
    ratios = on_hold_out(summary, "ratio_to_noise")
    assert {output for output, _ in ratios} == {"force", "pressure"}
    assert max(ratios.values()) <= 1.15


@pytest.mark.slow
def test_a_polytropic_oleo_lacks_heat_exchange_and_solubility(data_set):
    folder = data_set("campaigns/shaker-plain")
    summary = summary_of(folder, "f16n1d2")
    found = set()
    for entry in summary["rounds"]:
        accepted = next((c for c in entry["candidates"] if c["effect"] == entry["accepted"]), None)
        if accepted is not None:
            found |= {accepted["effect"], *accepted["indistinguishable_from"]}
    assert {"heat_exchange", "gas_solubility"} <= found
    # Solubility exists beside gas of its own temperature only; the declared model has no score.
    likely = {one["effect"]: one["probability"] for one in summary["structures"]["effects"]}
    assert min(likely["heat_exchange"], likely["gas_solubility"]) > 0.9
    assert max(on_hold_out(summary, "ratio_to_noise", 0).values()) > 3
    assert max(on_hold_out(summary, "ratio_to_noise").values()) <= 1.3


@pytest.mark.slow
def test_the_silverbox_lacks_a_cubic_spring_first(data_set):
    data_set("measured/silverbox")
    folder = STUDIES / "silverbox"
    summary = summary_of(folder, f"{folder / 'model.py'}:model")
    assert summary["effects"][0] == "cubic_stiffness"
    before, after = (on_hold_out(summary, "repeating", k) for k in (0, -1))
    assert all(value > 5e-3 for value in before.values())
    assert all(value <= 0.39e-3 for value in after.values())


@pytest.mark.slow
def test_the_mr_damper_lacks_friction_with_memory_then_stiffness(data_set):
    data_set("measured/mr_damper")
    folder = STUDIES / "mr_damper"
    summary = summary_of(folder, f"{folder / 'model.py'}:model")
    memory = {"dahl_friction", "bouc_wen_friction", "lugre_friction"}
    assert summary["effects"][0] in memory
    assert any("stiffness" in name for name in summary["effects"][1:])
    # Nothing that was added is said to depend on something else.
    assert not any(name.endswith("_dependent_term") for name in summary["effects"])
    assert len(memory.intersection(summary["effects"])) == 1
    assert not summary["certain"]
    before, after = (on_hold_out(summary, "rms", k) for k in (0, -1))
    assert all(value > 25.0 for value in before.values())
    assert all(value <= 9.0 for value in after.values())


@pytest.mark.slow
def test_the_mbari_gas_spring_lacks_heat_exchange(data_set):
    data_set("measured/mbari_gas_spring")
    folder = STUDIES / "mbari_gas_spring"
    summary = summary_of(folder, f"{folder / 'model.py'}:model")
    # A transient's noise is what neighbouring samples show; beside it a wall that stores heat is
    # significant too, and the run that was not used confirms it: its error falls from 0.73 psi.
    assert summary["effects"][0] == "heat_exchange"
    assert set(summary["effects"]) <= {"heat_exchange", "wall_heat_capacity"}
    # The state at 205 s, of the gas and of the wall where there is one, is estimated on the run
    # that was not used; nothing else is.
    assert summary["re_estimated"] == len(summary["effects"])
    psi, (first, last) = 6894.757, (summary["rounds"][k]["error"]["pressure"] for k in (0, -1))
    before = {run: entry["rms"] / psi for run, entry in first.items()}
    after = {run: entry["rms"] / psi for run, entry in last.items()}
    assert min(before.values()) > 4.0
    # A quick fit of a gas with one time constant reached 0.43 and 0.74 psi.
    assert after["before 205 s"] <= 0.5
    assert after["after 205 s"] <= 0.75


@pytest.mark.slow
def test_an_oleo_in_a_compliant_frame_lacks_that_and_nothing_else(data_set):
    summary = summary_of(data_set("campaigns/shaker-compliance"), "f16n2d2")
    assert summary["effects"] == ["frame_compliance"]
    # Its size in the simulation is 1.5e-7 m/N.
    found = summary["parameters"]["frame_compliance"]["estimate"]
    assert found == pytest.approx(1.5e-7, rel=0.03)
    assert max(on_hold_out(summary, "ratio_to_noise").values()) <= 1.15
