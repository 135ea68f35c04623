"""The lines in the terminal say what changed and where the files are."""

from __future__ import annotations

import io
import json

from rich.console import Console

from bayesoleo._report.terminal import print_summary


def printed(summary):
    stream = io.StringIO()
    print_summary(summary, Console(file=stream, width=110))
    return " ".join(stream.getvalue().split())


def test_error_effect_and_files(oleo):
    summary = json.loads(oleo.attrs["summary"])
    summary["files"] = {"report": "out/[red]report.html"}
    text = printed(summary)
    assert "Probable: Stribeck friction was missing; " in text
    assert "63.9 → 7.48" in text
    assert "94 % of the excess, p < 0.001" in text
    assert "cannot tell it from Dahl friction" in text
    assert "out/[red]report.html" in text


def test_an_effect_that_did_not_stay_is_said_to_have_gone(oleo):
    summary = json.loads(oleo.attrs["summary"])
    gone = "it was taken out again later"
    assert gone not in printed(summary)
    summary["effects"] = ["nonparametric_velocity"]
    assert gone in printed(summary)


def test_nothing_added(two_runs):
    text = printed(json.loads(two_runs.attrs["summary"]))
    assert "Nothing is missing" in text
    assert "→" not in text
