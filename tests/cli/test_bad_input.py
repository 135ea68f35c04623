"""What cannot be used gets one line, exit status 2, no traceback, and nothing is written."""

from __future__ import annotations

import errno
import os

import numpy as np
import pytest
import xarray as xr
from small_rig import CAMPAIGN, MODEL, rows, write_rows

from bayesoleo import _schema as schema
from bayesoleo._cli.options import settings
from bayesoleo._storage.files import only_writer
from bayesoleo._storage.result_files import read_tree, write_tree
from bayesoleo._workflow import Settings
from bayesoleo.discovery import StructurePrior
from bayesoleo.errors import InputError


def change(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def bad_rows(column, row, value):
    values = rows(1.0)
    values[row, column] = value
    return values


BAD_FILES = {
    "NaN": (bad_rows(1, 30, np.nan), "file slow.csv, run slow, column f_N: 1 missing value"),
    "gap": (
        np.delete(rows(1.0), 30, axis=0),
        "column time_s: gap of 1 missing sample after 0.29",
    ),
    "time back": (bad_rows(0, 30, 0.1), "run slow, column time_s: time does not increase"),
    "constant": (bad_rows(1, slice(None), 3.0), "run slow, column f_N: channel is constant (got 3"),
    "huge": (rows(1.0) * [1, 1e160, 1], "column f_N: size of the samples is out of range (got"),
    "tiny": (rows(1.0) * [1, 1e-160, 1], "column f_N: swing of the samples is out of range (got"),
    "short": (rows(1.0)[:150], "run slow, key frequency: fewer than two periods"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_records(refused, campaign, model, name):
    values, message = BAD_FILES[name]
    write_rows(campaign / "slow.csv", values)
    assert message in refused("close", campaign, "--model", model)


def test_an_unknown_aim_is_refused_before_anything_is_estimated(
    refused, campaign, model, monkeypatch
):
    def estimated(*_):
        raise AssertionError

    monkeypatch.setattr("bayesoleo._workflow.closing.run_loop", estimated)
    told = refused("propose", campaign, "--model", model, "--next-run", "stifness")
    assert "unknown aim" in told
    assert "structures, parameters" in told


BAD_TOML = {
    "no such file": ('file = "slow.csv"', 'file = "slwo.csv"', "slwo.csv, run slow: no such file"),
    "no such column": ('"f_N"', '"F_N"', "column F_N: no such column; did you mean f_N"),
    "unknown unit": ('unit = "mm"', 'unit = "furlog"', "key channels.displacement.unit: unknown"),
    "other unit": ('unit = "N"', 'unit = "lb"', "channels.force.unit: unit does not measure force"),
    "same label": ('label = "fast"', 'label = "slow"', "run slow, key label: "),
    "wrong frequency": ("frequency = 1.0", "frequency = 1.37", "run slow, key frequency: "),
    "no fit run": ('role = "fit"', 'role = "hold-out"', "fit"),
    "channel missing": ("channels.displacement]", "channels.stroke]", "displacement"),
}


@pytest.mark.parametrize("name", BAD_TOML)
def test_bad_declarations(refused, campaign, model, name):
    old, new, message = BAD_TOML[name]
    change(campaign / "campaign.toml", old, new)
    assert message in refused("close", campaign, "--model", model)


def test_empty_file(refused, campaign, model):
    (campaign / "slow.csv").write_text("")
    assert "file slow.csv, run slow: " in refused("check", campaign, "--model", model)


def test_no_campaign_there(refused, model, tmp_path):
    line = refused("close", tmp_path / "nowhere", "--model", model)
    assert "nowhere" in line
    assert "campaign.toml" in line


BAD_MODELS = {
    "unknown name": (MODEL.replace("- force", "- farce"), "farce"),
    "no prior": (MODEL.replace(", relative_sd=0.5", ""), "stiffness"),
    "bounds exclude the start": (
        MODEL.replace("relative_sd=0.5", "bounds=(0.0, 10.0)"),
        "line 11: the bounds exclude the start (got 2000.0); choose a value between 0 and 10",
    ),
    "start without a logarithm": (
        "from bayesoleo.model import LogNormal\n"
        + MODEL.replace("2e3", "0.0").replace("relative_sd=0.5", "prior=LogNormal(2e3, 0.5)"),
        "parameter 'stiffness' starts where its prior has no density (got 0.0); start above 0",
    ),
    "unknown keyword": (
        MODEL.replace("relative_sd=0.5", "rel_sd=0.5"),
        "did you mean relative_sd?",
    ),
    "error in the file": (MODEL + "\nx = 1 / 0\n", "line 19: ZeroDivisionError: division by zero"),
    "not Python": ("model = (\n", "line 1: SyntaxError: '(' was never closed"),
    "leaves": ("import sys\nsys.exit(0)\n", "line 2: SystemExit: 0"),
    "no object": (MODEL.replace("model =", "spring ="), "write {path}:spring"),
    "not a model": ("model = 3\n", "model is not a Model but int; the file holds no Model"),
    "input missing": (MODEL.replace('"force"', '"load"').replace("- force", "- load"), "load"),
}


@pytest.mark.slow
@pytest.mark.parametrize("command", ["check", "close", "estimate", "sample", "trace"])
@pytest.mark.parametrize("name", BAD_MODELS)
def test_bad_models(refused, campaign, model, name, command):
    text, message = BAD_MODELS[name]
    model.write_text(text)
    assert message.format(path=model) in refused(command, campaign, "--model", model)


def test_names_of_models(refused, campaign, model, tmp_path):
    line = refused("close", campaign, "--model", "f16n2d")
    assert "unknown system (got 'f16n2d'); did you mean f16n2d2 or" in line
    assert "there is no such file" in refused("check", campaign, "--model", tmp_path / "no.py")
    line = refused("check", campaign, "--model", f"{model}:sprung")
    assert f"no such object (got 'sprung'); write {model}:model" in line
    assert "a model file ends in .py" in refused("check", campaign, "--model", campaign)


def test_unknown_options_of_the_model(refused, campaign, model):
    line = refused("close", campaign, "--model", model, "--drive", "stroke")
    assert "cannot be driven by 'stroke'; drive it by one of: force, displacement" in line
    line = refused("close", campaign, "--model", model, "--scheme", "radau4")
    assert "key --scheme: unknown scheme (got 'radau4'); did you mean radau3?" in line
    for command in ("close", "trace", "propose", "check"):
        line = refused(command, campaign, "--model", model, "--without", "play,viscous_dampng")
        assert "key --without: unknown effect (got 'viscous_dampng'); did you mean viscous" in line


def test_unknown_effect(refused):
    assert "did you mean coulomb_friction" in refused("effects", "coulomb_frictoin")


@pytest.mark.parametrize("command", ["close", "sample", "estimate", "trace"])
def test_output_folder_is_tried_before_any_work(
    refused, campaign, model, tmp_path, command, monkeypatch
):
    monkeypatch.setattr(
        "bayesoleo._workflow.model_files.load_model", lambda _: pytest.fail("work was begun")
    )
    taken = tmp_path / "taken"
    taken.write_text("a file")
    line = refused(command, campaign, "--model", model, "--out", taken / "results")
    assert f"file {taken}: is not a folder; nothing can be written there" in line

    def denied(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryDirectory", denied)
    line = refused(command, campaign, "--model", model, "--out", tmp_path / "new" / "results")
    assert "results: cannot be written to: Permission denied; choose a folder" in line


def test_damaged_results(refused, tmp_path, made_up, campaign):
    path = tmp_path / "results.nc"
    assert "there is no such file" in refused("report", path)
    assert "is a folder" in refused("report", tmp_path)
    path.write_bytes(b"")
    assert "is empty" in refused("report", path)
    write_tree(made_up.two_run_tree(), path)
    path.write_bytes(path.read_bytes()[:2000])
    assert f"file {path}: cannot be read; it is damaged" in refused("report", path)
    out = tmp_path / "simulated"
    assert "is damaged" in refused("simulate", path, "--like", campaign, "--out", out)


def test_a_changed_byte_of_a_result_is_found(refused, tmp_path, made_up):
    path = tmp_path / "results.nc"
    write_tree(made_up.two_run_tree(), path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    for command in ("report", "assess"):
        assert f"file {path}: was changed since it was written" in refused(command, path)


@pytest.mark.parametrize("command", ["estimate", "sample", "trace", "close", "simulate"])
def test_a_folder_to_which_another_process_writes_is_refused(
    refused, campaign, model, tmp_path, command
):
    with only_writer(tmp_path / "out"):
        what = [model, "--like", campaign] if command == "simulate" else [campaign, "-m", model]
        line = refused(command, *what, "--out", tmp_path / "out")
    assert (
        f"file {tmp_path / 'out'}: another process is writing here (process {os.getpid()}" in line
    )


LIMITS = {
    "memory": (MemoryError("Unable to allocate 9 GiB"), "not enough memory: unable to allocate 9"),
    "library": (
        ImportError("a.so: failed to map segment from shared object"),
        "not enough memory: a library cannot be loaded",
    ),
    "disk": (OSError(errno.ENOSPC, "No space left on device", "a"), "file a: No space left on"),
}


@pytest.mark.parametrize("name", LIMITS)
def test_a_machine_at_its_limit_is_told_in_one_line(refused, campaign, model, monkeypatch, name):
    error, message = LIMITS[name]

    def at_the_limit(*_, **__):
        raise error

    monkeypatch.setattr("bayesoleo._workflow.estimating.fit_model", at_the_limit)
    assert message in refused("estimate", campaign, "--model", model)


BAD_SIMULATIONS = {
    "set": (["--set", "mass"], "key --set: is not name=value (got 'mass'); write name=number"),
    "number": (["--set", "mass=heavy"], "is not name=value (got 'mass=heavy')"),
    "twice": (["--noise", "force=1", "--noise", "force=2"], "key --noise force: is given twice"),
    "negative": (["--noise", "force=-1"], "noise is negative (got -1.0)"),
    "draws": (["--draws", "3"], "a model has no posterior to draw from (got 3)"),
}


@pytest.mark.parametrize("name", BAD_SIMULATIONS)
def test_bad_simulations(refused, campaign, tmp_path, name):
    arguments, message = BAD_SIMULATIONS[name]
    out = tmp_path / "simulated"
    line = refused("simulate", "duffing", "--like", campaign, "--out", out, *arguments)
    assert message in line


@pytest.mark.parametrize("command", ["estimate", "sample", "trace", "close"])
def test_results_of_another_campaign_are_spared(refused, campaign, model, tmp_path, command):
    out = tmp_path / "mine"
    out.mkdir()
    write_tree(xr.DataTree(xr.Dataset(attrs={schema.CAMPAIGN: "shaker"})), out / "results.nc")
    line = refused(command, campaign, "--model", model, "--out", out)
    assert f"file {out / 'results.nc'}, key campaign: holds results of another campaign" in line
    assert "(got 'shaker'); choose another folder with --out" in line


def test_results_of_the_same_campaign_give_way(run, campaign, model, tmp_path):
    out = tmp_path / "mine"
    out.mkdir()
    own = xr.Dataset(attrs={schema.CAMPAIGN: "mass on a spring"})
    write_tree(xr.DataTree(own), out / "results.nc")
    result = run("estimate", campaign, "--model", model, "--out", out, "--quiet", "--jobs", 1)
    assert result.exit_code == 0, result.output
    assert schema.POINT in read_tree(out / "results.nc").children


def test_simulation_spares_what_is_there(refused, campaign):
    line = refused("simulate", "duffing", "--like", campaign, "--out", campaign)
    assert "folder is not empty; choose another with --out" in line


def test_demo_spares_a_campaign_that_is_not_its_own(refused, campaign, tmp_path, monkeypatch):
    def demo_campaign(folder, seed):
        folder.mkdir()
        (folder / "campaign.toml").write_text(CAMPAIGN.replace("mass on a spring", "demo"))
        return folder

    import sys
    from types import ModuleType

    module = ModuleType("bayesoleo._workflow.simulating")
    module.demo_campaign = demo_campaign
    monkeypatch.setitem(sys.modules, "bayesoleo._workflow.simulating", module)
    out = tmp_path / "mine"
    out.mkdir()
    campaign.rename(out / "campaign")
    line = refused("demo", "--quiet", "--out", out)
    assert "holds other data than an older demo; choose another folder with --out" in line


@pytest.mark.parametrize(
    "arguments", [["clos"], ["close"], ["close", "x", "--seed", "-1"], ["check", "--nonsense"]]
)
def test_usage_errors_exit_with_two(run, arguments):
    result = run(*arguments)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("nothing=x", "no number (got 'nothing=x'); write nothing=0.45,"),
        ("noth=0.5", "no part of this prior (got 'noth=0.5'); use nothing, catalogue, outside"),
        ("nothing=0.9,outside=0.2", "leaves no probability for the other parts"),
        ("outside=0", "structure-prior.outside: must be a finite number above zero (got 0.0)"),
        ("outside=nan", "leaves no probability for the other parts"),
    ],
)
def test_a_prior_of_structures_that_cannot_be(refused, campaign, model, given, message):
    text = refused("close", campaign, "--model", model, "--structure-prior", given)
    assert "key --structure-prior" in text
    assert message in text


def test_parts_of_the_prior_that_are_left_out_share_the_rest():
    prior = settings(structure_prior="nothing=0.8").structure_prior
    assert (prior.nothing, prior.catalogue, prior.outside) == pytest.approx(
        (0.8, 0.2 * 7 / 11, 0.2 * 4 / 11)
    )
    assert settings(structure_prior=None).structure_prior == StructurePrior()


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (0.5, r"key structure_prior: no prior of structures \(got 0.5\); write .*StructurePrior"),
        (StructurePrior(nothing=-1.0), r"structure_prior.nothing: must be a finite number"),
        (StructurePrior(numbers=(0.5, 0.0)), r"structure_prior.numbers\[1\]: must be a finite"),
        (StructurePrior(numbers=()), r"structure_prior.numbers: is empty"),
        (StructurePrior(families={"frction": 2.0}), r"unknown family .*did you mean friction\?"),
        (
            StructurePrior(effects={"colomb_friction": 2.0}),
            r"unknown effect .*mean coulomb_friction",
        ),
    ],
)
def test_priors_in_python_are_checked_where_they_are_given(prior, message):
    with pytest.raises(InputError, match=message):
        Settings(structure_prior=prior)
