"""The identification study: what counts as right, its table, and a few of its campaigns."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

STUDIES = Path(__file__).resolve().parents[2] / "studies"
NAMES = tuple(f"identification{part}" for part in ("", "_data", "_sizes", "_rows", "_figures"))
ROW: dict[str, Any] = {
    "effect": "play", "target": "stroke", "factor": 3.0, "replication": 0,
    "verdict": "effect added", "certain": True,
    "added": ["play at stroke"], "same": [], "place": 1, "p_value": 1e-9, "ratio": 1.02,
    "seconds": 1.0,
}  # fmt: skip


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Imports a module of the study."""
    monkeypatch.syspath_prepend(str(STUDIES))
    yield import_module
    for name in NAMES:
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("added", "same", "right"),
    [
        (["play at stroke"], [], True),
        (["dahl_friction at stroke"], ["play", "lugre_friction"], True),
        (["dahl_friction at stroke"], ["play", "lugre_friction", "stribeck_friction"], False),
        (["play at other"], [], False),
        (["play at other"], ["play @ stroke"], True),
        (["dahl_friction at stroke", "play at stroke"], [], False),
        ([], [], False),
    ],
)
def test_right_is_the_effect_or_a_small_class_with_it(load, added, same, right):
    rows: ModuleType = load("identification_rows")
    assert rows.right({**ROW, "added": added, "same": same}) == right


def test_the_table_keeps_what_the_figures_need(load, tmp_path, monkeypatch):
    rows = load("identification_rows")
    monkeypatch.setattr(rows, "TABLE", tmp_path / "table.json")
    assert rows.stored() is None
    plain = {**ROW, "effect": "none", "target": "", "factor": 0.0, "added": [], "p_value": None}
    strange = {**ROW, "effect": "ripple", "added": ["play at stroke"]}
    likely = {**strange, "certain": False, "replication": 1}
    found = [ROW, {**ROW, "replication": 1, "added": []}, plain, strange, likely, {"failed": "no"}]
    rows.store(found, 10, "command", 0)
    table = rows.stored()
    assert (table["planned"], table["failed"], table["seed"]) == (10, 1, 0)
    kept = [*rows.plain(table["rows"]), *rows.named(table["rows"]), *rows.strange(table["rows"])]
    assert kept == [plain, ROW, found[1], strange, likely]
    said = rows.summarise(table["rows"])
    assert (said["right_at_3x"], said["false_additions"]) == (0.5, 0.0)
    assert said["outside_named_as_certain"] == 0.5
    assert said["right_at_10x"] is None
    assert said["outside_given_a_name"] == 1.0
    assert (said["one_name_and_right_at_3x"], said["certain_and_wrong_at_3x"]) == (0.5, 1)


def test_the_readme_says_what_the_stored_table_holds(load):
    """Also what speaks against the loop."""
    rows = load("identification_rows")
    table = rows.stored()
    readme = " ".join((STUDIES.parent / "README.md").read_text(encoding="utf-8").split())

    def cell(row_of, factor, part=True):
        found = [row_of(row) for row in rows.named(table["rows"], factor)]
        share = f", {100 * sum(found) / len(found):.0f} %" if part else ""
        return f"{sum(found)} of {len(found)}{share}"

    right = " | ".join(cell(rows.right, factor) for factor in rows.FACTORS)
    assert f"| right, alone or in a class of at most three | {right} |" in readme
    one = " | ".join(
        cell(lambda row: rows.alone(row) and rows.right(row), factor) for factor in rows.FACTORS
    )
    assert f"| a single name, and it is right | {one} |" in readme
    certain = [cell(lambda row: row["certain"], factor, factor > 1) for factor in rows.FACTORS]
    assert f"| called certain | {' | '.join(certain)} |" in readme
    wrong = [
        sum(row["certain"] and not rows.right(row) for row in rows.named(table["rows"], factor))
        for factor in rows.FACTORS
    ]
    assert "| called certain, and wrong | {} | {} | {}: ".format(*wrong) in readme
    planned = f"{table['planned']:,}".replace(",", " ")
    assert f"| campaigns that failed | {table['failed']} of {planned}" in readme
    strange = rows.strange(table["rows"])
    given = sum(bool(row["added"]) for row in strange)
    added = sum(row["verdict"] == "effect added" for row in strange)
    sure = sum(row["certain"] for row in strange)
    assert f"| {given} of {len(strange)}; {added}; {sure} |" in readme
    false = rows.plain(table["rows"])
    assert f"nominal 1 % | {sum(bool(row['added']) for row in false)} of {len(false)} |" in readme


@pytest.mark.statistical
def test_a_few_of_the_campaigns(load):
    """Nothing is added where nothing lacks, and what is large is named."""
    study, rows = load("identification"), load("identification_rows")
    planned = [asdict(campaign) for campaign in study.planned()]
    some = [*rows.plain(planned)[:2], *rows.named(planned, 10.0)[:2], *rows.strange(planned)[:1]]
    found = [study.run(study.Campaign(**one)) for one in some]
    said = rows.summarise(found)
    assert said["failed"] == 0
    assert said["false_additions"] == 0
    assert said["right_at_10x"] == 1
    assert not said["outside_named_as_certain"]


@pytest.mark.slow
def test_limits_and_shapes_of_the_effects_that_are_put_in(load):
    """A law's limit is met by its own score; nothing is put in twice, or larger than it can be."""
    sizes = load("identification_sizes")
    found = sizes.effects()
    assert ("direction_dependent_damping", "stroke") in found
    assert ("compression_damping", "stroke") not in found  # the same beside the model's damping
    assert found["power_law_damping", "stroke"].shapes["power_law_damping_exponent"] != 1.0
    for key, score in found.items():
        direction = np.ones(len(score.names))
        direction[::2] = -1.0  # the same in all runs would be no variation
        limit = sizes.limit(key, direction)
        assert 0 < limit < np.inf
        # Half of the campaigns: the median of chi-square beyond the critical value.
        away = limit**2 * float(direction @ score.information @ direction)
        assert 5.0 < away < 50.0
    most = max(sizes.FACTORS) * sizes.limit(("sensor_saturation_upper", "force"), np.ones(1))
    assert most <= 1.0
