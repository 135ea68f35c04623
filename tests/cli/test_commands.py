"""Every command does what it says, as far as that takes no time."""

from __future__ import annotations

import io
import json
import re

import pytest
import typer.main
from rich.console import Console

from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._cli import app, shell, shell as tables
from bayesoleo._cli.listing import readable
from bayesoleo._storage.result_files import read_tree, write_tree
from bayesoleo._workflow.settings import SCHEMES
from bayesoleo.effects import catalogue
from bayesoleo.solvers._schemes import scheme
from bayesoleo.systems import systems

COMMANDS = tuple(typer.main.get_command(app).commands)


def test_the_commands_are_these():
    expected = {"demo", "close", "check", "reduce", "estimate", "sample", "trace"}
    expected |= {"simulate", "report", "systems", "effects", "assess", "replicate", "predict"}
    expected |= {"propose", "init", "each"}
    assert set(COMMANDS) == expected


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(run, command):
    result = run(command, "--help")
    assert result.exit_code == 0
    assert "Examples:" in result.stdout
    assert f"bayesoleo {command}" in result.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_prints_json(command):
    names = [
        flag for one in typer.main.get_command(app).commands[command].params for flag in one.opts
    ]
    assert "--json" in names


def test_help_of_all(run):
    result = run("--help")
    assert result.exit_code == 0
    assert [name for name in COMMANDS if f" {name} " not in result.stdout] == []


def test_version(process):
    done = process("--version")
    assert done.returncode == 0
    assert done.stdout.startswith("bayesoleo ")


def test_systems_as_json(run):
    found = json.loads(run("systems", "--json").stdout)
    assert tuple(found) == systems()
    oleo = found["f16n2d2"]
    assert oleo["drives"] == ["force", "displacement", "pressure"]
    assert oleo["outputs"] == {"displacement": "m", "pressure": "Pa"}
    assert set(oleo["parameters"]["piston_area"]) >= {"value", "unit", "prior", "fixed", "by_run"}


def test_one_system(run, model):
    text = run("systems", "f16n2d2").stdout
    for part in ("gas_pressure = gas_stiffness*", "can be driven by", "J/(kg*K)", "fixed"):
        assert part in text
    own = json.loads(run("systems", model, "--json").stdout)
    assert own["name"] == "linear oscillator"
    assert run("systems").stdout.count("\n") == len(systems()) + 1


def test_effects_as_json(run):
    found = json.loads(run("effects", "--json").stdout)
    assert [item["id"] for item in found] == [effect.id for effect in catalogue()]
    keys = {"id", "family", "title", "formula", "parameters", "source", "applies_to"}
    for item in found:
        assert set(item) == keys
        kinds = {parameter["kind"] for parameter in item["parameters"].values()}
        assert kinds & {"amplitude", "amplitude by run"}
        assert all(set(p) >= {"unit", "description"} for p in item["parameters"].values())
    assert json.loads(run("effects", "dahl_friction", "--json").stdout)["family"] == "friction"


def test_effects_as_text(run):
    assert run("effects").stdout.count("\n") == len(catalogue()) + 1
    text = run("effects", "coulomb_friction").stdout
    assert "F_c 2/π arctan(q̇ / v_0)" in text
    assert "positive only" in run("effects", "stribeck_friction").stdout


def test_formulas_read_without_latex():
    left = [e.id for e in catalogue() if set("\\{}") & set(readable(e.formula))]
    assert left == []
    assert readable(r"\frac{a + b}{V_\mathrm{max} c}") == "(a + b)/(V_max c)"


def test_reduce(run, campaign, tmp_path):
    found = json.loads(run("reduce", campaign, "--json").stdout)
    assert found["units"] == {"force": "N", "displacement": "m"}
    slow = found["runs"][0]
    assert slow["periods"] == 4
    assert slow["frequency"] == pytest.approx(1.0, abs=5 * slow["frequency_sd"])
    assert slow["channels"]["displacement"]["harmonics"] == 1
    # 400 samples: the standard error of a standard deviation is 3.5 %.
    assert slow["channels"]["force"]["noise"] == pytest.approx(0.02, rel=0.15)
    text = run("reduce", campaign).stdout
    assert "hold-out" in text
    assert re.search(r"run +force \[mN\] +displacement \[µm\]", text)
    assert re.search(r"slow +\d\S* \(1\) +\d\S* \(1\)", text)
    file = tmp_path / "records.nc"
    assert run("reduce", campaign, "--out", file).exit_code == 0
    tree = read_tree(file)
    assert tree.attrs[schema.CAMPAIGN] == "mass on a spring"
    assert list(tree[schema.NOISE].to_dataset().data_vars) == ["force", "displacement"]


def test_tables_of_records_fit_a_terminal(run, campaign, tmp_path, monkeypatch):
    """Three channels and times of many digits, in eighty columns: no word broken, no digit lost."""
    toml = campaign / "campaign.toml"
    text = toml.read_text(encoding="utf-8")
    more = '[channels.pressure]\ncolumn = "p_Pa"\nunit = "Pa"\n\n[channels.force]'
    toml.write_text(text.replace("[channels.force]", more), encoding="utf-8")
    for file in campaign.glob("*.csv"):
        header, *rows = file.read_text(encoding="utf-8").splitlines()
        force = header.split(",").index("f_N")
        wider = [f"{header},p_Pa", *(f"{row},{row.split(',')[force]}" for row in rows)]
        file.write_text("\n".join(wider), encoding="utf-8")
    narrow = Console(width=80, highlight=False, soft_wrap=False)
    monkeypatch.setattr(shell, "console", lambda: narrow)
    text = run("reduce", campaign, "--quiet").stdout
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in text
    assert "frequency [Hz]" in lines[0]
    assert "pressure [mPa]" in text


def test_what_a_narrow_terminal_cannot_hold_in_a_line_is_folded():
    console = Console(width=20, file=io.StringIO())
    console.print(tables.table(["run", "value"], [["abcdefghijklmnopqrstuvwxyz", 1.234e-5]]))
    letters = re.findall(r"^[a-z]+", console.file.getvalue(), re.MULTILINE)
    assert "".join(letters[1:]) == "abcdefghijklmnopqrstuvwxyz"


def test_check_touches_nothing(run, campaign, model, tmp_path):
    before = sorted(tmp_path.rglob("*"))
    result = run("check", campaign, "--model", f"{model}:model", "--json")
    assert result.exit_code == 0, result.output
    plan = json.loads(result.stdout)
    assert (plan["fit"], plan["hold_out"]) == (["slow"], ["fast"])
    assert plan["unknowns"] == ["damping", "stiffness"]
    text = run("check", campaign, "--model", model).stdout
    assert "damping, stiffness" in text
    less = run("check", campaign, "--model", model, "--without", "play, preload", "--json")
    assert json.loads(less.stdout)["effects"] == plan["effects"] - 2
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_report_from_a_result(run, made_up, tmp_path):
    path = tmp_path / "results" / "results.nc"
    write_tree(made_up.two_run_tree(), path)
    result = run("report", path)
    assert result.exit_code == 0, result.output
    page = path.with_name("report.html")
    assert str(page) in result.stdout
    assert "<html" in page.read_text(encoding="utf-8")
    assert run("report", path, "--out", tmp_path / "other.html").exit_code == 0
    assert run("report", path, "--out", tmp_path / "pages" / "v1.2").exit_code == 0
    assert (tmp_path / "pages" / "v1.2" / "report.html").is_file()
    assert (tmp_path / "other.html").exists()


def test_close_hands_over_what_was_asked(run, campaign, model, made_up, monkeypatch):
    asked = {}

    def close(path, declared, settings, *, out, callback, progress):
        asked.update(path=path, name=declared.name, settings=settings, out=out, progress=progress)
        callback("working")
        return made_up.oleo_tree()

    monkeypatch.setattr(workflow, "close", close)
    result = run(
        *("close", campaign, "-m", model, "--seed", 3, "--jobs", 1, "--quick"),
        *("--drive", "displacement", "--steps", 64, "--max-effects", 1),
        *("--without", "humming_force,nonparametric"),
    )
    assert result.exit_code == 0, result.output
    assert asked["path"] == campaign
    assert asked["name"] == "linear oscillator"
    assert str(asked["out"]) == "bayesoleo-mass-on-a-spring"
    settings = asked["settings"]
    assert (settings.seed, settings.jobs, settings.quick, settings.steps) == (3, 1, True, 64)
    assert (settings.drive, settings.max_effects, settings.effective_size) == (
        "displacement",
        1,
        1000,
    )
    assert settings.without == ("humming_force", "nonparametric")
    assert not settings.nonparametric
    assert "Stribeck friction" in result.stdout
    assert "working" in result.stderr


def test_trace_shows_the_ranking(run, campaign, model, made_up, monkeypatch):
    monkeypatch.setattr(workflow, "trace", lambda *_, **__: made_up.oleo_tree())
    result = run("trace", campaign, "-m", model, "--quiet")
    assert result.exit_code == 0, result.output
    assert "not distinguishable from" in result.stdout
    assert "Stribeck" in result.stdout


def test_sample_shows_the_posterior(run, campaign, model, made_up, monkeypatch):
    monkeypatch.setattr(workflow, "sample", lambda *_, **__: made_up.oleo_tree())
    result = run("sample", campaign, "-m", model, "--quiet")
    assert result.exit_code == 0, result.output
    assert "97.5 %" in result.stdout
    assert "piston_area" in result.stdout


def test_estimate_shows_the_point(run, campaign, model, tmp_path):
    out = tmp_path / "point"
    result = run("estimate", campaign, "-m", model, "--json", "--quiet", "--out", out)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["status"]["status"] == "converged"
    stiffness = found["parameters"]["stiffness"]
    assert stiffness["unit"] == "N/m"
    # Against its own linearised error: four standard deviations.
    assert stiffness["estimate"] == pytest.approx(2e3, abs=4 * stiffness["sd"])
    assert (out / "results.nc").exists()
    text = run("estimate", campaign, "-m", model, "--quiet").stdout
    assert "mbe" in text
    assert "times the noise of a sample" in " ".join(text.split())
    assert "stiffness" in text


def test_simulate_hands_over_what_was_asked(run, campaign, made_up, monkeypatch, tmp_path):
    asked = []

    def simulate(source, like, settings, **more):
        asked.append((source, like, settings, more))
        return more["out"]

    monkeypatch.setattr(workflow, "simulate", simulate, raising=False)
    out, tail = tmp_path / "new", ("--like", campaign, "--out", tmp_path / "new")
    result = run("simulate", "duffing", *tail, "--set", "mass=2", "--noise", "force=0.5")
    assert result.exit_code == 0, result.output
    assert str(out) in result.stdout
    path = tmp_path / "results.nc"
    write_tree(made_up.two_run_tree(), path)
    assert run("simulate", path, *tail, "--draws", 3, "--seed", 8).exit_code == 0
    (model, like, _, first), (tree, _, settings, second) = asked
    assert (model.name, like) == ("duffing", campaign)
    values = {"out": out, "values": {"mass": 2.0}, "draws": None, "noise": {"force": 0.5}}
    assert first == values
    assert tree.attrs[schema.CAMPAIGN]
    assert settings.seed == 8
    assert second == {"out": out, "values": None, "draws": 3}


@pytest.mark.slow
def test_whole_loop_on_a_small_campaign(run, campaign, model, tmp_path):
    out = tmp_path / "results"
    arguments = ("close", campaign, "--model", model, "--out", out, "--quick", "--seed", 1)
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    for name in ("report.html", "results.nc", "summary.json"):
        assert str(out / name) in result.stdout
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    schema.validate_summary(summary)
    assert summary["verdict"] == schema.NOTHING_MISSING
    low, high = summary["parameters"]["stiffness"]["interval"]
    assert low < 2e3 < high
    assert run("report", out / "results.nc", "--out", tmp_path / "again.html").exit_code == 0
    # Asked for again with bad input, it stays as it is.
    before = {path: path.read_bytes() for path in out.iterdir() if path.is_file()}
    (campaign / "slow.csv").write_text("")
    assert run(*arguments).exit_code == 2
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("name", SCHEMES)
def test_schemes_in_the_help_exist(name):
    assert scheme(name, (2,)) is not None


@pytest.mark.parametrize(("given", "expected"), [([], "ensemble"), (["--sampler", "nuts"], "nuts")])
def test_the_sampler_is_passed_on(run, campaign, model, made_up, monkeypatch, given, expected):
    pytest.importorskip("nutpie")
    seen = []

    def noted(_, __, settings, **more):
        seen.append(settings.sampler)
        return made_up.oleo_tree()

    monkeypatch.setattr(workflow, "sample", noted)
    result = run("sample", campaign, "-m", model, "--quiet", *given)
    assert result.exit_code == 0, result.output
    assert seen == [expected]


def test_an_unknown_sampler_names_the_known(run, campaign, model):
    result = run("sample", campaign, "-m", model, "--sampler", "hmc")
    assert result.exit_code == 2
    assert "--sampler" in result.output
    assert "ensemble, nuts" in result.output
