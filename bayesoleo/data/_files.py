"""Readers of run files: delimited text, MATLAB v5, Parquet and netCDF.

Delimited text has a header, as spreadsheets and test machines write it.
"""

from __future__ import annotations

import csv
import re
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import CampaignError, MissingExtraError, import_extra

if TYPE_CHECKING:
    import pandas as pd


WHITESPACE = "whitespace"
_NAMED = {"whitespace": WHITESPACE, " ": WHITESPACE, "tab": "\t", "comma": ",", "semicolon": ";"}
_SNIFFED = (",", ";", "\t", "|", WHITESPACE)
_DECIMAL_COMMA = re.compile(r"^[+-]?\d+,\d+([eE][+-]?\d+)?$")

_SPREADSHEETS = (".xlsx", ".xlsm", ".xls", ".ods")


def read_text(
    path: Path,
    delimiter: str | None = None,
    header_delimiter: str | None = None,
    wanted: Collection[str] | None = None,
) -> dict[str, Array]:
    """Read a delimited text file with one header line.

    A leading ``#`` of the header is dropped. The delimiter is the one that splits the first lines
    into the most columns, all lines alike; it is checked against the header and against columns
    that come out empty.

    Parameters
    ----------
    path : Path
        The file.
    delimiter, header_delimiter : str, optional
        Of the values and of the header; ``whitespace`` stands for any run of blanks. Sniffed by
        default.
    wanted : collection of str, optional
        Columns that must be numbers; others are left out where they are not. All, by default.

    Returns
    -------
    dict of str to ndarray, shape (N,)
        Columns; empty cells are NaN.

    Raises
    ------
    CampaignError
        If no header is found, columns do not match it, or a cell is not a number.
    """
    header_line, skip, sample = _find_header(path)
    separator = _NAMED.get(delimiter or "", delimiter) or sniff_delimiter(sample)
    names = _header_names(path, header_line, separator, header_delimiter, _width(sample, separator))
    table = _read_cells(path, skip, separator, len(names))
    columns = {
        name: _numbers(path, name, table[index], skip)
        for index, name in enumerate(names)
        if wanted is None or name in wanted or table[index].dtype.kind in "biuf"
    }
    _check_filled(path, columns, separator)
    return columns


def sniff_delimiter(lines: list[str]) -> str:
    """The delimiter that splits lines alike, all if possible, into the most cells.

    Parameters
    ----------
    lines : list of str
        First lines of values.

    Returns
    -------
    str
        A character, or ``whitespace``.
    """
    best, most = ",", (False, 0.0, 1)
    for candidate in _SNIFFED:
        counts = [len(_split(line, candidate)) for line in lines]
        usual = max(counts, key=counts.count)
        # The one that leaves numbers comes first: a decimal comma, too, splits all lines alike.
        # A line that is longer than the others is told as such once the others have their cells.
        rank = (len(set(counts)) == 1, _numeric_share(lines, candidate), usual)
        if usual > 1 and rank > most:
            best, most = candidate, rank
    return best


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == WHITESPACE:
        return [cell.strip('"') for cell in line.split()]
    try:
        cells = next(csv.reader([line], delimiter=delimiter), [""])
    except csv.Error:  # a cell of more than 128 kB: a long line without this delimiter
        cells = line.split(delimiter)
    return [cell.strip() for cell in cells]


def _width(lines: list[str], delimiter: str) -> int:
    """The usual number of cells in a line."""
    counts = [len(_split(line, delimiter)) for line in lines]
    return max(counts, key=counts.count)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numeric_share(lines: list[str], delimiter: str) -> float:
    cells = [cell for line in lines for cell in _split(line, delimiter)]
    numbers = sum(_is_number(cell) or bool(_DECIMAL_COMMA.match(cell)) for cell in cells)
    return numbers / max(len(cells), 1)


def _find_header(path: Path) -> tuple[str, int, list[str]]:
    """The header line, the number of lines up to the values, and the first lines of values."""
    try:
        with path.open(encoding="utf-8-sig") as stream:
            lines = [line.rstrip("\r\n") for line in islice(stream, 200)]
    except UnicodeDecodeError as error:
        raise CampaignError(
            "not a text file in UTF-8", file=path.name, value=path.suffix, hint="export it as CSV"
        ) from error
    header, start = None, 0
    for number, line in enumerate(lines):
        text = line.strip()
        if not text:
            continue
        values = re.split(r"[,;|\s]+", text.strip(",;|"))
        if not text.startswith("#") and all(map(_is_number, values)):
            start = number
            break
        # The last comment line before the values, or the first line that is no comment, names the
        # columns.
        if header is not None and not header.startswith("#"):
            start = number
            break
        header = text
    sample = [line for line in lines[start : start + 50] if line.strip()]
    if header is None:
        raise CampaignError(
            "file has no header",
            file=path.name,
            value=lines[0][:60],
            hint="name the columns in line 1",
        )
    if start == 0 or not sample:
        raise CampaignError("file has a header and no values", file=path.name, value=header[:60])
    return header.lstrip("#").strip(), start, sample


def _header_names(
    path: Path, header: str, separator: str, header_delimiter: str | None, width: int
) -> list[str]:
    chosen = _NAMED.get(header_delimiter or "", header_delimiter)
    names = _split(header, chosen or separator)
    if chosen is None and len(names) != width:
        names = next((n for c in _SNIFFED if len(n := _split(header, c)) == width), names)
    if len(names) != width:
        raise CampaignError(
            f"header has {len(names)} columns and the values {width}, split by {separator!r}",
            file=path.name,
            key="delimiter",
            value=header[:60],
            hint="set delimiter and header_delimiter of this run",
        )
    repeated = sorted(name for name, count in Counter(names).items() if count > 1 and name)
    if repeated:
        raise CampaignError("two columns have this name", file=path.name, column=repeated[0])
    return names


def _read_cells(path: Path, skip: int, separator: str, width: int) -> pd.DataFrame:
    import pandas as pd

    try:
        with warnings.catch_warnings():
            # A line longer than the others is no more than a warning to pandas.
            warnings.simplefilter("error", pd.errors.ParserWarning)
            return pd.read_csv(
                path,
                sep=r"\s+" if separator == WHITESPACE else separator,
                header=None,
                names=list(range(width)),
                index_col=False,
                skiprows=skip,
                comment="#",
                encoding="utf-8-sig",
                skipinitialspace=True,
                low_memory=False,
            )
    except (pd.errors.ParserError, pd.errors.ParserWarning) as error:
        raise _ragged(path, skip, separator, width) from error


def _ragged(path: Path, skip: int, separator: str, width: int) -> CampaignError:
    """Which line has too many cells."""
    with path.open(encoding="utf-8-sig") as stream:
        for number, line in enumerate(stream, 1):
            cells = len(_split(line.split("#")[0].rstrip("\r\n"), separator))
            if number > skip and cells > width:
                return CampaignError(
                    f"line {number} has {cells} cells, the header {width}",
                    file=path.name,
                    value=line.strip()[:60],
                    hint="correct that line, or set the delimiter of this run",
                )
    return CampaignError("lines differ in their number of cells", file=path.name, key="delimiter")


def _numbers(path: Path, name: str, column: pd.Series, skip: int) -> Array:
    import pandas as pd

    if column.dtype.kind in "biuf":
        return column.to_numpy(dtype=float)
    numbers = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float)
    wrong = np.flatnonzero(np.isnan(numbers) & column.notna().to_numpy())
    if wrong.size:
        cell = str(column.iloc[wrong[0]])
        comma = _DECIMAL_COMMA.match(cell.strip())
        hint = "write decimal points" if comma else "write numbers only"
        if wrong[0] == 0 and not comma:
            hint += "; a line of units below the header has to go"
        raise CampaignError(
            f"not a number in {_place(path, skip, int(wrong[0]), cell)}",
            file=path.name,
            column=name,
            value=cell,
            hint=hint,
        )
    return numbers


def _place(path: Path, skip: int, row: int, cell: str) -> str:
    """Where an editor shows a row of values: blank lines and comments count there."""
    with path.open(encoding="utf-8-sig") as stream:
        filled = (
            (number, line)
            for number, line in enumerate(stream, 1)
            if number > skip and line.split("#")[0].strip()
        )
        number, line = next(islice(filled, row, None), (0, ""))
    return f"line {number}" if cell.strip() in line else f"row {row + 1}"


def _check_filled(path: Path, columns: dict[str, Array], separator: str) -> None:
    for name, values in columns.items():
        if np.mean(np.isnan(values)) > 0.5:
            raise CampaignError(
                f"column is more than half empty when split by {separator!r}",
                file=path.name,
                column=name,
                key="delimiter",
                hint="set the delimiter of this run, or leave that column out",
            )


def read_columns(
    path: Path,
    delimiter: str | None = None,
    header_delimiter: str | None = None,
    wanted: Collection[str] | None = None,
) -> Mapping[str, Array]:
    """Read all numeric columns of a run file.

    Parameters
    ----------
    path : Path
        ``.mat`` (up to version 7), ``.parquet``, ``.nc``; anything else is delimited text with a
        header.
    delimiter, header_delimiter : str, optional
        Of text files; sniffed by default. ``whitespace`` stands for any run of blanks.
    wanted : collection of str, optional
        Columns that must be numbers; text in others does not matter. All, by default.

    Returns
    -------
    mapping of str to ndarray, shape (N,)
        As written, not converted.

    Raises
    ------
    CampaignError
        If the file is missing, empty or not what its name says.
    MissingExtraError
        If the file is Parquet and pyarrow is not installed.
    """
    if not path.is_file():
        raise CampaignError("no such file", file=path.name, hint=_neighbours(path))
    if path.stat().st_size == 0:
        raise CampaignError("file is empty", file=path.name, hint="record the run again")
    if path.suffix.lower() in _SPREADSHEETS:
        raise CampaignError(
            "is a spreadsheet", file=path.name, value=path.suffix, hint="export it as CSV"
        )
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        return read_text(path, delimiter, header_delimiter, wanted)
    try:
        columns = reader(path)
    except (CampaignError, MissingExtraError):
        raise
    except Exception as error:  # each format's library raises its own types on a broken file
        raise CampaignError(
            f"cannot be read as {path.suffix}: {str(error)[:120]}", file=path.name
        ) from error
    if not columns:
        raise CampaignError("file has no numeric column", file=path.name)
    return columns


def _neighbours(path: Path) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent.name!r}"
    names = sorted(item.name for item in path.parent.iterdir() if item.suffix != ".toml")
    return f"the folder holds {', '.join(names[:12]) or 'no files'}"


def _read_mat(path: Path) -> dict[str, Array]:
    from scipy.io import loadmat

    try:
        variables = loadmat(path)
    except NotImplementedError as error:
        raise CampaignError(
            "MATLAB version 7.3 file", file=path.name, hint="save it in MATLAB with '-v7'"
        ) from error
    vectors = {}
    for name, value in variables.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
            continue
        if value.size > 1 and value.size == max(value.shape):
            vectors[name] = value.ravel().astype(float)
    return vectors


def _read_parquet(path: Path) -> dict[str, Array]:
    import pandas as pd

    import_extra("pyarrow", "parquet")
    table = pd.read_parquet(path)
    return {str(name): table[name].to_numpy(dtype=float) for name in table.select_dtypes("number")}


def _read_netcdf(path: Path) -> dict[str, Array]:
    import xarray as xr

    with xr.open_dataset(path, decode_times=False) as dataset:
        return {
            str(name): np.asarray(variable.values, dtype=float)
            for name, variable in dataset.variables.items()
            if variable.ndim == 1 and variable.dtype.kind in "biuf"
        }


_READERS: dict[str, Callable[[Path], dict[str, Array]]] = {
    ".mat": _read_mat,
    ".parquet": _read_parquet,
    ".nc": _read_netcdf,
}
