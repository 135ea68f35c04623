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
