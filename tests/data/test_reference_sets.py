"""Registered sets: known noise, harmonics and frequencies come back."""

import numpy as np
import pytest

from bayesoleo.data import load_campaign, reduce_campaign

pytestmark = pytest.mark.reference

CAMPAIGNS = ["plain", "wall", "breakaway", "fast-rebound", "compliance"]


@pytest.fixture
def write(tmp_path):
    def write_toml(text):
        (tmp_path / "campaign.toml").write_text(text)
        return reduce_campaign(load_campaign(tmp_path))

    return write_toml


def test_noise_of_all_runs_of_shaker_plain(data_set):
    reduced = reduce_campaign(load_campaign(data_set("campaigns/shaker-plain")))
    assert len(reduced.records) == 14
    for record in reduced.records:
        # 1500 degrees of freedom in the shortest run: standard error 1.8 %.
        assert record.signal_noise["displacement"] == pytest.approx(0.05e-3, rel=0.06)
        assert record.signal_noise["force"] == pytest.approx(20.0, rel=0.06)
        assert record.signal_noise["pressure"] == pytest.approx(0.05e5, rel=0.06)
        assert record.periods == 4
        assert record.frequency_sd / record.frequency < 3e-5
        assert set(record.harmonics["displacement"].orders.tolist()) <= {0, 1, 2, 3}


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMPAIGNS)
def test_stationary_shaker_runs_keep_all_periods(data_set, name):
    reduced = reduce_campaign(load_campaign(data_set(f"campaigns/shaker-{name}")))
    assert [record.dropped_periods for record in reduced.records] == [0] * 14


def silverbox(start, stop):
    return f"""
format = 1
name = "silverbox"
dataset = "silverbox"
[channels.voltage_in]
column = "V1"
unit = "V"
offset = "-mean"
[channels.voltage_out]
column = "V2"
unit = "V"
[[runs]]
label = "first"
file = "Schroeder80mV.mat"
frequency = 0.596
sample_rate = 610.3515625
start = {start / 610.3515625}
stop = {stop / 610.3515625}
"""


@pytest.mark.parametrize(("start", "last"), [(10592, 20831), (119375, 129614)])
def test_silverbox(data_set, write, start, last):
    record = write(silverbox(start, last)).records[0]
    # Ten periods from the start of the block, the first of them unsettled.
    assert (record.dropped_periods, record.periods) == (1, 9)
    assert record.frequency == pytest.approx(1e7 / 2**14 / 1024, rel=3e-7)
    assert record.signal_noise["voltage_out"] == pytest.approx(0.30e-3, rel=0.04)
    orders = set(record.harmonics["voltage_in"].orders.tolist())
    assert set(range(1, 336, 2)) <= orders


def test_mr_damper(data_set, write):
    text = """
format = 1
name = "mr_damper"
dataset = "mr_damper"
[channels.displacement]
column = "dist"
unit = "mm"
[channels.force]
column = "forc"
unit = "N"
"""
    known = {1: 0.840, 3: 0.899, 5: 0.970, 7: 1.053}
    for number, frequency in known.items():
        text += f"""
[[runs]]
label = "{number}"
file = "ensaio{number}.1.mat"
frequency = {frequency}
time = "Tout"
start = 5.0
"""
    for record in write(text).records:
        assert record.frequency == pytest.approx(known[int(record.label)], abs=6e-4)
        assert record.periods >= 20
        # A crank is no sine.
        assert {1, 2, 3} <= set(record.harmonics["displacement"].orders.tolist())
        assert 2.0 < record.signal_noise["force"] < 5.0


def test_mbari_gas_spring(data_set, write):
    record = write(
        """
format = 1
name = "mbari"
dataset = "mbari_gas_spring"
[channels.position]
column = "Pos(in)"
unit = "in"
[channels.lower_pressure]
column = "LowerSpringPressure(psia)"
unit = "psia"
[[runs]]
label = "cyclic"
file = "2022.01.28T16.46.31.exp"
kind = "transient"
time = "time(s)"
delimiter = "whitespace"
header_delimiter = ","
"""
    ).records[0]
    assert record.time[1] - record.time[0] == pytest.approx(0.02)
    assert record.samples["lower_pressure"][0] == pytest.approx(152.1 * 6894.757, rel=1e-6)
    assert np.ptp(record.samples["position"]) > 1.5
    assert 0 < record.signal_noise["lower_pressure"] < 7e3
