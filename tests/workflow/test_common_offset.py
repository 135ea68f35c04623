"""The offset of an output that drifts is given to predictions that ask for it, and said."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats
from small_campaigns import damper, damper_campaign, spring_damper_force
from typer.testing import CliRunner

import bayesoleo as bo
from bayesoleo._cli import app
from bayesoleo._workflow import simulate, simulating
from bayesoleo.errors import InputError
from bayesoleo.estimation._baselines import common_baselines

OFFSET = 3.0
#: Offsets of single runs scatter about that of the sensor; there is one run that does not drift.
BY_RUN = {"a": 0.4, "b": -0.5, "c": 0.2}


def drifting(x, v, t):
    """A sensor with a constant offset, and a slow polynomial about a mean of zero."""
    place = (t - t[0]) / (t[-1] - t[0])
    drift = 4.0 * (place - 0.5) + 3.0 * (place**2 - place + 1 / 6)
    return spring_damper_force(x, v, t) + OFFSET + drift


def still(x, v, t):
    return spring_damper_force(x, v, t) + OFFSET


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("offset")
    damper_campaign(made / "drifting", drifting, offsets=BY_RUN)
    damper_campaign(made / "other", still, runs=(("new", 1.2, 0.011, "fit"),), seed=4)
    damper_campaign(made / "plain", spring_damper_force)
    return made


@pytest.fixture(scope="module")
def fit(folder):
    return bo.Problem(folder / "drifting", damper(), progress=False).fit(progress=False)


@pytest.fixture(scope="module")
def saved(fit, folder):
    return fit.save(folder / "results.nc")


def test_the_offset_is_that_of_the_fitted_runs(fit):
    found = fit.offsets
    assert list(found.index) == ["force"]
    one = found.loc["force"]
    wanted = [OFFSET + BY_RUN[run] for run in "abc"]
    # What drifts was removed about its mean, which is a part of the noise by itself.
    assert one["offset"] == pytest.approx(np.mean(wanted), abs=0.15)
    assert (one["unit"], one["runs"]) == ("N", "a, b, c")
    assert abs(one["offset"] - OFFSET) < 2 * one["sd"]
    (note,) = [n for n in json.loads(fit.tree["point"].attrs["notes"]) if "drifts" in n]
    assert f"an offset of {one['offset']:.3g} ± {one['sd']:.2g} N, from a, b, c" in note


def test_its_deviation_is_that_of_one_more_run():
    """By Student's t, and no more than the priors say."""

    class Problem:
        names = tuple(f"y_baseline_error[{run}]" for run in "pqr")

        class predictor:  # noqa: N801 - stands for an attribute
            class model:  # noqa: N801
                outputs = {"y": type("Output", (), {"unit": "V"})}  # noqa: RUF012
                conditions = {"y_baseline_sd": None}  # noqa: RUF012

            records = tuple(
                type("Record", (), {"label": run, "conditions": {"y_baseline_sd": sd}})
                for run, sd in zip("pqr", (2.0, 2.0, 1.0), strict=True)
            )

    def of(theta, runs, shared=0.0):
        few = {"names": Problem.names[:runs], "predictor": Problem.predictor}
        covariance = 0.01 * np.eye(runs) + shared
        (found,) = common_baselines(type("Few", (), few)(), np.array(theta), covariance)
        return found

    found = of([1.0, 1.1, 2.4], 3)
    means = np.array([2.0, 2.2, 2.4])
    assert found.value == pytest.approx(2.2)
    half = stats.t.isf(0.025, 2) * means.std(ddof=1) * np.sqrt(1 + 1 / 3)
    assert 1.959964 * np.sqrt(found.sd**2 - 0.03 / 3) == pytest.approx(half)
    # Two runs far apart, and one, have the priors.
    assert of([1.0, 9.0], 2).sd == pytest.approx(np.sqrt(1.5 * 4.0 + 0.04 / 2))
    assert of([1.0], 1).sd == pytest.approx(np.sqrt(2 * 4.0 + 0.04))
    # An error that moves all runs alike moves their mean as far: in volts, 2 and 2 times 0.5.
    more = of([1.0, 9.0], 2, shared=0.25).sd ** 2 - of([1.0, 9.0], 2).sd ** 2
    assert more == pytest.approx(1.0)


def test_a_prediction_has_it_where_that_is_asked_for(fit, saved, folder):
    other = bo.load_campaign(folder / "other", progress=False)
    without = fit.predict(other)
    assert float(without.data["bias"].sel(output="force", run="new")) == pytest.approx(3.0, abs=0.1)
    assert "offset" not in without.data
    for stored in (fit, bo.load_result(saved)):
        found = stored.predict(other, common_offset=True)
        one = fit.offsets.loc["force"]
        assert float(found.data["offset"].sel(output="force")) == pytest.approx(one["offset"])
        assert float(found.data["offset_sd"].sel(output="force")) == pytest.approx(one["sd"])
        bias = float(found.data["bias"].sel(output="force", run="new"))
        # 200 draws of an offset leave a part of its deviation.
        assert abs(bias - (OFFSET - one["offset"])) < 0.3 * one["sd"]
        assert float(found.data["coverage"].sel(output="force", run="new")) > 0.9
        assert f"not fitted: force {one['offset']:.3g} ± {one['sd']:.2g} N" in str(found)


def test_a_fitted_run_keeps_its_own_mean(saved, folder):
    raw = bo.load_campaign(folder / "drifting", progress=False)
    result = bo.load_result(saved)
    lacking = result.predict(raw, runs=["b"]).data["bias"].sel(output="force", run="b")
    assert float(lacking) == pytest.approx(OFFSET + BY_RUN["b"], abs=0.15)
    found = result.predict(raw, runs=["b"], common_offset=True)
    assert abs(float(found.data["bias"].sel(output="force", run="b"))) < 0.15


def test_another_run_of_the_same_label_is_refused(saved, folder):
    damper_campaign(folder / "namesake", still, runs=(("b", 1.2, 0.011, "fit"),), seed=4)
    other = bo.load_campaign(folder / "namesake", progress=False)
    with pytest.raises(InputError, match="run b, key common_offset: another run of this label"):
        bo.load_result(saved).predict(other, common_offset=True)
    with pytest.raises(InputError, match="give this run another label"):
        simulate(
            bo.load_result(saved).tree, folder / "namesake", out=folder / "no", common_offset=True
        )


def test_each_new_run_has_an_offset_of_its_own(fit, folder, monkeypatch):
    runs = (("new", 1.2, 0.011, "fit"), ("next", 1.5, 0.011, "fit"))
    damper_campaign(folder / "two", still, runs=runs, seed=4)
    (values,) = simulating.parameter_sets(fit.tree, None, 0)
    monkeypatch.setattr(simulating, "parameter_sets", lambda *_: [values] * 20)
    out = folder / "two drawn"
    simulate(fit.tree, folder / "two", out=out, draws=20, noise={"force": 0}, common_offset=True)
    records = bo.load_campaign(out, progress=False).reduced.records
    means = np.array([record.samples["force"].mean() for record in records])
    kind = np.array(["next" in record.label for record in records])
    assert abs(np.corrcoef(means[kind], means[~kind])[0, 1]) < 0.7


def test_where_there_is_none_that_is_said(folder):
    fit = bo.Problem(folder / "plain", damper(), progress=False).fit(progress=False)
    assert fit.offsets.empty
    with pytest.raises(InputError, match="key common_offset: no common offset is known"):
        fit.predict(common_offset=True)
    with pytest.raises(InputError, match="no common offset is known"):
        simulate(damper(), folder / "plain", out=folder / "nowhere", common_offset=True)


def test_a_model_without_the_offset_is_refused(saved, folder):
    with pytest.raises(InputError, match=r"no offset of force \(got 'damper'\); predict with the"):
        bo.load_result(saved).predict(
            bo.load_campaign(folder / "other", progress=False), model=damper(), common_offset=True
        )


def test_the_command_line_predicts_and_simulates_with_it(fit, saved, folder):
    run = CliRunner().invoke
    one = fit.offsets.loc["force"]
    arguments = ["predict", str(saved), str(folder / "other"), "--common-offset"]
    said = run(app, arguments)
    assert said.exit_code == 0, said.output
    assert f"force {one['offset']:.3g} ± {one['sd']:.2g} N" in said.output
    table = json.loads(run(app, [*arguments, "--json"]).stdout)
    assert table["data_vars"]["offset"]["data"] == [pytest.approx(one["offset"])]
    means = {}
    for name, more in (("without", []), ("with", ["--common-offset"])):
        out = folder / f"simulated {name}"
        like = ["--like", str(folder / "other"), "--out", str(out), "--noise", "force=0"]
        made = run(app, ["simulate", str(saved), *like, *more])
        assert made.exit_code == 0, made.output
        campaign = bo.load_campaign(out, progress=False)
        means[name] = campaign.reduced.record("new").samples["force"].mean()
        said = "Offset and standard deviation added to runs that were not fitted: force"
        assert (said in campaign.description) == (name == "with")
    assert means["with"] - means["without"] == pytest.approx(one["offset"], rel=1e-3)


@pytest.mark.slow
def test_each_draw_of_a_posterior_has_a_draw_of_the_offset(fit, folder, monkeypatch):
    """The estimate in all draws: only the offset differs, by its standard deviation."""
    (values,) = simulating.parameter_sets(fit.tree, None, 0)
    monkeypatch.setattr(simulating, "parameter_sets", lambda *_: [values] * 60)
    like, out = folder / "other", folder / "drawn"
    simulate(fit.tree, like, out=out, draws=60, noise={"force": 0.0}, common_offset=True)
    campaign = bo.load_campaign(out, progress=False).reduced
    means = [record.samples["force"].mean() for record in campaign.records]
    one = fit.offsets.loc["force"]
    # Of 60 draws: three standard errors of a mean, and of a deviation.
    assert np.std(means) == pytest.approx(one["sd"], rel=3 / np.sqrt(2 * 60))
    without = folder / "drawn without"
    simulate(fit.tree, like, out=without, draws=1, noise={"force": 0.0})
    base = bo.load_campaign(without, progress=False).reduced.records[0].samples["force"].mean()
    assert np.mean(means) - base == pytest.approx(one["offset"], abs=3 * one["sd"] / np.sqrt(60))
