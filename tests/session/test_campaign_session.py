"""A session with a campaign: every step shows itself, is pickled and computed once."""

from __future__ import annotations

import io
import json
import pickle
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import arviz
import numpy as np
import pytest

import bayesoleo as bo
from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._session import display as figures
from bayesoleo._session.campaign import Campaign
from bayesoleo.discovery import _state
from bayesoleo.effects import find_effect
from bayesoleo.errors import InputError
from bayesoleo.prediction import RunPlan, motion
from tests.session.shown import check_shown
from tests.small_campaigns import damper

EFFECTS = (find_effect("cubic_stiffness"), find_effect("coulomb_friction"))


@pytest.fixture(scope="module")
def found(fit: bo.Fit) -> bo.Explanation:
    return fit.explain(effects=EFFECTS, max_effects=1)


@pytest.fixture(scope="module")
def plain(campaign: bo.Campaign) -> bo.Fit:
    """With independent errors: those of the catalogue, which would be chosen, draw slowly."""
    settings = {"quick": True, "jobs": 1, "error_model": "independent"}
    return bo.Problem(campaign, damper(cubic=False), **settings).fit()


@pytest.fixture(scope="module")
def posterior(plain: bo.Fit) -> bo.Posterior:
    return plain.sample(seed=3)


def test_the_root_has_few_names() -> None:
    assert sorted({*bo.__all__} - {"__version__"}) == [
        "Campaign", "Explanation", "Fit", "Model", "Output", "Parameter", "Posterior", "Problem",
        "Settings", "close_each", "load_campaign", "load_model", "load_result", "system",
        "write_campaign",
    ]  # fmt: skip


def test_campaign_is_reduced_once_and_shows_its_runs(campaign: bo.Campaign) -> None:
    check_shown(campaign, "5 runs, displacement controlled", "hold-out", "noise of force")
    assert campaign.reduced is campaign.reduced
    assert float(campaign.frequencies.sel(run="b")) == pytest.approx(2.0, rel=1e-4)
    assert list(campaign.noise.data_vars) == ["displacement", "force"]
    assert campaign.runs[0].label == "a"
    assert set(campaign.channels) == {"displacement", "force"}


@pytest.mark.parametrize("kind", [str, Path])
def test_a_problem_reads_a_folder(folder: Path, kind: type, problem: bo.Problem) -> None:
    assert repr(bo.Problem(kind(folder), damper(cubic=False))) == repr(problem)


def test_problem_says_what_would_be_fitted(problem: bo.Problem) -> None:
    check_shown(problem, "model damper, driven by displacement", "held out: d, e", picture=False)
    check = problem.check()
    check_shown(check, "unknowns: damping, stiffness", "correlation", picture=False)
    assert check.facts == workflow.check(problem._work.task.reduced, damper(cubic=False))
    assert isinstance(check.data_warnings, list)


@pytest.mark.slow
def test_fit_is_that_of_the_command_line(problem: bo.Problem, fit: bo.Fit) -> None:
    check_shown(fit, "fit of damper", "damping", "converged")
    assert problem.fit() is fit
    tree = workflow.estimate(problem._work.task.reduced, damper(cubic=False))
    np.testing.assert_array_equal(
        fit.parameters["estimate"], tree[schema.POINT][schema.ESTIMATE].values
    )
    assert fit.parameters.loc["damping", "unit"] == "N*s/m"


@pytest.mark.slow
def test_a_search_begins_with_the_estimate_that_was_made(
    campaign: bo.Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it was, whatever was asked of the fit meanwhile; the result is that of a search alone."""
    settings = bo.Settings(quick=True, jobs=1, effects=EFFECTS, max_effects=0)
    model, fit_model, anew = damper(cubic=False), _state.fit_model, []

    def counted(*given: Any, start: Any = None, **options: Any) -> Any:
        anew.append(start is None)
        return fit_model(*given, start=start, **options)

    monkeypatch.setattr(_state, "fit_model", counted)
    alone = workflow.trace(campaign.reduced, model, settings)
    assert anew.pop(0)  # the declared model; what follows starts at an estimate
    fit = bo.Problem(campaign, model, quick=True, jobs=1).fit()
    fit.profile()
    found = fit.explain(effects=EFFECTS, max_effects=0)
    assert not any(anew)
    own, other = (json.loads(tree.attrs["summary"]) for tree in (found.tree, alone))
    for key in ("rounds", "error_before", "parameters"):
        assert own[key] == other[key]


@pytest.mark.slow
def test_another_method_leads_to_the_same_mode(problem: bo.Problem, fit: bo.Fit) -> None:
    other = problem.fit(method="levenberg-marquardt")
    np.testing.assert_allclose(other.parameters["estimate"], fit.parameters["estimate"], rtol=1e-6)
    assert np.isnan(other.tree[schema.POINT][schema.MBE]).all()


def test_residuals_are_labelled(fit: bo.Fit) -> None:
    left = fit.residuals
    assert left["force"].attrs["units"] == "N"
    assert list(left["run"].values) == ["a", "b", "c"]
    difference = left["force_measured"] - left["force_predicted"] - left["force"]
    assert float(abs(difference).max()) < 1e-9
    assert {"time", "phase"} <= set(left.coords)


def test_each_question_is_one_line(fit: bo.Fit) -> None:
    check_shown(fit.profile(), "linear low")
    check_shown(fit.indifference(), "fall of the posterior")
    check_shown(fit.sampling_distribution(10), "10 of 10 replications")
    check_shown(fit.assess(), "runs z")
    check_shown(fit.predict(), "within 95 %")
    assert fit.profile() is fit.profile(progress=False)
    assert fit.sampling_distribution(10) is not fit.sampling_distribution(11)
    assert {"d", "e"} <= set(fit.predict()["run"].values)
    groups = set(fit.to_datatree().children)
    assert {schema.PROFILE, schema.INDIFFERENCE, schema.SAMPLING_DISTRIBUTION} <= groups


def test_posterior_is_read_by_arviz(plain: bo.Fit, posterior: bo.Posterior) -> None:
    check_shown(posterior, "posterior of damper", "nested R-hat")
    check_shown(posterior.summary(), "effective size")
    check_shown(posterior.compare(plain.indifference()), "sd / indifference")
    assert plain.sample(seed=3) is posterior
    table = arviz.summary(posterior.tree, var_names=["damping"])
    assert float(table["mean"].iloc[0]) == pytest.approx(
        float(posterior.summary()["mean"].sel(parameter="damping")), rel=0.01
    )
    assert posterior.plot(["damping"]).axes


def test_what_is_missing_is_found(found: bo.Explanation) -> None:
    assert found.effects == ("cubic_stiffness",)
    assert found.verdict == "effect added"
    check_shown(found, "cubic stiffness")
    assert len(found.parameters) == 3
    check_shown(found.fit, "fit of damper")
    assert found.fit is found.fit


def test_what_is_missing_has_probabilities(found: bo.Explanation) -> None:
    assert found.certainty == json.loads(found.tree.attrs["summary"])["certainty"]
    known = found.structures
    check_shown(known, "cubic stiffness", "what is missing")
    cubic = [name for name in known["effect"].values if name.startswith("cubic_stiffness")]
    assert float(known["probability"].sel(effect=cubic).sum()) > 0.5
    # Structures exclude each other, and those that were listed hold nearly everything.
    assert 0.95 < float(known["structure_probability"].sum()) <= 1.0 + 1e-9


@pytest.mark.slow
def test_report_and_posterior_of_what_was_found(found: bo.Explanation, tmp_path: Path) -> None:
    posterior = found.sample()
    check_shown(posterior, "posterior of damper")
    page = found.report(tmp_path / "report.html")
    assert "posterior" in page.read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("step", ["fit", "posterior", "found"])
def test_results_are_saved_and_loaded(
    step: str, request: pytest.FixtureRequest, campaign: bo.Campaign, tmp_path: Path
) -> None:
    result = request.getfixturevalue(step)
    loaded = bo.load_result(str(result.save(tmp_path / "results.nc")))
    assert type(loaded) is type(result)
    assert repr(loaded) == repr(result)
    check_shown(loaded)
    assert loaded.predict(campaign, runs=["d"], draws=20)["run"].values == ["d"]
    with pytest.raises(bo.errors.ResultsError, match=r"needs the runs .*bo\.load_campaign"):
        loaded.predict()


def test_a_loaded_fit_says_what_it_cannot_do(fit: bo.Fit, tmp_path: Path) -> None:
    loaded = bo.load_result(fit.save(tmp_path / "fit.nc"))
    assert isinstance(loaded, bo.Fit)
    check_shown(loaded.assess(), "runs z")
    with pytest.raises(bo.errors.ResultsError, match=r"holds numbers only .*fit again"):
        loaded.profile()


def test_a_pickled_fit_goes_on(fit: bo.Fit) -> None:
    other = pickle.loads(pickle.dumps(fit))
    np.testing.assert_array_equal(other.profile()["low"], fit.profile()["low"])
    assert isinstance(pickle.loads(pickle.dumps(fit._work.task.reduced.campaign)), Campaign)


def test_no_bar_is_shown_for_a_quick_step(campaign: bo.Campaign) -> None:
    shown = io.StringIO()
    with redirect_stderr(shown):
        bo.Problem(campaign, damper()).fit(progress=True)
    assert shown.getvalue() == ""


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"drive": "torque"}, "torque"),
        ({"error_modell": "full"}, r"key error_modell: .*'full'.*did you mean error_model\?"),
        ({"output": "force"}, r"key output: a model has its own .*with_parameters"),
    ],
)
def test_what_a_campaign_does_not_take(campaign, wrong, message) -> None:
    with pytest.raises(bo.errors.InputError, match=message):
        bo.Problem(campaign, damper(), **wrong)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"seed": "one"}, r"key seed: is not a whole number \(got 'one'\); write seed=0"),
        ({"seed": -1}, r"key seed: is too small \(got -1\); write seed=0 or more"),
        ({"quick": "yes"}, r"key quick: is not True or False \(got 'yes'\); write quick=True"),
        ({"jobs": 0}, r"key jobs: is too small \(got 0\); write jobs=1 or more"),
        ({"drive": 3}, r"key drive: is not text \(got 3\)"),
        ({"nuisance": "offset"}, r'key nuisance: .*got \'offset\'.*write nuisance=\("offset",\)'),
        ({"between_runs": "mass"}, r'key between_runs: .*write between_runs=\("mass",\)'),
        ({"without": "play"}, r'key without: .*write without=\("play",\)'),
        ({"effects": "play"}, r'key effects: .*write effects=\(.*find_effect\("play"\),\)'),
        ({"effects": ("play",)}, r'key effects: .*write effects=\(.*find_effect\("play"\),\)'),
        ({"effects": find_effect("play")}, r"key effects: .*got 'play'.*find_effect"),
        ({"scheme": "radau4"}, r"key scheme: .*got 'radau4'.*did you mean radau3"),
        ({"error_model": "ful"}, r"key error_model: .*got 'ful'.*did you mean full"),
    ],
)
def test_wrong_settings(setting, message) -> None:
    with pytest.raises(bo.errors.InputError, match=message):
        bo.Settings(**setting)


def test_settings_from_a_notebook() -> None:
    assert bo.Settings(nuisance=["gain"], seed=np.int64(3)).nuisance == ("gain",)


def test_every_output_is_drawn_with_a_legend(fit: bo.Fit) -> None:
    data = fit.residuals
    both = data.merge(data.rename({n: n.replace("force", "other") for n in data.data_vars}))
    figure = figures.fit_and_residual(both)
    legends = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    assert [[t.get_text() for t in one.get_texts()] for one in legends] == 2 * [
        ["measured", "predicted"]
    ]
    assert "times the noise of a sample" in repr(fit)


def test_settings_of_an_earlier_step(fit: bo.Fit) -> None:
    with pytest.raises(bo.errors.InputError, match=r"key scheme: .*bo\.Problem\(…, scheme="):
        fit.sample(scheme="thesis")
    with pytest.raises(bo.errors.InputError, match=r"key candidates: named terms .*effects="):
        fit.explain(candidates={"cubic": lambda x, c: c * x**3})


def test_neither_a_model_nor_a_campaign(campaign: bo.Campaign) -> None:
    with pytest.raises(bo.errors.InputError, match=r"key model: .*\(got 3\).*bo\.system"):
        bo.Problem(campaign, 3)
    with pytest.raises(bo.errors.InputError, match=r"key data: .*'dict'.*bo\.load_campaign"):
        bo.Problem({"x": [1.0]}, damper())


def test_a_simulated_campaign_gives_its_parameters_back(tmp_path: Path) -> None:
    plans = [
        RunPlan(label, frequency, {"displacement": motion(0.0, [0.02])})
        for label, frequency in (("slow", 1.0), ("fast", 3.0))
    ]
    truth, noise = {"damping": 60.0, "stiffness": 1200.0}, {"force": 0.05}
    simulated = bo.Campaign.simulate(
        tmp_path / "c", damper(cubic=False), plans, truth, noise=noise, seed=3
    )
    assert [run.label for run in simulated.runs] == ["slow", "fast"]
    assert simulated.noise["force"].values == pytest.approx(0.05, rel=0.2)
    point = bo.Problem(simulated, damper(cubic=False), jobs=1).fit().tree["point"]
    off = (point["estimate"] - [truth[name] for name in point["parameter"].values]) / point["sd"]
    assert np.abs(off).max() < 4.0  # standard deviations


def test_a_campaign_is_written_into_an_empty_folder_only(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(InputError, match="empty"):
        bo.Campaign.demo(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]
