"""The verdict as a sentence tells apart what was added at several places."""

from __future__ import annotations

from bayesoleo import schema
from bayesoleo.report.sentences import headline


def told(effects, accepted):
    rounds = [{"accepted": name, "accepted_target": place} for name, place in accepted]
    summary = {"effects": effects, "rounds": rounds, "verdict": schema.EFFECT_ADDED}
    return headline(summary)


def test_an_effect_added_at_two_places_is_told_with_both():
    text = told(
        ["varies_by_run", "stribeck_friction", "varies_by_run"],
        [("varies_by_run", "orifice"), ("stribeck_friction", "stroke"), ("varies_by_run", "area")],
    )
    names = "varies_by_run @ orifice, stribeck_friction and varies_by_run @ area"
    assert text == f"The model lacked effects: {names} found and added."


def test_a_place_that_is_not_sure_is_not_told():
    accepted = [("varies_by_run", place) for place in ("orifice", "area", "volume")]
    text = told(["varies_by_run", "varies_by_run"], accepted)
    assert text == "The model lacked effects: varies_by_run and varies_by_run found and added."
    assert "varies_by_run found" in told(["varies_by_run"], accepted[:1])
