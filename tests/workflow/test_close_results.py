"""The verbs on a small campaign: what they give back, write, and leave alone."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from small_campaigns import DAMPER_RUNS, FRICTION, damper, damper_campaign

from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._report.page import render_report
from bayesoleo._report.page_figures import draw_ahead, parts_ahead, parts_of_draws, shared_by
from bayesoleo._storage.result_files import read_tree
from bayesoleo._worker_processes import Beside
from bayesoleo._workflow import closing, structures_beside
from bayesoleo._workflow.predicting import predict
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.structures_beside import DrawnAhead, pictures_meanwhile
from bayesoleo.assessment import assess
from bayesoleo.effects import find_effect
from bayesoleo.errors import BayesoleoError, InputError
from bayesoleo.plots import _posterior
from bayesoleo.systems import system

EFFECTS = tuple(
    map(find_effect, ("coulomb_friction", "quintic_stiffness", "mass_error", "constant_force"))
)
SETTINGS = Settings(quick=True, jobs=1, effects=EFFECTS, seed=5, command="as typed")
MODEL = damper(offsets=True)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("campaign")
    damper_campaign(folder, offsets={"a": 2.0, "d": -3.0})
    return folder


@pytest.fixture(scope="module")
def closed(campaign, tmp_path_factory) -> tuple[xr.DataTree, Path]:
    out = tmp_path_factory.mktemp("results") / "out"
    return workflow.close(campaign, MODEL, SETTINGS, out=out), out


def contents(folder: Path) -> dict[str, str]:
    """Every file below a folder with its hash."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def posterior(tree: xr.DataTree) -> xr.Dataset:
    return tree[schema.POSTERIOR].to_dataset()


def test_close_writes_result_report_and_summary(closed):
    _, out = closed
    assert {"results.nc", "report.html", "summary.json"} <= {item.name for item in out.iterdir()}
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    schema.validate_summary(summary)
    assert summary["effects"] == ["coulomb_friction"]
    assert summary["verdict"] == schema.EFFECT_ADDED
    assert summary["seed"] == 5
    assert all((out / name).exists() for name in summary["files"].values())
    report = (out / "report.html").read_text(encoding="utf-8")
    assert "coulomb_friction" in report or "Coulomb" in report
    assert "<script src=" not in report


def test_why_an_error_model_was_chosen_is_kept_and_reported(closed):
    tree, folder = closed
    attributes = tree[schema.POSTERIOR].attrs
    word, why = attributes["error_model"], attributes[schema.ERROR_MODEL_REASON]
    assert why.startswith(f"{word} errors")
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert f"<p>{why[0].upper()}{why[1:]}.</p>" in page


def test_the_truth_lies_in_the_posteriors_interval(closed):
    summary = json.loads(closed[0].attrs[schema.SUMMARY])
    for name, true in {"damping": 200.0, "stiffness": 1000.0, "cubic": 2e6}.items():
        entry = summary["parameters"][name]
        assert abs(entry["mean"] - true) < 5 * entry["sd"]
        assert entry["interval"][0] < entry["mean"] < entry["interval"][1]
        # A linear model with tiny noise: the posterior is the Laplace approximation.
        assert entry["estimate"] == pytest.approx(entry["mean"], abs=entry["sd"])
    assert summary["parameters"]["coulomb_friction"]["mean"] == pytest.approx(FRICTION, rel=0.05)


#: What a closed loop fills; the others come of a study of the estimate, and that of the errors
#: where an error model remembers, of effects that the data cannot tell apart, or of one without a
#: name.
CLOSED = set(schema.GROUPS) - {
    schema.SAMPLING_DISTRIBUTION,
    schema.INDIFFERENCE,
    schema.ASSESSMENT,
    schema.PROFILE,
    schema.SENSITIVITY,
    schema.ERROR_MODEL,
    schema.PROPOSAL,
    schema.NONPARAMETRIC,
    schema.FREQUENCY_RESPONSE,
}


def test_the_file_reads_back_as_the_tree(closed):
    tree, out = closed
    back = read_tree(out / "results.nc")
    assert set(back.children) == set(tree.children) == CLOSED
    for group in CLOSED:
        xr.testing.assert_equal(back[group].to_dataset(), tree[group].to_dataset())
    assert back.attrs[schema.SUMMARY] == (out / "summary.json").read_text(encoding="utf-8")
    assert back.attrs[schema.FORMAT_ATTRIBUTE] == schema.FORMAT
    assert back.attrs[schema.COMMAND] == "as typed"
    assert back.attrs[schema.SEED] == 5


def test_names_dims_and_units_are_those_of_the_schema(closed):
    tree, _ = closed
    observed, residual = tree[schema.RECORDS], tree[schema.RESIDUAL]
    assert observed["force"].dims == (schema.RUN, schema.SAMPLE)
    assert observed["force"].attrs["units"] == "N"
    assert observed["displacement"].attrs["units"] == "m"
    for stage in (schema.before("force"), schema.after("force")):
        assert tree[schema.PREDICTION][stage].dims == (schema.RUN, schema.SAMPLE)
        assert residual[stage].attrs["units"] == "N"
        assert residual[schema.mean(stage)].dims == (schema.RUN, schema.PHASE)
    assert residual[schema.noise("force")].dims == (schema.RUN,)
    assert residual[schema.VELOCITY].attrs["units"] == "m/s"
    draws = posterior(tree)
    assert draws["damping"].attrs["units"] == "N*s/m"
    assert draws[schema.by_run("offset", "a")].attrs["units"] == "N"
    assert draws[schema.log_variance("force")].attrs["units"] == "ln((N)^2)"
    for group in CLOSED:
        for name, item in tree[group].data_vars.items():
            if np.issubdtype(item.dtype, np.floating):
                assert schema.UNITS in item.attrs, f"{group}/{name}"


def test_residuals_are_measured_less_predicted(closed):
    tree, _ = closed
    measured = tree[schema.RECORDS]["force"]
    for stage in (schema.before("force"), schema.after("force")):
        predicted, residual = tree[schema.PREDICTION][stage], tree[schema.RESIDUAL][stage]
        there = measured.sel(run=predicted.run)
        assert np.allclose(there - predicted, residual, equal_nan=True, atol=1e-9)


def test_discovery_holds_every_round_and_candidate(closed):
    tree, _ = closed
    found, summary = tree[schema.DISCOVERY], json.loads(tree.attrs[schema.SUMMARY])
    assert found.sizes[schema.ROUND] == len(summary["rounds"])
    assert list(found[schema.ACCEPTED].values) == ["coulomb_friction", ""]
    key = "coulomb_friction at force"
    assert found[schema.GAIN].sel(effect=key).values[0] > 0.9
    for k, entry in enumerate(summary["rounds"]):
        for run, error in entry["error"]["force"].items():
            there = found.to_dataset().isel(round=k).sel(output="force", run=run)
            assert float(there[schema.RMS]) == pytest.approx(error["rms"])
            assert float(there[schema.RATIO_TO_NOISE]) == pytest.approx(error["ratio_to_noise"])


def test_loop_prediction_and_assessment_have_the_same_figures(closed, campaign):
    """One error against one noise and one expectation, whoever is asked."""
    tree, out = closed
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    told = summary["rounds"][-1]["error"]["force"]
    assessed = assess(tree)
    foreseen = predict(tree, workflow.task.reduce(campaign), draws=40, jobs=1)
    for run, error in told.items():
        for key in ("ratio_to_noise", "ratio_to_expected"):
            for table in (assessed, foreseen):
                found = float(table[key].sel(output="force", run=run))
                assert found == pytest.approx(error[key]), (key, run)
        assert float(foreseen["expected_error"].sel(output="force", run=run)) == pytest.approx(
            error["expected"]
        )


def test_what_is_expected_of_a_run_that_the_result_does_not_hold_is_near_what_the_loop_says(
    closed, campaign
):
    """The same run with other samples: by draws, where the loop has sensitivities. Its offset is
    drawn from the prior there and estimated on the run here, so that more is expected."""
    tree, _ = closed
    reduced = workflow.task.reduce(campaign)
    record = reduced.record("e")
    other = replace(record, samples={k: v.copy() for k, v in record.samples.items()})
    other.samples["force"][0] += 1e-6
    changed = replace(reduced, records=(other,))
    same, found = (predict(tree, one, runs=["e"], draws=200, jobs=1) for one in (reduced, changed))
    assert float(found["noise"][0, 0]) == pytest.approx(float(same["noise"][0, 0]), rel=1e-3)
    assert float(found["expected_error"][0, 0]) > 10 * float(same["expected_error"][0, 0])


@pytest.mark.slow
def test_a_second_close_takes_up_the_checkpoints_and_agrees(closed, campaign):
    tree, out = closed
    store = out / "checkpoints"
    before = {path: path.stat().st_mtime_ns for path in store.rglob("*") if path.is_file()}
    assert before
    said: list[str] = []
    again = workflow.close(campaign, MODEL, SETTINGS, out=out, callback=said.append)
    xr.testing.assert_identical(posterior(again), posterior(tree))
    after = {path: path.stat().st_mtime_ns for path in store.rglob("*") if path.is_file()}
    draws = {path for path in before if path.suffix not in (".lock", ".json")}
    assert {path: after[path] for path in draws} == {path: before[path] for path in draws}


def test_results_depend_neither_on_threads_nor_on_the_folder(closed, campaign, monkeypatch):
    """With two jobs structures are compared in another process, with one before the draws."""
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    rightly, begun = structures_beside.begun_beside, []

    def noted(*given):
        begun.append(rightly(*given))
        return begun[-1]

    monkeypatch.setattr(closing, "begun_beside", noted)
    tree, _ = closed
    other = workflow.close(campaign, MODEL, replace(SETTINGS, jobs=2))
    assert len(begun) == 1
    assert begun[0] is not None
    xr.testing.assert_equal(posterior(other), posterior(tree))
    one, two = (json.loads(item.attrs[schema.SUMMARY]) for item in (tree, other))
    for summary in (one, two):
        summary.pop("files")
    assert one == two


def test_figures_drawn_ahead_are_those_of_the_result(closed, campaign, tmp_path, monkeypatch):
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    monkeypatch.setattr(closing, "WORTH_KEEPING", math.inf)  # however slow the machine is
    # Of so few parameters, those of an added effect are shown: a tree has to know them.
    monkeypatch.setattr(_posterior, "CORNER_MOST", 1)
    rightly, drawn = DrawnAhead.pictures, {}

    def whole(ahead):
        ahead.beside._thread.join()  # until it has drawn all
        drawn.update(rightly(ahead))
        return drawn

    def all_here(beside, tree):
        found = pictures_meanwhile(beside, tree)
        drawn.update(found)
        return found

    monkeypatch.setattr(Beside, "answered", False)  # whatever is waited for takes as long
    monkeypatch.setattr(DrawnAhead, "pictures", whole)
    monkeypatch.setattr(closing, "pictures_meanwhile", all_here)
    tree = workflow.close(campaign, MODEL, replace(SETTINGS, jobs=2), out=tmp_path)
    assert set(drawn) == {*parts_ahead(tree), *parts_of_draws(tree)}
    shown = {kind for (kind, _), figures in drawn.items() if figures}
    assert {"residual", "data", "fit", "formulas", "posterior", "predictive", "trace"} <= shown
    shared = shared_by(tree)
    for part, figures in drawn.items():
        assert draw_ahead(shared, part) == (part, figures)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    monkeypatch.setenv("BAYESOLEO_PROCESSES", "0")  # another one would show more parameters
    assert page == render_report(read_tree(tmp_path / "results.nc"))


def test_nothing_is_drawn_meanwhile_once_there_is_an_answer(closed):
    tree, _ = closed

    class Answering:
        """After one figure."""

        asked = 0

        @property
        def answered(self):
            self.asked += 1
            return self.asked > 1

    assert pictures_meanwhile(SimpleNamespace(answered=True), tree) == {}
    drawn = pictures_meanwhile(Answering(), tree)
    assert list(drawn) == parts_of_draws(tree)[:1] == [("trace", 0)]


@pytest.mark.slow
def test_another_seed_draws_other_samples_of_the_same_posterior(closed, campaign):
    tree, _ = closed
    other = workflow.sample(
        campaign, damper(), replace(SETTINGS, seed=6, effects=()), progress=False
    )
    same = workflow.sample(
        campaign, damper(), replace(SETTINGS, seed=5, effects=()), progress=False
    )
    a, b = posterior(other)["damping"], posterior(same)["damping"]
    assert not np.array_equal(a.values[:, :5], b.values[:, :5])
    # Quick draws have an effective size of some hundred: a tenth of a standard deviation.
    assert float(a.mean()) == pytest.approx(float(b.mean()), abs=0.5 * float(a.std()))
    assert schema.DISCOVERY in tree.children


@pytest.mark.slow
def test_estimate_and_sample_give_the_groups_they_promise(campaign, tmp_path):
    records = {schema.RECORDS, schema.CONSTANT_DATA, schema.NOISE}
    point = workflow.estimate(campaign, MODEL, SETTINGS, out=tmp_path / "estimate")
    # Something is missing in this model: the errors that are chosen have quantities of their own.
    assert set(point.children) == records | {schema.POINT, schema.ERROR_MODEL}
    assert set(read_tree(tmp_path / "estimate" / "results.nc").children) == set(point.children)
    plain = replace(SETTINGS, error_model="independent")
    point = workflow.estimate(campaign, MODEL, plain)
    assert set(point.children) == records | {schema.POINT}
    sampled = workflow.sample(campaign, MODEL, plain, out=tmp_path / "sample")
    more = {schema.POSTERIOR, schema.PRIOR, schema.SAMPLE_STATS, schema.LOG_LIKELIHOOD}
    more |= {schema.LOG_PRIOR, schema.PREDICTION, schema.PERIOD_PREDICTIVE, schema.COMPARISON}
    more |= {schema.OBSERVED_DATA, schema.POSTERIOR_PREDICTIVE}
    assert set(sampled.children) == set(point.children) | more
    xr.testing.assert_identical(
        sampled[schema.POINT].to_dataset(), point[schema.POINT].to_dataset()
    )


@pytest.mark.slow
def test_trace_ranks_and_adds_nothing(campaign, tmp_path):
    tree = workflow.trace(campaign, MODEL, SETTINGS, out=tmp_path)
    summary = json.loads(tree.attrs[schema.SUMMARY])
    assert summary["effects"] == []
    assert len(summary["rounds"]) == 1
    assert summary["rounds"][0]["candidates"][0]["effect"] == "coulomb_friction"
    assert summary["rounds"][0]["accepted"] is None
    assert summary["error_before"] == summary["error_after"]
    assert summary["parameters"]["damping"]["mean"] is None
    assert schema.POSTERIOR not in tree.children
    assert set(read_tree(tmp_path / "results.nc").children) == set(tree.children)


def test_what_was_reduced_can_be_given_instead_of_the_folder(campaign):
    reduced = workflow.reduce(campaign)
    assert workflow.reduce(reduced) is reduced
    one, two = (workflow.estimate(source, MODEL, SETTINGS) for source in (campaign, reduced))
    xr.testing.assert_identical(one[schema.POINT].to_dataset(), two[schema.POINT].to_dataset())


def test_check_says_what_would_be_done_and_touches_nothing(campaign, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = contents(campaign)
    found = workflow.check(campaign, MODEL, SETTINGS)
    assert contents(campaign) == before
    assert list(tmp_path.iterdir()) == []
    assert found["fit"] == ["a", "b", "c"]
    assert found["hold_out"] == ["d", "e"]
    assert found["outputs"] == ["force"]
    assert found["inputs"] == ["displacement"]
    assert set(found["unknowns"]) == {
        "damping", "stiffness", "cubic", "offset[a]", "offset[b]", "offset[c]",
    }  # fmt: skip
    assert found["effects"] == len(EFFECTS)


def bad_campaign(folder: Path) -> Path:
    damper_campaign(folder)
    path = folder / "b.csv"
    lines = path.read_text().splitlines()
    lines[7] = lines[7].rsplit(",", 1)[0] + ",nan"
    path.write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("verb", ["close", "trace", "sample", "estimate"])
def test_bad_input_leaves_an_older_result_alone(verb, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("results.nc", "report.html", "summary.json"):
        (out / name).write_text("older")
    before = contents(out)
    run = getattr(workflow, verb)
    with pytest.raises(BayesoleoError, match="b"):
        run(bad_campaign(tmp_path / "nan"), MODEL, SETTINGS, out=out)
    good = tmp_path / "good"
    damper_campaign(good)
    with pytest.raises(InputError, match=r"input_voltage|force"):
        run(good, system("f16n2d2"), replace(SETTINGS, drive="pressure"), out=out)
    assert contents(out) == before


@pytest.fixture(scope="module")
def by_displacement(tmp_path_factory):
    """The rig controls the displacement."""
    return damper_campaign(tmp_path_factory.mktemp("drive")).campaign


def test_drive_the_controlled_channel_drives_if_it_can(by_displacement):
    model = system("linear_oscillator")
    assert workflow.choose_drive(model, by_displacement, None) == "displacement"


def test_drive_the_models_own_inputs_need_no_exchange(by_displacement):
    assert workflow.choose_drive(damper(), by_displacement, None) is None


def test_drive_it_can_be_told(by_displacement):
    model = system("linear_oscillator")
    assert workflow.choose_drive(model, by_displacement, "model") is None
    assert workflow.choose_drive(model, by_displacement, "force") is None
    assert workflow.choose_drive(model, by_displacement, "displacement") == "displacement"


def test_drive_nothing_controlled_leaves_the_model_as_it_is(by_displacement):
    free = replace(by_displacement, controlled=None)
    assert workflow.choose_drive(system("linear_oscillator"), free, None) is None


def test_drive_what_has_no_inverse_is_an_error_only_if_asked_for(by_displacement):
    assert (
        workflow.choose_drive(damper(), replace(by_displacement, controlled="force"), None) is None
    )
    with pytest.raises(BayesoleoError, match="cannot be driven by 'force'"):
        workflow.choose_drive(damper(), by_displacement, "force")


def test_an_oscillator_is_closed_in_the_drive_of_the_rig(tmp_path):
    """Displacement-controlled: the oscillator's force is the answer, and no equation is solved."""
    reduced = damper_campaign(tmp_path, runs=DAMPER_RUNS[:4])
    tree = workflow.trace(
        reduced, system("linear_oscillator"), replace(SETTINGS, effects=EFFECTS[:1])
    )
    assert tree.attrs[schema.DRIVE] == "displacement"
    assert tree[schema.RESIDUAL][schema.before("force")].attrs["units"] == "N"
