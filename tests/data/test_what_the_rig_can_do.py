"""The table [rig] of a campaign."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bayesoleo.data import SimulatedRun, load_campaign, write_campaign
from bayesoleo.data._campaign_toml import read_rig
from bayesoleo.errors import CampaignError


@pytest.mark.parametrize(
    ("name", "entry", "limit"),
    [
        ("amplitude", {"low": 5, "high": 50, "unit": "mm"}, (0.005, 0.05)),
        ("frequency", {"high": 10.0, "unit": "Hz"}, (-math.inf, 10.0)),
        ("force", {"low": -2.0, "unit": "kN"}, (-2000.0, math.inf)),
        # A swing of ten degrees is ten kelvin, a mean of ten degrees is not.
        ("amplitude", {"high": 10, "unit": "degC"}, (-math.inf, 10.0)),
        ("mean", {"low": 10, "unit": "degC"}, (283.15, math.inf)),
    ],
)
def test_limits_become_si(name, entry, limit):
    assert read_rig({name: entry}, "campaign.toml")[name] == pytest.approx(limit)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (3, "key rig: is no table"),
        ({"amplitude": 50}, "key rig.amplitude: malformed limit"),
        ({"amplitude": {"unit": "mm"}}, "key rig.amplitude: malformed limit.*low = 1, high = 50"),
        ({"amplitude": {"high": 50}}, "key rig.amplitude.unit: limit without unit"),
        ({"amplitude": {"hi": 50, "low": 1, "unit": "mm"}}, "key rig.amplitude.hi: malformed"),
        ({"amplitude": {"high": True, "unit": "mm"}}, "key rig.amplitude.high: malformed"),
        ({"amplitude": {"high": 5, "unit": "mmm"}}, "key rig.amplitude.unit: unknown unit"),
        ({"frequency": {"high": 5, "unit": "mm"}}, "key rig.frequency.unit: is no frequency"),
        ({"mean": {"low": 5, "high": 1, "unit": "mm"}}, "key rig.mean: .*wrong way round"),
    ],
)
def test_malformed_limits_are_told_with_what_to_write(table, message):
    with pytest.raises(CampaignError, match=message):
        read_rig(table, "campaign.toml")


def test_a_campaign_keeps_them_and_one_without_has_none(tmp_path):
    time = np.arange(400) / 100
    samples = {"displacement": np.sin(2 * np.pi * time)}
    folder = write_campaign(
        tmp_path / "c",
        name="c",
        channels={"displacement": ("x_mm", "mm")},
        runs=[SimulatedRun("a", time, samples, 1.0)],
    )
    assert load_campaign(folder).rig == {}
    toml = folder / "campaign.toml"
    text = toml.read_text()
    toml.write_text(f'{text}\n[rig]\namplitude = {{ high = 20, unit = "mm" }}\n')
    assert load_campaign(folder).rig == {"amplitude": (-math.inf, 0.02)}
