"""Run files of every kind: text, MATLAB, TDMS, UFF58, JSON, Parquet, netCDF, HDF5, WAV, NumPy.

A column's name leads to it: ``force``, ``group/force`` where a file has groups, ``data.force`` a
field of a structure, ``X(:,2)`` the second column of a table, ``Y{3}`` the third cell. Columns,
cells and records are counted from one.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayesoleo._types import Array
from bayesoleo.data._text_files import read_text
from bayesoleo.data._text_layout import FileColumns
from bayesoleo.errors import CampaignError, MissingExtraError, import_extra

_SPREADSHEETS = (".xlsx", ".xlsm", ".xls", ".ods")
#: The optional dependency that brings the readers of rig formats.
FORMATS = "formats"
#: Columns of a table that are named; a wider one is an image or a matrix of another meaning.
_MOST_COLUMNS = 256


def read_columns(
    path: Path,
    delimiter: str | None = None,
    header_delimiter: str | None = None,
    wanted: Collection[str] | None = None,
) -> Mapping[str, Array]:
    """Read the numeric columns of a run file; see :func:`read_file`."""
    return read_file(path, delimiter, header_delimiter, wanted).columns


def read_file(
    path: Path,
    delimiter: str | None = None,
    header_delimiter: str | None = None,
    wanted: Collection[str] | None = None,
    encoding: str | None = None,
    progress: bool = False,
    every: bool = False,
) -> FileColumns:
    """Read a run file.

    Parameters
    ----------
    path : Path
        The ending decides how it is read; an unknown one is delimited text.
    delimiter, header_delimiter, encoding : str, optional
        Of text files; found from the file by default. ``whitespace`` stands for any run of blanks.
    wanted : collection of str, optional
        Columns that must be numbers; what others hold does not matter. All, by default.
    progress : bool, optional
        Whether to show a bar after two seconds.
    every : bool, optional
        Whether to read other columns as well, those of text left out.

    Returns
    -------
    FileColumns
        Values as written, not converted.

    Raises
    ------
    CampaignError
        If the file is missing, empty or not what its name says.
    MissingExtraError
        If a package is needed that is not installed.
    """
    if not path.is_file():
        raise CampaignError("no such file", file=path.name, hint=_neighbours(path))
    if path.stat().st_size == 0:
        raise CampaignError("file is empty", file=path.name, hint="record the run again")
    suffix = path.suffix.lower()
    if suffix in _SPREADSHEETS:
        raise CampaignError(
            "is a spreadsheet", file=path.name, value=path.suffix, hint="export it as CSV"
        )
    reader = READERS.get(suffix)
    if reader is None:
        return read_text(path, delimiter, header_delimiter, wanted, encoding, progress, every)
    try:
        found = reader(path)
    except (CampaignError, MissingExtraError):
        raise
    except Exception as error:  # each format's library raises its own types on a broken file
        raise CampaignError(
            f"cannot be read as {path.suffix}: {str(error)[:120]}", file=path.name
        ) from error
    if not found.columns:
        raise CampaignError("file has no numeric column", file=path.name)
    return found


def _neighbours(path: Path) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent.name!r}"
    names = sorted(item.name for item in path.parent.iterdir() if item.suffix != ".toml")
    return f"the folder holds {', '.join(names[:12]) or 'no files'}"


def _file_columns(
    items: Iterator[tuple[str, Array]],
    units: Mapping[str, str] | None = None,
    rates: Mapping[str, float] | None = None,
) -> FileColumns:
    """Columns of named arrays: tables become their columns, single numbers stand apart."""
    columns: dict[str, Array] = {}
    numbers: dict[str, float] = {}
    for name, value in items:
        if value.dtype.kind not in "biuf" or value.ndim > 2:
            continue
        if value.size == 1:
            numbers[name] = float(value.ravel()[0])
        elif value.size == max(value.shape, default=0):
            columns[name] = value.ravel().astype(float)
        elif value.ndim == 2:
            # The longer side is time, whichever program wrote the table.
            table = value if value.shape[0] >= value.shape[1] else value.T
            for k in range(min(table.shape[1], _MOST_COLUMNS)):
                columns[f"{name}(:,{k + 1})"] = table[:, k].astype(float)
    return FileColumns(columns, tuple(columns), units or {}, rates or {}, numbers)


def _within(name: str, value: Any) -> Iterator[tuple[str, Array]]:
    """Arrays in nested mappings, lists and MATLAB's cells, with the names that lead to them."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not str(key).startswith("__"):
                yield from _within(f"{name}.{key}" if name else str(key), item)
    elif isinstance(value, np.ndarray) and value.dtype.names:
        one = value.ravel()
        for key in value.dtype.names:
            if value.dtype[key].kind in "biuf":
                yield from _within(f"{name}.{key}" if name else key, one[key])
                continue
            for k, item in enumerate(one[key], 1):
                place = f"{name}({k})" if one.size > 1 else name
                yield from _within(f"{place}.{key}", item)
    elif isinstance(value, np.ndarray) and value.dtype == object:
        single = value.size == 1
        for k, item in enumerate(value.ravel(order="F"), 1):
            yield from _within(name if single else f"{name}{{{k}}}", item)
    elif isinstance(value, np.ndarray):
        yield name, value
    elif isinstance(value, int | float):
        yield name, np.asarray(float(value))


def _read_mat(path: Path) -> FileColumns:
    from scipy.io import loadmat

    with path.open("rb") as stream:
        head = stream.read(128)
    if head[124:126] in (b"\x00\x02", b"\x02\x00") or b"MATLAB 7.3" in head:
        return _read_hdf(path)
    return _file_columns(_within("", loadmat(path)))


def _read_hdf(path: Path) -> FileColumns:
    """HDF5 and MATLAB 7.3, which is HDF5 with references for cells."""
    import h5py

    units: dict[str, str] = {}
    with h5py.File(path) as file:
        return _file_columns(_of_group(file, file, "", units), units)


def _of_group(file: Any, group: Any, place: str, units: dict[str, str]) -> Iterator[Any]:
    import h5py

    matlab = "MATLAB_class" in group.attrs or any(
        "MATLAB_class" in item.attrs for item in group.values()
    )
    for key, item in group.items():
        if key.startswith("#"):  # MATLAB keeps what references lead to here
            continue
        name = f"{place}{'.' if matlab else '/'}{key}" if place else key
        if isinstance(item, h5py.Group):
            yield from _of_group(file, item, name, units)
        elif isinstance(item, h5py.Dataset):
            yield from _of_dataset(file, item, name, units)


def _of_dataset(file: Any, item: Any, name: str, units: dict[str, str]) -> Iterator[Any]:
    import h5py

    if h5py.check_ref_dtype(item.dtype) is not None:
        for k, reference in enumerate(np.ravel(item[()]), 1):
            target = file[reference]
            place = f"{name}{{{k}}}" if item.size > 1 else name
            if isinstance(target, h5py.Group):
                yield from _of_group(file, target, place, units)
            else:
                yield from _of_dataset(file, target, place, units)
        return
    # netCDF stores a dimension without values in this way.
    if bytes(item.attrs.get("NAME", b"")).startswith(b"This is a netCDF dimension but not"):
        return
    text = item.attrs.get("units", item.attrs.get("unit"))
    if isinstance(text, bytes):
        text = text.decode("utf-8", "replace")
    if isinstance(text, str) and text:
        units[name] = _bare_unit(text)
    if item.attrs.get("MATLAB_class", b"") not in (b"char", b"cell"):
        yield from _within(name, _unpacked(item[()], item.attrs))


def _unpacked(values: Any, about: Mapping[str, Any]) -> Any:
    """Values that netCDF stores as scaled integers, or with a number for a missing one."""
    factor, shift = about.get("scale_factor"), about.get("add_offset")
    fill = about.get("_FillValue")
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "iuf":
        return values
    if factor is None and shift is None and fill is None:
        return values
    found = values * np.ravel(1.0 if factor is None else factor)[0]
    found = np.asarray(found + np.ravel(0.0 if shift is None else shift)[0], dtype=float)
    if fill is not None:
        found[values == np.ravel(fill)[0]] = np.nan
    return found


def _bare_unit(text: str) -> str:
    """``seconds since 2020-01-01`` is a unit of time and a date."""
    return text.split(" since ")[0].strip()


def _read_netcdf(path: Path) -> FileColumns:
    with path.open("rb") as stream:
        classic = stream.read(3) == b"CDF"
    if not classic:
        return _read_hdf(path)
    from scipy.io import netcdf_file

    units: dict[str, str] = {}
    arrays: dict[str, Array] = {}
    with netcdf_file(path, mmap=False) as file:
        for name, variable in file.variables.items():
            values = np.array(variable.data)
            native = values.astype(values.dtype.newbyteorder("="))
            arrays[name] = _unpacked(native, variable._attributes)
            if isinstance(getattr(variable, "units", None), bytes):
                units[name] = _bare_unit(variable.units.decode("utf-8", "replace"))
    return _file_columns(iter(arrays.items()), units)


def _read_parquet(path: Path) -> FileColumns:
    import pandas as pd

    import_extra("pyarrow", "parquet")
    table = pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_feather(path)
    if not isinstance(table.index, pd.RangeIndex):
        table = table.reset_index()
    return _of_table(table)


def _of_table(table: Any) -> FileColumns:
    """Columns of a pandas table; dates become seconds from the first one."""
    import pandas as pd

    columns, units = {}, {}
    for name, column in table.items():
        if pd.api.types.is_datetime64_any_dtype(column):
            columns[str(name)] = (column - column.iloc[0]).dt.total_seconds().to_numpy(float)
            units[str(name)] = "s"
        elif pd.api.types.is_timedelta64_dtype(column):
            columns[str(name)] = column.dt.total_seconds().to_numpy(float)
            units[str(name)] = "s"
        elif pd.api.types.is_numeric_dtype(column):
            columns[str(name)] = column.to_numpy(dtype=float, na_value=np.nan)
    return FileColumns(columns, tuple(columns), units)


def _read_json(path: Path) -> FileColumns:
    """JSON: records, columns by name, or rows of numbers; JSON lines as well."""
    text = path.read_text(encoding="utf-8-sig")
    try:
        content = json.loads(text)
    except json.JSONDecodeError:
        if path.suffix.lower() == ".json" and "\n{" not in text:
            raise
        content = [json.loads(line) for line in text.splitlines() if line.strip()]
    units = _units_in_json(content)
    return _file_columns(_in_json("", content), units)


def _in_json(name: str, value: Any) -> Iterator[tuple[str, Array]]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _in_json(f"{name}.{key}" if name else str(key), item)
    elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
        for key in dict.fromkeys(key for item in value for key in item):
            yield from _in_json(f"{name}.{key}" if name else key, [item.get(key) for item in value])
    elif isinstance(value, list) and value:
        array = _numeric(value)
        if array is not None:
            yield name or "data", array
        elif any(isinstance(item, list | Mapping) for item in value):
            for k, item in enumerate(value, 1):
                yield from _in_json(f"{name}{{{k}}}", item)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield name, np.asarray(float(value))


def _numeric(value: list[Any]) -> Array | None:
    """A list of numbers, or of rows of numbers of one length; null is a missing value."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return array if array.ndim <= 2 and not all(isinstance(v, str) for v in value) else None


def _units_in_json(content: Any) -> dict[str, str]:
    """Units that stand beside columns under keys such as ``force units`` or in ``units``."""
    if not isinstance(content, Mapping):
        return {}
    stated = content.get("units")
    units = {str(k): str(v) for k, v in stated.items()} if isinstance(stated, Mapping) else {}
    for key, value in content.items():
        name = re.sub(r"[ _]units?$", "", str(key))
        if name != key and isinstance(value, str):
            units[name] = value
    return units


def _read_tdms(path: Path) -> FileColumns:
    file = import_extra("nptdms", FORMATS).TdmsFile.read(path)
    arrays: dict[str, Array] = {}
    units: dict[str, str] = {}
    rates: dict[str, float] = {}
    groups = file.groups()
    for group in groups:
        for channel in group.channels():
            # One group is the usual case, and its name then says nothing.
            name = channel.name if len(groups) == 1 else f"{group.name}/{channel.name}"
            values = np.asarray(channel[:])
            if values.dtype.kind == "M":
                values = (values - values[0]) / np.timedelta64(1, "s")
                units[name] = "s"
            arrays[name] = values
            about = channel.properties
            if about.get("unit_string"):
                units[name] = str(about["unit_string"])
            if about.get("wf_increment"):
                rates[name] = 1.0 / float(about["wf_increment"])
    return _file_columns(iter(arrays.items()), units, rates)


def _read_uff(path: Path) -> FileColumns:
    """Data sets 58 of a universal file: time histories; those of other kinds are left out."""
    file = import_extra("pyuff", FORMATS).UFF(str(path))
    arrays: dict[str, Array] = {}
    units: dict[str, str] = {}
    rates: dict[str, float] = {}
    for number, kind in enumerate(file.get_set_types()):
        if int(kind) != 58:
            continue
        record = file.read_sets(number)
        if np.iscomplexobj(record["data"]) or int(record.get("func_type", 1)) > 1:
            continue
        name = _uff_name(record, len(arrays) + 1, arrays)
        arrays[name] = np.asarray(record["data"], dtype=float)
        unit = str(record.get("ordinate_axis_units_lab", "")).strip()
        if unit and unit.upper() != "NONE":
            units[name] = unit
        if record.get("abscissa_spacing") == 1 and record.get("abscissa_inc"):
            rates[name] = 1.0 / float(record["abscissa_inc"])
        elif "x" in record:
            arrays.setdefault("time", np.asarray(record["x"], dtype=float))
    return _file_columns(iter(arrays.items()), units, rates)


def _uff_name(record: Mapping[str, Any], number: int, taken: Collection[str]) -> str:
    """The first line of a record's header, or its response node and direction."""
    lines = [str(record.get(key, "")).strip() for key in ("rsp_ent_name", "id1")]
    name = next((t for t in lines if t and t.upper() != "NONE" and t not in taken), "")
    return name or f"record {number}"


def _read_wav(path: Path) -> FileColumns:
    """Sound: channels from one; integers become parts of full scale, from -1 to 1."""
    from scipy.io import wavfile

    rate, values = wavfile.read(path)
    values = values[:, None] if values.ndim == 1 else values
    if values.dtype.kind == "u":
        values = (values.astype(float) - 128.0) / 128.0
    elif values.dtype.kind == "i":
        values = values / -float(np.iinfo(values.dtype).min)
    columns = {f"channel {k + 1}": one.astype(float) for k, one in enumerate(values.T)}
    return FileColumns(columns, tuple(columns), {}, dict.fromkeys(columns, float(rate)))


def _read_numpy(path: Path) -> FileColumns:
    content = np.load(path, allow_pickle=False)
    if isinstance(content, np.ndarray):
        return _file_columns(_within("" if content.dtype.names else "data", content))
    return _file_columns(_within("", dict(content)))


#: Readers by the ending of a file; every other file is delimited text.
READERS: dict[str, Callable[[Path], FileColumns]] = {
    ".mat": _read_mat,
    **dict.fromkeys((".parquet", ".feather", ".arrow"), _read_parquet),
    ".nc": _read_netcdf,
    ".cdf": _read_netcdf,
    **dict.fromkeys((".h5", ".hdf5", ".hdf", ".he5"), _read_hdf),
    **dict.fromkeys((".json", ".jsonl", ".ndjson"), _read_json),
    ".tdms": _read_tdms,
    **dict.fromkeys((".uff", ".unv", ".uf58", ".u58"), _read_uff),
    ".wav": _read_wav,
    **dict.fromkeys((".npy", ".npz"), _read_numpy),
}
