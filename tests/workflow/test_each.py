"""Many loops: manifest, resumption, isolation of failures, lost processes; the loop is a stub."""

from __future__ import annotations

import csv
import json
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import pytest

from bayesoleo import _parallel as parallel, close_each
from bayesoleo._parallel import LostError, OwnProcesses
from bayesoleo._storage.files import only_writer
from bayesoleo._workflow import each, each_task
from bayesoleo._workflow.each_task import Outcome, Work
from bayesoleo._workflow.settings import Settings
from bayesoleo.data import CampaignData, SimulatedRun, load_campaign, write_campaign
from bayesoleo.errors import InputError, ModelError, ResultsError, UnfinishedError
from bayesoleo.model import Model, Output, Parameter


def law(name: str, stiffness: float = 1.0) -> Model:
    return Model(
        name,
        inputs={"x": "m"},
        parameters={"stiffness": Parameter(stiffness, "N/m", sd=1.0)},
        outputs={"force": Output("stiffness*x", "N")},
    )


def make_campaign(folder: Path, shift: float = 0.0) -> Path:
    time = [0.1 * k for k in range(40)]
    samples = {"x": [k % 10 + shift for k in range(40)], "force": [k % 10 + 0.0 for k in range(40)]}
    run = SimulatedRun("a", time, samples, 1.0)
    channels = {"x": ("x", "m"), "force": ("force", "N")}
    return write_campaign(folder, name=folder.name, channels=channels, runs=[run], overwrite=True)


SUMMARY = {
    "effects": ["coulomb_friction"],
    "targets": ["x"],
    "certainty": "certain",
    "structures": {
        "nothing": 0.02,
        "effects": [{"effect": "coulomb_friction", "target": "x", "probability": 0.97}],
    },
    "units": {"force": "N"},
    "error_before": {
        "fit": {"force": {"rms": 3.0, "ratio_to_noise": 3.0}},
        "hold-out": {"force": {"rms": 2.0, "ratio_to_noise": 2.0}},
    },
    "error_after": {
        "fit": {"force": {"rms": 1.0, "ratio_to_noise": 1.0}},
        "hold-out": {"force": {"rms": 1.5, "ratio_to_noise": 1.0}},
    },
}
FILES = {
    "results.nc": b"arrays",
    "report.html": b"<html>",
    "summary.json": json.dumps(SUMMARY).encode(),
}


class Loops:
    """In the place of processes: counts calls, fails and gets lost as asked."""

    def __init__(self) -> None:
        self.done: list[tuple[str, str, int]] = []
        self.works: list[Work] = []
        self.failing: dict[str, str] = {}  # reason by name of the campaign
        self.lost: Counter[str] = Counter()  # how often yet
        self.raised: dict[str, BaseException] = {}

    def __call__(self, work: Work, _stopped: object = None) -> Outcome:
        name = Path(work.path).name
        self.works.append(work)
        if name in self.raised:
            raise self.raised[name]
        if self.lost[name]:
            self.lost[name] -= 1
            raise LostError("it ran out of memory")
        self.done.append((name, work.model.name, work.settings.seed))
        if name in self.failing:
            return Outcome(self.failing[name], 0.5)
        if work.out is None:
            return Outcome("", 0.5, FILES)
        work.out.mkdir(parents=True, exist_ok=True)
        for file, content in FILES.items():
            (work.out / file).write_bytes(content)
        return Outcome("", 0.5)


@pytest.fixture
def loops(monkeypatch: pytest.MonkeyPatch) -> Loops:
    made = Loops()
    monkeypatch.setattr(parallel, "in_own_process", made)
    return made


@pytest.fixture
def campaigns(tmp_path: Path) -> list[Path]:
    return [make_campaign(tmp_path / "data" / name) for name in ("one", "two")]


def manifest(out: Path) -> dict[str, dict]:
    """Tasks by folder."""
    tasks = json.loads((out / "manifest.json").read_text())["tasks"]
    return {task["folder"]: task for task in tasks}


def test_every_combination_is_a_task_with_a_folder_of_its_own(loops, campaigns, tmp_path):
    out = tmp_path / "all"
    found = close_each(campaigns, [law("a"), law("b")], out=out, seeds=2, jobs=3)
    every = [(c, m, s) for c in ("one", "two") for m in ("a", "b") for s in (0, 1)]
    assert sorted(loops.done) == every
    assert [(Path(t.campaign).name, t.model, t.seed) for t in found.tasks] == every
    tasks = manifest(out)
    assert sorted(tasks) == [f"{c}/{m}/seed-{s}" for c, m, s in every]
    for folder, task in tasks.items():
        assert (task["state"], task["reason"], task["attempts"]) == ("done", None, 1)
        assert (out / folder / "results.nc").is_file()
    assert {work.settings.jobs for work in loops.works} == {1}
    assert not found.failed
    assert "coulomb_friction" in repr(found)


def test_the_table_has_effect_and_errors_of_held_out_runs(loops, campaigns, tmp_path):
    close_each(campaigns, law("a"), out=tmp_path / "all", jobs=1)
    with (tmp_path / "all" / "summary.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["status"] for row in rows] == ["done", "done"]
    wanted = {
        "effect": "coulomb_friction", "target": "x", "certainty": "certain", "probability": "0.97",
        "output": "force", "unit": "N", "error_before": "2.0", "error_after": "1.5",
        "seconds": "0.5", "attempts": "1", "folder": "one/a/seed-0", "reason": "",
    }  # fmt: skip
    assert {name: rows[0][name] for name in wanted} == wanted


def test_without_an_effect_the_probability_is_that_nothing_is_missing(tmp_path):
    path = tmp_path / "summary.json"
    path.write_text(json.dumps({**SUMMARY, "effects": [], "targets": [], "certainty": None}))
    found = each_task.found_in(path)
    assert (found["effect"], found["probability"]) == (None, 0.02)


def test_what_is_done_is_not_done_again(loops, campaigns, tmp_path):
    for seeds, more in ((1, 2), (1, 0), (2, 2)):
        before = len(loops.done)
        close_each(campaigns, law("a"), out=tmp_path / "all", seeds=seeds, jobs=1)
        assert len(loops.done) - before == more
    assert len(manifest(tmp_path / "all")) == 4


@pytest.mark.parametrize(
    ("change", "again"),
    [
        ({}, []),
        ({"settings": Settings(command="other words", jobs=7)}, []),
        ({"settings": Settings(quick=True)}, ["one", "two"]),
        ({"models": law("a", 2.0)}, ["one", "two"]),
        ({"shift": 1.0}, ["two"]),
        ({"gone": "one/a/seed-0/summary.json"}, ["one"]),
    ],
)
def test_what_depends_on_changed_inputs_is_done_again(loops, campaigns, tmp_path, change, again):
    out = tmp_path / "all"
    close_each(campaigns, law("a"), out=out, jobs=1)
    loops.done.clear()
    if "shift" in change:
        make_campaign(campaigns[1], change["shift"])
    if "gone" in change:
        (out / change["gone"]).unlink()
    given = {name: change[name] for name in ("models", "settings") if name in change}
    close_each(campaigns, **{"models": law("a"), **given}, out=out, jobs=1)
    assert [name for name, _, _ in loops.done] == again


def test_a_failure_ends_its_own_task_only(loops, campaigns, tmp_path):
    unread, out = make_campaign(tmp_path / "data" / "unread"), tmp_path / "all"
    (unread / "campaign.toml").write_text("format = 1\nnam = 3\n")
    lacking = make_campaign(tmp_path / "data" / "lacking")
    (lacking / "a.csv").unlink()
    (tmp_path / "broken.py").write_text("1/0\n")
    loops.failing["two"] = "run a: too short"
    models = [law("a"), str(tmp_path / "broken.py")]
    told: list[str] = []
    given = [*campaigns, unread, lacking]
    found = close_each(given, models, out=out, jobs=1, callback=told.append)
    assert loops.done == [("one", "a", 0), ("two", "a", 0)]
    reasons = {task.folder: task.reason for task in found.failed}
    assert len(reasons) == len(told) == 7
    assert reasons["two/a/seed-0"] == "run a: too short"
    assert "key nam: unknown key" in reasons["unread/a/seed-0"]
    assert "file a.csv: no such file" in reasons["lacking/a/seed-0"]
    assert "line 1: ZeroDivisionError" in reasons["one/broken/seed-0"]
    assert all("\n" not in reason for reason in reasons.values())
    assert manifest(out)["one/a/seed-0"]["state"] == "done"
    # Failed tasks are tried again, and one whose cause is mended is done.
    loops.failing.clear()
    found = close_each(given, law("a"), out=out, jobs=1)
    assert loops.done[2:] == [("two", "a", 0)]
    assert {task.folder for task in found.failed} == {"unread/a/seed-0", "lacking/a/seed-0"}


def test_a_task_whose_process_is_lost_is_tried_again(loops, campaigns, tmp_path):
    loops.lost["one"] = 2
    told: list[str] = []
    found = close_each(campaigns, law("a"), out=tmp_path / "all", jobs=1, callback=told.append)
    assert [task.attempts for task in found.tasks] == [3, 1]
    assert not found.failed
    assert told == ["one/a/seed-0 was lost and is tried again: it ran out of memory"] * 2


def test_a_task_that_is_lost_again_and_again_is_given_up(loops, campaigns, tmp_path):
    loops.lost["one"] = 99
    found = close_each(campaigns, law("a"), out=tmp_path / "all", jobs=2, retries=1)
    (failed,) = found.failed
    assert failed.reason == "lost 2 times, the last time because it ran out of memory"
    assert (failed.attempts, found.tasks[1].state) == (2, "done")


@pytest.mark.parametrize("how", ["fails", "raises"])
def test_an_error_of_the_input_is_not_tried_again(loops, campaigns, tmp_path, how):
    if how == "fails":
        loops.failing["one"] = "no such channel"
    else:
        loops.raised["one"] = InputError("no such channel")
    found = close_each(campaigns, law("a"), out=tmp_path / "all", jobs=1)
    assert [task.attempts for task in found.tasks] == [1, 1]
    assert [task.reason for task in found.tasks] == ["no such channel", None]


def test_a_stopped_call_goes_on(loops, campaigns, tmp_path):
    out = tmp_path / "all"
    loops.raised["two"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        close_each(campaigns, law("a"), out=out, jobs=1)
    assert {f: t["state"] for f, t in manifest(out).items()} == {
        "one/a/seed-0": "done",
        "two/a/seed-0": "waiting",
    }
    loops.raised.clear()
    close_each(campaigns, law("a"), out=out, jobs=1)
    assert [name for name, _, _ in loops.done] == ["one", "two"]
    assert not (out / ".lock").exists()


def test_a_second_process_is_refused(loops, campaigns, tmp_path):
    with (
        only_writer(tmp_path / "all"),
        pytest.raises(ResultsError, match="another process is writing here"),
    ):
        close_each(campaigns, law("a"), out=tmp_path / "all")
    assert loops.works == []


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"campaigns": ["nowhere"]}, InputError, "no such folder"),
        ({"campaigns": []}, InputError, "names none"),
        ({"models": "f16n2d3"}, ModelError, "did you mean"),
        ({"models": "nowhere.py:model"}, ModelError, "there is no such file"),
        ({"models": [law("a"), law("a", 2.0)]}, InputError, "two models have this name"),
        ({"seeds": 0}, InputError, "write seeds=1 or more"),
        ({"jobs": 0}, InputError, "write jobs=1 or more"),
        ({"retries": -1}, InputError, "write retries=0 or more"),
        ({"jobs": 2, "scheduler": "local:2"}, InputError, "no meaning with a scheduler"),
        ({"scheduler": "local:none"}, InputError, "whole number above zero"),
    ],
)
def test_what_cannot_be_meant_is_refused_before_anything_is_run(
    loops, campaigns, tmp_path, change, error, text
):
    given = {"campaigns": campaigns, "models": law("a"), **change}
    with pytest.raises(error, match=text):
        close_each(**given, out=tmp_path / "all")
    assert loops.works == []
    assert not (tmp_path / "all").exists()


@pytest.mark.parametrize("text", ["{}", "no JSON", '{"format": 2, "tasks": []}', "[]"])
def test_another_manifest_is_left_alone(loops, campaigns, tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ResultsError, match="is no manifest of tasks"):
        close_each(campaigns, law("a"), out=tmp_path)
    assert (tmp_path / "manifest.json").read_text() == text


def test_campaigns_of_one_name_keep_their_folders_in_any_order(loops, tmp_path):
    given = [make_campaign(tmp_path / rig / "shaker") for rig in ("new", "old")]
    out = tmp_path / "all"
    first = close_each(given, law("a"), out=out, jobs=1)
    folders = {task.campaign: task.folder for task in first.tasks}
    assert sorted(folders.values()) == ["shaker/a/seed-0", "shaker~2/a/seed-0"]
    again = close_each(given[::-1], law("a"), out=out, jobs=1)
    assert {task.campaign: task.folder for task in again.tasks} == folders
    assert len(loops.done) == 2


# -- by value ---------------------------------------------------------------------------


WHY = "the scheduler was lost, or has no workers"


class Remote(OwnProcesses):
    """A cluster that is lost after so many tasks."""

    left = 10**9

    @property
    def lost(self) -> str:
        return "" if self.left > 0 else WHY

    def submit(self, function):
        self.left -= 1
        return super().submit(function)


@pytest.fixture
def remote(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How many tasks clusters take."""
    limits: dict[str, int] = {}

    @contextmanager
    def connect(_scheduler, _jobs):
        pool = Remote(1)
        pool.left = limits.get("left", pool.left)
        yield pool
        pool.close()

    monkeypatch.setattr(each, "task_pool", connect)
    return limits


def test_a_scheduler_gets_files_and_returns_files(loops, remote, campaigns, tmp_path):
    out = tmp_path / "all"
    close_each(campaigns, law("a"), out=out, scheduler="tcp://cluster:8786")
    for work in loops.works:
        assert sorted(work.files) == ["a.csv", "campaign.toml"]
        assert (work.out, work.campaign) == (None, None)
    for name in ("one", "two"):
        folder = out / name / "a" / "seed-0"
        assert {file: (folder / file).read_bytes() for file in FILES} == FILES
        assert "summary.json" in (folder / "SHA256SUMS").read_text()


def test_with_shared_folders_paths_are_sent(loops, remote, campaigns, tmp_path):
    close_each(campaigns, law("a"), out=tmp_path / "all", scheduler="tcp://x:1", shared=True)
    assert [work.out for work in loops.works] == [
        tmp_path / "all" / name / "a" / "seed-0" for name in ("one", "two")
    ]
    assert {len(work.files) for work in loops.works} == {0}


@pytest.mark.parametrize("place", ["elsewhere.csv", "data/one/b.csv"])
def test_a_campaign_whose_files_have_whole_paths_is_sent_as_it_was_read(
    loops, remote, campaigns, tmp_path, place
):
    toml = campaigns[0] / "campaign.toml"
    moved = tmp_path / place
    (campaigns[0] / "a.csv").rename(moved)
    text = toml.read_text().replace('file = "a.csv"', f'file = "{moved}"')
    toml.write_text("outside_files = true\n" + text)
    close_each(campaigns[0], law("a"), out=tmp_path / "all", scheduler="tcp://x:1")
    (work,) = loops.works
    assert isinstance(work.campaign, CampaignData)
    assert work.campaign.sha256 == load_campaign(campaigns[0]).sha256


def test_a_lost_scheduler_leaves_a_manifest_that_goes_on(loops, remote, campaigns, tmp_path):
    out = tmp_path / "all"
    remote["left"] = 2
    with pytest.raises(UnfinishedError, match=WHY) as caught:
        close_each(campaigns, law("a"), out=out, seeds=3, scheduler="tcp://x:1")
    states = Counter(task["state"] for task in manifest(out).values())
    assert states["done"] <= 2
    assert states["waiting"] == 6 - states["done"]
    assert f"; {states['waiting']} tasks are left" in str(caught.value)
    del remote["left"]
    found = close_each(campaigns, law("a"), out=out, seeds=3, scheduler="tcp://x:1")
    assert not found.failed
    assert len(loops.done) == len(found.tasks) + 2 - states["done"]


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> list:
    """Arguments of ``close``, which writes what the stub writes."""
    calls = []

    def close(source, model, settings, *, out):
        calls.append((load_campaign(source), model, settings))
        out.mkdir(parents=True, exist_ok=True)
        (out / "summary.json").write_bytes(FILES["summary.json"])

    monkeypatch.setattr(each_task, "close", close)
    return calls


def work_of(campaign: Path, out: Path | None) -> Work:
    (wanted,) = each_task.every_task(campaign, law("a"), 1, Settings())
    return wanted.work(out)


def test_a_worker_closes_the_loop_on_the_same_campaign(closed, campaigns, tmp_path):
    outcome = work_of(campaigns[0], None)(tmp_path / "worker")
    assert outcome.reason == ""
    assert outcome.files == {"summary.json": FILES["summary.json"]}
    assert closed[0][0].sha256 == load_campaign(campaigns[0]).sha256


def test_a_worker_s_error_names_the_campaign_as_it_was_given(closed, campaigns, tmp_path):
    work = work_of(campaigns[0], None)
    del work.files["campaign.toml"]
    outcome = work(tmp_path / "worker")
    assert str(campaigns[0]) in outcome.reason
    assert str(tmp_path / "worker") not in outcome.reason


def test_a_worker_of_another_version_is_told(closed, campaigns, tmp_path, monkeypatch):
    work = work_of(campaigns[0], None)
    monkeypatch.setattr(each_task, "package_version", lambda _: "9.9")
    assert "another version of bayesoleo (got '9.9')" in work(tmp_path / "worker").reason
    assert closed == []
