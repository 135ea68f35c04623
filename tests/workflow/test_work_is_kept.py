"""What is known is written as soon as it is known, and a late failure takes nothing with it."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_campaigns import damper, damper_campaign
from typer.testing import CliRunner

import bayesoleo._worker_processes as processes
from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._cli import app
from bayesoleo._cli.shell import UNFINISHED
from bayesoleo._storage.result_files import read_tree
from bayesoleo._workflow import closing, output, structures_beside
from bayesoleo._workflow.settings import Settings
from bayesoleo.discovery import _loop as search
from bayesoleo.effects import find_effect
from bayesoleo.errors import InputError, UnfinishedError

EFFECTS = tuple(map(find_effect, ("coulomb_friction", "quintic_stiffness")))
SETTINGS = Settings(quick=True, jobs=1, effects=EFFECTS, seed=5, error_model="independent")
FAULT = "NameError: name 'dahl_friction_memory' is not defined"


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("campaign")
    damper_campaign(folder)
    return folder


@pytest.fixture(scope="module")
def whole(campaign, tmp_path_factory):
    """Nothing failed."""
    return workflow.close(campaign, damper(), SETTINGS, out=tmp_path_factory.mktemp("whole"))


def broken(*_, **__):
    raise NameError(FAULT.removeprefix("NameError: "))


def failing_round(number):
    """A round that breaks off: the work of the rounds before must stay."""
    counted = iter(range(1, 99))

    def examine(*arguments, **more):
        return broken() if next(counted) == number else rightly(*arguments, **more)

    rightly = search.examine
    return examine


def without_draws(monkeypatch):
    """Sampling takes most of the time, and is not what these tests are about."""
    monkeypatch.setattr(closing, "draw", lambda *_: None)


def without_page(monkeypatch):
    """So do figures."""
    monkeypatch.setattr(output, "write_report", lambda *_: [])


def read_back(folder: Path) -> tuple[dict, str]:
    """Summary and page of a folder; the three files agree."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    schema.validate_summary(summary)
    tree = read_tree(folder / "results.nc")
    assert json.loads(tree.attrs[schema.SUMMARY]) == summary
    return summary, (folder / "report.html").read_text(encoding="utf-8")


def check_unfinished(folder: Path, error: UnfinishedError, stage: str) -> dict:
    summary, page = read_back(folder)
    assert summary["unfinished"][0]["stage"] == stage
    assert FAULT in summary["unfinished"][0]["reason"]
    assert FAULT in page.replace("&#39;", "'").replace("&#x27;", "'")
    assert FAULT in str(error)
    assert isinstance(error.__cause__, NameError)
    assert json.loads(error.tree.attrs[schema.SUMMARY]) == summary
    return summary


@pytest.mark.slow
def test_a_search_that_breaks_off_keeps_the_rounds_before(campaign, whole, tmp_path, monkeypatch):
    without_draws(monkeypatch)
    monkeypatch.setattr(search, "examine", failing_round(2))
    with pytest.raises(UnfinishedError, match=r"search: NameError: .*what is known") as caught:
        workflow.close(campaign, damper(), SETTINGS, out=tmp_path)
    summary = check_unfinished(tmp_path, caught.value, "search")
    assert summary["effects"] == ["coulomb_friction"]
    assert summary["rounds"][-1]["reason"].startswith("the search broke off here: ")

    said: list[str] = []
    monkeypatch.undo()
    tree = workflow.close(campaign, damper(), SETTINGS, out=tmp_path, callback=said.append)
    assert any(text.startswith("go on after round 1") for text in said)
    assert not any(text.startswith("round 1:") for text in said)
    ours, theirs = (json.loads(item.attrs[schema.SUMMARY]) for item in (tree, whole))
    assert ours == theirs
    assert read_back(tmp_path)[0]["unfinished"] == []


def test_a_search_that_breaks_off_at_once_keeps_the_estimate(campaign, tmp_path, monkeypatch):
    monkeypatch.setattr(search, "examine", broken)
    with pytest.raises(UnfinishedError) as caught:
        workflow.trace(campaign, damper(), SETTINGS, out=str(tmp_path))
    summary = check_unfinished(tmp_path, caught.value, "search")
    # Friction that the model lacks looks like damping.
    assert summary["parameters"]["damping"]["estimate"] > 200.0
    assert summary["effects"] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "module", "name"),
    [
        ("proposals", closing, "what_next"),
        ("predictions", output, "loop_groups"),
        ("report", output, "write_report"),
        ("report", output, "summarise"),
    ],
)
def test_a_late_stage_that_fails_leaves_the_others(
    campaign, tmp_path, monkeypatch, stage, module, name
):
    rightly, written = getattr(module, name), tmp_path / "results.nc"

    def late(*arguments, **more):  # fails once the first estimate has been written
        return broken() if written.exists() else rightly(*arguments, **more)

    monkeypatch.setattr(module, name, late)
    with pytest.raises(UnfinishedError) as caught:
        workflow.trace(campaign, damper(), SETTINGS, out=tmp_path)
    summary = check_unfinished(tmp_path, caught.value, stage)
    assert summary["parameters"]["damping"]["estimate"] > 200.0
    assert summary["rounds"][0]["error"]["force"]["a"]["ratio_to_noise"] > 2.0


@pytest.mark.slow
def test_a_figure_that_fails_leaves_the_page(campaign, tmp_path, monkeypatch):
    monkeypatch.setattr("bayesoleo.plots.records", broken)
    with pytest.raises(UnfinishedError, match="figure of the data could not be drawn"):
        workflow.trace(campaign, damper(), SETTINGS, out=tmp_path)
    summary, page = read_back(tmp_path)
    assert [item["stage"] for item in summary["unfinished"]] == ["report"]
    assert "<figure>" in page
    assert "could not be drawn" in page


@pytest.mark.slow
def test_a_posterior_that_fails_leaves_the_effect(campaign, tmp_path, monkeypatch):
    monkeypatch.setattr(closing, "draw", broken)
    with pytest.raises(UnfinishedError) as caught:
        workflow.close(campaign, damper(), SETTINGS, out=tmp_path)
    summary = check_unfinished(tmp_path, caught.value, "posterior")
    assert summary["effects"] == ["coulomb_friction"]
    assert summary["parameters"]["damping"]["interval"] is None
    assert len(summary["unfinished"]) == 1


@pytest.mark.parametrize(
    ("name", "stage"), [("structures_of", "search"), ("questions_of", "proposals")]
)
def test_what_is_compared_beside_the_draws_may_fail(campaign, tmp_path, monkeypatch, name, stage):
    monkeypatch.setattr(structures_beside, name, broken)
    with pytest.raises(UnfinishedError) as caught:
        workflow.close(campaign, damper(), SETTINGS, out=tmp_path)
    summary = check_unfinished(tmp_path, caught.value, stage)
    assert summary["effects"] == ["coulomb_friction"]
    assert summary["parameters"]["damping"]["interval"] is not None
    # Without probabilities nothing is certain.
    assert (summary["certainty"] == schema.CERTAIN) == summary["certain"]
    assert not (summary["certain"] and stage == "search")
    assert ("probability" in json.dumps(summary["structures"])) == (stage == "proposals")


def test_without_a_folder_the_error_carries_what_is_known(campaign, monkeypatch):
    monkeypatch.setattr(closing, "draw", broken)
    with pytest.raises(UnfinishedError, match=r"dahl_friction_memory") as caught:
        workflow.close(campaign, damper(), SETTINGS)
    assert schema.DISCOVERY in caught.value.tree.children
    assert caught.value.folder is None


def test_what_is_shown_early_may_fail(campaign, tmp_path, monkeypatch):
    """Then nothing is drawn ahead, and the result is whole."""
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    without_draws(monkeypatch)
    monkeypatch.setattr(closing, "finish", broken)
    workflow.close(campaign, damper(), replace(SETTINGS, jobs=2), out=tmp_path)
    summary, page = read_back(tmp_path)
    assert summary["unfinished"] == []
    assert "<figure>" in page


def test_an_interrupt_while_that_is_made_leaves_the_processes_free(campaign, tmp_path, monkeypatch):
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    monkeypatch.setattr(closing, "WORTH_KEEPING", math.inf)  # however slow the machine is

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(closing, "finish", interrupted)
    with pytest.raises(KeyboardInterrupt):
        workflow.close(campaign, damper(), replace(SETTINGS, jobs=2), out=tmp_path)
    assert not processes._in_use.locked()


@pytest.mark.slow
def test_predictions_that_fail_are_told_once(campaign, tmp_path, monkeypatch):
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    without_draws(monkeypatch)
    monkeypatch.setattr(output, "loop_groups", broken)
    with pytest.raises(UnfinishedError) as caught:
        workflow.close(campaign, damper(), replace(SETTINGS, jobs=2), out=tmp_path)
    summary = check_unfinished(tmp_path, caught.value, "predictions")
    assert len(summary["unfinished"]) == 1


@pytest.mark.slow
def test_a_sample_that_fails_leaves_the_estimate(campaign, tmp_path, monkeypatch):
    monkeypatch.setattr("bayesoleo._workflow.estimating.draw", broken)
    with pytest.raises(UnfinishedError, match="posterior"):
        workflow.sample(campaign, damper(), SETTINGS, out=str(tmp_path))
    tree = read_tree(tmp_path / "results.nc")
    assert float(tree[schema.POINT][schema.ESTIMATE][0]) > 200.0
    assert json.loads(tree.attrs[schema.UNFINISHED])[0]["stage"] == "posterior"


def test_an_estimate_that_fails_is_an_error_and_leaves_an_older_result(
    campaign, tmp_path, monkeypatch
):
    (tmp_path / "results.nc").write_text("older")
    without_page(monkeypatch)
    monkeypatch.setattr(search, "fit_state", broken)
    with pytest.raises(NameError):
        workflow.close(campaign, damper(), SETTINGS, out=tmp_path)
    assert (tmp_path / "results.nc").read_text() == "older"


@pytest.mark.slow
def test_an_older_result_is_put_aside_until_the_new_one_is_complete(
    campaign, tmp_path, monkeypatch
):
    for name in output.FILES:
        (tmp_path / name).write_text(f"older {name}")
    monkeypatch.setattr(search, "examine", broken)
    with pytest.raises(UnfinishedError):
        workflow.trace(campaign, damper(), SETTINGS, out=tmp_path)
    for name in output.FILES:
        assert (tmp_path / "older" / name).read_text() == f"older {name}"
    monkeypatch.undo()
    workflow.trace(campaign, damper(), SETTINGS, out=tmp_path)
    assert not (tmp_path / "older").exists()
    assert read_back(tmp_path)[0]["unfinished"] == []


def test_a_folder_that_fails_on_the_way_does_not_end_the_work(campaign, tmp_path, monkeypatch):
    said: list[str] = []
    without_page(monkeypatch)
    monkeypatch.setattr(closing, "result_tree", broken)
    tree = workflow.trace(campaign, damper(), SETTINGS, out=tmp_path, callback=said.append)
    assert any("could not be written" in text for text in said)
    assert json.loads(tree.attrs[schema.SUMMARY])["unfinished"] == []


@pytest.mark.slow
def test_a_search_of_seconds_writes_once_and_is_kept_all_the_same(campaign, tmp_path, monkeypatch):
    without_draws(monkeypatch)
    without_page(monkeypatch)
    rightly, there = search.examine, []

    def examine(*arguments, **more):
        there.append(((tmp_path / "results.nc").exists(), kept.exists()))
        return rightly(*arguments, **more)

    kept = tmp_path / "checkpoints" / "search.pickle"
    monkeypatch.setattr(search, "examine", examine)
    workflow.close(campaign, damper(), SETTINGS, out=tmp_path)
    assert there == [(False, True)] * 2
    assert (tmp_path / "results.nc").exists()


@pytest.mark.slow
def test_a_result_whose_draws_cannot_be_written_leaves_the_effect(campaign, tmp_path, monkeypatch):
    rightly = output.result_tree

    def with_draws(task, loop, drawn, *more):
        return broken() if drawn is not None else rightly(task, loop, drawn, *more)

    monkeypatch.setattr(output, "result_tree", with_draws)
    monkeypatch.setattr(closing, "draw", lambda *_: ())
    with pytest.raises(UnfinishedError) as caught:
        workflow.close(campaign, damper(), SETTINGS, out=tmp_path)
    summary = check_unfinished(tmp_path, caught.value, "report")
    assert summary["effects"] == ["coulomb_friction"]
    assert [one["stage"] for one in summary["unfinished"]] == ["report", "posterior"]


@pytest.mark.slow
def test_files_that_fail_beside_the_figures_are_tried_again(campaign, tmp_path, monkeypatch):
    rightly, tried = output.write_files, []

    def write_files(*arguments):
        tried.append(len(tried))
        return broken() if tried == [0] else rightly(*arguments)

    monkeypatch.setattr(output, "write_files", write_files)
    without_draws(monkeypatch)
    monkeypatch.setattr(output, "write_report", _page_of_nothing)
    tree = workflow.close(campaign, damper(), SETTINGS, out=tmp_path)
    assert tried == [0, 1]
    assert read_back(tmp_path)[0] == json.loads(tree.attrs[schema.SUMMARY])


def _page_of_nothing(_, path, before, ahead):
    before()
    assert ahead is None  # nothing was drawn before
    path.write_text("no figure", encoding="utf-8")
    return []


@pytest.mark.slow
def test_an_older_result_is_not_taken_for_the_one_that_cannot_be_written(
    campaign, tmp_path, monkeypatch
):
    without_draws(monkeypatch)
    without_page(monkeypatch)
    workflow.trace(campaign, damper(), SETTINGS, out=tmp_path)
    older = (tmp_path / "results.nc").read_bytes()
    monkeypatch.setattr(output, "result_tree", broken)
    monkeypatch.setattr(closing, "result_tree", broken)
    with pytest.raises(NameError):
        workflow.close(campaign, damper(), SETTINGS, out=tmp_path)
    assert (tmp_path / "results.nc").read_bytes() == older


@pytest.fixture(scope="module")
def broken_off(campaign, tmp_path_factory) -> Path:
    """Folder of a search that broke off in its second round."""
    folder = tmp_path_factory.mktemp("broken")
    with pytest.MonkeyPatch.context() as patched:
        without_draws(patched)
        without_page(patched)
        patched.setattr(search, "examine", failing_round(2))
        with pytest.raises(UnfinishedError):
            workflow.close(campaign, damper(), SETTINGS, out=folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("changed", ["campaign", "model", "setting", "file"])
def test_another_task_starts_anew_and_says_so(campaign, broken_off, tmp_path, monkeypatch, changed):
    without_draws(monkeypatch)
    without_page(monkeypatch)
    shutil.copytree(broken_off, tmp_path, dirs_exist_ok=True)
    kept = tmp_path / "checkpoints" / "search.pickle"
    source, model, settings = campaign, damper(), SETTINGS
    if changed == "campaign":
        source = tmp_path / "other"
        damper_campaign(source, seed=1)
    elif changed == "model":
        model = damper(linear=False)
    elif changed == "setting":
        settings = replace(SETTINGS, max_effects=1)
    else:
        kept.write_bytes(kept.read_bytes()[:-5])
    said: list[str] = []
    workflow.close(source, model, settings, out=tmp_path, callback=said.append)
    (anew,) = [text for text in said if text.startswith("start anew")]
    assert ("damaged" if changed == "file" else f"another {changed}") in anew
    assert any(text.startswith("round 1:") for text in said)
    assert not kept.exists()  # the search is complete, and the file is large


def test_how_much_is_drawn_has_no_say_in_what_is_missing(campaign, tmp_path, monkeypatch):
    without_page(monkeypatch)
    monkeypatch.setattr(closing, "draw", broken)
    with pytest.raises(UnfinishedError):
        workflow.close(campaign, damper(), SETTINGS, out=tmp_path)
    without_draws(monkeypatch)
    said: list[str] = []
    settings = replace(SETTINGS, quick=False, effective_size=10, command="again")
    workflow.close(campaign, damper(), settings, out=tmp_path, callback=said.append)
    assert said[0].startswith("go on after round 2")
    assert not any(text.startswith(("round", "start anew")) for text in said)


@pytest.mark.slow
def test_the_terminal_says_what_failed_and_the_status_is_its_own(campaign, tmp_path, monkeypatch):
    without_page(monkeypatch)
    monkeypatch.setattr(closing, "draw", broken)
    file = tmp_path / "model.py"
    file.write_text(
        "from bayesoleo.model import Model, Output, Parameter\n"
        "model = Model('spring', inputs={'displacement': 'm'},\n"
        "    parameters={'k': Parameter(900.0, 'N/m', sd=3000.0)},\n"
        "    outputs={'force': Output({'spring': 'k*displacement'}, 'N')})\n"
    )
    arguments = ["close", campaign, "--model", f"{file}:model", "--out", tmp_path / "out"]
    shown = CliRunner().invoke(app, [*map(str, arguments), "--quick", "--max-effects", "0"])
    assert shown.exit_code == UNFINISHED == 3
    assert "Unfinished stage: posterior. NameError" in " ".join(shown.stdout.split())
    assert shown.stderr.splitlines()[-1].startswith("error: unfinished: posterior: NameError")


KILLED = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from small_campaigns import damper
from bayesoleo import _workflow as workflow
from bayesoleo.effects import find_effect
from bayesoleo._workflow import Settings, output

output.OFTEN = 0.0

def say(text):
    if text.startswith({stage!r}):
        os.kill(os.getpid(), signal.SIGKILL)

effects = tuple(map(find_effect, ("coulomb_friction", "quintic_stiffness")))
settings = Settings(quick=True, jobs=1, effects=effects, seed=5, error_model="independent")
workflow.close({campaign!r}, damper(), settings, out={out!r}, callback=say)
"""

#: Stage that is begun when the process is killed, and the rounds that are finished then.
KILLS = {"round 1": 0, "round 2": 1, "sample the posterior": 2, "write results": 2}


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends SIGKILL")
@pytest.mark.parametrize("stage", KILLS)
def test_killed_at_any_stage_it_goes_on_to_the_same_result(campaign, whole, tmp_path, stage):
    tests = str(Path(__file__).parents[1])
    script = KILLED.format(tests=tests, stage=stage, campaign=str(campaign), out=str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", script], timeout=300, check=False, capture_output=True
    )
    assert done.returncode == -signal.SIGKILL
    # What was known is readable.
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    schema.validate_summary(summary)
    assert summary["unfinished"]
    assert read_tree(tmp_path / "results.nc").attrs[schema.UNFINISHED]
    assert summary["effects"] == (["coulomb_friction"] if KILLS[stage] else [])
    said: list[str] = []
    tree = workflow.close(campaign, damper(), SETTINGS, out=tmp_path, callback=said.append)
    assert f"go on after round {KILLS[stage]}, " in said[0]
    ours, theirs = (json.loads(item.attrs[schema.SUMMARY]) for item in (tree, whole))
    assert ours == theirs
    draws = [item[schema.POSTERIOR]["damping"].values for item in (tree, whole)]
    np.testing.assert_array_equal(*draws)


ODD = {
    "surrogate": ("r\udcffsults", "is not UTF-8"),
    "null": ("results\0", "holds a null character"),
    "empty": ("", "is empty"),
    "long": ("r" * 300, "has a name longer than the 255 bytes"),
    "number": (3, "is not a path"),
}


@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize("verb", ["estimate", "sample", "trace", "close", "simulate"])
def test_a_folder_that_cannot_be_is_refused_before_any_work(tmp_path, monkeypatch, verb, name):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(workflow.task, "load_campaign", lambda _: pytest.fail("work was begun"))
    out, message = ODD[name]
    arguments = (damper(), "rig") if verb == "simulate" else ("rig", damper())
    with pytest.raises(InputError, match=message):
        getattr(workflow, verb)(*arguments, SETTINGS, out=out)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["results.nc", "report.html", "checkpoints"])
def test_what_is_in_the_way_is_found_before_any_work(tmp_path, monkeypatch, name):
    monkeypatch.setattr(workflow.task, "load_campaign", lambda _: pytest.fail("work was begun"))
    if name == "checkpoints":
        (tmp_path / name).write_text("a file")
    else:
        (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=rf"{name}: is a (file|folder), not a"):
        workflow.close("rig", damper(), SETTINGS, out=tmp_path)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root writes anywhere")
def test_a_folder_that_is_read_only_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr(workflow.task, "load_campaign", lambda _: pytest.fail("work was begun"))
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="cannot be written to"):
        workflow.close("rig", damper(), SETTINGS, out=tmp_path / "results")


class Named:
    """A path-like of one's own."""

    def __init__(self, path):
        self.path = path

    def __fspath__(self):
        return self.path


@pytest.mark.parametrize("kind", [str, os.fsencode, Named, lambda path: Named(os.fsencode(path))])
def test_every_kind_of_path_is_taken(campaign, tmp_path, kind):
    out = tmp_path / "Ergebnisse µ – 測定"
    workflow.estimate(campaign, damper(), SETTINGS, out=kind(str(out)))
    assert read_tree(out / "results.nc").attrs[schema.MODEL] == "damper"


@pytest.mark.slow
def test_a_longer_search_goes_on_where_a_quick_one_ended(tmp_path, monkeypatch):
    """By the same command without ``--quick``."""

    def with_two(x, v, _):
        return 1000.0 * x + 200.0 * v + 2.0e6 * x**3 + 5.0 * np.sign(v) + 4.0

    without_draws(monkeypatch)
    monkeypatch.setattr(closing, "QUICK", 1.0)
    damper_campaign(tmp_path / "campaign", with_two)
    settings = replace(SETTINGS, effects=(*EFFECTS, find_effect("constant_force")))
    out, told = tmp_path / "out", []
    tree = workflow.close(tmp_path / "campaign", damper(), settings, out=out)
    quick = json.loads(tree.attrs[schema.SUMMARY])
    assert len(quick["effects"]) == 1
    assert "structures" not in quick or quick["structures"] is None
    assert "The quick search ended there" in read_back(out)[1]
    longer = replace(settings, quick=False)
    tree = workflow.close(tmp_path / "campaign", damper(), longer, out=out, callback=told.append)
    assert any(text.startswith("go on after round 1") for text in told)
    found = json.loads(tree.attrs[schema.SUMMARY])
    assert set(found["effects"]) == {"coulomb_friction", "constant_force"}
    assert not (out / "checkpoints" / "search.pickle").exists()
