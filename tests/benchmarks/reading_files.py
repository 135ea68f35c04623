"""Files as test rigs write them, each made by the library that people write it with.

Every case holds the same three periods of a motion in mm and a force in kN; a case writes them into
a folder and says what ``campaign.toml`` has to state about them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

RATE, FREQUENCY, PERIODS = 200.0, 1.0, 3
TIME = np.arange(round(PERIODS * RATE / FREQUENCY)) / RATE
MOTION = 10.0 * np.sin(2 * np.pi * TIME) + 0.3
FORCE = 2.0 * np.cos(2 * np.pi * TIME) + 0.2 * np.cos(6 * np.pi * TIME)
NAMES = ("time", "x", "F")


@dataclass(frozen=True)
class Case:
    """A kind of file.

    Parameters
    ----------
    name : str
    file : str
        Its name.
    write : callable
        Takes the path.
    columns : tuple of str
        Of motion and force.
    run : str
        Further keys of the run.
    needs : tuple of str
        Modules that write or read it.
    tolerance : float
        Of the values, relative to their range: how many digits the file keeps.
    units : tuple of str
        Of motion and force.
    expected : mapping
        Values that differ from the common ones.
    """

    name: str
    file: str
    write: Callable[[Path], None]
    columns: tuple[str, str] = ("x", "F")
    run: str = ""
    needs: tuple[str, ...] = ()
    tolerance: float = 1e-6
    units: tuple[str, str] = ("mm", "kN")
    note: str = ""
    expected: Mapping[str, np.ndarray] = field(default_factory=dict)


def campaign(case: Case, folder: Path) -> Path:
    """Write the file and a campaign of one run."""
    folder.mkdir(parents=True, exist_ok=True)
    case.write(folder / case.file)
    channels = zip(_names(case), case.columns, case.units, strict=True)
    tables = [
        f"[channels.{name}]\ncolumn = {json.dumps(column)}\nunit = {json.dumps(unit)}\n"
        for name, column, unit in channels
    ]
    run = f'[[runs]]\nlabel = "a"\nfile = "{case.file}"\nfrequency = {FREQUENCY}\n{case.run}\n'
    text = "\n".join(['format = 1\nname = "rig"\n', *tables, run])
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return folder


def _names(case: Case) -> tuple[str, str]:
    """Channels; that of a force has a unit of force."""
    return ("displacement", "signal" if case.units == ("1", "1") else "force")


def check(case: Case, folder: Path) -> None:
    """Load the campaign and compare it with what was written."""
    from bayesoleo.data import load_campaign

    (run,) = load_campaign(folder).runs
    np.testing.assert_allclose(run.time_step, 1 / RATE, rtol=1e-6)
    sets = zip(_names(case), (MOTION, FORCE), (1e-3, 1e3), strict=True)
    for name, values, factor in sets:
        expected = case.expected.get(name, values) * factor
        if case.units == ("1", "1"):  # sound: parts of full scale
            expected = expected / factor / 20.0
        assert run.samples[name].size == expected.size, (run.samples[name].size, expected.size)
        off = np.max(np.abs(run.samples[name] - expected))
        assert off <= case.tolerance * np.ptp(expected), off


def table(names: tuple[str, ...] = NAMES, time: np.ndarray = TIME) -> pd.DataFrame:
    """The values as a table."""
    return pd.DataFrame(dict(zip(names, (time, MOTION, FORCE), strict=True)))


def csv(names: tuple[str, ...] = NAMES, time: np.ndarray = TIME, **options: object) -> Callable:
    """A writer by pandas."""

    def write(path: Path) -> None:
        table(names, time).to_csv(path, index=False, **{"float_format": "%.9g", **options})

    return write


def text(
    above: str,
    *,
    sep: str = ";",
    decimal: str = ".",
    encoding: str = "utf-8",
    end: str = "",
    newline: str = "\n",
    time: np.ndarray = TIME,
    below: str = "",
) -> Callable[[Path], None]:
    """A writer of lines above the values, and the values by NumPy."""

    def write(path: Path) -> None:
        rows = np.column_stack([time, MOTION, FORCE])
        lines = [sep.join(f"{v:.9g}" for v in row).replace(".", decimal) + end for row in rows]
        content = newline.join([*above.splitlines(), *lines, *below.splitlines(), ""])
        path.write_bytes(content.encode(encoding))

    return write


PREAMBLE = """Test rig 7;hydraulic
Operator;A. Müller
Date;2024-05-03
Sample rate;200
Channels;3

time;x;F
s;mm;kN"""
CATMAN = """catman 5.1
Kanäle: 3
Zeit  1 - Standardmessrate [s]\tWeg [mm]\tKraft [kN]"""
LVM = """LabVIEW Measurement
Writer_Version\t2
Separator\tTab
***End_of_Header***

Channels\t2
Samples\t600\t600
X_Dimension\tTime\tTime
***End_of_Header***
X_Value\tx\tF\tComment"""


def clock(day: str) -> Callable[[Path], None]:
    """A time column of dates, or of times of day."""

    def write(path: Path) -> None:
        stamps = pd.Timestamp("2024-05-03 12:00:00") + pd.to_timedelta(TIME, unit="s")
        made = table()
        made["time"] = stamps.strftime(day)
        made.to_csv(path, index=False, float_format="%.9g")

    return write


def ragged(path: Path) -> None:
    """A sampling time in the first row only, and every row ends in a comma."""
    lines = ['"time","x","F","Ts",']
    for k, row in enumerate(np.column_stack([TIME, MOTION, FORCE])):
        lines.append(",".join(f"{v:.9g}" for v in row) + (",0.005," if k == 0 else ",,"))
    path.write_text("\n".join(lines) + "\n")


def two_runs_by_column(path: Path) -> None:
    """Another, shorter run stands in further columns."""
    made = table(("t1", "x1", "F1"))
    for name, values in (("t2", TIME), ("x2", 2 * MOTION), ("F2", 2 * FORCE)):
        made[name] = pd.Series(values[:-150])
    made[["t2", "x2", "F2", "t1", "x1", "F1"]].to_csv(path, index=False, float_format="%.9g")


def two_runs_by_segment(path: Path) -> None:
    """Time starts anew."""
    other = table().assign(x=-MOTION, F=-FORCE)
    pd.concat([other, table()]).to_csv(path, index=False, float_format="%.9g")


def two_runs_by_number(path: Path) -> None:
    """A column numbers the runs."""
    other = table().assign(x=-MOTION, F=-FORCE, run=1)
    pd.concat([other, table().assign(run=2)]).to_csv(path, index=False, float_format="%.9g")


def mat(**options: object) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        from scipy.io import savemat

        columns = dict(zip(NAMES, (TIME, MOTION, FORCE), strict=True))
        savemat(path, {**columns, "Ts": 1 / RATE, "other": np.arange(7.0)}, **options)

    return write


def mat_structure(path: Path) -> None:
    from scipy.io import savemat

    cells = np.empty((1, 2), dtype=object)
    cells[0, 0], cells[0, 1] = MOTION[:100], MOTION
    savemat(path, {"data": {"t": TIME, "F": FORCE}, "Y": cells, "X": np.eye(3)})


def mat_new(path: Path) -> None:
    import hdf5storage

    columns = {"time": TIME[:, None], "x": MOTION[:, None], "rig": {"F": FORCE[:, None]}}
    hdf5storage.savemat(str(path), columns, format="7.3")


def hdf(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        group = file.create_group("run 1")
        for name, values in zip(NAMES, (TIME, MOTION, FORCE), strict=True):
            group[name] = values
        group["x"].attrs["units"] = "mm"


def hdf_table(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["all"] = np.column_stack([TIME, MOTION, FORCE])


def netcdf(engine: str, **options: object) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import xarray as xr

        content = {"x": ("time", MOTION), "F": ("time", FORCE)}
        coordinates = {"time": ("time", TIME, {"units": "s"})}
        xr.Dataset(content, coordinates).to_netcdf(path, engine=engine, **options)

    return write


def tdms(groups: int, waveform: bool) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        from nptdms import ChannelObject, TdmsWriter

        about = {"wf_increment": 1 / RATE, "unit_string": "mm"} if waveform else {}
        values = dict(zip(NAMES, (TIME, MOTION, FORCE), strict=True))
        if waveform:
            values.pop("time")
        found = []
        for group in range(1, groups + 1):
            sign = 1.0 if group == groups else -1.0
            for name, one in values.items():
                unit = {"unit_string": {"x": "mm", "F": "kN"}[name]} if waveform else {}
                data = one if name == "time" else sign * one
                found.append(ChannelObject(f"run {group}", name, data, {**about, **unit}))
        with TdmsWriter(path) as writer:
            writer.write_segment(found)

    return write


def uff(path: Path) -> None:
    import pyuff

    file, found = pyuff.UFF(str(path)), []
    for number, (name, values, unit) in enumerate((("x", MOTION, "mm"), ("F", FORCE, "kN")), 1):
        record = pyuff.prepare_58(
            binary=0,
            func_type=1,
            rsp_node=number,
            rsp_dir=1,
            ref_node=1,
            ref_dir=1,
            ref_ent_name="NONE",
            rsp_ent_name="NONE",
            data=values,
            x=TIME,
            id1=name,
            id2="",
            id3="",
            id4="",
            id5="",
            load_case_id=0,
            ord_data_type=4,
            abscissa_spacing=1,
            abscissa_min=0.0,
            abscissa_inc=1 / RATE,
            ordinate_axis_units_lab=unit,
            abscissa_spec_data_type=17,
            ordinate_spec_data_type=8,
            orddenom_spec_data_type=0,
            z_axis_spec_data_type=0,
            return_full_dict=True,
        )
        record = {key: item for key, item in record.items() if item is not None}
        found.append(record)
    file.write_sets(found, "overwrite")


def wav(dtype: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        from scipy.io import wavfile

        parts = np.column_stack([MOTION, FORCE]) / 20.0
        if dtype.startswith("int"):
            parts = np.round(parts * -float(np.iinfo(dtype).min))
        wavfile.write(path, int(RATE), parts.astype(dtype))

    return write


def records(path: Path) -> None:
    table().to_json(path, orient="records", double_precision=12)


def json_columns(path: Path) -> None:
    path.write_text(json.dumps({name: list(table()[name]) for name in NAMES}))


def json_rows(path: Path) -> None:
    rows = np.column_stack([TIME, MOTION, FORCE]).tolist()
    path.write_text(json.dumps({"data": rows, "dt": 1 / RATE, "displacement units": "mm"}))


def json_lines(path: Path) -> None:
    table().to_json(path, orient="records", lines=True, double_precision=12)


def jittered() -> np.ndarray:
    """Times of a clock that jitters by a tenth of a sample."""
    rng = np.random.default_rng(3)
    moved = TIME + rng.uniform(-0.1, 0.1, TIME.size) / RATE
    moved[[0, -1]] = TIME[[0, -1]]
    return moved


def uneven(path: Path) -> None:
    time = jittered()
    motion = np.interp(time, TIME, MOTION)
    values = {
        "time": time,
        "x": 10.0 * np.sin(2 * np.pi * time) + 0.3,
        "F": 2.0 * np.cos(2 * np.pi * time) + 0.2 * np.cos(6 * np.pi * time),
    }
    assert motion.size == time.size
    pd.DataFrame(values).to_csv(path, index=False, float_format="%.12g")


def remarks(path: Path) -> None:
    """Remarks stand beyond the last column of some rows."""
    lines = ["time,x,F"]
    for k, row in enumerate(np.column_stack([TIME, MOTION, FORCE])):
        lines.append(",".join(f"{v:.9g}" for v in row) + (",valve opened" if k == 40 else ""))
    path.write_text("\n".join(lines) + "\n")


GERMAN = ("Zeit [s]", "Weg [mm]", "Kraft [kN]")
_XF = ("x", "F")
#: All kinds of file.
CASES = (
    Case("csv", "a.csv", csv()),
    Case("semicolon", "a.csv", csv(sep=";")),
    Case("tab", "a.txt", csv(sep="\t")),
    Case("blanks", "a.dat", text("time x F", sep="   ")),
    Case("pipe", "a.txt", csv(sep="|")),
    Case("decimal comma", "a.csv", csv(sep=";", decimal=",")),
    Case("decimal comma and tab", "a.asc", csv(sep="\t", decimal=",")),
    Case("decimal comma and blanks", "a.asc", text("time x F", sep="  ", decimal=",")),
    Case("preamble and units", "a.csv", text(PREAMBLE)),
    Case(
        "preamble, decimal comma, cp1252", "a.csv", text(PREAMBLE, decimal=",", encoding="cp1252")
    ),
    Case(
        "catman",
        "a.asc",
        text(CATMAN, sep="\t", decimal=",", encoding="cp1252"),
        ("Weg [mm]", "Kraft [kN]"),
        'time = "Zeit  1 - Standardmessrate [s]"',
    ),
    Case("LabVIEW lvm", "a.lvm", text(LVM, sep="\t")),
    Case("commented header", "a.exp", text("# made by hand\n# time, x, F", sep="  ")),
    Case("percent header", "a.txt", text("% time x F", sep=" ")),
    Case("no header", "a.csv", text("", sep=","), ("2", "3"), 'time = "1"'),
    Case("trailing delimiter", "a.csv", text("time;x;F;", end=";")),
    Case("trailing delimiter of values", "a.csv", text("time,x,F", sep=",", end=",")),
    Case("ragged column", "a.csv", ragged),
    Case("remarks in rows", "a.csv", remarks),
    Case("cp1252", "a.csv", csv(GERMAN, sep=";", encoding="cp1252"), GERMAN[1:]),
    Case("utf-16", "a.csv", csv(sep="\t", encoding="utf-16")),
    Case("utf-16 without mark", "a.csv", csv(encoding="utf-16-le")),
    Case("byte order mark", "a.csv", csv(encoding="utf-8-sig")),
    Case(
        "shift_jis",
        "a.csv",
        csv(("時間 [s]", "変位 [mm]", "力 [kN]"), encoding="shift_jis"),
        ("変位 [mm]", "力 [kN]"),
        'time = "時間 [s]"\nencoding = "shift_jis"',
    ),
    Case("carriage returns", "a.csv", text("time,x,F", sep=",", newline="\r")),
    Case("lines of windows", "a.csv", text("time,x,F", sep=",", newline="\r\n")),
    Case("sep line of a spreadsheet", "a.csv", text("sep=;\ntime;x;F", decimal=",")),
    Case("milliseconds", "a.csv", csv(("Time [ms]", *_XF), 1e3 * TIME)),
    Case("microseconds in a row of units", "a.csv", text("time;x;F\nus;mm;kN", time=1e6 * TIME)),
    Case(
        "declared minutes",
        "a.csv",
        csv(("stamp", *_XF), TIME / 60, float_format="%.12g"),
        run='time = "stamp"\ntime_unit = "min"',
    ),
    Case("no time", "a.csv", csv(("n", *_XF), np.arange(TIME.size)), run="sample_rate = 200"),
    Case("dates", "a.csv", clock("%Y-%m-%d %H:%M:%S.%f")),
    Case("times of day", "a.csv", clock("%H:%M:%S.%f")),
    Case("uneven", "a.csv", uneven, tolerance=1e-4, note="unevenly spaced"),
    Case("two runs by column", "a.csv", two_runs_by_column, ("x1", "F1"), 'time = "t1"'),
    Case(
        "shorter run by column",
        "a.csv",
        two_runs_by_column,
        ("x2", "F2"),
        'time = "t2"',
        expected={"displacement": 2 * MOTION[:-150], "force": 2 * FORCE[:-150]},
    ),
    Case("two runs by segment", "a.csv", two_runs_by_segment, run="segment = 2"),
    Case("two runs by rows", "a.csv", two_runs_by_segment, run="rows = [601, 1200]"),
    Case(
        "two runs by number",
        "a.csv",
        two_runs_by_number,
        run='segment = { column = "run", value = 2 }',
    ),
    Case("compressed csv", "a.csv.gz", csv(compression="gzip")),
    Case("json records", "a.json", records),
    Case("json columns", "a.json", json_columns),
    Case("json rows", "a.json", json_rows, ("data(:,2)", "data(:,3)"), 'time = "data(:,1)"'),
    Case("json lines", "a.jsonl", json_lines),
    Case("MAT v4", "a.mat", mat(format="4")),
    Case("MAT v5", "a.mat", mat()),
    Case("MAT v5 compressed", "a.mat", mat(do_compression=True, oned_as="column")),
    Case("MAT structure and cells", "a.mat", mat_structure, ("Y{2}", "data.F"), 'time = "data.t"'),
    Case("MAT v7.3", "a.mat", mat_new, ("x", "rig.F"), needs=("hdf5storage",)),
    Case("TDMS", "a.tdms", tdms(1, False), needs=("nptdms",)),
    Case("TDMS waveform", "a.tdms", tdms(1, True), needs=("nptdms",)),
    Case("TDMS of two runs", "a.tdms", tdms(2, False), ("run 2/x", "run 2/F"), needs=("nptdms",)),
    Case("UFF58", "a.uff", uff, needs=("pyuff",), tolerance=1e-4),
    Case("Parquet", "a.parquet", lambda path: table().to_parquet(path), needs=("pyarrow",)),
    Case("Feather", "a.feather", lambda path: table().to_feather(path), needs=("pyarrow",)),
    Case("HDF5 groups", "a.h5", hdf, ("run 1/x", "run 1/F")),
    Case("HDF5 table", "a.hdf5", hdf_table, ("all(:,2)", "all(:,3)"), 'time = "all(:,1)"'),
    Case("netCDF 4", "a.nc", netcdf("h5netcdf")),
    Case("netCDF 3", "a.nc", netcdf("scipy", format="NETCDF3_CLASSIC")),
    Case(
        "WAV 16 bit",
        "a.wav",
        wav("int16"),
        ("channel 1", "channel 2"),
        tolerance=1e-4,
        units=("1", "1"),
    ),
    Case("WAV float", "a.wav", wav("float32"), ("channel 1", "channel 2"), units=("1", "1")),
    Case("NumPy", "a.npz", lambda path: np.savez(path, time=TIME, x=MOTION, F=FORCE)),
)
