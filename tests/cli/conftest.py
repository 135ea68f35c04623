"""A small good campaign and model to break, and the ways to run a command."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from small_rig import CAMPAIGN, MODEL, rows, write_rows
from typer.testing import CliRunner

from bayesoleo._cli import app

TREE = Path(__file__).parents[1] / "plots" / "synthetic_tree.py"


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    folder = tmp_path / "rig"
    folder.mkdir()
    (folder / "campaign.toml").write_text(CAMPAIGN)
    for label, frequency in (("slow", 1.0), ("fast", 2.0)):
        write_rows(folder / f"{label}.csv", rows(frequency))
    return folder


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "spring.py"
    path.write_text(MODEL)
    return path


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable:
    """Run a command in an empty folder, ``work``."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.delenv("BAYESOLEO_DEBUG", raising=False)

    def invoke(*arguments: object):
        return CliRunner().invoke(app, [str(item) for item in arguments])

    return invoke


@pytest.fixture
def refused(run: Callable, tmp_path: Path) -> Callable:
    """Run a command that cannot be done: one line, exit status 2, nothing written anywhere."""

    def invoke(*arguments: object) -> str:
        before = sorted(tmp_path.rglob("*"))
        result = run(*arguments)
        assert result.exit_code == 2, result.output
        assert result.stdout == ""
        told = result.stderr.splitlines()
        # A command that takes long says that it has begun before it has read what it was given.
        (line,) = [line for line in told if not line.endswith(": loading libraries")]
        assert line.startswith("error: ")
        assert "Traceback" not in line
        assert sorted(tmp_path.rglob("*")) == before
        return line

    return invoke


@pytest.fixture
def process(tmp_path: Path) -> Callable:
    """Run the real command in a process of its own."""

    def start(*arguments: object, **options: object) -> subprocess.CompletedProcess:
        command = [sys.executable, "-W", "error", "-m", "bayesoleo", *map(str, arguments)]
        return subprocess.run(
            command, capture_output=True, text=True, cwd=tmp_path, timeout=120, **options
        )

    return start


@pytest.fixture(scope="session")
def made_up():
    """Results from closed formulas, made for the plots' tests."""
    spec = importlib.util.spec_from_file_location("synthetic_tree_of_commands", TREE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
