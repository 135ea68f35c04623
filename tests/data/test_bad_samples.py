"""One number that no sensor measured is found, with its place; a pulse is none."""

from __future__ import annotations

import numpy as np
import pytest
from small_table import table

from bayesoleo.data import load_campaign
from bayesoleo.data._sample_quality import impossible_sample
from bayesoleo.errors import CampaignError


@pytest.mark.parametrize(("value", "times"), [(1e300, "more than 1e100"), (-4e9, "times")])
def test_one_impossible_sample_is_named_with_its_place(make_campaign, value, times):
    rows = table()
    rows[56, 1] = value
    with pytest.raises(CampaignError, match=f"row 57, at .* {times}") as caught:
        load_campaign(make_campaign(rows=rows))
    error = caught.value
    assert (error.run, error.value) == ("a", value)
    assert str(error.file).endswith("a.csv")
    assert "mask that time" in error.hint


def test_the_row_counts_what_was_cut(make_campaign):
    rows = table()
    rows[56, 1] = 1e300
    folder = make_campaign({"frequency = 1.0": "frequency = 1.0\nstart = 0.4"}, rows)
    with pytest.raises(CampaignError, match=r"row 57, at 1\.12 s"):
        load_campaign(folder)


def test_a_few_are_found_as_one_is():
    values = np.sin(np.linspace(0, 40, 2000))
    values[[300, 900, 1500]] = 1e9, -1e9, 1e9
    assert impossible_sample(values)[0] == 300


@pytest.mark.parametrize(
    "values",
    [
        np.random.default_rng(1).standard_normal(500),
        np.random.default_rng(1).standard_cauchy(2000),
        np.where(np.arange(400) == 200, 100.0, 0.0),  # a pulse without noise
        np.exp(-(((np.arange(400) - 200) / 1.5) ** 2)),  # a smooth one
        1e-3 * np.random.default_rng(2).standard_normal(400) + 100 * (np.arange(400) == 7),
        np.sign(np.sin(np.arange(300.0))),
        np.array([1.0, 2.0]),
    ],
    ids=["noise", "heavy tails", "pulse", "bell", "tap", "switch", "two"],
)
def test_what_a_sensor_may_measure_is_left(values):
    assert impossible_sample(values) == (None, "")
