"""The command ``each``: exit statuses, table and JSON; the loop is a stub."""

from __future__ import annotations

import json

import pytest

from bayesoleo import _parallel as parallel
from bayesoleo._workflow.each_task import Outcome
from bayesoleo.errors import UnfinishedError

SUMMARY = {
    "effects": [],
    "certainty": None,
    "units": {"force": "N"},
    "error_before": {"fit": {"force": {"rms": 3.0, "ratio_to_noise": 1.0}}},
    "error_after": {"fit": {"force": {"rms": 3.0, "ratio_to_noise": 1.0}}},
}


@pytest.fixture
def reasons(monkeypatch) -> dict[int, str]:
    """Why tasks fail, by their seed."""
    found: dict[int, str] = {}

    def stub(work, _stopped=None):
        reason = found.get(work.settings.seed, "")
        work.out.mkdir(parents=True, exist_ok=True)
        (work.out / "summary.json").write_text(json.dumps(SUMMARY))
        return Outcome(reason, 1.5)

    monkeypatch.setattr(parallel, "in_own_process", stub)
    return found


def test_all_are_done(run, campaign, model, tmp_path, reasons):
    arguments = ["each", campaign, "--model", model, "--seeds", 2, "--out", tmp_path / "all"]
    result = run(*arguments, "--quiet")
    assert result.exit_code == 0, result.output
    assert "2 of 2 tasks are done" in result.stdout
    assert "rig/spring/seed-1" in result.stdout
    found = json.loads(run(*arguments, "--json", "--quiet").stdout)
    assert [task["status"] for task in found["tasks"]] == ["done", "done"]
    assert [task["error_before"] for task in found["tasks"]] == [3.0, 3.0]


def test_some_failed(run, campaign, model, tmp_path, reasons):
    reasons[1] = "run slow: too short"
    arguments = ["each", campaign, "--model", model, "--seeds", 2, "--out", tmp_path / "all"]
    result = run(*arguments)
    assert result.exit_code == 1
    assert "failed    rig/spring/seed-1: run slow: too short" in result.stdout
    assert "1 of 2 tasks is done" in result.stdout
    assert result.stderr == "rig/spring/seed-1 failed: run slow: too short\n"


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (["nowhere"], "no such folder"),
        (["--jobs", 1, "--scheduler", "local:2"], "no meaning with a scheduler"),
        (["--model", "f16n2d3"], "did you mean"),
        (["--without", "f16n2d2"], "unknown effect"),
    ],
)
def test_nothing_is_run_where_something_is_wrong(refused, campaign, model, tmp_path, wrong, text):
    out = tmp_path / "all"
    assert text in refused("each", campaign, "--model", model, "--out", out, *wrong)


def test_a_lost_scheduler_and_a_stop(run, campaign, model, tmp_path, monkeypatch):
    from bayesoleo import _workflow

    def ending(error):
        def close_each(*_, **__):
            raise error

        return close_each

    arguments = ["each", campaign, "--model", model, "--out", tmp_path / "all"]
    lost = UnfinishedError([{"stage": "each", "reason": "the scheduler was lost"}], None)
    monkeypatch.setattr(_workflow, "close_each", ending(lost), raising=False)
    result = run(*arguments)
    assert result.exit_code == 3
    assert result.stderr == "error: unfinished: each: the scheduler was lost\n"
    monkeypatch.setattr(_workflow, "close_each", ending(KeyboardInterrupt()), raising=False)
    result = run(*arguments)
    assert result.exit_code == 130
    assert "the same command does the others" in result.stderr
