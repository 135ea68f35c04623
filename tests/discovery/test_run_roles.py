"""Every way of holding data out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_campaigns import DAMPER_RUNS, damper, damper_campaign

from bayesoleo.data._noise import check_length
from bayesoleo.discovery._assembly import RecordNoise, assign, halves
from bayesoleo.errors import CampaignError
from bayesoleo.prediction._predictor import Predictor


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    return damper_campaign(tmp_path_factory.mktemp("roles")).records


def test_declared_roles_are_kept(records):
    roles = assign(records)
    assert roles.strategy == "declared"
    assert [r.label for r in roles.fitted] == ["a", "b", "c"]
    assert [r.label for r in roles.held_out] == ["d", "e"]
    assert roles.description == "2 declared hold-out runs"


def test_without_hold_out_every_run_is_left_out_once(records):
    roles = assign([r for r in records if r.role == "fit"])
    assert roles.strategy == "leave-one-run-out"
    assert roles.fitted == roles.held_out
    assert "leave-one-run-out" in roles.description


@pytest.mark.parametrize("periods", [4, 7])
def test_halves_of_a_lone_run_are_predicted_as_the_whole_is(tmp_path, periods):
    (whole,) = damper_campaign(tmp_path, runs=DAMPER_RUNS[:1], periods=periods).records
    roles = assign([whole])
    (first,), (second,) = roles.fitted, roles.held_out
    assert roles.strategy == "split periods"
    assert first.periods + second.periods == whole.periods == periods
    assert {first.role, second.role} == {"fit", "hold-out"}
    assert first.label != second.label
    time = np.concatenate([first.time, second.time])
    assert np.array_equal(time, whole.time)
    model = damper()
    predicted = [
        Predictor(model, [record], backend="numpy", jobs=1)
        .predict(np.array([200.0, 1000.0, 2e6]))[0]
        .y
        for record in (whole, first, second)
    ]
    together = np.concatenate(predicted[1:], axis=1)
    assert together == pytest.approx(predicted[0], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("per_period", [100.0, 100.3, 100.51, 99.76])
def test_either_half_of_a_record_a_sample_short_holds_its_periods(records, per_period):
    size = int(np.ceil(4 * per_period)) - 1
    short = replace(
        records[0],
        time=np.arange(size) * 1.0,
        samples={name: np.zeros(size) for name in records[0].samples},
        frequency=1 / per_period,
        periods=4,
        kept=None,
    )
    parts = halves(short)
    assert sum(part.time.size for part in parts) == size
    for part in parts:
        check_length(part.time.size, 1 / per_period)  # raises where two periods are not there


def test_a_lone_short_run_cannot_be_split(tmp_path):
    (whole,) = damper_campaign(tmp_path, runs=DAMPER_RUNS[:1], periods=3).records
    roles = assign([whole])
    assert roles.strategy == "none"
    assert roles.held_out == ()
    assert "nothing could be held out" in roles.description


def test_no_run_to_fit_is_an_error(records):
    with pytest.raises(CampaignError, match="no run to fit; give one run or more role"):
        assign([r for r in records if r.role != "fit"])


def test_transients_are_fitted_and_held_out_like_periodic_runs(records):
    mixed = [replace(records[0], kind="transient"), *records[1:]]
    assert [record.label for record in assign(mixed).fitted] == [
        record.label for record in assign(records).fitted
    ]


def test_a_lone_transient_leaves_nothing_to_hold_out(records):
    roles = assign([replace(records[0], kind="transient", periods=0)])
    assert roles.strategy == "none"
    assert "transient" in roles.description


def test_noise_that_was_measured_is_found_again(tmp_path):
    """Of the halves of a lone run by each of them, of halves made later by the whole run."""
    (whole,) = damper_campaign(tmp_path, runs=DAMPER_RUNS[:1], periods=8).records
    roles, own, all_of_it = assign([whole]), RecordNoise(1.0, 0.1, 3.0), RecordNoise(2.0, 0.2, 4.0)
    label = roles.fitted[0].label
    assert roles.noise_of("force", label) is None
    assert replace(roles, measured={(label, "force"): own}).noise_of("force", label) == own
    later = replace(roles, measured={(whole.label, "force"): all_of_it})
    assert later.noise_of("force", label) == all_of_it
