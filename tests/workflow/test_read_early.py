"""A campaign that another process reads while a command loads its libraries."""

from __future__ import annotations

import warnings
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from small_campaigns import DAMPER_RUNS, damper_campaign
from threadpoolctl import threadpool_limits
from typer.testing import CliRunner

import bayesoleo._kept_processes as kept_processes
from bayesoleo._cli import app
from bayesoleo._workflow import read_early as early
from bayesoleo._workflow.task import reduce
from bayesoleo.errors import CampaignError, DataWarning


@pytest.fixture
def campaign(tmp_path, monkeypatch) -> Path:
    """A campaign that may be read elsewhere; no process is left."""
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    monkeypatch.setattr(early, "OF_A_SEARCH", ())
    # Arrays of more than 64 KiB are sent in another way, and BLAS adds them in its threads.
    damper_campaign(tmp_path / "rig", runs=DAMPER_RUNS[:2], periods=150, seed=1)
    yield tmp_path / "rig"
    early._begun.clear()
    kept_processes.end_processes()


@pytest.fixture
def elsewhere(monkeypatch):
    """Nothing is read by this process."""

    def never(*_, **__):
        raise AssertionError("read here")

    for module in ("_workflow.task", "data._campaign"):
        monkeypatch.setattr(f"bayesoleo.{module}.load_campaign", never)


def assert_same(one, other):
    """All that records hold, bit by bit, in arrays that compiled code takes as its own."""
    if isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
        assert one.flags.writeable == other.flags.writeable
    elif hasattr(one, "__dataclass_fields__"):
        assert type(one) is type(other)
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif not callable(one):
        assert one == other or one != one


def test_it_is_the_same_as_read_here(campaign, elsewhere, monkeypatch):
    assert early.begin_reading(campaign, jobs=2)
    found = reduce(campaign)
    monkeypatch.undo()
    with threadpool_limits(2, user_api="blas"):  # the other process has one
        here = reduce(campaign)
    assert here.records[0].time.nbytes > 2**16
    assert_same(here, found)


def test_the_next_call_reads_it_again(campaign):
    assert early.begin_reading(campaign, jobs=2)
    first = reduce(campaign)
    toml = campaign / "campaign.toml"
    text = toml.read_text(encoding="utf-8")
    toml.write_text(text.replace('name = "damper"', 'name = "another"'), encoding="utf-8")
    assert (first.campaign.name, reduce(campaign).campaign.name) == ("damper", "another")


def test_a_command_has_it_read_elsewhere(campaign, elsewhere, monkeypatch):
    """What it began is what it takes: it then finds that the model has other channels."""
    monkeypatch.setattr("bayesoleo._first_compilation.is_marked", lambda: True)
    line = ["close", str(campaign), "--model", "f16n2d2", "--jobs", "2"]
    ended = CliRunner().invoke(app, line)
    assert "needs channel 'pressure'" in f"{ended.output} {ended.exception}"
    assert not early._begun


def test_what_it_warns_of_is_told_here(campaign):
    file = next(campaign.rglob("*.csv"))
    rows = file.read_text(encoding="utf-8").splitlines()
    head, step = rows[0].split(","), float(rows[2].split(",")[0]) - float(rows[1].split(",")[0])
    rng = np.random.default_rng(0)
    for k in range(2, len(rows) - 1):
        cells = rows[k].split(",")
        cells[0] = repr(float(cells[0]) + 0.2 * step * rng.uniform(-1.0, 1.0))
        rows[k] = ",".join(cells)
    assert head[0].startswith("t")
    file.write_text("\n".join(rows) + "\n", encoding="utf-8")

    def said():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            reduce(campaign)
        return [(one.category, str(one.message)) for one in caught]

    assert early.begin_reading(campaign, jobs=2)
    elsewhere, here = said(), said()
    assert elsewhere == here
    assert any(c is DataWarning and "unevenly spaced" in text for c, text in here)


def test_what_is_wrong_is_told_as_ever(campaign):
    file = next(campaign.rglob("*.csv"))
    text = file.read_text(encoding="utf-8").splitlines()
    text[5] = text[5].replace(",", ",bad", 1)
    file.write_text("\n".join(text) + "\n", encoding="utf-8")
    assert early.begin_reading(campaign, jobs=2)
    with pytest.raises(CampaignError) as first:
        reduce(campaign)
    with pytest.raises(CampaignError) as second:
        reduce(campaign)
    assert str(first.value) == str(second.value)
    assert file.name in str(first.value)


def test_it_is_read_here_where_the_process_is_killed(campaign):
    assert early.begin_reading(campaign, jobs=2)
    kept_processes.kill_processes()
    assert reduce(campaign).records


@pytest.mark.parametrize("reason", ["alone", "large", "fetched", "no file", "no toml", "no run"])
def test_it_is_not_begun_where_that_makes_no_sense(campaign, monkeypatch, reason):
    toml = campaign / "campaign.toml"
    if reason == "large":
        monkeypatch.setattr(early, "LARGEST", 1000)
    elif reason == "fetched":
        toml.write_text('dataset = "silverbox"\n' + toml.read_text(encoding="utf-8"))
    elif reason == "no file":
        next(campaign.rglob("*.csv")).unlink()
    elif reason == "no toml":
        toml.write_text("runs = [", encoding="utf-8")
    elif reason == "no run":
        toml.write_text("runs = 3", encoding="utf-8")
    assert not early.begin_reading(campaign, jobs=1 if reason == "alone" else 2)
    assert not early._begun
