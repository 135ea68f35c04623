"""Loading: what is good reads in SI, what is not is told in one line."""

import hashlib

import numpy as np
import pytest
import scipy.io
from small_table import TOML, table

from bayesoleo.data import load_campaign
from bayesoleo.errors import CampaignError


def test_good_campaign_is_read_in_si(make_campaign):
    folder = make_campaign()
    campaign = load_campaign(folder)
    run = campaign.run("a")
    assert campaign.controlled == "displacement"
    assert campaign.channels["force"].si_unit == "N"
    assert run.samples["displacement"][0] == pytest.approx(3e-3)
    assert run.samples["force"][0] == pytest.approx(1200.0)
    assert run.conditions["initial_pressure"] == pytest.approx(4.9e5)
    assert run.condition_sd["initial_pressure"] == pytest.approx(1e4)
    assert run.condition_units["initial_pressure"] == "Pa"
    assert run.time_step == 0.02
    assert load_campaign(folder / "campaign.toml").sha256 == campaign.sha256


def test_checksum_covers_toml_and_files(make_campaign):
    folder = make_campaign()
    whole = hashlib.sha256((folder / "campaign.toml").read_bytes())
    whole.update(hashlib.sha256((folder / "a.csv").read_bytes()).digest())
    assert load_campaign(folder).sha256 == whole.hexdigest()


def test_samples_cannot_be_changed(make_campaign):
    run = load_campaign(make_campaign()).runs[0]
    with pytest.raises(ValueError, match="read-only"):
        run.samples["force"][0] = 0.0


def test_scale_comes_before_offset(make_campaign):
    folder = make_campaign(
        {'unit = "mm"': 'unit = "mm"\nscale = -2.0\noffset = 5.0\naccuracy = 0.26\nbandwidth = 30'}
    )
    campaign = load_campaign(folder)
    expected = (-2.0 * table()[:, 1] + 5.0) * 1e-3
    np.testing.assert_allclose(campaign.runs[0].samples["displacement"], expected, atol=1e-8)
    assert campaign.channels["displacement"].accuracy == pytest.approx(0.26e-3)
    assert campaign.channels["displacement"].bandwidth == 30.0
    assert campaign.runs[0].bandwidths == {"displacement": 30.0}


def test_mean_is_removed_after_the_cut(make_campaign):
    rows = table()
    rows[:20, 1] += 1e3
    folder = make_campaign(
        {
            'unit = "mm"': 'unit = "mm"\noffset = "-mean"',
            "frequency = 1.0": "frequency = 1.0\nstart = 0.4",
        },
        rows,
    )
    run = load_campaign(folder).runs[0]
    assert run.time[0] == pytest.approx(0.4)
    assert run.samples["displacement"].mean() == pytest.approx(0.0, abs=1e-12)


def test_sample_rate_and_window(make_campaign):
    change = "frequency = 1.0\nsample_rate = 100.0\nstart = 0.1\nstop = 1.2\n"
    folder = make_campaign({"frequency = 1.0": change.replace("1.0\ns", "2.0\ns", 1)})
    run = load_campaign(folder).runs[0]
    assert run.time.size == 111
    assert run.time[0] == pytest.approx(0.1)


@pytest.mark.parametrize("name", ["time", "Time [s]", "time (s)", "t", "t_s"])
def test_a_time_column_is_known_by_its_name(make_campaign, name):
    (run,) = load_campaign(make_campaign(header=f"{name},x_mm,f_kN")).runs
    np.testing.assert_allclose(run.time, table()[:, 0], atol=1e-12)


@pytest.mark.parametrize("name", ["clock_ms", "stamp"])
def test_a_time_column_of_another_name_has_to_be_declared(make_campaign, name):
    with pytest.raises(CampaignError, match=r"no time column; .* write time = '...', or give"):
        load_campaign(make_campaign(header=f"{name},x_mm,f_kN"))


@pytest.mark.parametrize("decimals", [3, 4, 9])
def test_rounded_time_stamps_are_forgiven(make_campaign, decimals):
    rows = table()
    rows[:, 0] = np.round(np.arange(len(rows)) / 151.7, decimals)
    rows[:, 1:] = table(3.0, 50)[:, 1:]
    run = load_campaign(make_campaign({"frequency = 1.0": "frequency = 3.0"}, rows)).runs[0]
    assert run.time_step == pytest.approx(1 / 151.7, rel=10.0 ** (-decimals))
    assert np.ptp(np.diff(run.time)) < 1e-12


def test_a_cut_leaves_out_what_is_wrong_before_it(make_campaign):
    """What the errors about gaps and clocks advise has to work."""
    late = {"frequency = 1.0": "frequency = 1.0\nstart = 0.6"}
    whole = load_campaign(make_campaign(late)).runs[0]
    gap = np.delete(table(), slice(10, 20), axis=0)
    back = table()
    back[5, 0] = 0.0
    unknown = table()
    unknown[3, 0] = np.nan
    for rows in (gap, back, unknown):
        (run,) = load_campaign(make_campaign(late, rows)).runs
        np.testing.assert_allclose(run.time, whole.time, atol=1e-12)
    bad = table()
    bad[60, 0] = 0.1
    with pytest.raises(CampaignError, match=r"time does not increase in row 61 .* sort the rows"):
        load_campaign(make_campaign(late, bad))


def changed(column, row, value):
    rows = table()
    rows[row, column] = value
    return rows


BAD_VALUES = [
    (changed(1, 30, np.nan), "run a, column x_mm: 1 missing value.* first at 0.6 s"),
    (
        changed(1, slice(60, 62), np.inf),
        r"run a, column x_mm: 2 infinite .* row 61, at 1.2 s .got inf.; write",
    ),
    (changed(0, 30, np.inf), r"run a, column time_s: infinite time in row 31 .got inf."),
    (changed(0, 30, 0.1), "run a, column time_s: time does not increase in row 31"),
    (changed(0, 30, np.nan), "run a, column time_s: no time in row 31"),
    (np.delete(table(), 30, axis=0), "run a, column time_s: gap of 1 missing sample.* after 0.58"),
    (np.delete(table(), np.s_[30:61], axis=0), "run a, column time_s: gap of 31 missing sample"),
    (changed(0, 30, 0.607), "run a, column time_s: spacing at .* instead of 0.02 s"),
    (
        changed(2, slice(None), 1.0),
        "run a, column f_kN: channel is constant .got 1.0.; make it a condition",
    ),
    (table(1.5), r"run a, key frequency: fewer than two periods .*\(got 1.0\)"),
    (
        changed(1, slice(20, -1), np.nan),
        "run a, column x_mm, key delimiter: column is more than half empty",
    ),
]


@pytest.mark.parametrize(("rows", "message"), BAD_VALUES)
def test_bad_values(make_campaign, rows, message):
    with pytest.raises(CampaignError, match=f"file a.csv, {message}") as caught:
        load_campaign(make_campaign(rows=rows))
    assert "\n" not in str(caught.value)


BAD_TOML = [
    ({"format = 1": "format = 2"}, r"key format: unknown .* format \(got 2\); write format = 1"),
    ({"format = 1": ""}, "key format: unknown campaign format .*write format = 1"),
    ({"format = 1": "format = ="}, "campaign.toml: not valid TOML"),
    ({'"mm"': "mm"}, 'not valid TOML: .*; text needs quotes: unit = "mm"'),
    ({"= 1.0": "= 1.0 Hz"}, "not valid TOML: .*; a number stands alone: frequency = 1.0"),
    ({'name = "small"': ""}, "key name: missing"),
    ({'name = "small"': "name = 3"}, r"key name: wrong kind of value \(got 3\)"),
    (
        {'controlled = "disp': 'controled = "disp'},
        "key controled: unknown key; did you mean controlled",
    ),
    (
        {'controlled = "displacement"': 'controlled = "dis"'},
        "controlled channel is not declared .*one of: displ",
    ),
    (
        {'column = "x_mm"': 'column = "x_m"'},
        "run a, column x_m: no such column; did you mean x_mm.*f_kN",
    ),
    ({'column = "x_mm"': 'colum = "x_mm"'}, "key channels.displacement.colum: unknown key"),
    (
        {'column = "f_kN"': 'column = "x_mm"'},
        "key channels.force.column: is the column of channel displacement already .*'x_mm'",
    ),
    (
        {'unit = "mm"': 'unit = "furlog"'},
        r"key channels.displacement.unit: unknown unit \(got 'furlog'\)",
    ),
    ({'unit = "kN"': 'unit = "lb"'}, "key channels.force.unit: unit does not measure force .*lbf"),
    (
        {'unit = "mm"': 'unit = "mm"\nscale = 0.0'},
        "key channels.displacement.scale: must not be zero",
    ),
    ({'unit = "mm"': 'unit = "mm"\noffset = "mean"'}, "displacement.offset: wrong kind .*'-mean'"),
    (
        {'file = "a.csv"': 'file = "b.csv"'},
        "file b.csv, run a: no such file; the folder holds a.csv",
    ),
    (
        {'kind = "periodic"': 'kind = "periodical"'},
        "key kind: unknown kind .*did you mean periodic",
    ),
    ({'kind = "periodic"': 'role = "holdout"'}, "key role: unknown role .*did you mean hold-out"),
    ({'kind = "periodic"': 'kind = "transient"'}, "transient run with a frequency"),
    ({"frequency = 1.0": ""}, "run a, key frequency: periodic run without frequency"),
    ({"frequency = 1.0": "frequency = -1"}, r"key frequency: must be positive \(got -1"),
    (
        {"frequency = 1.0": "frequency = 30"},
        "key frequency: fewer than four samples a period at 50 Hz",
    ),
    (
        {"frequency = 1.0": "frequency = 1.0\nfreq = 2"},
        "run a, key freq: unknown key; did you mean",
    ),
    ({"frequency = 1.0": "frequency = 1.0\ntime = 't'"}, "run a, column t: no such column"),
    (
        {"frequency = 1.0": "frequency = 1.0\ntime = 't'\nsample_rate = 1"},
        "time and sample_rate are both",
    ),
    (
        {"frequency = 1.0": "frequency = 1.0\nstart = 9.0"},
        "key start: fewer than three samples .*from 0 to 2.98 s",
    ),
    (
        {"frequency = 1.0": "frequency = 1.0\nstart = 2.0\nstop = 1.0"},
        "key stop: stop is not after start",
    ),
    (
        {'{ value = 4.9, unit = "bar", sd = 0.1 }': "4.9e5"},
        "conditions.initial_pressure: malformed condition",
    ),
    (
        {'4.9, unit = "bar"': '4.9, unit = "K"'},
        "initial_pressure.unit: unit does not measure pressure",
    ),
    ({"sd = 0.1": "sd = -0.1"}, "conditions.initial_pressure.sd: must be positive"),
    ({"sd = 0.1": "std = 0.1"}, "conditions.initial_pressure.std: unknown key"),
    ({"format = 1": 'format = 1\ndataset = "silverboks"'}, "key dataset: data set is not here"),
]


@pytest.mark.parametrize(("replace", "message"), BAD_TOML)
def test_bad_declarations(make_campaign, replace, message):
    with pytest.raises(CampaignError, match=message) as caught:
        load_campaign(make_campaign(replace))
    assert "\n" not in str(caught.value)


def test_two_runs_of_the_same_samples(make_campaign):
    """A slip of the pen in a file's name would hold a run out from itself."""
    end = 'initial_pressure = { value = 4.9, unit = "bar", sd = 0.1 }\n'
    again = TOML[TOML.index("[[runs]]") :].replace('label = "a"', 'label = "b"')
    with pytest.raises(CampaignError, match=r"a.csv, run b, key file: .*the same samples as run a"):
        load_campaign(make_campaign({end: end + again}))
    second = again.replace("frequency = 1.0", "frequency = 1.0\nstart = 2.0")
    first = {"frequency = 1.0": "frequency = 1.0\nstop = 2.0", end: end + second}
    assert len(load_campaign(make_campaign(first, table(4.0))).runs) == 2


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('label = "a"', 'label = "a\\u0000"', "label"),
        ("initial_pressure =", '"initial\\u0000pressure" =', "initial"),
    ],
)
def test_a_null_character_is_refused(make_campaign, old, new, key):
    with pytest.raises(CampaignError, match=f"key {key}.*: text holds a null character"):
        load_campaign(make_campaign({old: new}))


def test_two_runs_of_one_label(make_campaign):
    run = TOML[TOML.index("[[runs]]") :]
    with pytest.raises(CampaignError, match="run a, key label: two runs have this label"):
        load_campaign(make_campaign({run: run + run}))


def test_no_campaign(tmp_path):
    with pytest.raises(CampaignError, match=r"campaign.toml: no such file; a campaign is a folder"):
        load_campaign(tmp_path)
    with pytest.raises(CampaignError, match=r"nowhere: no such folder; a campaign is a folder"):
        load_campaign(tmp_path / "nowhere")
    (tmp_path / "rig.csv").write_text("t,a\n")
    with pytest.raises(CampaignError, match=r"rig.csv: is a file; a folder is expected; a camp"):
        load_campaign(tmp_path / "rig.csv")


def test_unknown_run(make_campaign):
    with pytest.raises(CampaignError, match="run b: no such run; one of: a"):
        load_campaign(make_campaign()).run("b")


def test_columns_of_different_length(make_campaign):
    folder = make_campaign({'"a.csv"': '"a.mat"', "frequency = 1.0": "frequency = 1.0\nstop = 2.0"})
    time, displacement, force = table().T
    columns = {"time_s": time[:-1], "x_mm": displacement, "f_kN": force}
    scipy.io.savemat(folder / "a.mat", columns)
    message = "run a, column x_mm: column has 150 samples and time 149"
    with pytest.raises(CampaignError, match=message):
        load_campaign(folder)
