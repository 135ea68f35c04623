"""Run files of every kind give the same columns."""

import numpy as np
import pandas as pd
import pytest
import scipy.io
import xarray as xr

from bayesoleo.data import load_campaign
from bayesoleo.data._files import read_columns
from bayesoleo.errors import CampaignError

VALUES = np.column_stack([np.arange(8) * 0.5, np.arange(8.0) ** 2, np.linspace(-1, 1, 8)])


def text(delimiter, header):
    lines = [delimiter.join(f"{cell:.9g}" for cell in row) for row in VALUES]
    return "\n".join([header, *lines]) + "\n"


@pytest.mark.parametrize(
    ("content", "options"),
    [
        (text(",", "t,a,b"), {}),
        (text(";", "t;a;b"), {}),
        (text("\t", "t\ta\tb"), {}),
        (text("  ", "t a b"), {}),
        (text("  ", "#t,a,b"), {"delimiter": "whitespace", "header_delimiter": ","}),
        (text(" ", "# t,a,b"), {}),
        ("# made by hand\n\n" + text(",", '"t","a","b"'), {}),
        ("\ufeff" + text(",", "# t, a, b").replace("\n", "\r\n"), {}),
    ],
)
def test_text(tmp_path, content, options):
    path = tmp_path / "run.exp"
    path.write_bytes(content.encode())
    check(read_columns(path, **options))


def check(columns):
    for name, expected in zip(("t", "a", "b"), VALUES.T, strict=True):
        np.testing.assert_allclose(columns[name], expected, rtol=1e-8)


def test_a_line_may_be_longer_than_a_cell(tmp_path):
    """Python's csv takes a line without its delimiter for one cell, of 128 kB at most."""
    count = 30_000
    head = ",".join(["t", "a", "b", *(f"c{k}" for k in range(count))])
    lines = [",".join([f"{cell:.9g}" for cell in row] + ["0"] * count) for row in VALUES]
    (tmp_path / "run.csv").write_text("\n".join([head, *lines]) + "\n")
    check(read_columns(tmp_path / "run.csv"))


def test_binary_formats(tmp_path):
    columns = dict(zip(("t", "a", "b"), VALUES.T, strict=True))
    scipy.io.savemat(tmp_path / "run.mat", columns | {"note": "hand made", "rate": 2.0})
    pd.DataFrame(columns | {"note": ["x"] * 8}).to_parquet(tmp_path / "run.parquet")
    data = xr.Dataset({name: ("sample", values) for name, values in columns.items()})
    data.to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    for name in ("run.mat", "run.parquet", "run.nc"):
        found = read_columns(tmp_path / name)
        assert set(found) == {"t", "a", "b"}
        check(found)


def test_text_in_a_column_that_is_not_wanted_does_not_matter(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,a,note\n0,1,good\n1,2,bad\n")
    assert set(read_columns(path, wanted={"t", "a"})) == {"t", "a"}
    with pytest.raises(CampaignError, match=r"column note: not a number in line 2 \(got 'good'\)"):
        read_columns(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "file is empty"),
        ("t,a\n", "header and no values"),
        ("t,a,b\n0,1\n1,2\n", "key delimiter: header has 3 columns and the values 2"),
        (
            "# rig\nt,a\n\n0,1\n# pause\n1,2\n2,x\n",
            r"column a: not a number in line 7 \(got 'x'\); write numbers only",
        ),
        ("t,a,a\n0,1,1\n1,2,1\n", "column a: two columns have this name"),
        (
            "t,a,b\n0,1,\n1,2,\n2,3,\n",
            "column b, key delimiter: column is more than half empty when split by ','",
        ),
        ("t,a\n0,1\n1,2,3\n", r"line 3 has 3 cells, the header 2 \(got '1,2,3'\); correct that"),
        ("t;a\n0;1\n\n# a;b;c\n1;2;3\n2;3\n", "line 5 has 3 cells, the header 2"),
        ("t,a\n0,1\n1,2\nt,a\n0,1\n1,2\n", "the names stand in line 1 and once more in line 4"),
        (
            "t,a\n" + "0,1\n1,2\n" * 9 + "t,a\n0,1\n",
            r"not a number in line 20 \(got '.'\); the names stand here once more",
        ),
        ("t,a\n0,x\n1,2\n2,3\n", r"column a: not a number in line 2 \(got 'x'\)"),
        ("t;a\n0,1;2,5\n0,2;2.5\n0,3;2,5\n", "column a: not a number in line 3"),
    ],
)
def test_bad_text(tmp_path, content, message):
    path = tmp_path / "run.csv"
    path.write_text(content)
    with pytest.raises(CampaignError, match=message):
        read_columns(path)


@pytest.mark.parametrize("suffix", [".mat", ".parquet", ".nc"])
def test_broken_binary_file(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    path.write_bytes(b"no such format" * 20)
    with pytest.raises(CampaignError, match=f"cannot be read as {suffix}|is no|version"):
        read_columns(path)


def test_a_spreadsheet_has_to_be_exported(tmp_path):
    path = tmp_path / "run.xlsx"
    path.write_bytes(b"PK" + bytes(20))
    with pytest.raises(CampaignError, match=r"spreadsheet \(got '.xlsx'\); export it as CSV"):
        read_columns(path)


def test_not_text(tmp_path):
    path = tmp_path / "run.dat"
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(CampaignError, match="not a text file"):
        read_columns(path)


@pytest.mark.parametrize(
    ("old", "new", "line", "hint"),
    [
        ("0.6", "abc", r"line 32 \(got 'abc'\)", "write numbers only"),
        ("0.6,", "0.6;", r"line 32 \(got '0.6;", "separate its numbers by ','"),
    ],
)
def test_a_damaged_time_is_told_and_not_missed(make_campaign, old, new, line, hint):
    """A cell that is no number leaves out no column of time that nobody declares."""
    folder = make_campaign()
    file = folder / "a.csv"
    rows = file.read_text().split("\n")
    assert rows[31].startswith(old)
    rows[31] = rows[31].replace(old, new, 1).replace(",", ";" if ";" in new else ",")
    file.write_text("\n".join(rows))
    message = rf"file a.csv, run a, column time_s: not a number in {line}.*; {hint}.*sample_rate"
    with pytest.raises(CampaignError, match=message):
        load_campaign(folder)


def test_a_damaged_time_does_not_matter_where_the_rate_is_stated(make_campaign):
    folder = make_campaign({"frequency = 1.0": "frequency = 1.0\nsample_rate = 50.0"})
    file = folder / "a.csv"
    file.write_text(file.read_text().replace("\n0.6,", "\nabc,", 1))
    assert load_campaign(folder).runs[0].time_step == pytest.approx(0.02)
