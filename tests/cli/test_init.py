"""A folder of files becomes a campaign and a model that can be checked at once."""

import json

import numpy as np
import pytest
from small_rig import rows

from bayesoleo._report.terminal import sparkline
from bayesoleo._workflow.first_look import start_campaign
from bayesoleo.data import load_campaign
from bayesoleo.data._residual_time_shift import guess_frequency
from bayesoleo.errors import CampaignError


def write(path, values, header, sep=","):
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [sep.join(f"{v:.9g}" for v in row) for row in values]
    path.write_text("\n".join([header, *lines]) + "\n")


@pytest.fixture
def folder(tmp_path):
    """Three files as a rig writes them, with what is no run beside them."""
    made = tmp_path / "measured"
    for label, frequency in (("slow", 1.0), ("fast", 2.0), ("faster", 3.0)):
        write(made / f"{label}.csv", rows(frequency), "Rig 7\nTime [s],Force [N],Stroke [mm]")
    (made / "README.txt").write_text("measured in May\n")
    (made / "photo.png").write_bytes(b"\x89PNG")
    return made


def test_what_is_written_loads_and_is_checked(run, folder):
    done = run("init", folder)
    assert done.exit_code == 0, done.output
    campaign = load_campaign(folder)
    assert {n: (c.column, c.unit) for n, c in campaign.channels.items()} == {
        "force": ("Force [N]", "N"),
        "displacement": ("Stroke [mm]", "mm"),
    }
    declared = {one.label: (one.frequency, one.role) for one in campaign.runs}
    assert {k: v[1] for k, v in declared.items()} == {
        "fast": "fit",
        "faster": "fit",
        "slow": "hold-out",
    }
    for label, frequency in (("slow", 1.0), ("fast", 2.0), ("faster", 3.0)):
        # A lag is known to about a tenth of a sample of the hundred in a period.
        assert declared[label][0] == pytest.approx(frequency, rel=2e-3)
    text = (folder / "campaign.toml").read_text()
    assert text.count("TO FILL IN") == 2  # the head, and the controlled channel
    assert "fill in   controlled" in done.stdout
    assert (folder / "channels.png").stat().st_size > 1000
    checked = run("check", folder, "--model", folder / "model.py", "--json")
    assert checked.exit_code == 0, checked.output
    assert json.loads(checked.stdout)["outputs"] == ["displacement"]


def test_nothing_is_overwritten(run, folder, refused):
    (folder / "model.py").write_text("mine = 1\n")
    found = json.loads(run("init", folder, "--json").stdout)
    assert [path.rsplit("/", 1)[-1] for path in found["kept"]] == ["model.py"]
    assert (folder / "model.py").read_text() == "mine = 1\n"
    before = (folder / "campaign.toml").read_text()
    assert "there is a campaign already" in refused("init", folder)
    assert (folder / "campaign.toml").read_text() == before


def test_what_files_do_not_say_is_asked(tmp_path):
    values = rows(1.0)
    write(tmp_path / "a.csv", np.column_stack([np.arange(400), values[:, 1:]]), "n,u,load")
    found = start_campaign(tmp_path)
    text = (tmp_path / "campaign.toml").read_text()
    assert "sample_rate = 1.0  # TO FILL IN: the sampling rate in Hz" in text
    assert 'unit = "N"  # TO FILL IN: the file does not say the unit of load; N is assumed' in text
    assert [q.split(":")[0] for q in found.questions] == [
        "channels.u.unit",
        "channels.force.unit",
        "sample_rate of run a",
        "controlled",
    ]
    assert any("column n was left out: it counts samples" in note for note in found.notes)


@pytest.mark.parametrize(
    ("column", "name", "unit"),
    [
        ("acc_g", "acceleration", "g_0"),
        ("a_top_mg", "acceleration", "mg_0"),
        ("ax [g]", "acceleration", "g_0"),
        ("T_C", "temperature", "degC"),
        ("Tamb_C", "temperature", "degC"),
        ("oil temp (C)", "temperature", "degC"),
        ("mass_g", "mass", "g"),
        ("charge_C", "charge", "C"),
    ],
)
def test_the_quantity_decides_between_two_meanings_of_a_unit(tmp_path, recwarn, column, name, unit):
    write(tmp_path / "a.csv", rows(1.0), f"time_s,{column},x_mm")
    found = start_campaign(tmp_path)
    channel = found.campaign.channels[name]
    assert (channel.column, channel.unit) == (column, unit)
    assert [q.split(":")[0] for q in found.questions] == ["controlled"]
    assert not recwarn.list  # that the file states g means the same


@pytest.mark.parametrize(
    ("column", "unit", "meanings"),
    [
        ("top_g", "g_0", "gram or standard gravity?"),
        ("oil_C", "degC", "coulomb or degree Celsius?"),
        ("force_g", "gf", "g is a mass"),
    ],
)
def test_a_unit_of_two_meanings_is_asked(tmp_path, column, unit, meanings):
    write(tmp_path / "a.csv", rows(1.0), f"time_s,{column},x_mm")
    question, _ = start_campaign(tmp_path).questions
    assert f"the unit of column {column}; '{unit}' stands there now" in question
    text = (tmp_path / "campaign.toml").read_text()
    assert f'unit = "{unit}"  # TO FILL IN: {meanings}' in text


def test_a_free_decay_is_a_transient(tmp_path):
    time = np.arange(2000) / 100
    angle = np.exp(-0.2 * time) * np.cos(6 * time)
    write(tmp_path / "decay.csv", np.column_stack([time, angle]), "time,theta_rad")
    (run,) = start_campaign(tmp_path).campaign.runs
    assert run.kind == "transient"
    assert "free oscillation" in (tmp_path / "model.py").read_text()


def test_parts_of_a_file_become_runs(tmp_path):
    both = np.vstack([rows(2.0), rows(1.0)])
    write(tmp_path / "all.csv", both, "time_s;F_N;x_mm", sep=";")
    found = start_campaign(tmp_path).campaign
    assert [one.label for one in found.runs] == ["all 1", "all 2"]
    assert [one.time.size for one in found.runs] == [400, 400]


def test_a_file_that_cannot_be_read_is_left_out(folder):
    (folder / "broken.mat").write_bytes(b"no such format" * 20)
    found = start_campaign(folder)
    assert any(note.startswith("broken.mat was left out") for note in found.notes)
    assert len(found.campaign.runs) == 3


def test_a_damaged_time_column_is_told(tmp_path):
    write(tmp_path / "a.csv", rows(1.0), "time_s,F_N,x_mm")
    file = tmp_path / "a.csv"
    file.write_text(file.read_text().replace("\n0.5,", "\nabc,", 1))
    found = start_campaign(tmp_path)
    assert "column time_s was left out: file a.csv, column time_s: not a number" in found.notes[0]


def test_a_folder_without_records_is_refused(tmp_path):
    with pytest.raises(CampaignError, match="no file here holds a record"):
        start_campaign(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("periods", [2.5, 7.3, 40.0])
def test_the_frequency_is_that_of_the_whole_motion(periods):
    """A strong harmonic, as of a pressure that does not tell the directions, misleads nobody."""
    time = np.arange(4000) / 500
    turn = 2 * np.pi * periods / 8.0 * time
    noise = np.random.default_rng(1).normal(size=(2, time.size))
    values = np.array([np.cos(turn) + 0.2 * np.cos(3 * turn), np.cos(2 * turn)]) + 0.05 * noise
    assert guess_frequency(values, time) == pytest.approx(periods / 8.0, rel=0.01)


@pytest.mark.parametrize("drift", [0.0, 0.3, 5.0])
def test_a_channel_that_only_drifts_does_not_hide_the_period(drift):
    """A temperature is logged beside the others: noise about a slow rise."""
    rng, time = np.random.default_rng(4), np.arange(2400) / 200.0
    wave = np.sin(2 * np.pi * 1.5 * time) + 0.01 * rng.normal(size=time.size)
    rise = 24.0 + drift * time / 12.0 + 0.05 * rng.normal(size=time.size)
    assert guess_frequency(np.stack([wave, rise]), time) == pytest.approx(1.5, rel=1e-3)
    assert guess_frequency(rise[None], time) is None
    # What moves and does not repeat makes a transient of all.
    decay = np.exp(-time / 4.0) * np.cos(2 * np.pi * 4.0 * time)
    assert guess_frequency(np.stack([wave, decay, rise]), time) is None


def test_noise_and_chirps_do_not_repeat():
    time = np.arange(4000) / 500
    rng = np.random.default_rng(4)
    assert guess_frequency(rng.normal(size=(1, 4000)), time) is None
    assert guess_frequency(np.sin(2 * np.pi * (0.5 + time) * time)[None], time) is None


def test_a_line_of_blocks_goes_from_low_to_high():
    assert sparkline(np.arange(8.0), 8) == "▁▂▃▄▅▆▇█"
    assert len(sparkline(np.zeros(500), 48)) == 48
