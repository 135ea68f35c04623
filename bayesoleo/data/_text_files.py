"""Values of delimited text, a part of the file at a time, as :mod:`_text_layout` finds them."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from tqdm.auto import tqdm

from bayesoleo._types import Array
from bayesoleo.data._text_layout import (
    DATE,
    DECIMAL_COMMA,
    MISSING,
    SNIFFED,
    WHITESPACE,
    FileColumns,
    TextLayout,
    find_layout,
    is_number,
    is_time,
    open_text,
    split_cells,
    without_remark,
)
from bayesoleo.errors import CampaignError, number_of

if TYPE_CHECKING:
    import pandas as pd

#: Rows that are read at once.
ROWS = 250_000


def read_text(
    path: Path,
    delimiter: str | None = None,
    header_delimiter: str | None = None,
    wanted: Collection[str] | None = None,
    encoding: str | None = None,
    progress: bool = False,
    every: bool = False,
) -> FileColumns:
    """Read a delimited text file.

    Parameters
    ----------
    path : Path
        The file.
    delimiter, header_delimiter : str, optional
        Of the values and of the header; ``whitespace`` stands for any run of blanks. Found from
        the first lines by default.
    wanted : collection of str, optional
        Columns that must be numbers; others are left out. All, by default.
    encoding : str, optional
        Found from the file by default.
    progress : bool, optional
        Whether to show a bar after two seconds.
    every : bool, optional
        Whether to read the other columns as well, those of text left out.

    Returns
    -------
    FileColumns
        Empty cells are NaN.

    Raises
    ------
    CampaignError
        If no values are found, the header does not match them, or a cell is not a number.
    """
    layout = find_layout(path, delimiter, header_delimiter, encoding)
    names = _unique(path, layout.names, wanted)
    read = [
        k
        for k, name in enumerate(names)
        if name and (every or wanted is None or name in wanted or is_time(name))
    ]
    columns, clocks, faults = _read_values(
        path, layout, {k: names[k] for k in read}, wanted, progress
    )
    _check_filled(path, columns, layout.delimiter, wanted)
    units = {**layout.units, **dict.fromkeys(clocks, "s")}
    times = {name: fault for name, fault in faults.items() if is_time(name)}
    return FileColumns(columns, tuple(name for name in names if name), units, faults=times)


def _read_values(
    path: Path,
    layout: TextLayout,
    read: Mapping[int, str],
    wanted: Collection[str] | None,
    progress: bool,
) -> tuple[dict[str, Array], list[str], dict[str, CampaignError]]:
    """Values by name, which of them are times of day, and why columns were not read."""
    import pandas as pd

    try:
        return _collect(path, layout, len(layout.names), read, wanted, progress)
    except (pd.errors.ParserError, pd.errors.ParserWarning) as error:
        width = _width_with_remarks(path, layout)
        if width is None:
            raise _ragged(path, layout) from error
    return _collect(path, layout, width, read, wanted, progress)


def _collect(
    path: Path,
    layout: TextLayout,
    width: int,
    read: Mapping[int, str],
    wanted: Collection[str] | None,
    progress: bool,
) -> tuple[dict[str, Array], list[str], dict[str, CampaignError]]:
    parts: dict[int, list[Array]] = {k: [] for k in read}
    clock: dict[int, pd.Timestamp] = {}
    faults: dict[str, CampaignError] = {}
    rows = 0
    for table in _tables(path, layout, width, progress):
        for k in list(parts):
            try:
                parts[k].append(_numbers(path, read[k], table[k], layout, rows, clock, k))
            except CampaignError as error:
                if wanted is None or read[k] in wanted:
                    raise
                del parts[k]  # it may be needed as time, or not at all
                faults[read[k]] = error
        rows += len(table)
    columns = {read[k]: np.concatenate(found) for k, found in parts.items() if found}
    return columns, [read[k] for k in clock], faults


def _unique(path: Path, names: Sequence[str], wanted: Collection[str] | None) -> list[str]:
    """Names of which the second of two alike is followed by its number."""
    found: list[str] = []
    seen: dict[str, int] = {}
    for name in names:
        again = seen.get(name, 0)
        seen[name] = again + 1
        if again and name and (wanted is None or name in wanted):
            raise CampaignError(
                "two columns have this name",
                file=path.name,
                column=name,
                hint=f"name them apart in the file; or use another column than {name!r}",
            )
        found.append(f"{name} ({again + 1})" if again and name else name)
    return found


def _tables(path: Path, layout: TextLayout, width: int, progress: bool) -> Iterator[pd.DataFrame]:
    """Rows of values, a part of the file at a time, with a bar where it takes long."""
    import pandas as pd

    size, options = path.stat().st_size, {"unit": "B", "unit_scale": True, "leave": False}
    with (
        open_text(path, layout.encoding) as stream,
        warnings.catch_warnings(),
        tqdm(total=size, desc=path.name, delay=2.0, disable=not progress, **options) as bar,
    ):
        # A line longer than the others is no more than a warning to pandas.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        for _ in range(layout.first):
            stream.readline()
        yield from _parts(stream, layout, width, bar)


def _parts(
    stream: io.TextIOWrapper, layout: TextLayout, width: int, bar: Any
) -> Iterator[pd.DataFrame]:
    import pandas as pd

    reader = pd.read_csv(
        stream,
        sep=r"\s+" if layout.delimiter == WHITESPACE else layout.delimiter,
        decimal=layout.decimal,
        header=None,
        names=list(range(width)),
        index_col=False,
        comment="#",
        na_values=list(MISSING),
        skipinitialspace=True,
        low_memory=False,
        chunksize=ROWS,
    )
    for part in reader:
        yield part
        bar.update(max(0, cast(Any, stream.buffer).tell() - bar.n))


def _width_with_remarks(path: Path, layout: TextLayout) -> int | None:
    """The largest number of cells in a line, if what stands beyond the last column is no number."""
    width = most = len(layout.names)
    for _, cells in _value_lines(path, layout):
        if any(is_number(cell, layout.decimal) for cell in cells[width:]):
            return None
        most = max(most, len(cells))
    return most


def _value_lines(path: Path, layout: TextLayout) -> list[tuple[int, list[str]]]:
    with open_text(path, layout.encoding) as stream:
        return [
            (number, split_cells(without_remark(line), layout.delimiter))
            for number, line in enumerate(stream, 1)
            if number > layout.first and without_remark(line).strip()
        ]


def _ragged(path: Path, layout: TextLayout) -> CampaignError:
    """Which line has too many cells."""
    width = len(layout.names)
    for number, cells in _value_lines(path, layout):
        if len(cells) > width:
            mark = {WHITESPACE: " "}.get(layout.delimiter, layout.delimiter)
            return CampaignError(
                f"line {number} has {number_of(len(cells), 'cell')}, the header {width}",
                file=path.name,
                value=mark.join(cells)[:60],
                hint="correct that line, or set the delimiter of this run",
            )
    return CampaignError("lines differ in their number of cells", file=path.name, key="delimiter")


def _numbers(
    path: Path,
    name: str,
    column: pd.Series,
    layout: TextLayout,
    before: int,
    clock: dict[int, pd.Timestamp],
    index: int,
) -> Array:
    """Values of a column; times of day become seconds from the first one."""
    import pandas as pd

    if column.dtype.kind in "biuf":
        return column.to_numpy(dtype=float)
    filled = column.dropna()
    if index in clock or (len(filled) and DATE.match(str(filled.iloc[0]).strip())):
        times = _times(column)
        if times is not None:
            first = clock.setdefault(index, times.iloc[0])
            return np.asarray((times - first).dt.total_seconds(), dtype=float)
    text = column
    if layout.decimal == ",":  # a point is then no decimal sign: 1.500 may be a thousand and a half
        kept = column.where(~column.astype(str).str.contains(".", regex=False))
        text = kept.astype(str).str.replace(",", ".", regex=False)
    numbers = pd.to_numeric(text, errors="coerce").to_numpy(dtype=float)
    wrong = np.flatnonzero(np.isnan(numbers) & column.notna().to_numpy())
    if wrong.size:
        cell = str(column.iloc[wrong[0]])
        raise CampaignError(
            f"not a number in {_place(path, layout, before + int(wrong[0]), cell)}",
            file=path.name,
            column=name,
            value=cell,
            hint=_instead(cell.strip(), layout),
        )
    return numbers


def _instead(cell: str, layout: TextLayout) -> str:
    """What to write instead of a cell that is no number."""
    if cell in layout.names:
        return "the names stand here once more: write each part to a file of its own"
    if DECIMAL_COMMA.match(cell):
        return _one_sign(layout.decimal)
    for other in SNIFFED:
        cells = split_cells(cell, other)
        if len(cells) == len(layout.names) and all(is_number(c, layout.decimal) for c in cells):
            return f"separate its numbers by {layout.delimiter!r}, as in the other lines"
    return _one_sign(layout.decimal) if layout.decimal == "," else "write numbers only"


def _one_sign(decimal: str) -> str:
    word = "commas" if decimal == "," else "points"
    return f"write decimal {word} throughout the file"


def _times(column: pd.Series) -> pd.Series | None:
    """Dates or times of day, where all cells are that."""
    import pandas as pd

    text = column.astype(str).str.strip().str.replace(",", ".", regex=False)
    try:
        if re.match(r"^\d{1,2}:", text.iloc[0]):
            whole = text.where(text.str.count(":") > 1, text + ":00")
            return pd.Timestamp(0) + pd.to_timedelta(whole)
        day_first = re.match(r"^\d{1,2}\.", text.iloc[0]) is not None
        return pd.to_datetime(text, format="mixed", dayfirst=day_first)
    except (ValueError, TypeError):
        return None


def _place(path: Path, layout: TextLayout, row: int, cell: str) -> str:
    """Where an editor shows a row of values: blank lines and comments count there."""
    with open_text(path, layout.encoding) as stream:
        filled = (
            (number, line)
            for number, line in enumerate(stream, 1)
            if number > layout.first and without_remark(line).strip()
        )
        number, line = next(islice(filled, row, None), (0, ""))
    return f"line {number}" if cell.strip() in line else f"row {row + 1}"


def _check_filled(
    path: Path, columns: Mapping[str, Array], separator: str, wanted: Collection[str] | None
) -> None:
    """Raise where a column that is used is mostly empty before its last value."""
    for name, values in columns.items():
        last = np.flatnonzero(np.isfinite(values))
        gaps = np.isnan(values[: last[-1] + 1]) if last.size else np.ones(1)
        if np.mean(gaps) > 0.5 and (wanted is None or name in wanted):
            raise CampaignError(
                f"column is more than half empty when split by {separator!r}",
                file=path.name,
                column=name,
                key="delimiter",
                hint="set the delimiter of this run, or leave that column out",
            )
