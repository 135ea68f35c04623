"""Runs to records."""

import pickle

import numpy as np
import pytest

from bayesoleo.data import SimulatedRun, load_campaign, reduce_campaign, write_campaign
from bayesoleo.data._noise import innovation_noise
from bayesoleo.errors import CampaignError

CHANNELS = {"displacement": ("x_mm", "mm"), "force": ("f_N", "N")}


def simulated(rng, label="a", frequency=1.0013, start=0.21, samples=1230, nominal=1.0, **more):
    time = start + np.arange(samples) / 300
    turn = 2 * np.pi * frequency * time
    displacement = 0.01 * np.cos(turn) + 0.02 + 1e-4 * rng.normal(size=samples)
    force = 100 * np.tanh(8 * np.sin(turn)) + 2.0 * rng.normal(size=samples)
    samples_by_channel = {"displacement": displacement, "force": force}
    return SimulatedRun(label, time, samples_by_channel, frequency=nominal, **more)


def reduced(folder, runs, **options):
    write_campaign(folder, name="n", channels=CHANNELS, runs=runs, overwrite=True)
    return reduce_campaign(load_campaign(folder), **options)


def test_record_of_a_periodic_run(tmp_path):
    run = simulated(np.random.default_rng(1), group="g", conditions={"mass": (25.0, "kg", 0.1)})
    record = reduced(tmp_path, [run]).record("a")
    assert abs(record.frequency - 1.0013) < 4 * record.frequency_sd
    assert (record.periods, record.dropped_periods, record.group) == (4, 0, "g")
    assert record.time.size == int(4 * 300 / record.frequency)
    # The last whole periods are kept.
    assert record.time[-1] == pytest.approx(run.time[-1])
    assert record.samples["force"].shape == record.time.shape
    # 930 degrees of freedom: 2.3 % standard error.
    assert record.signal_noise["displacement"] == pytest.approx(1e-4, rel=0.08)
    assert record.signal_noise["force"] == pytest.approx(2.0, rel=0.08)
    assert record.conditions["mass"] == 25.0
    assert record.condition_sd["mass"] == pytest.approx(0.1)
    assert 0 <= record.phase[0] < record.phase[-1] < 4


def test_harmonics_give_the_input_back_with_its_derivative(tmp_path):
    record = reduced(tmp_path, [simulated(np.random.default_rng(2))]).records[0]
    harmonics = record.harmonics["displacement"]
    assert harmonics.orders.tolist() == [0, 1]
    speed = harmonics.evaluate(record.phase, record.frequency, derivative=1)
    expected = -0.01 * 2 * np.pi * 1.0013 * np.sin(2 * np.pi * 1.0013 * record.time)
    np.testing.assert_allclose(speed, expected, atol=1.5e-4)
    # A friction-like square wave keeps its odd harmonics.
    assert set(range(1, 14, 2)) <= set(record.harmonics["force"].orders.tolist())


def test_unsettled_period_is_dropped_and_counted(tmp_path):
    run = simulated(np.random.default_rng(3), samples=1530)
    run.samples["force"][:] += 200 * np.exp(-(run.time - run.time[0]) / 0.3)
    record = reduced(tmp_path, [run]).records[0]
    assert record.dropped_periods >= 1
    assert record.periods + record.dropped_periods == 5
    assert record.signal_noise["force"] < 2.5


def test_threads_and_progress_change_nothing(tmp_path, capsys):
    rng = np.random.default_rng(4)
    runs = [simulated(rng, label) for label in "abc"]
    one, two = reduced(tmp_path, runs, jobs=1), reduced(tmp_path, runs, jobs=2, progress=True)
    for left, right in zip(one.records, two.records, strict=True):
        assert left.frequency == right.frequency
        assert left.signal_noise == right.signal_noise
    assert "reduce" in capsys.readouterr().err


def test_records_travel_between_processes(tmp_path):
    whole = reduced(tmp_path, [simulated(np.random.default_rng(10))])
    copy = pickle.loads(pickle.dumps(whole))
    np.testing.assert_array_equal(copy.records[0].time, whole.records[0].time)
    assert whole.records[0].samples["force"].flags.writeable


def test_transient(tmp_path):
    rng = np.random.default_rng(5)
    run = simulated(rng, nominal=None, kind="transient", samples=3000)
    record = reduced(tmp_path, [run]).records[0]
    assert np.isnan(record.frequency)
    assert np.isnan(record.frequency_sd)
    assert (record.periods, dict(record.harmonics)) == (0, {})
    assert record.signal_noise["displacement"] == pytest.approx(1e-4, rel=0.08)
    assert record.signal_noise["force"] == pytest.approx(2.0, rel=0.15)


@pytest.mark.parametrize("curvature", [0.0, 0.3])
def test_innovation_noise_is_that_of_white_noise(curvature):
    rng = np.random.default_rng(6)
    smooth = np.sin(curvature * np.arange(4000)) * 10
    assert innovation_noise(smooth + 0.1 * rng.normal(size=4000)) == pytest.approx(0.1, rel=0.06)


def test_wrong_frequency_names_run_and_file(tmp_path):
    run = simulated(np.random.default_rng(7), nominal=1.6)
    message = r"file a.csv, run a, key frequency: .* \(got 1.6\); it repeats at about 1(.00.)? Hz"
    with pytest.raises(CampaignError, match=message):
        reduced(tmp_path, [run])


def test_two_declared_periods_that_are_fewer(tmp_path):
    run = simulated(np.random.default_rng(8), frequency=0.97, nominal=1.0, samples=610)
    with pytest.raises(CampaignError, match="run a, key frequency: fewer than two periods"):
        reduced(tmp_path, [run])


def test_unknown_record(tmp_path):
    with pytest.raises(CampaignError, match="run z: no such run; one of: a"):
        reduced(tmp_path, [simulated(np.random.default_rng(9))]).record("z")
