"""A count and its noun agree."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import bayesoleo
from bayesoleo import load_campaign
from bayesoleo.data import SimulatedRun, write_campaign
from bayesoleo.errors import number_of

#: Sentences that are said of several only.
SEVERAL = {
    "The periodic solutions of all {len(known)} runs",
    "({len(values)} runs)",
    "first {MOST_PANELS} of {len(runs)} runs",
}
COUNTED = re.compile(r"\{len\([^{}]*\)\}(?: [a-z-]+){0,2} [a-z-]+s\b")


@pytest.mark.parametrize(
    ("count", "words"), [(0, "0 runs"), (1, "1 run"), (2, "2 runs"), (np.int64(1), "1 run")]
)
def test_a_noun_is_singular_for_one(count, words):
    assert number_of(count, "run") == words


def test_a_plural_may_be_given():
    assert [number_of(n, "axis", "axes") for n in (1, 2)] == ["1 axis", "2 axes"]


def test_a_campaign_of_one_run_has_one(tmp_path):
    time = np.arange(100) / 100
    run = SimulatedRun("a", time, {"x": np.sin(time)}, None, kind="transient")
    write_campaign(tmp_path, name="n", channels={"x": ("x", "m")}, runs=[run])
    assert repr(load_campaign(tmp_path)).startswith("campaign n: 1 run\n")


def test_no_sentence_counts_with_a_fixed_plural():
    """Where a number of things is put before a noun, the noun must follow it."""
    wrong = [
        f"{file.name}: {match.group()}"
        for file in Path(bayesoleo.__file__).parent.rglob("*.py")
        for line in file.read_text().splitlines()
        for match in COUNTED.finditer(line)
        if not any(known in line for known in SEVERAL)
    ]
    assert wrong == []
