"""One call over a campaign: what it says of a right and of a wrong model, and of a result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from small_campaigns import damper, damper_campaign, spring_damper_force, with_friction

from bayesoleo import _schema as schema
from bayesoleo.assessment import assess, score_draws, score_normal, series_of_tree
from bayesoleo.errors import InputError, ResultsError
from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model._priors import Normal
from bayesoleo.prediction._predictor import Predictor


def fitted(folder, force, **options):
    reduced = damper_campaign(folder, force, **options)
    problem = CampaignProblem(Predictor(damper(), reduced.records, backend="numpy", jobs=1))
    return problem, estimate(problem)


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    return fitted(tmp_path_factory.mktemp("right"), spring_damper_force)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory):
    return fitted(tmp_path_factory.mktemp("wrong"), with_friction)


def test_right_model_leaves_noise(right):
    found = assess(*right)
    for key in ("runs_p", "normality_p", "lack_of_fit_p"):
        assert (found[key] > 1e-3).all(), key
    assert (found["share_p"].min() * found["share_p"].size) > 0.01
    np.testing.assert_allclose(found["rms"], 0.5, rtol=0.1)
    np.testing.assert_allclose(found["ratio_to_noise"], 1.0, atol=0.25)
    assert abs(found["intraclass_correlation"]).max() < 0.1
    assert "*" not in "".join(str(found).splitlines()[1:-1])
    head, first = (line.split() for line in str(found).splitlines()[:2])
    assert first[head.index("unit")] == "N"


def test_missing_friction_shows_in_every_test(wrong):
    found = assess(*wrong)
    assert (found["runs_p"] < 1e-6).all()
    assert (found["lack_of_fit_p"] < 1e-12).all()
    assert (found["intraclass_correlation"] > 0.5).all()
    share = found["share"].isel(output=0)
    # friction is a function of velocity, and as such of phase, but not of time
    assert (share.sel(variable="rate of displacement") > 0.8).all()
    assert (share.sel(variable="time") < 0.1).all()
    assert list(found["unit"].values) == ["N"]


def test_correlogram_respects_phase(wrong):
    found = assess(*wrong)
    one = found.data.isel(output=0, run=0)
    lag = {key: one[key].sel(lag=1.0).item() for key in ("correlogram", "noise_correlogram")}
    assert lag["correlogram"] == pytest.approx(float(one["intraclass_correlation"]), abs=0.05)
    assert abs(lag["noise_correlogram"]) < 0.2  # the average over 8 periods takes an eighth away
    assert one["correlogram"].sel(lag=0.0) == 1.0


def test_runs_with_offsets_of_their_own_differ(tmp_path):
    offsets = dict(zip("abcde", (3.0, -3.0, 2.0, -2.0, 0.0), strict=True))
    found = assess(*fitted(tmp_path, spring_damper_force, offsets=offsets))
    assert float(found["share_of_runs"][0]) > 0.5
    assert float(found["share_of_runs_p"][0]) < 1e-6
    assert "means differ from run to run" in str(found)


def test_outlier_is_placed(right):
    problem, point = right
    run = problem.predictor.runs[2]
    record = run.record
    samples = {**record.samples, "force": record.samples["force"].copy()}
    samples["force"][123] += 20.0
    records = [r.record for r in problem.predictor.runs]
    records[2] = replace(record, samples=samples)
    again = CampaignProblem(Predictor(damper(), records, backend="numpy", jobs=1))
    found = assess(again, point).data.sel(output="force", run=record.label)
    assert float(found["outliers"]) == 1
    step = record.time[1] - record.time[0]
    assert float(found["outlier_time"][0]) == pytest.approx(123 * step)


def test_plain_regression_has_an_order_only():
    x = np.linspace(0, 1, 60)
    y = 1 + x**2 + 0.01 * np.random.default_rng(0).normal(size=60)
    problem = FunctionProblem(lambda x, t: t[0] + t[1] * x, x, y, [Normal(0, 10)] * 2)
    found = assess(problem, estimate(problem))
    assert float(found["runs_z"][0, 0]) < -4
    assert np.isnan(found["lack_of_fit"]).all()
    assert found["share"].sel(variable="sample").item() > 0.5
    with pytest.raises(InputError, match="estimate is missing"):
        assess(problem)


def stored(problem, point):
    """The groups of a result that an assessment reads."""
    runs = problem.predictor.runs
    y = [problem.predictor.simulate(problem.full(point.theta[None]), r).y[0, 0]
         for r in range(len(runs))]  # fmt: skip
    longest = max(run.record.time.size for run in runs)

    def padded(rows):
        table = np.full((len(rows), longest), np.nan)
        for line, row in zip(table, rows, strict=True):
            line[: len(row)] = row
        return ((schema.RUN, schema.SAMPLE), table, {schema.UNITS: "N"})

    records = [run.record for run in runs]
    residual = [r.samples["force"] - p for r, p in zip(records, y, strict=True)]
    coords = {schema.RUN: [r.label for r in records]}
    constant = {
        schema.FREQUENCY: [r.frequency for r in records],
        schema.ROLE: [r.role for r in records],
        schema.RUN_GROUP: [r.group for r in records],
    }
    return xr.DataTree.from_dict(
        {
            schema.RESIDUAL: xr.Dataset({"force_before": padded(residual)}, coords=coords),
            schema.RECORDS: xr.Dataset(
                {
                    "force": padded([r.samples["force"] for r in records]),
                    "displacement": padded([r.samples["displacement"] for r in records]),
                    schema.TIME: padded([r.time - r.time[0] for r in records]),
                    schema.PHASE: padded([r.phase for r in records]),
                },
                coords=coords,
            ),
            schema.CONSTANT_DATA: xr.Dataset(
                {key: (schema.RUN, values) for key, values in constant.items()}, coords=coords
            ),
        }
    )


def test_stored_result_is_assessed_alike(wrong):
    direct = assess(*wrong)
    found = assess(stored(*wrong))
    for key in ("rms", "runs_z", "normality", "intraclass_correlation"):
        np.testing.assert_allclose(found[key], direct[key], rtol=1e-9)
    assert "force" not in found["variable"].values  # its noise is the residual's
    assert "predicted force" in found["variable"].values


def test_tree_without_residuals_is_refused(wrong):
    with pytest.raises(ResultsError, match="holds no residuals"):
        assess(xr.DataTree())
    with pytest.raises(ResultsError, match="use 'before' or 'after'"):
        series_of_tree(stored(*wrong), "later")


def test_scores_of_calibrated_and_of_overconfident_predictions():
    rng = np.random.default_rng(1)
    y = rng.normal(2.0, 3.0, 4000)
    good, sure = score_normal(y, 2.0, 3.0), score_normal(y, 2.0, 1.0)
    # minus the entropy of the normal distribution, within three standard errors
    expected = -0.5 * np.log(2 * np.pi * np.e * 9)
    assert good.log_score == pytest.approx(expected, abs=3 * np.sqrt(0.5 / 4000))
    assert good.coverage == pytest.approx(0.95, abs=0.011)
    assert good.distance < 0.031 < sure.distance
    assert sure.log_score < good.log_score
    assert sure.coverage < 0.6


def test_draws_score_as_the_mixture_that_they_are():
    rng = np.random.default_rng(2)
    y = rng.normal(0.0, np.hypot(1.0, 0.5), 500)
    draws = np.repeat(0.5 * rng.standard_normal((4000, 1)), 500, axis=1)
    many, exact = score_draws(y, draws, 1.0), score_normal(y, 0.0, np.hypot(1.0, 0.5))
    assert many.log_score == pytest.approx(exact.log_score, abs=0.01)
    np.testing.assert_allclose(many.pit, exact.pit, atol=0.03)
    with pytest.raises(InputError, match="one row a draw"):
        score_draws(y, draws[:, 1:], 1.0)
    with pytest.raises(InputError, match="must be positive"):
        score_normal(y, 0.0, 0.0)
