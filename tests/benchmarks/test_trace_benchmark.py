"""What the benchmark of tracing says of the committed table, beside its own sample."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROW: dict[str, Any] = {
    "effect": "play", "target": "stroke", "factor": 3.0, "replication": 0,
    "added": ["play at stroke"], "same": [], "certain": True,
}  # fmt: skip
PLAIN = {**ROW, "effect": "none", "target": "", "factor": 0.0, "added": [], "certain": False}
STRANGE = {**ROW, "effect": "ripple", "added": ["play at stroke"], "certain": True}
WRONG = {**ROW, "replication": 1, "added": ["dahl_friction at stroke"], "same": ["lugre_friction"]}
TABLE = {"version": "0.1.0", "rows": [ROW, WRONG, PLAIN, STRANGE]}


@pytest.fixture(scope="module")
def trace() -> Iterator[ModuleType]:
    """The benchmark; the standard library has a module of its name."""
    path, modules = list(sys.path), set(sys.modules)
    spec = importlib.util.spec_from_file_location(
        "trace_benchmark", Path(__file__).with_name("trace.py")
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    sys.path[:] = path
    for name in {name for name in sys.modules if name.startswith("identification")} - modules:
        del sys.modules[name]


def test_the_figures_of_the_table_stand_beside_the_sample(trace):
    found = trace.of_table([ROW], TABLE)
    assert found == {
        "table_campaigns": 4,
        "table_right_at_3x": 0.5,
        "table_false_additions": 0.0,
        "table_mean_class_size": 1.5,
        "table_outside_named_as_certain": 1.0,
        "table_version": "0.1.0",
        "sample_as_in_table": 1.0,
    }


def test_a_sample_is_like_the_table_where_the_same_was_added(trace):
    """What was added counts, in its order; not how alike other effects were."""
    gone = {**ROW, "replication": 2}
    failed = {"effect": "play", "target": "stroke", "factor": 3.0, "replication": 2, "failed": "no"}
    twice = {**WRONG, "added": [*WRONG["added"], "play at stroke"]}
    for sample, alike in (
        ([{**ROW, "same": ["dahl_friction"]}], 1.0),
        ([PLAIN, {**ROW, "added": []}], 0.5),
        ([twice], 0.0),
        ([gone], 0.0),
        ([failed], 1.0),
        ([], None),
    ):
        assert trace.of_table(sample, TABLE)["sample_as_in_table"] == alike


def test_without_a_table_the_keys_stay(trace):
    found = trace.of_table([ROW], None)
    assert set(found) == set(trace.of_table([ROW], TABLE))
    assert set(found.values()) == {None}


def test_the_committed_table_is_read(trace):
    """Every campaign that the study plans is in it or counted as failed."""
    table = trace.rows.stored()
    found = trace.of_table(table["rows"][:20], table)
    assert found["table_campaigns"] + table["failed"] == table["planned"]
    assert found["sample_as_in_table"] == 1.0
