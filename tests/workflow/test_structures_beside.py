"""Structures are compared by another process before it is known that the search has ended."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import xarray as xr
from small_campaigns import damper, damper_campaign

from bayesoleo import _schema as schema, _worker_processes
from bayesoleo._workflow import closing, structures_beside
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.structures_beside import Early
from bayesoleo.discovery import _loop
from bayesoleo.effects import find_effect
from bayesoleo.errors import UnfinishedError

EFFECTS = tuple(map(find_effect, ("coulomb_friction", "quintic_stiffness", "constant_force")))
SETTINGS = Settings(seed=5, quick=True, effects=EFFECTS, jobs=2)


@pytest.fixture
def early(monkeypatch):
    """One that notes what is begun and what is ended, with the loops "a", "b", "c"."""
    events: list[str] = []

    def begin(loop):
        events.append(f"begin {loop}")
        if loop == "c":
            return "known c", None
        return f"known {loop}", SimpleNamespace(name=loop, drop=lambda: events.append("end"))

    monkeypatch.setattr(structures_beside, "start_ahead", lambda jobs: events.append("ready"))
    return Early(begin, 2), events


def test_what_was_begun_for_the_loop_that_stands_is_taken(early):
    begun, events = early
    begun("a")
    known, beside = begun.of("a")
    assert (known, beside.name) == ("known a", "a")
    assert events == ["begin a"]


def test_what_was_begun_for_another_loop_is_ended(early):
    begun, events = early
    begun("a")
    known, beside = begun.of("b")
    assert (known, beside.name) == ("known b", "b")
    assert events == ["begin a", "end", "ready", "begin b"]


def test_it_is_dropped_once_and_a_process_made_ready_meanwhile(early):
    begun, events = early
    drop = begun("a")
    drop()
    drop()
    assert events == ["begin a", "end", "ready"]
    assert begun.of("a")[0] == "known a"  # begun again


def test_what_no_process_can_do_is_not_begun_twice(early):
    begun, events = early
    begun("c")
    assert begun.of("c") == ("known c", None)
    assert events == ["begin c"]


def test_nothing_goes_on_where_the_search_is_left_by_an_error(early):
    begun, events = early

    def search(failing):
        with begun:
            begun("a")
            if failing:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search(True)
    assert events == ["begin a", "end"]
    search(False)
    assert events[2:] == ["begin a"]


def test_what_cannot_be_begun_is_left_to_the_caller(monkeypatch):
    def begin(_loop):
        raise RuntimeError("can't start new thread")

    begun = Early(begin, 2)
    begun("a")
    assert begun.of("a") == (None, None)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    return damper_campaign(tmp_path_factory.mktemp("campaign"))


@pytest.fixture(scope="module")
def alone(campaign):
    """What one process finds."""
    return closing.close(campaign, damper(), replace(SETTINGS, jobs=1))


@pytest.mark.slow
@pytest.mark.parametrize("again", [False, True], ids=["stands", "done again"])
def test_results_are_the_same_where_it_is_begun_early(
    campaign, alone, tmp_path, monkeypatch, again
):
    """Also where a search that is done again takes its place, and the process is ended."""
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    events: list[str] = []
    begin, drop = Early.__call__, Early.drop
    rightly = _loop.best_of_beam

    def beam(progress, roles, numerics, follow, *rest):
        events.append("beam")
        if again:
            follow(progress, 2)
        return rightly(progress, roles, numerics, follow, *rest)

    def begun(early, loop):
        events.append("begin")
        return begin(early, loop)

    def dropped(early):
        events.append("drop")
        drop(early)

    monkeypatch.setattr(_loop, "best_of_beam", beam)
    monkeypatch.setattr(Early, "__call__", begun)
    monkeypatch.setattr(Early, "drop", dropped)
    tree = closing.close(campaign, damper(), SETTINGS, out=tmp_path / "early")
    assert events[:2] == ["begin", "beam"]
    assert events[2:] == (["drop", "drop", "begin"] if again else [])
    one, two = (json.loads(item.attrs[schema.SUMMARY]) for item in (tree, alone))
    one.pop("files"), two.pop("files")
    assert one == two
    xr.testing.assert_equal(tree["posterior"].to_dataset(), alone["posterior"].to_dataset())


@pytest.mark.slow
@pytest.mark.parametrize("fails", [False, True], ids=["ends", "breaks off"])
def test_what_took_long_is_written_before_the_draws(campaign, tmp_path, monkeypatch, fails):
    """Also where structures were begun before a search took long with other first effects."""
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    events: list[str] = []
    now, late = closing.time.monotonic, [0.0]
    monkeypatch.setattr(closing.time, "monotonic", lambda: now() + late[0])

    def beam(progress, *_):
        late[0] = closing.WORTH_KEEPING
        if fails:
            raise RuntimeError("it broke")
        return progress

    def noted(name):
        rightly = getattr(closing, name)

        def call(*given, **named):
            events.append(name)
            return rightly(*given, **named)

        monkeypatch.setattr(closing, name, call)

    monkeypatch.setattr(_loop, "best_of_beam", beam)
    for name in ("begun_beside", "with_structures", "_write_found", "draw"):
        noted(name)
    expected = ["begun_beside", "with_structures", "_write_found", "draw"]
    if fails:
        with pytest.raises(UnfinishedError, match="it broke"):
            closing.close(campaign, damper(), SETTINGS, out=tmp_path)
    else:
        tree = closing.close(campaign, damper(), SETTINGS, out=tmp_path)
        assert json.loads(tree.attrs[schema.SUMMARY])["structures"]["effects"]
    assert events == expected
    assert not _worker_processes._in_use.locked()
