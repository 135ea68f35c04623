"""Sensors known to their accuracy only, through the whole loop."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_campaigns import CUBIC, FRICTION, damper, damper_campaign

from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._workflow.settings import Settings
from bayesoleo.effects import find_effect

OFFSET, ACCURACY = 1.5, 2.0
EFFECTS = tuple(map(find_effect, ("coulomb_friction", "quintic_stiffness", "mass_error")))
HELD = Settings(quick=True, jobs=1, effects=EFFECTS, seed=5)
FREE = replace(HELD, nuisance=("offset", "gain"))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> Path:
    """A damper with friction, whose force sensor is off by 1.5 N and accurate to 2 N."""
    folder = tmp_path_factory.mktemp("sensor") / "campaign"
    damper_campaign(folder, offsets=dict.fromkeys("abcde", OFFSET))
    toml = folder / "campaign.toml"
    text = toml.read_text(encoding="utf-8")
    toml.write_text(text.replace('unit = "N"', f'unit = "N"\naccuracy = {ACCURACY}'), "utf-8")
    return folder


def first_round(tree):
    return json.loads(tree.attrs[schema.SUMMARY])["rounds"][0]


@pytest.mark.slow
def test_ranking_is_not_blurred_by_what_a_sensor_may_be_off(campaign):
    free, held = (workflow.trace(campaign, damper(), settings) for settings in (FREE, HELD))
    best = [first_round(tree)["candidates"][0] for tree in (free, held)]
    assert [item["effect"] for item in best] == ["coulomb_friction"] * 2
    # what the offset leaves behind, no effect explains
    assert best[0]["gain"] > 0.97 > 0.85 > best[1]["gain"]
    point = free[schema.POINT].to_dataset().set_coords(schema.UNIT)
    offset = point.sel(parameter="sensor_offset_force")
    assert abs(float(offset["estimate"]) - OFFSET) < 0.1
    # the spread of the prior: half of the accuracy's variance at two standard deviations
    assert float(offset["sd"]) < ACCURACY / (2 * np.sqrt(2))


@pytest.mark.slow
def test_closed_loop_finds_physics_and_offset(campaign):
    free, held = (workflow.close(campaign, damper(), settings) for settings in (FREE, HELD))
    posterior = free[schema.POSTERIOR].to_dataset()
    truth = {"sensor_offset_force": OFFSET, "coulomb_friction": FRICTION, "cubic": CUBIC}
    for name, value in truth.items():
        draws = posterior[name]
        assert abs(float(draws.mean()) - value) < 4 * float(draws.std()), name
    # nothing but the prior bounds the gain, beside a stiffness and a damping that are free
    gain = posterior["sensor_gain_force"]
    largest = float(free[schema.RECORDS]["force"].max())
    assert float(gain.std()) == pytest.approx(ACCURACY / (2 * np.sqrt(2)) / largest, rel=0.35)
    summaries = [json.loads(tree.attrs[schema.SUMMARY]) for tree in (free, held)]
    assert summaries[0]["verdict"] == schema.EFFECT_ADDED
    # An offset taken for physics: friction is found, and what no name explains has none. A constant
    # is a function of any quantity: of which it is said to be one, says nothing.
    physics, curve = summaries[1]["effects"]
    assert physics == "coulomb_friction"
    assert curve.startswith("nonparametric_")
