"""A summary that breaks its schema is refused with the path of what breaks it."""

from __future__ import annotations

import copy
import json
import math

import jsonschema
import pytest

from bayesoleo import _schema as schema
from bayesoleo.errors import ResultsError

RUN = {"role": "fit", "rms": 3.0, "repeating": 2.0, "noise": 1.0, "ratio_to_noise": 2.0}
ROLE = {"force": {"rms": 3.0, "repeating": 2.0, "ratio_to_noise": 2.0}}
SUMMARY = {
    "campaign": "shaker",
    "model": "f16n2d2",
    "rounds": [
        {
            "error": {"force": {"a": RUN, "b": {**RUN, "noise": None, "ratio_to_noise": None}}},
            "candidates": [
                {
                    "effect": "stribeck",
                    "target": None,
                    "family": "friction",
                    "gain": 0.9,
                    "p_value": 0.001,
                    "expected": {"breakaway": 130.0},
                    "indistinguishable_from": [],
                }
            ],
            "accepted": None,
            "reason": "",
        }
    ],
    "effects": [],
    "parameters": {
        "k": {"estimate": 1.0, "mean": None, "sd": 0.1, "interval": [0.8, 1.2], "unit": "N/m"}
    },
    "error_before": {"fit": ROLE, "hold-out": ROLE},
    "error_after": {"fit": ROLE, "hold-out": ROLE},
    "verdict": "nothing missing",
}


def broken(path, value):
    summary = copy.deepcopy(SUMMARY)
    place = summary
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    return summary


def test_the_schema_is_a_schema():
    jsonschema.Draft202012Validator.check_schema(schema.summary_schema())


def test_good_summaries_pass():
    schema.validate_summary(SUMMARY)
    schema.validate_summary(
        {**SUMMARY, "format": 1, "drive": None, "seed": 3, "notes": ["x"], "new": 1}
    )
    assert json.loads(schema.summary_json(SUMMARY)) == SUMMARY


def averaged(**entry):
    prior = {"nothing": 0.5, "catalogue": 0.4, "outside": 0.1, "numbers": [1.0], "families": {}}
    one = {"unit": "N/m", "declared": None, "final": None, "averaged": entry}
    rest = {"nothing": 1.0, "outside": 0.0, "only_outside": 0.0, "effects": [], "classes": []}
    structures = {"prior": prior, **rest, "list": [], "parameters": {"k": one}}
    return {**SUMMARY, "structures": structures}


def test_averages_may_be_withheld_with_a_reason():
    none = {"mean": None, "sd": None, "interval": None, "median": None}
    schema.validate_summary(averaged(**none, reason="The data determine it poorly."))
    schema.validate_summary(averaged(mean=1.0, sd=0.1, interval=[0.8, 1.2], median=1.0))
    with pytest.raises(ResultsError, match=r"averaged\.interval"):
        schema.validate_summary(averaged(**none | {"interval": [1.0]}))
    with pytest.raises(ResultsError, match=r"averaged\.reason"):
        schema.validate_summary(averaged(**none, reason=3))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("structures",), {}, r"key structures: "),
        (("verdict",), "all good", r"key verdict: .*'all good' is not one of"),
        (("rounds",), [], r"key rounds: "),
        (("rounds", 0, "accepted"), 3, r"key rounds\[0\].accepted: "),
        (("rounds", 0, "error", "force", "a", "rms"), "3", r"key rounds\[0\].error.force.a.rms: "),
        (("rounds", 0, "candidates", 0, "p_value"), 1.5, r"candidates\[0\].p_value: .*1.5"),
        (("parameters", "k", "interval"), [1.0], r"key parameters.k.interval: "),
        (("error_after", "test"), {}, r"key error_after: .*'test'"),
        (("parameters", "k", "mean"), math.nan, r"key parameters.k.mean: .*finite.*write null"),
        (("rounds", 0, "candidates", 0, "gain"), math.inf, r"candidates\[0\].gain: .*finite"),
    ],
)
def test_what_is_wrong_is_named(path, value, message):
    with pytest.raises(ResultsError, match=message):
        schema.validate_summary(broken(path, value))


def test_a_missing_part_is_named():
    summary = {name: value for name, value in SUMMARY.items() if name != "verdict"}
    with pytest.raises(ResultsError, match=r"key summary: .*'verdict' is a required property"):
        schema.validate_summary(summary)


def test_names_are_built_in_one_place():
    assert schema.mean(schema.before("force")) == "force_before_mean"
    assert schema.variable_name(schema.by_run("offset", "a/b")) == "offset[a∕b]"


def test_a_summary_that_was_valid_is_checked_again_once_it_has_changed():
    schema.validate_summary(SUMMARY)
    for _ in range(2):  # what is wrong is not remembered as checked
        with pytest.raises(ResultsError, match="verdict"):
            schema.validate_summary(broken(["verdict"], "no such verdict"))
    schema.validate_summary(SUMMARY)
    with pytest.raises(ResultsError, match="verdict"):
        schema.validate_summary(broken(["verdict"], object()))
