"""One line on stability in the page, a warning in the terminal where a run is unstable."""

from __future__ import annotations

import copy
import io
import json

import pytest
from rich.console import Console

from bayesoleo import _schema as schema
from bayesoleo._report.page import render_report
from bayesoleo._report.sentences import stability
from bayesoleo._report.terminal import print_summary
from bayesoleo.errors import ResultsError


def with_runs(tree, **runs):
    """The summary of a result with solutions of given multipliers."""
    summary = copy.deepcopy(json.loads(tree.attrs[schema.SUMMARY]))
    summary["stability"] = {
        run: {
            "multipliers": [[m.real, m.imag] for m in map(complex, values)],
            "stable": all(abs(m) < 1 for m in values) if values else None,
            "branch_jumps": 0,
        }
        for run, values in runs.items()
    }
    summary["branch_jumps"] = {"estimate": 0, "posterior": None}
    return summary


def printed(summary) -> str:
    stream = io.StringIO()
    print_summary(summary, Console(file=stream, width=110))
    return " ".join(stream.getvalue().split())


def test_stable_runs_are_one_line_of_the_page_and_none_of_the_terminal(two_runs):
    summary = with_runs(two_runs, a=[0.3 + 0.4j, 0.3 - 0.4j], b=[0.2, 0.1], c=[])
    line = "The periodic solutions of all 2 runs are stable; largest Floquet multiplier 0.500"
    assert stability(summary) == f"{line}, in a."
    assert "Floquet" not in printed(summary)
    tree = two_runs.copy()
    tree.attrs[schema.SUMMARY] = schema.summary_json(summary)
    assert line in render_report(tree)


def test_an_unstable_run_is_a_warning(two_runs):
    summary = with_runs(two_runs, a=[-1.5, 0.1], b=[0.2, 0.1])
    summary["branch_jumps"]["estimate"] = 3
    text = printed(summary)
    assert "The periodic solution of a is unstable; largest Floquet multiplier 1.50, in a." in text
    assert "changed branch or stability 3 times" in text


def test_a_result_without_periodic_solutions_says_nothing(two_runs):
    assert stability(json.loads(two_runs.attrs[schema.SUMMARY])) == ""
    assert stability(with_runs(two_runs, a=[])) == ""


def test_the_schema_knows_what_a_multiplier_is(two_runs):
    summary = with_runs(two_runs, a=[0.5])
    summary["stability"]["a"]["multipliers"] = [[0.5]]
    with pytest.raises(ResultsError, match=r"stability\.a\.multipliers\[0\]"):
        schema.validate_summary(summary)
