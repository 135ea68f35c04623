"""A start is estimated on the part of a record that tells it; the prediction is as of all of it."""

from dataclasses import replace

import numpy as np
import pytest
from broadband_transients import KINDS, record

from bayesoleo.discovery import _beginnings
from bayesoleo.discovery._beginnings import FEWEST, LEFT, RESERVE, beginning_of
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._run_predictions import predict_held_out
from bayesoleo.estimation._problem import Evaluation
from bayesoleo.model._drive_and_start import with_estimated_starts
from bayesoleo.prediction._records import transient_record
from bayesoleo.solvers._orbit import Status

TIME = 0.01 * np.arange(20_000)
RECORD = transient_record("long", TIME, {"out": np.sin(TIME)})


def seen(*columns, outputs=1, noise=0.1):
    """An evaluation with these sensitivities, of every output alike."""
    residual = noise * np.random.default_rng(0).standard_normal(len(columns[0]))
    rows = np.stack(columns, axis=1)
    return Evaluation((residual,) * outputs, (rows,) * outputs, Status.CONVERGED)


@pytest.mark.parametrize("decay", [300.0, 900.0])
@pytest.mark.parametrize("outputs", [1, 2])
def test_the_beginning_is_as_long_as_the_start_is_seen(decay, outputs):
    """A column that decays by exp(-n/decay) has exp(-2n/decay) of its squares after n."""
    column = np.exp(-np.arange(TIME.size) / decay)
    part = beginning_of(RECORD, seen(column, outputs=outputs))
    needed = 0.5 * decay * np.log(1 / LEFT)
    assert part.time.size == pytest.approx(RESERVE * needed, rel=0.01)
    np.testing.assert_array_equal(part.samples["out"], RECORD.samples["out"][: part.time.size])


def test_curves_of_a_beginning_are_those_of_the_record():
    part = beginning_of(RECORD, seen(np.exp(-np.arange(TIME.size) / 300.0)))
    place = part.position[5:-5]
    found = part.smoothed["out"].evaluate(place, part.rate, 1)
    np.testing.assert_allclose(found, np.cos(part.time[5:-5]), atol=1e-4)


def test_nearly_the_same_columns_need_what_tells_them_apart():
    """Their difference is seen much later than they are."""
    place = np.arange(TIME.size)
    fast = np.exp(-place / 45.0)
    late = fast + 1e-3 * np.exp(-(((place - 2000.0) / 200.0) ** 2))
    assert beginning_of(RECORD, seen(fast)).time.size == FEWEST
    assert beginning_of(RECORD, seen(fast, late)).time.size > 2000


def test_masked_samples_are_counted_where_they_stand():
    kept = np.ones(TIME.size, dtype=bool)
    kept[100:1100] = False
    masked = replace(RECORD, kept=kept)
    column = np.exp(-np.arange(TIME.size) / 400.0)[kept]
    part = beginning_of(masked, seen(column))
    assert part.time.size > RESERVE * 1100
    np.testing.assert_array_equal(part.kept, kept[: part.time.size])


@pytest.mark.parametrize(
    "column",
    [
        np.cos(TIME),
        np.exp(TIME / 100.0),
        np.exp(-TIME / 100.0),
        np.zeros(TIME.size),
        np.full(TIME.size, np.nan),
    ],
    ids=["undamped", "growing", "slow", "unseen", "not solved"],
)
def test_a_start_that_is_not_forgotten_needs_all(column):
    assert beginning_of(RECORD, seen(column)) is None


def test_what_nothing_tells_does_not_lengthen_it():
    column = np.exp(-np.arange(TIME.size) / 300.0)
    alone = beginning_of(RECORD, seen(column)).time.size
    assert beginning_of(RECORD, seen(column, np.zeros(TIME.size))).time.size == alone
    assert beginning_of(RECORD, seen(column, 2.0 * column)).time.size == pytest.approx(alone, abs=2)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(KINDS))
def test_the_prediction_of_a_hold_out_run_is_the_same(name, monkeypatch):
    model, truth = KINDS[name]
    started = with_estimated_starts(model)
    fit = fit_model(started, [record(model, truth)], Numerics(jobs=1))
    other = replace(record(model, truth, seed=3), label="other")
    (short,) = predict_held_out(fit, [other])
    sizes = []

    def noted(one, evaluation):
        found = beginning_of(one, evaluation)
        sizes.append(one.time.size if found is None else found.time.size)

    monkeypatch.setattr(_beginnings, "beginning_of", noted)
    (whole,) = predict_held_out(fit, [other])
    assert whole.status.ok
    assert short.status.ok
    assert max(sizes) < other.time.size / 4  # a beginning was taken
    noise = 0.05 * np.std(other.samples["out"])
    # A tenth of a standard deviation of the start is 0.01 in the sum of squares of the noise.
    assert np.sum((whole.y - short.y) ** 2) < 0.03 * noise**2
