"""Many loops in real processes: here, on workers that are killed, and after a kill of the call."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_campaigns import damper, damper_campaign, spring_damper_force, with_friction

from bayesoleo import close_each
from bayesoleo._parallel import connected
from bayesoleo._storage.files import changed_files
from bayesoleo._storage.result_files import read_tree
from bayesoleo._workflow.settings import Settings

pytestmark = pytest.mark.slow
QUICK = Settings(quick=True, max_effects=1)
CALL = """
from bayesoleo import Settings, close_each
from small_campaigns import damper
close_each({campaigns}, damper(), out={out!r}, jobs=2,
           settings=Settings(quick=True, max_effects=1))
"""


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    root = tmp_path_factory.mktemp("rigs")
    for name, force in (("rubbing", with_friction), ("free", spring_damper_force)):
        damper_campaign(root / name, force)
    return [root / "rubbing", root / "free"]


def check(out: Path, names=("rubbing", "free")) -> None:
    """Results are whole, and say what is known of these campaigns."""
    effects = {"rubbing": ["coulomb_friction"], "free": []}
    for name in names:
        folder = out / name / "damper" / "seed-0"
        assert json.loads((folder / "summary.json").read_text())["effects"] == effects[name]
        assert (folder / "report.html").is_file()
        assert changed_files(folder) == []
        assert "posterior" in read_tree(folder / "results.nc").children


@pytest.fixture(scope="module")
def here(campaigns: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("here")
    found = close_each(campaigns, damper(), out=out, jobs=2, settings=QUICK)
    assert [task.state for task in found.tasks] == ["done", "done"]
    return out


def test_processes_of_this_machine(here: Path) -> None:
    check(here)


def test_a_killed_worker_s_tasks_are_done_by_others_with_the_same_result(
    here: Path, campaigns: list[Path], tmp_path: Path
) -> None:
    with connected("local:2") as client:
        workers = list(client.run(os.getpid).values())
        address = client.scheduler.address
        killer = subprocess.Popen(["sh", "-c", f"sleep 8; kill -9 {workers[0]}"])
        found = close_each(campaigns, damper(), out=tmp_path, scheduler=address, settings=QUICK)
        killer.wait()
    assert [(task.state, task.reason) for task in found.tasks] == [("done", None)] * 2
    check(tmp_path)
    for name in ("rubbing", "free"):
        summaries = [
            json.loads((root / name / "damper" / "seed-0" / "summary.json").read_text())
            for root in (here, tmp_path)
        ]
        assert summaries[0] == summaries[1]


def test_a_killed_call_goes_on_and_its_processes_end(campaigns: list[Path], tmp_path: Path) -> None:
    text = CALL.format(campaigns=[str(path) for path in campaigns], out=str(tmp_path / "all"))
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, f"{root}/tests"])}
    with subprocess.Popen([sys.executable, "-c", text], env=environment) as call:
        while not list((tmp_path / "all").rglob("results.nc")):
            assert call.poll() is None
            time.sleep(0.1)
        call.send_signal(signal.SIGKILL)
    found = close_each(campaigns, damper(), out=tmp_path / "all", jobs=2, settings=QUICK)
    assert not found.failed
    check(tmp_path / "all")
