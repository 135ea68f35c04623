"""Predictions of unused runs know how good they are: against closed forms and against the truth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from small_campaigns import (
    DAMPING,
    STIFFNESS,
    damper,
    damper_campaign,
    spring_damper_force,
    with_friction,
)

import bayesoleo
import bayesoleo._workflow
from bayesoleo import _schema as schema, _workflow as workflow, plots
from bayesoleo._workflow.predicting import draws_of, predict
from bayesoleo._workflow.settings import Settings
from bayesoleo.errors import InputError
from bayesoleo.model import Model, Output, Parameter

SETTINGS = Settings(jobs=1, steps=64)
NOISE = 0.5


@pytest.fixture(scope="module")
def estimated(tmp_path_factory):
    reduced = damper_campaign(tmp_path_factory.mktemp("right"), spring_damper_force, noise=NOISE)
    return workflow.estimate(reduced, damper(), SETTINGS), reduced


def test_right_model_foresees_runs_that_it_has_not_seen(estimated):
    tree, reduced = estimated
    found = predict(tree, reduced, runs=["d", "e"], jobs=1)
    assert list(found["run"].values) == ["d", "e"]
    np.testing.assert_allclose(found["rms"], found["expected_rms"], rtol=0.1)
    np.testing.assert_allclose(found["coverage"], 0.95, atol=0.025)
    # Kolmogorov's distance of 800 samples is above 0.058 once in a hundred times
    assert (found["pit_distance"] < 0.058).all()
    # the entropy of the noise, within four standard errors
    entropy = -0.5 * np.log(2 * np.pi * np.e * NOISE**2)
    np.testing.assert_allclose(found["log_score"], entropy, atol=4 * np.sqrt(0.5 / 800))


def test_spread_is_that_of_the_linearised_estimate(estimated):
    tree, reduced = estimated
    # A model that is linear in its parameters: variance of the mean plus noise, in closed form.
    point = tree[schema.POINT].to_dataset()
    found = predict(tree, reduced, runs=["e"], draws=4000, jobs=1)
    record = reduced.record("e")
    time = found["time"].values[0][np.isfinite(found["time"].values[0])]
    shown = np.round(time / (record.time[1] - record.time[0])).astype(int)
    x, v = (
        record.harmonics["displacement"].evaluate(record.phase, record.frequency, k)[shown]
        for k in (0, 1)
    )
    rows = np.column_stack([v, x, x**3])
    assert list(point["parameter"].values) == ["damping", "stiffness", "cubic"]
    variance = np.einsum("nj,jk,nk->n", rows, point["covariance"].values, rows)
    expected = 1.959964 * np.sqrt(variance + float(point["variance"][0]))
    half = 0.5 * (found["high"] - found["low"]).values[0, 0, : time.size]
    np.testing.assert_allclose(half, expected, rtol=0.01)
    np.testing.assert_allclose(
        found["mean"][0, 0, : time.size], rows @ point["estimate"].values, atol=0.01
    )


def test_missing_physics_is_told_by_every_score(tmp_path, estimated):
    wrong = damper_campaign(tmp_path, with_friction, noise=NOISE)
    found = predict(estimated[0], wrong, runs=["d"], jobs=1)
    assert float(found["rms"][0, 0]) > 5 * float(found["expected_rms"][0, 0])
    assert float(found["coverage"][0, 0]) < 0.5
    assert float(found["pit_distance"][0, 0]) > 0.3


def test_posterior_is_drawn_from_where_there_is_one(tmp_path, estimated):
    _, reduced = estimated
    tree = workflow.sample(reduced, damper(), replace(SETTINGS, quick=True), out=tmp_path)
    known = draws_of(tree, 300, np.random.default_rng(0))
    posterior = tree[schema.POSTERIOR].to_dataset()
    stored = set(posterior["damping"].values.ravel())
    assert set(known.draws["damping"]) <= stored
    assert known.sd["force"].std() > 0
    found = predict(tree, reduced, runs=["d"], jobs=1)
    assert 0.9 < float(found["coverage"][0, 0]) < 0.99


def test_constants_with_a_tolerance_and_runs_of_their_own_widen_it(estimated):
    tree, reduced = estimated
    model = damper().with_parameters(
        offset=Parameter(0.0, "N", sd=3.0, fixed=True),
        own=Parameter(0.0, "N", sd=4.0, by_run=True),
    )
    terms = {**model.outputs["force"].terms, "offset": "offset", "own": "own"}
    model = replace(model, outputs={"force": Output(terms, "N")})
    found = predict(tree, reduced, model=model, runs=["d"], draws=4000, jobs=1)
    # 0.5, 3 and 4 N are independent; a standard deviation of 4000 draws is good to 1.1 %
    assert float(found["expected_rms"][0, 0]) == pytest.approx(np.sqrt(25.25), rel=0.04)


def test_text_and_figure_have_the_numbers(estimated):
    found = predict(*estimated, runs=["d", "e"], jobs=1)
    assert "within 95 %" in str(found)
    head, first = (line.split() for line in str(found).splitlines()[:2])
    assert first[head.index("unit")] == "N"
    assert "200 draws of damper" in str(found)
    assert json.loads(str(found["failed"].values[0])) == {}
    figure = plots.forecast(found.data)
    assert len(figure.axes) == 4
    bars = figure.axes[1].patches
    assert sum(bar.get_height() * bar.get_width() for bar in bars) == pytest.approx(1.0)
    assert float(found["pit"].mean()) == pytest.approx(1.0)


def test_what_cannot_be_foreseen_is_said(estimated):
    tree, reduced = estimated
    with pytest.raises(InputError, match="no such run"):
        predict(tree, reduced, runs=["z"])
    with pytest.raises(InputError, match="two or more"):
        predict(tree, reduced, draws=1)
    assert bayesoleo._workflow.predicting.predict is predict


def test_model_of_another_experiment_takes_the_estimates(estimated):
    """A mass let go on the damper: a transient without input, answered in closed form."""
    tree, reduced = estimated
    model = Model(
        "release",
        inputs={},
        dofs={"position": bayesoleo.model.Dof("m", initial="0.01", initial_rate="0")},
        parameters={
            "damping": Parameter(DAMPING, "N*s/m", sd=1.0),
            "stiffness": Parameter(STIFFNESS, "N/m", sd=1.0),
            "mass": Parameter(50.0, "kg", fixed=True),
        },
        equations={"position": "mass*ddot(position) + damping*dot(position) + stiffness*position"},
        outputs={"displacement": Output("position", "m")},
    )
    time = np.arange(400) / 100
    decay = DAMPING / 100
    omega = np.sqrt(STIFFNESS / 50 - decay**2)
    true = (
        0.01 * np.exp(-decay * time) * (np.cos(omega * time) + decay / omega * np.sin(omega * time))
    )
    record = replace(
        reduced.record("d"), label="drop", kind="transient", frequency=np.nan, periods=0, time=time,
        samples={"displacement": true}, harmonics={}, signal_noise={"displacement": 1e-5},
    )  # fmt: skip
    released = type(reduced)(reduced.campaign, (record,))
    found = predict(tree, released, model=model, jobs=1)
    inside = (found["low"] <= found["measured"]) & (found["measured"] <= found["high"])
    assert bool(inside.all())
    assert float(found["rms"][0, 0]) < 2e-4
