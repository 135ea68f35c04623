"""The commands that say how good an estimate is."""

from __future__ import annotations

import json

import pytest

from bayesoleo import _schema as schema, plots
from bayesoleo._storage.result_files import read_tree


@pytest.fixture
def traced(run, campaign, model, tmp_path):
    out = tmp_path / "traced"
    result = run("trace", campaign, "--model", model, "--out", out, "--quiet")
    assert result.exit_code == 0, result.output
    return out / "results.nc"


@pytest.mark.slow
def test_result_is_assessed_in_words_numbers_and_pictures(run, traced, tmp_path):
    result = run("assess", traced, "--figure", tmp_path / "look.png")
    assert result.exit_code == 0, result.output
    assert "over noise" in result.stdout
    assert (tmp_path / "look-displacement.png").stat().st_size > 10_000
    numbers = json.loads(run("assess", traced, "--json").stdout)
    assert numbers["data_vars"]["runs_z"]["dims"] == ["output", "run"]
    one = run("assess", traced, "--figure", tmp_path / "one.png", "--run", "slow")
    assert one.stdout == result.stdout
    assert (tmp_path / "one-displacement.png").stat().st_size > 20_000
    assert "there are" in run("assess", traced, "--run", "slaw").stderr
    assert "give --figure" in run("assess", traced, "--run", "slow").stderr
    result = run("assess", traced, "--stage", "later")
    assert result.exit_code == 2
    assert "use 'before' or 'after'" in result.stderr


def test_replications_go_on_where_they_were_stopped(run, campaign, model, tmp_path):
    arguments = ["replicate", campaign, "--model", model, "--runs", "slow", "-n", 20, "--quiet"]
    arguments += ["--out", tmp_path / "kept", "--jobs", 1]
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    assert "20 of 20 replications converged" in result.stdout
    assert len(list((tmp_path / "kept").glob("slot-*.npz"))) == 1
    tree = read_tree(tmp_path / "kept" / "replications.nc")
    found = tree[schema.SAMPLING_DISTRIBUTION]
    assert found["replicate"].sizes["replication"] == 20
    assert int((found["status"] == 0).sum()) == 20
    assert tree.attrs[schema.SEED] == 0
    plots.sampling_distribution(found)
    assert run(*arguments).stdout == result.stdout


def test_unknown_run_is_refused(refused, campaign, model):
    line = refused("replicate", campaign, "--model", model, "--runs", "slaw")
    assert "did you mean slow" in line


@pytest.mark.filterwarnings("always::bayesoleo.errors.DataWarning")
def test_half_the_frequency_is_warned_of(run, campaign, model):
    toml = campaign / "campaign.toml"
    text = toml.read_text(encoding="utf-8")
    assert "frequency = 2.0" in text
    toml.write_text(text.replace("frequency = 2.0", "frequency = 1.0"), encoding="utf-8")
    result = run("reduce", campaign, "--quiet")
    assert result.exit_code == 0, result.output
    assert "warning: run fast: the motion repeats 2 times" in result.stderr
    assert "write frequency = 2" in result.stderr
    assert len(json.loads(run("reduce", campaign, "--json").stdout)["data_warnings"]) == 1
    assert result.stderr.count("run fast") == 1
    # whoever goes on without looking at the records is told as well
    result = run("check", campaign, "--model", model)
    assert result.exit_code == 0, result.output
    assert "warning: run fast: the motion repeats 2 times" in result.stderr
    assert "write frequency = 2" in result.stdout


@pytest.mark.slow
def test_unused_run_is_predicted_and_scored(run, campaign, model, tmp_path):
    out = tmp_path / "point"
    result = run("estimate", campaign, "--model", model, "--out", out, "--quiet", "--jobs", 1)
    assert result.exit_code == 0, result.output
    arguments = ["predict", out / "results.nc", campaign, "--runs", "fast", "--jobs", 1]
    result = run(*arguments, "--figure", tmp_path / "bands.png", "--quiet")
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    assert "within 95 %" in result.stdout
    assert (tmp_path / "bands-displacement.png").stat().st_size > 10_000
    numbers = json.loads(run(*arguments, "--json").stdout)["data_vars"]
    assert numbers["coverage"]["data"][0][0] == pytest.approx(0.95, abs=0.03)
    toml = campaign / "campaign.toml"
    toml.write_text(toml.read_text().replace('role = "fit"', 'role = "hold-out"'))
    alone = json.loads(run(*arguments, "--json").stdout)["data_vars"]
    assert alone["rms"] == numbers["rms"]  # no run to fit is needed
    refused = run("estimate", campaign, "--model", model)
    assert refused.exit_code == 2
    assert 'key role: no run to fit; give one run or more role = "fit"' in refused.stderr
    refused = run(*arguments[:-3], "slaw")
    assert refused.exit_code == 2
    assert "no such run" in refused.stderr
