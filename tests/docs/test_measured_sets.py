"""Campaigns and models of the measured sets fit together, and results are kept while they last."""

from __future__ import annotations

import json
import subprocess
import tomllib
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from bayesoleo import load_model
from bayesoleo.data._campaign import REGISTERED
from bayesoleo.gallery import print_added
from bayesoleo.model import driven_by

ROOT = Path(__file__).resolve().parents[2]


def loaded(path: Path) -> ModuleType:
    """A module of the folder of studies, which is on no path."""
    spec = spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


measured_sets = loaded(ROOT / "studies" / "measured_sets.py")
measured_pages = loaded(ROOT / "studies" / "measured_pages.py")
CAMPAIGNS = sorted((ROOT / "studies" / "measured").rglob("campaign.toml"))


@pytest.mark.parametrize("path", CAMPAIGNS, ids=lambda path: path.parent.name)
def test_files_of_a_campaign_are_registered(path):
    declared = tomllib.loads(path.read_text(encoding="utf-8"))
    known = REGISTERED[declared["dataset"]].hashes
    assert {run["file"] for run in declared["runs"]} <= set(known)


@pytest.mark.parametrize("name", measured_sets.SETS)
def test_a_model_takes_and_gives_the_channels_of_its_campaign(name):
    folder = ROOT / "studies" / "measured" / name
    declared = tomllib.loads((folder / "campaign.toml").read_text(encoding="utf-8"))
    model = load_model(folder / "model.py")
    if "controlled" in declared:
        model = driven_by(model, declared["controlled"])
    assert {*model.inputs, *model.outputs} <= set(declared["channels"])


def test_a_result_is_kept_until_the_set_changes(tmp_path, monkeypatch):
    begun = []

    def run(command, **options):
        begun.append(command)
        out = json.dumps({"emps_fit_N": 1.5})
        return SimpleNamespace(returncode=0, stdout=out, stderr="")

    monkeypatch.setattr(subprocess, "run", run)
    for version, calls in (("a", 1), ("a", 1), ("b", 2)):
        monkeypatch.setattr(measured_sets, "version", lambda name, now=version: now)
        assert measured_sets.kept("emps", tmp_path, 1) == {"emps_fit_N": 1.5}
        assert len(begun) == calls


def test_a_set_that_fails_says_why_and_is_tried_again(tmp_path, monkeypatch):
    failed = SimpleNamespace(returncode=1, stdout="", stderr="before\nInputError: no such file")
    monkeypatch.setattr(subprocess, "run", lambda command, **options: failed)
    found = measured_sets.kept("cascaded_tanks", tmp_path, 1)
    assert found == {"tanks_failed": "InputError: no such file"}
    assert not list(tmp_path.iterdir())


def test_a_set_in_which_nothing_was_found_says_nothing():
    assert measured_sets.found_in({"effects": [], "rounds": []}) == ""


def test_all_sets_are_told_also_one_that_failed(tmp_path, monkeypatch, capsys):
    figures = {}
    for short in measured_pages.SOURCES:
        figures |= {f"{short}_certainty": "likeness", f"{short}_seconds": 61.4}
        figures |= {f"{short}_found": f"an effect of {short}\n  c  1.0 … 2.0"}
    del figures["emps_certainty"], figures["emps_found"]
    figures |= {"emps_failed": "killed", "tanks_found": "", "tanks_certainty": ""}
    (tmp_path / "measured.json").write_text(json.dumps({"figures": figures}))
    monkeypatch.setattr(measured_pages, "TABLE", tmp_path / "measured.json")
    measured_pages.print_all_found()
    told = capsys.readouterr().out
    assert "Silverbox: likeness, 61 s\n  an effect of silverbox\n    c  1.0 … 2.0\n" in told
    assert "EMPS drive: killed\n" in told
    assert "cascaded tanks: no name, 61 s\n  nothing was added\n" in told


def test_errors_stand_beside_published_ones(tmp_path, monkeypatch, capsys):
    figures = {"silverbox_arrow_mV": 0.5, "emps_position_mm": 0.4, "brfd_holdout_kip": 0.3}
    (tmp_path / "measured.json").write_text(json.dumps({"figures": figures}))
    monkeypatch.setattr(measured_pages, "TABLE", tmp_path / "measured.json")
    measured_pages.print_all_errors()
    told = capsys.readouterr().out
    assert "0.5 mV   0.6 GP-NARX, 1.4 SUBNET" in told
    assert "Vargas 2021" in told
    (axes,) = measured_pages.beside_published().axes
    assert [item.get_text() for item in axes.get_yticklabels()] == [
        "Silverbox, arrow",
        "EMPS, position on the pulses",
    ]


def test_a_long_unit_does_not_run_into_its_number(capsys):
    name, unit = "quadratic", "(kg·m²/A/s⁵)/V²"
    shared = {"mean": -4659.0, "interval": None, "unit": unit, "shared_with": "another"}
    entry = {"effect": "quadratic_stiffness", "target": "y", "expected": {name: 0.0}}
    candidates = [{**entry, "accepted": True}]
    rounds = [{"accepted": "quadratic_stiffness", "accepted_target": "y", "candidates": candidates}]
    summary = {
        "effects": ["quadratic_stiffness"], "targets": ["y"], "rounds": rounds,
        "parameters": {name: shared},
    }  # fmt: skip
    print_added(summary)
    assert f"4659 {unit}   shared with another" in capsys.readouterr().out
