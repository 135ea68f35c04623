"""Stretches of a record that do not count: from campaign.toml to the estimate and the posterior."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_campaigns import CUBIC, DAMPING, STIFFNESS, damper, damper_campaign, spring_damper_force

from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._workflow.predicting import predict
from bayesoleo._workflow.settings import Settings
from bayesoleo.assessment import assess
from bayesoleo.data import load_campaign, reduce_campaign
from bayesoleo.data._reduction import reduce_run
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import scales_of
from bayesoleo.discovery._samples_that_count import without_masked
from bayesoleo.discovery._score_tests import score_all
from bayesoleo.discovery._state import fit_state
from bayesoleo.effects import find_effect
from bayesoleo.errors import CampaignError
from bayesoleo.estimation import estimate, sampling_distribution
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.prediction._predictor import Predictor

SETTINGS = Settings(jobs=1, steps=64, quick=True)
TRUTH = {"damping": DAMPING, "stiffness": STIFFNESS, "cubic": CUBIC}
#: When the sensors drop out in run a, s.
FAULT = (3.2, 3.6)


def broken(folder: Path, *, mask: bool, size: float = 1.0) -> Path:
    """Run a with a stretch in which both sensors show nonsense."""
    damper_campaign(folder, spring_damper_force, runs=[("a", 1.0, 0.01, "fit"),
                                                       ("b", 2.0, 0.006, "fit")])  # fmt: skip
    path = folder / "a.csv"
    header, *_ = path.read_text(encoding="utf-8").splitlines()
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    column = header.split(",").index
    inside = (table[:, 0] >= FAULT[0]) & (table[:, 0] <= FAULT[1])
    table[inside, column("f_N")] += 40.0 * size
    table[inside, column("x_mm")] += 3.0 * size
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.12g")
    if mask:
        toml = folder / "campaign.toml"
        text = toml.read_text(encoding="utf-8")
        masked = text.replace('label = "a"', f'label = "a"\nmask = [{list(FAULT)}]')
        toml.write_text(masked, encoding="utf-8")
    return folder


def test_values_may_be_missing_where_they_are_masked(tmp_path):
    whole = load_campaign(broken(tmp_path, mask=True)).run("a")
    path = tmp_path / "a.csv"
    rows = path.read_text(encoding="utf-8").splitlines()
    inside = np.flatnonzero((whole.time >= FAULT[0]) & (whole.time <= FAULT[1]))
    for k in inside[3:8]:
        time, *others = rows[1 + k].split(",")
        rows[1 + k] = ",".join([time, *[""] * len(others)])
    path.write_text("\n".join(rows), encoding="utf-8")
    gaps = load_campaign(tmp_path).run("a")
    kept = np.setdiff1d(np.arange(whole.time.size), inside[3:8])
    for name, values in gaps.samples.items():
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(values[kept], whole.samples[name][kept])
    (tmp_path / "campaign.toml").write_text(
        (tmp_path / "campaign.toml").read_text(encoding="utf-8").replace("mask = ", "# "),
        encoding="utf-8",
    )
    with pytest.raises(CampaignError, match=r"5 missing value.*mask the gap"):
        load_campaign(tmp_path)


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    return reduce_campaign(load_campaign(broken(tmp_path_factory.mktemp("m"), mask=True)), jobs=1)


def fitted(reduced):
    """As the loop fits it, by NumPy's kernels."""
    numerics = Numerics(jobs=1, backend="numpy")
    return fit_state(Assembly(damper()), assign(reduced.records), numerics)


def scored(state, *names):
    """Scores by effect."""
    scales = scales_of(state.fit, None, state.assembly.native)
    found = state.assembly.options(scales, [find_effect(name) for name in names])
    scores, _ = score_all(state.base(), found, jobs=1)
    return {score.option.candidate.effect: score for score in scores}


def problem_of(reduced):
    return CampaignProblem(Predictor(damper(), reduced.records, backend="numpy", jobs=1))


def test_what_is_masked_is_neither_fitted_nor_part_of_the_input(masked, tmp_path):
    point = estimate(problem_of(masked))
    for name, value in TRUTH.items():
        sd = point.sd[point.names.index(name)]
        assert abs(point[name] - value) < 4 * sd, name
    assert point.variance[0] == pytest.approx(0.25, rel=0.1)
    kept = reduce_campaign(load_campaign(broken(tmp_path, mask=False)), jobs=1)
    wrong = estimate(problem_of(kept))
    assert wrong.variance[0] > 5 * point.variance[0]


def test_noise_and_frequency_are_those_of_the_other_samples(masked):
    record = masked.record("a")
    assert record.kept is not None
    assert (~record.kept).sum() == pytest.approx(0.4 * 100.37, abs=2)
    # eight hundred samples know their noise to 2.5 %, a period of eight less well
    assert record.signal_noise["force"] == pytest.approx(0.5, rel=0.12)
    assert abs(record.frequency - 1.0) < 5 * record.frequency_sd
    assert masked.record("b").kept is None


def test_nothing_depends_on_the_masked_values(tmp_path):
    found = [
        estimate(problem_of(reduce_campaign(load_campaign(
            broken(tmp_path / str(size), mask=True, size=size)), jobs=1)))
        for size in (0.0, 100.0)
    ]  # fmt: skip
    # to the rounding of the bridge
    np.testing.assert_allclose(found[0].theta, found[1].theta, rtol=1e-8)
    np.testing.assert_allclose(found[0].sd, found[1].sd, rtol=1e-8)


def test_all_ways_to_the_misfit_agree(masked):
    problem = problem_of(masked)
    theta = np.array(list(TRUTH.values())) * [1.01, 0.98, 1.05]
    problem.freeze(theta)
    e = problem.evaluate(theta)
    counts = problem.counts[:, 0]
    assert e.residual[0].size == counts.sum() < sum(r.time.size for r in masked.records)
    expected = [float(part @ part) for part in np.split(e.residual[0], [counts[0]])]
    np.testing.assert_allclose(problem.misfit(theta[None]).sum_of_squares[0, :, 0], expected)
    equations = problem.normal_equations(theta[None], [problem.data[0][None]])
    np.testing.assert_allclose(equations.sums[0, 0], sum(expected))
    np.testing.assert_allclose(equations.gram[0, 0], e.sensitivity[0].T @ e.sensitivity[0])
    same = problem.with_data([problem.data[0] + 1.0])
    np.testing.assert_allclose(same.evaluate(theta).residual[0], e.residual[0] + 1.0)


@pytest.mark.slow
def test_everything_after_the_estimate_knows_of_it(masked, tmp_path):
    tree = workflow.sample(masked, damper(), SETTINGS, out=tmp_path)
    posterior = tree[schema.POSTERIOR].to_dataset()
    for name, value in TRUTH.items():
        assert abs(float(posterior[name].mean()) - value) < 4 * float(posterior[name].std()), name
    problem = problem_of(masked)
    point = estimate(problem)
    found = assess(problem, point)
    assert float(found["outliers"].max()) <= 1
    np.testing.assert_allclose(found["rms"], 0.5, rtol=0.1)
    scatter = sampling_distribution(problem, point, replications=60, jobs=1)
    # a standard deviation of sixty draws is good to 9 %
    np.testing.assert_allclose(scatter["sd"] / scatter["expected_sd"], 1.0, atol=0.35)
    foreseen = predict(tree, masked, runs=["a"], jobs=1)
    assert float(foreseen["rms"][0, 0]) == pytest.approx(0.5, rel=0.1)


@pytest.fixture(scope="module")
def traced(tmp_path_factory):
    """The loop's state on masked runs, of which a sensor shows nonsense of two sizes, and whole
    ones, all with the same noise elsewhere."""
    found = {}
    for size in (0.0, 1.0, 100.0):
        folder = broken(tmp_path_factory.mktemp("t"), mask=True, size=size)
        reduced = reduce_campaign(load_campaign(folder), jobs=1)
        found[size] = fitted(reduced)
    folder = broken(tmp_path_factory.mktemp("t"), mask=False, size=0.0)
    found["whole"] = fitted(reduce_campaign(load_campaign(folder), jobs=1))
    return found


def test_the_loop_leaves_stretches_out(traced):
    """Nothing is missing; what a broken sensor showed is no error."""
    error = traced[1.0].fit_errors.at("force", "a")
    assert error.ratio < 1.15
    assert error.rms == pytest.approx(0.5, rel=0.1)
    # 760 of 803 samples know the noise about as well as all do, and the average a little less.
    whole = traced["whole"].fit_errors.at("force", "a")
    assert error.average.sigma == pytest.approx(whole.average.sigma, rel=0.05)
    assert error.average.noise / whole.average.noise == pytest.approx(
        (whole.average.samples / error.average.samples) ** 0.5, rel=0.05
    )
    assert error.average.samples == pytest.approx(whole.average.samples - 40, abs=2)


def test_errors_and_scores_do_not_depend_on_the_masked_values(traced):
    names = ("coulomb_friction", "quintic_stiffness", "constant_force")
    one, other = (scored(traced[size], *names) for size in (0.0, 100.0))
    a, b = (traced[size].fit_errors.at("force", "a") for size in (0.0, 100.0))
    # to the rounding of the bridge
    assert a.ratio == pytest.approx(b.ratio, rel=1e-7)
    for name in names:
        assert one[name].fall == pytest.approx(other[name].fall, rel=1e-6, abs=1e-6)
        np.testing.assert_allclose(one[name].expected, other[name].expected, rtol=1e-6)


def test_the_bridged_average_is_that_of_the_samples_that_count(masked):
    """Least squares on all harmonics of the others alone, by another way."""
    record = masked.record("a")
    rng = np.random.default_rng(3)
    residual = rng.standard_normal(record.time.size)
    residual[~record.kept] = 1e6
    filled = without_masked(record, residual)
    orders = np.arange(1, 50)
    angle = 2 * np.pi * np.outer(record.phase, orders)
    columns = np.concatenate([np.ones((record.time.size, 1)), np.cos(angle), np.sin(angle)], axis=1)
    expected = np.linalg.lstsq(columns[record.kept], residual[record.kept], rcond=None)[0]
    np.testing.assert_allclose(filled[~record.kept], columns[~record.kept] @ expected, atol=1e-6)
    np.testing.assert_array_equal(filled[record.kept], residual[record.kept])


def test_an_effect_is_found_in_runs_with_masked_stretches(tmp_path):
    folder = broken(tmp_path, mask=True)
    reduced = reduce_campaign(load_campaign(folder), jobs=1)
    effects = tuple(map(find_effect, ("cubic_stiffness", "coulomb_friction", "constant_force")))
    settings = replace(SETTINGS, effects=effects)
    tree = workflow.trace(reduced, damper(cubic=False), settings)
    first = json.loads(tree.attrs[schema.SUMMARY])["rounds"][0]["candidates"][0]
    assert first["effect"] == "cubic_stiffness"
    assert first["gain"] > 0.9
    assert np.isnan(tree[schema.RESIDUAL]["force_before"].values[0]).sum() >= 39


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        ("[1.0, 2.0]", "must be pairs of seconds"),
        ("[[2.0, 1.0]]", "must be pairs of seconds"),
        ("[[50.0, 51.0]]", "no sample lies in this stretch"),
        ("[[0.0, 7.5]]", "of the run is masked"),
    ],
)
def test_what_is_no_mask_is_said(tmp_path, mask, words):
    folder = broken(tmp_path, mask=True)
    toml = folder / "campaign.toml"
    text = toml.read_text(encoding="utf-8").replace(f"mask = [{list(FAULT)}]", f"mask = {mask}")
    toml.write_text(text, encoding="utf-8")
    with pytest.raises(CampaignError, match=words):
        load_campaign(folder)


def test_transient_is_estimated_without_its_stretch(masked):
    """The smooth curve behind the input is drawn straight across."""
    run = load_campaign(masked.campaign.path).run("a")
    transient = replace(run, kind="transient", frequency=None)
    record = reduce_run(transient)
    assert record.kept is not None
    assert record.signal_noise["force"] < 3.0
