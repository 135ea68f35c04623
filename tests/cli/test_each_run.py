"""Estimates from each run by itself, on the command line."""

from __future__ import annotations

import json

from bayesoleo._storage.result_files import read_tree
from bayesoleo.errors import InputError
from bayesoleo.estimation import _between_runs


def test_each_run_gets_its_line_and_the_runs_are_compared(run, campaign, model, tmp_path):
    out = tmp_path / "each"
    arguments = ["estimate", campaign, "--model", model, "--each", "--quiet", "--jobs", 1]
    result = run(*arguments, "--out", out)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert [line.split()[0] for line in lines[1:3]] == ["slow", "fast"]
    assert "p equal" in result.stdout
    tree = read_tree(out / "each.nc")
    assert tree["each"].sizes["run"] == 2
    assert tree["between_runs"].sizes["parameter"] == 2
    facts = json.loads(run(*arguments, "--json").stdout)
    assert facts["each"]["data_vars"]["status"]["data"] == ["converged"] * 2
    # simulated with 2000 N/m in both runs
    stiffness = [row[1] for row in facts["each"]["data_vars"]["estimate"]["data"]]
    assert max(abs(value - 2000) for value in stiffness) < 5


def test_estimates_are_written_where_the_runs_cannot_be_compared(
    run, campaign, model, tmp_path, monkeypatch
):
    def refuse(each):
        raise InputError("nothing can be compared", run="slow")

    monkeypatch.setattr(_between_runs, "between_runs", refuse)
    arguments = ["estimate", campaign, "--model", model, "--each", "--quiet", "--jobs", 1]
    result = run(*arguments, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert "runs not compared: run slow: nothing can be compared" in result.stdout
    tree = read_tree(tmp_path / "each.nc")
    assert set(tree.children) == {"each"}
