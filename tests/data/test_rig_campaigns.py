"""Keys of a campaign that say which part of which file is a run."""

import numpy as np
import pytest
import scipy.io
from small_table import TOML, table

from bayesoleo.data import load_campaign
from bayesoleo.errors import CampaignError, DataWarning


def make(folder, text, run="", top="", name="a.csv", toml=TOML):
    """A campaign whose run file has this text, with further keys of the run and of the top."""
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text)
    toml = toml.replace('"a.csv"', f'"{name}"').replace(
        "frequency = 1.0", f"frequency = 1.0\n{run}"
    )
    (folder / "campaign.toml").write_text(f"{top}\n{toml}")
    return folder


def csv(rows, header="time_s,x_mm,f_kN"):
    return "\n".join([header, *(",".join(f"{v:.9g}" for v in row) for row in rows)]) + "\n"


def test_a_run_may_name_columns_of_its_own(tmp_path):
    rows = np.column_stack([table(), 2 * table()[:, 1]])
    folder = make(tmp_path, csv(rows, "time_s,x_mm,f_kN,x2"), 'columns = { displacement = "x2" }')
    (run,) = load_campaign(folder).runs
    np.testing.assert_allclose(run.samples["displacement"], 2e-3 * table()[:, 1], rtol=1e-7)
    np.testing.assert_allclose(run.samples["force"], 1e3 * table()[:, 2], rtol=1e-7)


def test_two_runs_of_one_file_by_columns_are_no_double(tmp_path):
    rows = np.column_stack([table(), 2 * table()[:, 1:]])
    text = csv(rows, "time_s,x_mm,f_kN,x2,f2")
    second = (
        '\n[[runs]]\nlabel = "b"\nfile = "a.csv"\nfrequency = 1.0\n'
        'columns = { displacement = "x2", force = "f2" }\n'
    )
    folder = make(tmp_path, text, toml=TOML + second)
    assert [run.label for run in load_campaign(folder).runs] == ["a", "b"]


BAD = [
    ("rows = [1, 900]", "key rows: the file has 150 rows"),
    ("rows = [5, 5]", "key rows: must be the first and the last row"),
    ("segment = 2", "key segment: time starts anew 0 times"),
    ("segment = 0", "key segment: is no part of a file"),
    ('segment = { column = "x_mm", value = 99 }', "column x_mm, key segment: no row has this"),
    ("rows = [1, 100]\nsegment = 1", "key segment: rows and segment are both given"),
    ('columns = { stroke = "x" }', "key columns.stroke: no such channel; one of: displacement"),
    ('columns = { force = "F" }', "column F: no such column"),
    ('time_unit = "fortnight"', "key time_unit: is no unit of time"),
    ('encoding = "klingon"', "key encoding: cannot be read in this encoding"),
]


@pytest.mark.parametrize(("run", "message"), BAD)
def test_bad_parts_are_refused(tmp_path, run, message):
    with pytest.raises(CampaignError, match=message):
        load_campaign(make(tmp_path, csv(table()), run))


def test_a_file_outside_the_folder_needs_saying_so(tmp_path):
    (tmp_path / "out.csv").write_text(csv(table()))
    inside = tmp_path / "rig"
    folder = make(inside, csv(table()), name="unused.csv", toml=TOML)
    toml = (folder / "campaign.toml").read_text().replace("unused.csv", "../out.csv")
    (folder / "campaign.toml").write_text(toml)
    with pytest.raises(
        CampaignError, match=r"outside the folder .*outside_files = true at the top"
    ):
        load_campaign(folder)
    (folder / "campaign.toml").write_text("outside_files = true\n" + toml)
    assert load_campaign(folder).runs[0].file == "../out.csv"


def test_the_unit_of_the_file_is_compared_with_the_declared_one(tmp_path):
    text = csv(table()).replace("x_mm,f_kN\n", "x_mm,f_kN\ns,mm,N\n", 1)
    with pytest.warns(
        DataWarning, match=r"column f_kN is in N, and campaign.toml that it is in kN"
    ):
        load_campaign(make(tmp_path, text))


def test_a_gap_in_an_uneven_record_is_no_jitter(tmp_path):
    rows = table()
    rng = np.random.default_rng(2)
    rows[1:-1, 0] += rng.uniform(-0.002, 0.002, rows.shape[0] - 2)
    with pytest.warns(DataWarning, match=r"unevenly spaced, 0.01\d* to 0.02\d* s apart"):
        load_campaign(make(tmp_path, csv(rows)))
    hole = np.delete(rows, np.s_[60:65], axis=0)
    with pytest.raises(CampaignError, match=r"gap of 5 missing samples after"):
        load_campaign(make(tmp_path, csv(hole)))


def test_a_sampling_time_in_the_file_is_proposed(tmp_path):
    folder = make(tmp_path, "", name="a.mat")
    columns = {"x_mm": table()[:, 1], "f_kN": table()[:, 2], "Ts": 0.02}
    scipy.io.savemat(folder / "a.mat", columns)
    with pytest.raises(CampaignError, match=r"holds Ts = 0.02; .*write sample_rate = 50"):
        load_campaign(folder)


def test_hold_out_runs_alone_can_be_loaded(tmp_path):
    folder = make(tmp_path, csv(table()), 'role = "hold-out"')
    assert [run.role for run in load_campaign(folder).runs] == ["hold-out"]
