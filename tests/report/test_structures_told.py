"""Headline, section and terminal give what is missing its probability, and say what differs."""

from __future__ import annotations

import copy
import io
import json

import pytest
from rich.console import Console

from bayesoleo import _schema as schema
from bayesoleo._report import structures
from bayesoleo._report.page import render_report
from bayesoleo._report.sentences import badge, headline
from bayesoleo._report.terminal import print_summary
from bayesoleo._session.display import structures_data, structures_text

COULOMB, STRIBECK = "coulomb_friction @ stroke", "stribeck_friction @ stroke"
NOTHING, OUTSIDE = (), None


def probabilities(table, classes=()):
    """The summary's key from structures ``(effects..., [None for outside])`` to probability."""
    listed = [
        {
            "effects": [one for one in members if one is not None],
            "outside": None in members,
            "probability": p,
            "estimated": True,
        }
        for members, p in table.items()
    ]
    single = {}
    for one in listed:
        for member in one["effects"]:
            single[member] = single.get(member, 0.0) + one["probability"]
    prior = {"nothing": 0.5, "catalogue": 0.4, "outside": 0.1, "numbers": [1.0], "families": {}}
    return {
        "prior": prior,
        "nothing": table.get(NOTHING, 0.0),
        "outside": sum(p for members, p in table.items() if None in members),
        "only_outside": table.get((OUTSIDE,), 0.0),
        "effects": [
            dict(zip(("effect", "target"), name.split(" @ "), strict=True))
            | {"title": "", "probability": p}
            for name, p in sorted(single.items(), key=lambda item: -item[1])
        ],
        "classes": list(classes),
        "list": sorted(listed, key=lambda one: -one["probability"]),
    }


def summary_of(table, effects=(), sure=None, verdict=schema.EFFECT_ADDED, ratio=1.0, classes=()):
    errors = {"ratio_to_noise": ratio, "repeating": 1.0, "rms": 1.0, "lowest": 0.0}
    pairs = [name.split(" @ ") for name in effects]
    ranked = [
        {
            "accepted": effect,
            "accepted_target": place,
            "candidates": [
                {"effect": effect, "target": place, "gain": 0.9, "p_value": 1e-9,
                 "indistinguishable_from": []},
            ],
        }
        for effect, place in pairs
    ]  # fmt: skip
    last = {"accepted": None, "candidates": [], "error": {"force": {"a": errors}}}
    return {
        "effects": [effect for effect, _ in pairs],
        "targets": [place for _, place in pairs],
        "rounds": [*ranked, last],
        "verdict": verdict,
        "certainty": sure,
        "error_after": {"hold-out": {"force": errors}},
        "structures": probabilities(table, classes),
    }


def test_a_certain_name_is_said_with_its_probability_and_the_next():
    found = summary_of({(COULOMB,): 0.9, (COULOMB, OUTSIDE): 0.07, (STRIBECK,): 0.02}, [COULOMB],
                       schema.CERTAIN)  # fmt: skip
    text = headline(found)
    assert text.startswith(
        "Certain: Coulomb friction (stroke) was missing, with probability 0.97; the error is"
    )
    assert text.endswith("The next is breakaway friction (stroke), 0.02.")
    assert badge(found) == "effect added · certain"
    found = summary_of({(COULOMB,): 0.9, (COULOMB, OUTSIDE): 0.06, (OUTSIDE,): 0.03}, [COULOMB],
                       schema.CERTAIN)  # fmt: skip
    assert headline(found).endswith("The next is only something outside the catalogue, 0.03.")


def test_nothing_missing_is_said_with_its_probability():
    found = summary_of({NOTHING: 0.93, (COULOMB,): 0.05}, verdict=schema.NOTHING_MISSING)
    assert headline(found).startswith("Nothing is missing, with probability 0.93: the model")
    assert badge(found) == "nothing missing · 0.93"


def test_nothing_missing_is_not_claimed_against_its_probability():
    found = summary_of({(COULOMB,): 0.7, NOTHING: 0.3}, verdict=schema.NOTHING_MISSING)
    text = headline(found)
    assert "Nothing is missing" not in text
    assert "that nothing is missing has probability 0.30" in text
    assert text.endswith(
        "The search added nothing, but the most probable structure is Coulomb friction (stroke)"
        " (0.70)."
    )


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({(OUTSIDE,): 0.8}, "Something is missing that the catalogue does not have (0.80): "),
        ({(COULOMB,): 0.8}, "Something is missing, probably Coulomb friction (stroke) (0.80): "),
        (
            {(COULOMB, OUTSIDE): 0.65, (OUTSIDE,): 0.34},
            "Something is missing that effects of the catalogue do not explain alone (0.99): ",
        ),
        ({(COULOMB,): 0.4, (STRIBECK,): 0.4}, "Something is missing: "),
        (
            {NOTHING: 0.8},
            "More is left than is expected, which may be coloured noise; nothing is missing with"
            " probability 0.80: ",
        ),
    ],
)
def test_what_is_left_has_its_probability(table, text):
    assert headline(summary_of(table, verdict=schema.UNEXPLAINED, ratio=5.0)).startswith(text)


def test_effects_beside_an_unknown_law_are_called_similar():
    text = structures.beside_outside(summary_of({(COULOMB, OUTSIDE): 0.65, (OUTSIDE,): 0.34}))
    assert text.startswith("Something outside the catalogue acts (0.99). Probabilities of effects")
    assert text.endswith("not as its causes.")
    assert not structures.beside_outside(summary_of({(OUTSIDE,): 0.99, NOTHING: 0.01}))
    assert not structures.beside_outside(summary_of({(COULOMB, OUTSIDE): 0.65, (COULOMB,): 0.3}))


def test_an_improbable_name_is_not_called_probable():
    found = summary_of({(STRIBECK,): 0.6, (COULOMB,): 0.3}, [COULOMB], schema.PROBABLE)
    text = headline(found)
    assert text.startswith("One explanation of several: Coulomb friction (stroke) was added, with")
    assert "most probable structure is breakaway friction (stroke) (0.60)" in text


DRAG = "quadratic_damping @ stroke"


def test_several_effects_have_the_probability_of_all_together():
    """Each may be probable although all at once are not."""
    pairs = [(COULOMB, STRIBECK), (COULOMB, DRAG), (STRIBECK, DRAG)]
    table = {(COULOMB, STRIBECK, DRAG): 0.4} | {(*pair, OUTSIDE): 0.2 for pair in pairs}
    found = summary_of(table, [COULOMB, STRIBECK, DRAG], schema.PROBABLE)
    text = headline(found)
    assert text.startswith("One explanation of several: Coulomb friction (stroke), breakaway")
    assert "were added, with probabilities 0.80, 0.80 and 0.80, and 0.40 for all 3 together" in text
    assert "Something outside the catalogue acts, with probability 0.60." in text
    # What was summed over all structures counts more than those that are listed.
    found["structures"]["together"] = 0.51
    assert headline(found).startswith("Probable: Coulomb friction (stroke), breakaway")
    assert "and 0.51 for all 3 together" in headline(found)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({(COULOMB,): 0.3, (OUTSIDE,): 0.35, (STRIBECK,): 0.35}, "acts is more probable: 0.35."),
        ({(COULOMB,): 0.3, (COULOMB, OUTSIDE): 0.6}, "catalogue acts, with probability 0.60."),
        ({(COULOMB,): 0.6, (OUTSIDE,): 0.4}, ""),
    ],
)
def test_something_outside_is_named_where_it_is_more_probable(table, said):
    text = headline(summary_of(table, [COULOMB], schema.PROBABLE))
    assert ("Something outside the catalogue acts" in text or "That something outside" in text) is (
        said != ""
    )
    assert said in text


def test_something_outside_is_named_where_nothing_was_added():
    table = {(COULOMB, OUTSIDE): 0.35, (STRIBECK, OUTSIDE): 0.3, NOTHING: 0.35}
    for verdict in (schema.NOTHING_MISSING, schema.UNEXPLAINED):
        text = headline(summary_of(table, verdict=verdict, ratio=2.0))
        assert "Something outside the catalogue acts, with probability 0.65." in text
    once = headline(summary_of({(OUTSIDE,): 0.9, NOTHING: 0.1}, verdict=schema.NOTHING_MISSING))
    assert once.count("outside the catalogue") == 1


def test_the_sum_of_a_class_is_said():
    together = {"effects": [STRIBECK, COULOMB, "dahl_friction @ stroke"], "family": "friction",
                "probability": 0.993}  # fmt: skip
    found = summary_of({(STRIBECK,): 0.6, (COULOMB,): 0.39}, [COULOMB], schema.PROBABLE,
                       classes=[together])  # fmt: skip
    assert headline(found).startswith("Probable as one of a class: Coulomb friction (stroke) was")
    (text,) = structures.classes(found)
    assert text == (
        "Breakaway friction (stroke) or Coulomb friction (stroke) or another effect of the family"
        " friction: together 0.99."
    )
    together["probability"] = 0.999
    (text,) = structures.classes(found)
    assert text.endswith("together above 0.99.")


@pytest.mark.parametrize(
    ("table", "effects", "agrees"),
    [
        ({(COULOMB,): 0.6, (STRIBECK,): 0.4}, [COULOMB], True),
        ({(COULOMB, OUTSIDE): 0.6, (COULOMB,): 0.4}, [COULOMB], False),
        ({(STRIBECK,): 0.6}, [COULOMB], False),
        ({(OUTSIDE,): 0.6}, ["nonparametric_stroke @ force"], True),
        ({(STRIBECK, COULOMB): 0.6}, [COULOMB, STRIBECK], True),
    ],
)
def test_disagreement_is_said_in_one_sentence(table, effects, agrees):
    text = structures.disagreement(summary_of(table, effects, schema.PROBABLE))
    assert (text == "") is agrees
    assert text.count(".") <= 1 + text.count("0.")


def test_an_effect_that_was_not_compared_has_no_probability():
    found = summary_of({(STRIBECK,): 0.9}, ["play @ stroke"], schema.PROBABLE)
    assert "with probability" not in headline(found)


def test_a_likeness_and_the_verdict_read_together():
    found = summary_of({(COULOMB,): 0.9}, [COULOMB], schema.LIKENESS, ratio=3.0)
    assert badge(found) == "effect added · a likeness only"
    assert "explaining most of the excess, but the error of force" in headline(found)


def test_results_without_probabilities_read_as_before():
    found = summary_of({}, [COULOMB], schema.CERTAIN)
    for absent in (None, "gone"):
        old = copy.deepcopy(found)
        if absent is None:
            old["structures"] = None
        else:
            del old["structures"]
        assert "probability" not in headline(old)
        assert structures.lines(old) == structures.section(old) == []
        assert structures.table(old) is None


TABLE = {("Stribeck_friction @ stroke",): 0.81, ("Dahl_friction @ stroke", OUTSIDE): 0.12,
         NOTHING: 0.01}  # fmt: skip


@pytest.fixture
def weighed(synthetic):
    """The made-up result with probabilities."""
    tree = synthetic.oleo_tree()
    summary = json.loads(tree.attrs["summary"])
    summary |= {"structures": probabilities(TABLE), "targets": ["stroke"]}
    schema.validate_summary(summary)
    tree.attrs["summary"] = json.dumps(summary)
    return tree


@pytest.mark.slow
def test_table_figure_and_terminal_of_a_result(weighed):
    summary = json.loads(weighed.attrs["summary"])
    page = render_report(weighed)
    assert page.index('id="structures"') < page.index('id="errors"') < page.index('id="data"')
    assert "could not be drawn" not in page
    table = structures.table(summary)
    assert [row[1] for row in table.rows] == ["0.81", "0.12", "0.01", "0.06"]
    assert table.rows[-1][0] == "all others"
    assert table.marked == {0}
    stream = io.StringIO()
    print_summary(summary, Console(file=stream, width=200))
    assert "Probabilities: Stribeck friction (stroke) 0.81; Dahl friction" in stream.getvalue()


def test_labelled_arrays_of_a_session_repeat_the_summary(weighed):
    summary = json.loads(weighed.attrs["summary"])
    data = structures_data(summary)
    member = data["member"].values.T @ data["structure_probability"].values
    # All structures of this result are listed, so that members add up to their effects.
    assert member == pytest.approx(data["probability"].values)
    assert float(data["nothing"]) == 0.01
    assert "Dahl friction (stroke) and something outside" in structures_text(summary)


def test_averaged_parameters_stand_beside_the_estimates():
    one = {
        "unit": "N/m",
        "declared": {"mean": 1520.0, "sd": 4.0},
        "final": None,
        "averaged": {"mean": 1500.0, "sd": 12.0, "interval": [1480.0, 1521.0]},
    }
    table = structures.parameters({"structures": {"parameters": {"stiffness": one}}})
    assert table is not None
    ((name, declared, final, averaged, interval, unit),) = table.rows
    assert (name, final, unit) == ("stiffness", "–", "kN/m")
    assert declared.startswith("1.520")
    assert averaged.startswith("1.500")
    one["averaged"] = {**one["averaged"], "mean": 1600.0, "median": 1501.0}
    table = structures.parameters({"structures": {"parameters": {"stiffness": one}}})
    assert table.rows[0][3].startswith("1.501")
    assert interval == "1.480 … 1.521"


def test_averages_that_are_withheld_say_why():
    reason = "The data determine this parameter poorly."
    none = {"mean": None, "sd": None, "interval": None, "median": None, "reason": reason}
    one = {
        "unit": "N/m",
        "declared": {"mean": 1520.0, "sd": 900.0},
        "final": None,
        "averaged": none,
    }
    summary = {"structures": {"parameters": {"stiffness": one, "slope": {**one, "declared": None}}}}
    table = structures.parameters(summary)
    assert table is not None
    assert table.rows[0] == ["stiffness", "1.52 ± 0.9", "–", "–", "not stated", "kN/m"]
    assert table.rows[1][1:5] == ["–", "–", "–", "not stated"]
    assert structures.withheld(summary) == f"stiffness, slope: {reason}"


def test_a_mean_too_large_for_a_number_leaves_the_interval():
    averaged = {"mean": None, "sd": None, "interval": [100.0, 9e5], "median": 1.1e4}
    one = {"unit": "s/m", "declared": None, "final": None, "averaged": averaged}
    table = structures.parameters({"structures": {"parameters": {"slope": one}}})
    assert table is not None
    assert table.rows[0][4].endswith("900000")


def test_results_without_averages_have_no_table_of_them():
    assert structures.parameters({"structures": {"nothing": 1.0}}) is None
    assert structures.parameters({}) is None


def test_an_average_of_zero_is_told_in_its_own_unit():
    """Zero but for round-off: in units of its deviation, not in millionths of them."""
    about = {"mean": -1.3e-17, "sd": 1.0}
    one = {
        "unit": "1",
        "declared": {"mean": 0.0, "sd": 1.0},
        "final": about,
        "averaged": {"mean": 5e-4, "median": -6e-4, "sd": 0.99, "interval": [-1.65, 1.64]},
    }
    table = structures.parameters({"structures": {"parameters": {"force_baseline_error[1]": one}}})
    assert table is not None
    assert table.rows[0][1:] == ["0.0 ± 1", "0.0 ± 1", "0.00", "−1.65 … 1.64", ""]
