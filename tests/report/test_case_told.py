"""The case on the first page: each question with its answer in numbers."""

from __future__ import annotations

import json

import pytest

from bayesoleo import _schema as schema
from bayesoleo._report.page import case
from bayesoleo._report.tables import failed, output_units


@pytest.fixture(scope="module")
def answers(oleo):
    summary = json.loads(oleo.attrs[schema.SUMMARY])
    summary["rounds"][0]["failed"] = {
        "backlash at stroke": "singular", "gap at stroke": "singular", "mass_error": "spanned"
    }  # fmt: skip
    return dict(case(summary, output_units(oleo, summary), oleo)), summary


def test_what_it_is_how_large_and_whether_it_holds(answers):
    found, _ = answers
    assert found["What is it?"].startswith("Stribeck friction explains 94 % of the excess (")
    assert "corrected for the search of" in found["What is it?"]
    assert "comes nearest: " in found["What else could it be?"]
    assert "95 %" in found["How large?"]
    assert "→" in found["Does it hold on data not used?"]
    assert "times its standard error" in found["Was anything wrong?"]
    assert "best remaining candidate" in found["What is left?"]


def test_a_number_without_a_unit_has_none_in_a_sentence(answers, oleo):
    summary = json.loads(json.dumps(answers[1]))
    added = next(c for c in summary["rounds"][0]["candidates"] if c["expected"])
    for name in added["expected"]:
        summary["parameters"][name]["unit"] = ""
        summary["parameters"][name].update(estimate=-1.0, mean=-1.0, sd=0.7, interval=None)
    answer = dict(case(summary, {}, oleo))["How large?"]
    assert answer.count("= −1.00 ± 0.70") == len(added["expected"])
    assert "± 0.70 1" not in answer


def test_how_sure_a_name_is(answers, oleo):
    summary = json.loads(json.dumps(answers[1]))
    question = "How sure is its name?"
    sure = dict(case(summary | {"certain": True, "certainty": "certain"}, {}, oleo))[question]
    assert sure.startswith("Certain: ")
    for entry in summary["rounds"]:
        for candidate in entry["candidates"]:
            candidate["indistinguishable_from"] = []
    for word, begins in {
        "likeness": "A likeness only: ", "probable": "Probable: ", "no cause": "No cause is named: "
    }.items():  # fmt: skip
        answer = dict(case(summary | {"certain": False, "certainty": word}, {}, oleo))[question]
        assert answer.startswith(begins)
    summary["rounds"][0]["candidates"][0]["indistinguishable_from"] = ["another"]
    summary["rounds"][0]["accepted"] = summary["rounds"][0]["candidates"][0]["effect"]
    summary["rounds"][0]["accepted_target"] = summary["rounds"][0]["candidates"][0]["target"]
    classed = dict(case(summary | {"certain": False}, {}, oleo))[question]
    assert classed.startswith("Probable, as one of a class: ")
    summary.pop("certain", None)
    assert question not in dict(case(summary, {}, oleo))


def test_what_was_removed_again_is_not_said_to_be_it(answers, oleo):
    removed = json.loads(json.dumps(answers[1]))
    removed["effects"] = []
    found = dict(case(removed, {}, oleo))
    assert found["What is it?"].endswith("was added first, and removed again.")
    assert "explains" not in found["What is it?"]


def test_candidates_without_a_score_are_counted_by_reason(answers):
    found, summary = answers
    expected = "3 candidates have no score: 2 (singular), 1 (spanned)."
    assert found["What could not be tried?"] == expected
    table = failed(summary["rounds"][0])
    assert ["gap (stroke)", "singular"] in table.rows
    assert failed({"candidates": []}) is None


def test_nothing_wrong_is_said_so(answers, two_runs):
    _, summary = answers
    quiet = json.loads(json.dumps(summary))
    for runs in quiet["rounds"][0]["error"].values():
        for entry in runs.values():
            entry["ratio_to_noise"] = 1.01
    quiet["rounds"], quiet["effects"] = quiet["rounds"][:1], []
    quiet["rounds"][0]["accepted"] = None
    found = dict(case(quiet, {}, two_runs))
    assert found["Was anything wrong?"].startswith("No: no error is larger than chance allows")
    assert "What is it?" not in found
    assert "Does it hold on data not used?" not in found


@pytest.mark.parametrize(("p", "alone"), [(0.59, False), (0.001, True)])
def test_a_p_value_that_added_nothing_says_beside_what_it_stands(answers, oleo, p, alone):
    """An effect of transients is added on trial, and confirmed beside those that follow."""
    trial = json.loads(json.dumps(answers[1]))
    for candidate in trial["rounds"][0]["candidates"]:
        candidate["p_value"] = p
    told = dict(case(trial, {}, oleo))["What is it?"]
    assert ("beside what the model had until then" not in told) == alone
