"""Replications of the calibration study do not depend on who makes them, and what is counted."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

STUDIES = Path(__file__).resolve().parents[2] / "studies"
NAMES = ("calibration", "calibration_coverage", "calibration_oleo")


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The command's module."""
    monkeypatch.syspath_prepend(str(STUDIES))
    yield import_module("calibration")
    for name in NAMES:
        sys.modules.pop(name, None)


@pytest.mark.slow
def test_two_processes_fill_the_same_slots(study: ModuleType, tmp_path: Path) -> None:
    """In whatever order they end; and a slot that is there is not made again."""
    here = study.replicate("spring", 6, 1, tmp_path / "here", None)
    study.replicate("spring", 2, 1, tmp_path / "there", None)
    first = tmp_path / "there" / "slot-000000.npz"
    made = first.stat().st_mtime_ns
    there = study.replicate("spring", 6, 1, tmp_path / "there", "local:2")
    assert len(here) == len(there) == 6
    for one, other in zip(here, there, strict=True):
        assert set(one) == {"ranks", "reached"}
        assert all(np.array_equal(one[key], other[key]) for key in one)
    assert first.stat().st_mtime_ns == made
    assert len({tuple(item["ranks"]) for item in here}) > 1


def test_coverage_counts_intervals_that_hold_the_truth(study: ModuleType) -> None:
    """Two parameters, of which the second does not keep its meaning beside the second effect."""
    coverage = sys.modules["calibration_coverage"]
    coverage.keeps_meaning = lambda: np.array([[True, True], [True, False]])
    coverage.campaign.EFFECTS = {"one": (), "other": ()}
    covers = np.array([[1, 1], [1, 0], [0, 0], [1, 0]])
    effects = [0, 0, 1, 1]
    items = [
        {
            "low": np.where(row, -1.0, 1.0), "high": np.full(2, 2.0), "truth": np.zeros(2),
            "size": np.array(1.0), "effect": np.array(effect), "weighted": np.array(True),
            "reached": np.array(True),
        }
        for row, effect in zip(covers, effects, strict=True)
    ]  # fmt: skip
    found = coverage._of_model(items, np.array([1.0, 2.0]))
    assert found["each"] == [0.75, 0.5]
    assert found["each_left_out"] == [None, 0.0]
    assert found["each_all"] == [0.75, 0.25]
    assert found["pooled"] == pytest.approx(4 / 6, abs=1e-4)
    assert found["pooled_all"] == 0.5
    assert found["by_effect"] == [0.75, 0.5]
    assert found["median_width_over_prior_sd"] == [3.0, 0.5]
    # Replications are the units: shares 2/2, 1/2, 0/1, 1/1 about 4/6, over 6 intervals.
    about = np.array([2 - 4 / 3, 1 - 4 / 3, -2 / 3, 1 / 3])
    error = np.sqrt(np.sum(about**2)) / 6
    assert found["pooled_standard_error"] == pytest.approx(error, abs=1e-4)
