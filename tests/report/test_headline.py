"""The first line says how sure it is, and calls effects by their titles."""

from __future__ import annotations

import itertools

import pytest

from bayesoleo import _schema as schema
from bayesoleo._report import tables as yardstick
from bayesoleo._report.sentences import error_model, headline, headline_parts
from bayesoleo._workflow.settings import Settings
from bayesoleo.discovery import _inference as inference
from bayesoleo.discovery._work import ENDED
from bayesoleo.effects import catalogue
from bayesoleo.effects._catalogue import called, in_sentence, parameter_called, with_titles


def told(names, sure, *, ratio=1.0, alike=(), verdict=schema.EFFECT_ADDED, lowest=0.0, **more):
    """The headline of effects, each ``id @ target``."""
    summary = summary_of(names, sure, ratio=ratio, alike=alike, verdict=verdict, lowest=lowest)
    return headline(summary | more)


def summary_of(names, sure, *, ratio=1.0, alike=(), verdict=schema.EFFECT_ADDED, lowest=0.0):
    """What a headline needs of a summary."""
    pairs = [name.split(" @ ") for name in names]
    ranked = {name: [candidate(*name.split(" @ "), alike)] for name in names}
    entries = [
        {"accepted": effect, "accepted_target": place, "candidates": ranked[f"{effect} @ {place}"]}
        for effect, place in pairs
    ]
    errors = {"ratio_to_noise": ratio, "repeating": 1.0, "rms": 1.0, "lowest": lowest}
    last = {"accepted": None, "candidates": [], "error": {"force": {"a": errors}}}
    return {
        "effects": [effect for effect, _ in pairs],
        "targets": [place for _, place in pairs],
        "rounds": [*entries, last],
        "verdict": verdict,
        "certainty": sure,
        "error_after": {"hold-out": {"force": errors}},
    }


def candidate(effect, place, alike):
    return {
        "effect": effect, "target": place, "gain": 0.9, "p_value": 1e-9,
        "indistinguishable_from": list(alike),
    }  # fmt: skip


def test_each_certainty_has_its_word():
    one = ["coulomb_friction @ stroke"]
    down = "was missing; the error is then down to"
    assert told(one, schema.CERTAIN).startswith(f"Certain: Coulomb friction (stroke) {down}")
    assert told(one, schema.PROBABLE).startswith(f"Probable: Coulomb friction (stroke) {down}")
    assert "something that was not may" in told(one, schema.PROBABLE)
    left = told(one, schema.LIKENESS, ratio=13.6, verdict=schema.UNEXPLAINED)
    assert left.startswith("A likeness only: Coulomb friction (stroke) was added, and the error of")
    most = told(one, schema.LIKENESS, ratio=13.6)
    assert "was added, explaining most of the excess, but the error of force" in most
    assert "force on the hold-out runs is 13.6 times" in left
    none = told(["nonparametric_stroke @ force"], schema.NO_CAUSE,
                titles={
                    "nonparametric_stroke": "Nonparametric: a smooth function of stroke"
                })  # fmt: skip
    assert none.startswith("No cause is named: a smooth function of stroke (force) was added; ")


def test_a_curve_that_leaves_an_error_names_no_cause_either():
    text = told(
        ["nonparametric_stroke @ force"], schema.NO_CAUSE, ratio=6.0, verdict=schema.UNEXPLAINED
    )
    assert text.startswith(
        "No cause is named: nonparametric stroke (force) was added, and the error of"
    )


def test_names_beside_a_curve_without_one_are_a_likeness():
    """That only noise is left then is no merit of the names alone."""
    both = ["coulomb_friction @ stroke", "nonparametric_stroke @ stroke"]
    text = told(both, schema.LIKENESS)
    assert text.startswith("A likeness only: Coulomb friction (stroke) and nonparametric stroke")
    assert "the error is then down to" in text
    assert "; but a curve without a name had to explain a part." in text
    assert "a part" not in told(both, schema.LIKENESS, ratio=6.0)


def test_a_class_is_said_with_titles():
    text = told(["coulomb_friction @ stroke"], schema.PROBABLE,
                alike=["stribeck_friction", "coulomb_friction @ arm"])  # fmt: skip
    assert text.endswith(
        "These data cannot tell it from breakaway friction or Coulomb friction (arm)."
    )


def test_four_false_names_are_no_finding():
    names = ["coulomb_friction @ x", "sensor_lag @ force", "cubic_stiffness @ x", "play @ x"]
    text = told(names, schema.LIKENESS, ratio=13.6, verdict=schema.UNEXPLAINED)
    assert text.startswith("A likeness only: Coulomb friction (x); lag of a sensor, channels")
    assert " and play (x) were added, and the error of force" in text


def test_a_search_that_broke_off_is_said_first():
    broken = [{"stage": "search", "reason": "NameError: x"}]
    text = told(["play @ x"], schema.PROBABLE, unfinished=broken)
    lead = "Unfinished, the search did not come to its end. "
    assert text.startswith(f"{lead}Probable: play (x) was missing")
    late = [{"stage": "posterior", "reason": "NameError: x"}]
    assert told(["play @ x"], schema.PROBABLE, unfinished=late).startswith("Probable: ")


@pytest.mark.parametrize("names", [[], ["coulomb_friction @ x"]], ids=["none", "one"])
def test_a_quick_search_that_went_no_further_says_so(names):
    sure = schema.LIKENESS if names else None
    plain = told(names, sure, ratio=3.0, verdict=schema.UNEXPLAINED)
    summary = summary_of(names, sure, ratio=3.0, verdict=schema.UNEXPLAINED)
    summary["rounds"] = [*summary["rounds"][:-1], {**summary["rounds"][-1], "reason": ENDED}]
    text = headline(summary)
    on = "without --quick (in Python quick=False) it goes on."
    assert text == f"{plain} The quick search ended there: {on}"
    assert headline_parts(summary)[1].endswith(on)
    # Results of earlier versions have the reason in other words after the semicolon.
    summary["rounds"][-1]["reason"] = "a quick search goes no further; without --quick it looks"
    assert headline(summary) == text


def test_a_run_that_alone_is_too_large_is_named():
    text = told([], None, ratio=1.1, verdict=schema.UNEXPLAINED)
    assert (
        text
        == "Something is missing: the error of force in run a is 1.10 times its standard error."
    )


def runs_told(**ratios):
    """The headline where nothing was found and no error is too large over all runs."""
    runs = {run: {"ratio_to_noise": r, "limit": limit} for run, (r, limit) in ratios.items()}
    last = {"accepted": None, "candidates": [], "error": {"force": runs}}
    return told([], None, rounds=[last], verdict=schema.UNEXPLAINED)


def test_the_run_that_is_named_is_one_that_is_too_large():
    """Chance allows more in a run of few samples."""
    assert "force in run b is 1.40 times" in runs_told(a=(1.5, 2.0), b=(1.4, 1.2))


def test_a_run_without_a_prediction_is_what_is_missing():
    text = runs_told(a=(1.0, 1.2), b=(None, 1.2))
    assert text == "Something is missing: there is no prediction of force in run b."


def test_less_error_than_chance_allows_is_no_finding():
    text = told([], None, ratio=0.16, verdict=schema.UNEXPLAINED, lowest=0.8)
    assert text.startswith("No verdict: the error of force on the hold-out runs is 0.16 times")
    assert text.endswith("less than chance allows: its noise is overstated.")


def test_what_is_expected_is_taken_before_the_noise():
    assert yardstick.ratio({"ratio_to_noise": 5.4, "ratio_to_expected": 0.9}) == 0.9
    assert yardstick.ratio({"ratio_to_noise": 5.4}) == 5.4


@pytest.mark.parametrize("sure", [*schema.CERTAINTIES, None])
def test_no_id_stands_where_a_title_belongs(sure):
    """Of all effects of the catalogue, added and alike."""
    ids = [effect.id for effect in catalogue() if "_" in effect.id]
    for one, other in itertools.pairwise(ids):
        names = [] if sure is None else [f"{one} @ stroke"]
        verdict = schema.UNEXPLAINED if sure in (None, schema.LIKENESS) else schema.EFFECT_ADDED
        text = told(names, sure, alike=[other], ratio=2.0, verdict=verdict)
        assert "_" not in text


def test_titles_read_as_parts_of_sentences():
    names = [in_sentence(effect.title) for effect in catalogue()]
    assert len(set(names)) == len(names)
    assert not any("(" in name or ":" in name for name in names)
    assert called("play @ arm", {}) == "play (arm)"
    assert called("my_own_law", {}) == "my own law"
    assert in_sentence("PWM force") == "PWM force"
    assert in_sentence("A parameter that differs").startswith("a parameter")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sensor_lag explains 4 %", "lag explains 4 %"),
        ("sensor_lag @ force, and play", "lag (force), and play"),
        ("sensor_lag_2 and my_sensor_lag", "sensor_lag_2 and my_sensor_lag"),
        ("at sensor_lag[run 3]", "at sensor_lag[run 3]"),
        ("stands instead of play and sensor_lag:", "stands instead of play and lag:"),
    ],
)
def test_ids_in_sentences_become_titles(text, said):
    assert with_titles(text, {"sensor_lag": "Lag", "play": "Play: no stiffness"}) == said


def test_effects_that_were_not_tried_are_counted():
    sentence = told(["coulomb_friction @ stroke"], schema.CERTAIN, effects_left_out=52)
    assert sentence.endswith("The search was not given 52 other effects of the catalogue.")
    assert "catalogue" not in told(["coulomb_friction @ stroke"], schema.CERTAIN)


def test_settings_count_what_they_leave_out_of_the_catalogue():
    every = len(catalogue())
    assert Settings().left_out == 0
    assert Settings(without=("coulomb_friction",)).left_out == 1
    assert Settings(effects=catalogue()[:2]).left_out == every - 2


@pytest.mark.parametrize("sure", [*schema.CERTAINTIES, None])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_title_of_a_page_is_short_and_nothing_is_lost(sure, count):
    names = ["coulomb_friction @ x", "sensor_lag @ force", "cubic_stiffness @ x"]
    names = [] if sure is None else names[:count]
    for verdict in (schema.EFFECT_ADDED, schema.UNEXPLAINED):
        summary = summary_of(names, sure, ratio=2.0, verdict=verdict, alike=["play @ x"])
        title, rest = headline_parts(summary)
        whole = headline(summary)
        assert not rest.startswith(("Explaining", "And", "But"))
        whole = whole.replace(
            ", explaining", f", {'It explains' if count == 1 else 'They explain'}"
        )
        assert whole.startswith(title[:-1])
        assert whole.endswith(rest[1:])
        # No more than a conjunction between the two is left out.
        assert len(title) + len(rest) >= len(whole) - len(", and ")
        assert len(title) < 110 + 45 * count
        assert title.endswith(".")


@pytest.mark.parametrize(
    ("label", "words"),
    [
        ("stribeck_friction", "breakaway friction"),
        ("stribeck_friction_decay", "breakaway friction, decay"),
        ("stribeck_friction[run 3]", "breakaway friction [run 3]"),
        ("my_law_b", "law of mine, b"),
        ("damping", "damping"),
        ("play_of_mine", "play_of_mine"),
        ("stroke.damping.pressure", "stroke.damping.pressure"),
    ],
)
def test_parameters_of_an_effect_are_called_by_its_title(label, words):
    assert parameter_called(label, {"my_law": "Law of mine"}) == words
    assert called(f"varies_by_run @ {label}", {"my_law": "Law of mine"}).endswith(f"({words})")


REASONS = {
    "white": f"independent errors, chosen because {inference._PLAIN}",
    "inputs": f"spectral errors, chosen because {inference._BY_INPUTS}",
    "effects": f"catalogue errors, chosen because {inference._LEFT.format(7.0)}",
    "beyond": f"power errors, chosen because {inference._BEYOND}",
    "undecided": f"catalogue errors, chosen because {inference._UNDECIDED.format('drag')}",
    "priors": inference._NO_MORE.format("power", inference._LEFT.format(7.0), 1.0, "force", ""),
}


@pytest.mark.parametrize("why", REASONS)
@pytest.mark.parametrize("sure", [*schema.CERTAINTIES, None])
@pytest.mark.parametrize(
    "verdict", [schema.EFFECT_ADDED, schema.UNEXPLAINED, schema.NOTHING_MISSING]
)
@pytest.mark.parametrize("pooled", [1.0, 3.0])
@pytest.mark.parametrize("single", [1.0, 3.0])
@pytest.mark.parametrize("role", [schema.FIT, schema.HOLD_OUT])
def test_headline_and_errors_say_one_thing(why, sure, verdict, pooled, single, role):
    """Of every size of the errors, over all runs of a role and in one of them."""
    summary = summary_of(["coulomb_friction @ x"] if sure else [], sure, verdict=verdict)
    fine = {"ratio_to_noise": 1.0, "repeating": 1.0, "rms": 1.0}
    summary["error_after"] = {role: {"force": fine | {"ratio_to_noise": pooled}}}
    summary["rounds"][-1]["error"] = {
        "force": {"a": fine | {"ratio_to_noise": single, "role": role}}
    }
    text = headline(summary)
    errors = error_model({schema.ERROR_MODEL_REASON: REASONS[why]}, summary)
    large = max(pooled, single) > 2
    if large:
        assert "the error of force" in text
        assert "down to" not in text
    none = "no more than noise is left in the fitted runs" in errors
    more = "more than noise is left in the fitted runs" in errors and not none
    assert not (more and "down to" in text)
    assert not (none and large and role == schema.FIT)
    # Both are said where nothing speaks against it.
    assert none == (why in ("white", "inputs") and not (large and role == schema.FIT))
    assert more == (why == "beyond" and large and role == schema.FIT)


@pytest.mark.parametrize("verdict", [schema.EFFECT_ADDED, schema.UNEXPLAINED])
@pytest.mark.parametrize("sure", schema.CERTAINTIES)
def test_the_rest_of_a_headline_begins_without_a_conjunction(sure, verdict):
    summary = summary_of(["coulomb_friction @ x"], sure, ratio=3.0, verdict=verdict)
    assert headline_parts(summary)[1].startswith(("The error of force", "It explains most of"))
