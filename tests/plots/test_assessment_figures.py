"""Figures of regions, replications, sensitivities and assessments show what the data hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from small_campaigns import damper, damper_campaign, with_friction

from bayesoleo import plots
from bayesoleo.assessment import assess, series_of_problem
from bayesoleo.errors import InputError
from bayesoleo.estimation import (
    FunctionProblem,
    between_runs,
    estimate,
    estimate_each,
    indifference,
    local_sensitivity,
    profile,
    sampling_distribution,
    sobol,
)
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model._priors import Normal
from bayesoleo.prediction._predictor import Predictor


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    reduced = damper_campaign(tmp_path_factory.mktemp("damper"), with_friction, periods=4)
    problem = CampaignProblem(Predictor(damper(), reduced.records[:3], backend="numpy", jobs=1))
    return problem, estimate(problem)


def test_contours_and_ellipses_are_drawn(fitted):
    found = indifference(*fitted, [("damping", "stiffness")], points=12)
    figure = plots.indifference(found)
    (axes,) = figure.axes
    curves = [line.get_xydata() for line in axes.lines]
    np.testing.assert_allclose(curves[1][:-1], found["contour"].values[0, 0])
    np.testing.assert_allclose(curves[2][:-1], found["ellipse"].values[1, 0])
    assert axes.get_xlabel() == "damping"


def test_profile_shows_falls_and_level(fitted):
    found = profile(*fitted, ["cubic"])
    (axes,) = plots.profile(found).axes
    np.testing.assert_allclose(axes.lines[1].get_ydata(), found["fall"].values[0])
    # Linear in its parameters: between the points too the profile is a parabola.
    x, fall = axes.lines[2].get_data()
    half = float(found["linear_high"][0]) - float(found["estimate"][0])
    exact = 1.92073 * ((x - float(found["estimate"][0])) / half) ** 2
    # But for the variance, which is estimated anew at each point.
    np.testing.assert_allclose(fall, exact, rtol=5e-3, atol=1e-4)
    assert axes.lines[3].get_ydata()[0] == pytest.approx(1.92, abs=0.01)


def test_histograms_hold_all_replications(fitted):
    found = sampling_distribution(*fitted, replications=30, input_noise=False)
    figure = plots.sampling_distribution(found)
    assert len(figure.axes) == 3
    bars = figure.axes[0].patches
    assert sum(bar.get_height() * bar.get_width() for bar in bars) == pytest.approx(1.0)


def test_bare_data_draw_the_same_and_other_things_are_refused(fitted):
    found = profile(*fitted, ["cubic"])
    for given in (found.data, xr.DataTree(found.data)):
        np.testing.assert_allclose(
            plots.profile(given).axes[0].lines[1].get_ydata(), found["fall"].values[0]
        )
    for draw in (
        plots.profile, plots.indifference, plots.sampling_distribution, plots.assessment,
        plots.sensitivity, plots.forecast,
    ):  # fmt: skip
        with pytest.raises(InputError, match="needs a result or its Dataset"):
            draw(fitted[1])


def test_table_of_sensitivities_has_its_numbers(fitted):
    problem, point = fitted
    local = local_sensitivity(problem, point.theta)
    texts = [t.get_text() for t in plots.sensitivity(local).axes[0].texts]
    assert texts[0] == f"{float(local['percent'][0, 0]):+.3g} %"
    priors = [Normal(0, 1), Normal(0, 2)]
    shares = sobol(lambda t: t.sum(1, keepdims=True), priors, ["a", "b"], ["y"], samples=256)
    texts = [t.get_text() for t in plots.sensitivity(shares.data).axes[0].texts]
    assert texts[1].startswith(f"{float(shares['total'][0, 1]):.2f} (")


def test_assessment_shows_runs_and_variables(fitted):
    found = assess(*fitted)
    correlogram, ratios, shares = plots.assessment(found).axes
    assert len(correlogram.lines) == 2 * 3 + 1
    np.testing.assert_allclose(ratios.lines[0].get_ydata(), found["ratio_to_noise"][0])
    labels = [label.get_text() for label in shares.get_xticklabels()]
    assert labels == list(found["variable"].values)


def test_tests_of_one_residual_show_their_numbers(fitted):
    series = series_of_problem(*fitted)[0]
    found = assess([series]).data.isel(output=0, run=0)
    figure = plots.residual_tests(series)
    assert len(figure.axes) == 4 + len(series.variables)
    titles = [axes.get_title("left") + axes.get_title("right") for axes in figure.axes]
    assert f"z = {float(found['runs_z']):.1f}" in titles[1]
    assert f"kurtosis {float(found['kurtosis']):.2f}" in titles[2]
    share = found["share"].sel(variable="rate of displacement").item()
    last = plots.residual_tests(series, ["rate of displacement"]).axes[-1]
    assert last.get_title("left") == f"explains {100 * share:.2g} %"
    with pytest.raises(InputError, match="no such variable"):
        plots.residual_tests(series, ["velocity"])


def test_outliers_are_ringed(fitted):
    series = series_of_problem(*fitted)[0]
    residual = series.residual.copy()
    residual[50] += 40.0
    axes = plots.residual_tests(replace(series, residual=residual)).axes[0]
    # the farthest first; the jump of the friction makes some of its own
    assert axes.lines[-1].get_xdata()[0] == 50 * series.time_step


def test_runs_stand_beside_their_mean_and_spread():
    rng = np.random.default_rng(4)
    x = np.linspace(-1, 1, 40)
    problems = {
        run: FunctionProblem(
            lambda x, t: t[0] * x + t[1],
            x,
            slope * x + 0.1 * rng.standard_normal(40),
            [Normal(1, 5), Normal(0, 1)],
            ["slope", "level"],
        )
        for run, slope in {"a": 1.0, "b": 1.5, "c": 0.7, "d": 1.2}.items()
    }
    each = estimate_each(problems)
    each["status"].values[3] = "no_convergence"
    first, second = plots.by_run(each).axes
    view = between_runs(each)
    assert first.lines[0].get_ydata()[0] == pytest.approx(view.mean[0])
    assert first.get_title("right") == "p equal < 0.001"
    assert f"{view.p_value[1]:.2g}" in second.get_title("right")
    points = next(line for line in first.lines if line.get_marker() == "o")
    np.testing.assert_allclose(points.get_ydata(), each["estimate"][:3, 0])
    failed = next(line for line in first.lines if line.get_marker() == "x")
    assert list(failed.get_xdata()) == [3]
