"""Layout of delimited text as test rigs write it: preamble, names, units, values.

The values are found first: a block of lines that one delimiter splits alike into numbers. The
lines directly above them hold the names of the columns and, where a rig writes it, a row of units.
Everything further above is a preamble, and is skipped. Encoding, delimiter and decimal sign follow
from the first lines.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo._units import parse_unit
from bayesoleo.errors import CampaignError, number_of

if TYPE_CHECKING:
    pass


WHITESPACE, BLANKS = "whitespace", "two blanks"
_NAMED = {"whitespace": WHITESPACE, " ": WHITESPACE, "tab": "\t", "comma": ",", "semicolon": ";"}
SNIFFED = (",", ";", "\t", "|", WHITESPACE)
_COMMENT = re.compile(r"^\s*(#+|%+|!+|//+|\*+)\s*")
DECIMAL_COMMA = re.compile(r"^[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?$")
_WORDS = re.compile(r"[^\W_]")
DATE = re.compile(
    r"^(\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[T ]\s*)?\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?"
    r"\s*(Z|[+-]\d\d:?\d\d)?$"
)
#: Words for a value that is missing, beside those that pandas knows.
MISSING = ("-", "--", "---", "----", "NAN", "Nan", "OVLD")
#: A column after the last one that holds remarks, and need not be filled.
_REMARKS = ("comment", "comments", "note", "notes", "remark", "remarks", "kommentar", "bemerkung")
#: Bytes and lines from which the layout is found.
_HEAD, _LINES = 1 << 18, 400
#: Units of one letter that rigs write; other letters more often name a quantity.
_LETTERS = frozenset("smNVAKgWJhTC°%1-")
#: Modules of the standard library that open a compressed file.
_COMPRESSED = {".gz": "gzip", ".bz2": "bz2", ".xz": "lzma"}
_NO_UNIT = ("", "-", "--", "—", "1", "none", "[]", "()", "[-]", "(-)")
_TIME = re.compile(
    r"^(time|t|timestamp|time ?stamp|zeit|elapsed[_ ]?time|x_value)(?:[_ ]*[\[(/ _]*"
    r"(?P<unit>ns|us|µs|μs|ms|msec|s|sec|seconds?|min|h)[\])]*)?$",
    re.IGNORECASE,
)
#: Seconds in a unit of time as rigs write it.
TIME_UNITS = {
    "ns": 1e-9,
    "us": 1e-6,
    "µs": 1e-6,
    "μs": 1e-6,
    "ms": 1e-3,
    "msec": 1e-3,
    "s": 1.0,
    "sec": 1.0,
    "second": 1.0,
    "seconds": 1.0,
    "min": 60.0,
    "minute": 60.0,
    "minutes": 60.0,
    "h": 3600.0,
    "hour": 3600.0,
    "hours": 3600.0,
    "milliseconds": 1e-3,
    "microseconds": 1e-6,
    "nanoseconds": 1e-9,
    "days": 86400.0,
}


@dataclass(frozen=True)
class FileColumns:
    """What a run file holds.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (N,)
        Values as written; lengths may differ.
    names : tuple of str
        All columns, also those that were not read.
    units : mapping of str to str
        By column, where the file states them.
    sample_rate : mapping of str to float
        By column, Hz, where the file itself states it.
    numbers : mapping of str to float
        Single numbers beside the columns, such as ``Ts``.
    faults : mapping of str to CampaignError
        Why columns whose names are those of time were not read.
    """

    columns: Mapping[str, Array]
    names: tuple[str, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    sample_rate: Mapping[str, float] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    faults: Mapping[str, CampaignError] = field(default_factory=dict)


def is_time(name: str) -> bool:
    """Whether a column's name is that of time, with or without a unit."""
    return _TIME.match(name.strip()) is not None


def time_unit(name: str) -> str | None:
    """The unit of time in the name of a time column: ``ms`` of ``Time [ms]``."""
    found = _TIME.match(name.strip())
    return found["unit"] if found else None


@cache
def is_unit(text: str) -> bool:
    """Whether a cell holds a unit and no name.

    Parameters
    ----------
    text : str
        With or without brackets.
    """
    bare = text.strip().strip("[]()").strip()
    if len(bare) < 2 and bare not in _LETTERS:
        return False
    try:
        parse_unit(bare)
    except CampaignError:
        return bare in ("°", "%", "-")
    return True


def unit_in_name(name: str) -> str | None:
    """The unit that a column's name ends in: ``kN`` of ``Force [kN]``, ``load_kN`` or ``F/kN``."""
    bracket = re.search(r"[\[(]\s*([^\[\]()]+)\s*[\])]\s*$", name)
    if bracket:
        return bracket[1] if is_unit(bracket[1]) else None
    last = re.search(r"[\w)][ _/]([^\s_/]+(/[^\s_/]+)?)$", name.strip())
    if last and len(last[1]) <= 6 and is_unit(last[1]):
        return last[1]
    return None


@dataclass(frozen=True)
class TextLayout:
    """How a text file is laid out.

    Parameters
    ----------
    encoding, delimiter, decimal : str
    first : int
        Lines before the values.
    names : tuple of str
        Of the columns; empty where one has none.
    units : mapping of str to str
    """

    encoding: str
    delimiter: str
    decimal: str
    first: int
    names: tuple[str, ...]
    units: Mapping[str, str]


def open_bytes(path: Path) -> IO[bytes]:
    """Open a file that may be compressed, as its ending says."""
    module = _COMPRESSED.get(path.suffix.lower())
    return cast(IO[bytes], import_module(module).open(path, "rb") if module else path.open("rb"))


def open_text(path: Path, encoding: str) -> io.TextIOWrapper:
    """Open a text file that may be compressed; what cannot be decoded is marked."""
    return io.TextIOWrapper(cast(Any, open_bytes(path)), encoding=encoding, errors="replace")


def find_encoding(path: Path, wanted: str | None = None) -> str:
    """The encoding of a text file.

    Parameters
    ----------
    path : Path
    wanted : str, optional
        As the user states it; checked.

    Raises
    ------
    CampaignError
        If the file is not text, or not in that encoding.
    """
    with open_bytes(path) as stream:
        head = stream.read(_HEAD)
    for mark, name in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF32_LE, "utf-32"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if wanted is None and head.startswith(mark):
            return name
    guesses = [wanted] if wanted else ["utf-8-sig", "cp1252"]
    if wanted is None and b"\0" in head:
        guesses = ["utf-16-le" if head[1::2].count(0) > head[::2].count(0) else "utf-16-be"]
    for name in guesses:
        if name is not None and _reads(head, name):
            return name
    if wanted:
        raise CampaignError(
            "cannot be read in this encoding",
            file=path.name,
            key="encoding",
            value=wanted,
            hint="leave it out, or write for example encoding = 'cp1252' or 'utf-16'",
        )
    raise CampaignError(
        "not a text file, nor of a kind whose ending is known",
        file=path.name,
        value=path.suffix,
        hint="state the encoding of the run if it is text (encoding = 'shift_jis'), or export it "
        "as CSV",
    )


def _reads(head: bytes, encoding: str) -> bool:
    try:
        text = codecs.getincrementaldecoder(encoding)("strict").decode(head)
    except (UnicodeDecodeError, LookupError):
        return False
    return not re.search(r"[\x00-\x08\x0e-\x1b]", text)


def _first_lines(path: Path, encoding: str) -> list[str]:
    with open_text(path, encoding) as stream:
        return [line.rstrip("\n") for line in islice(stream, _LINES)]


def split_cells(line: str, delimiter: str) -> list[str]:
    if delimiter == WHITESPACE:
        if '"' in line:
            return [cell for cell in next(csv.reader([line.strip()], delimiter=" ")) if cell]
        return line.split()
    if delimiter == BLANKS:
        return re.split(r"\s{2,}|\t", line.strip())
    try:
        cells = next(csv.reader([line], delimiter=delimiter), [""])
    except csv.Error:  # a cell of more than 128 kB: a long line without this delimiter
        cells = line.split(delimiter)
    return [cell.strip() for cell in cells]


def is_number(cell: str, decimal: str = ".") -> bool:
    if decimal == "," and DECIMAL_COMMA.match(cell):
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def _is_value(cell: str, decimal: str) -> bool:
    """Whether a cell may stand in a row of values: a number, a time of day, or nothing."""
    return is_number(cell, decimal) or cell in MISSING or not cell or bool(DATE.match(cell))


@dataclass(frozen=True)
class _Block:
    """The values as one delimiter and one decimal sign find them; ``open_end`` where every row
    ends in a delimiter."""

    delimiter: str
    decimal: str
    first: int
    width: int
    open_end: bool
    rank: tuple[float, ...]


def without_remark(line: str) -> str:
    """A line of values without its remark; empty for a comment."""
    return line.split("#")[0].rstrip("\r\n")


def _find_block(lines: Sequence[str], delimiter: str, decimal: str) -> _Block | None:
    """The block of values, if this delimiter and decimal sign leave one."""
    rows = {
        k: split_cells(text, delimiter)
        for k, line in enumerate(lines)
        if (text := without_remark(line)).strip()
    }
    share = {
        k: sum(is_number(c, decimal) or bool(DATE.match(c)) for c in row)
        / max(1, sum(map(bool, row)))
        for k, row in rows.items()
    }
    widths = [len(rows[k]) for k in rows if share[k] > 0.5]
    if not widths:
        return None
    width = max(widths, key=widths.count)
    good = [k for k in rows if share[k] > 0.5 and len(rows[k]) == width]
    firm = [
        c for c in range(width) if np.mean([_is_value(rows[k][c], decimal) for k in good]) > 0.5
    ]
    fits = {
        k: len(row) == width and all(_is_value(row[c], decimal) for c in firm) and share[k] > 0
        for k, row in rows.items()
    }
    keys = list(rows)
    for place, k in enumerate(keys):
        near = keys[place : place + 6]
        # Numbers of a preamble are followed by words: names and units.
        words = any(share[other] == 0 for other in near)
        if fits[k] and share[k] > 0.5 and not words and np.mean([fits[n] for n in near]) >= 0.5:
            part = keys[place:]
            numbers = float(np.mean([share[other] for other in part]))
            alike = float(np.mean([len(rows[other]) == width for other in part]))
            open_end = all(rows[other][-1] == "" for other in good)
            return _Block(delimiter, decimal, k, width, open_end, (round(numbers, 2), alike, width))
    return None


def _decimals(lines: Sequence[str], delimiter: str) -> tuple[str, ...]:
    return (".",) if delimiter == "," or not any("," in line for line in lines) else (".", ",")


@dataclass(frozen=True)
class _Header:
    """Names and units above the values; ``found`` counts the cells of a line that does not fit."""

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    found: int = 0
    line: str = ""


def _cells(line: str, block: _Block, chosen: str | None) -> list[str]:
    """Cells of a header line: as many as there are columns, if some delimiter splits it so."""
    text = _COMMENT.sub("", line).strip("\r\n")
    width = block.width
    tries = [chosen] if chosen else [block.delimiter, *SNIFFED, BLANKS]
    splits = [[cell.strip().strip('"') for cell in split_cells(text, one)] for one in tries]
    for cells in splits:
        if width > 1 and sum(cell.endswith((",", ";")) for cell in cells) >= width - 1:
            continue  # blanks follow another delimiter
        if len(cells) == width:
            return cells
        bare = list(cells)
        while bare and not bare[-1]:
            bare.pop()
        if len(bare) == width - 1 and (
            cells != bare or block.open_end
        ):  # the values end in a delimiter, too
            return [*bare, ""]
        if len(bare) == width or (len(bare) == width + 1 and bare[-1].lower() in _REMARKS):
            return bare[:width]
    return splits[0]


def _find_header(lines: Sequence[str], block: _Block, chosen: str | None) -> _Header:
    """Look upwards from the values for the names and the units."""
    above: list[tuple[str, list[str]]] = []
    for line in reversed(lines[: block.first]):
        if not _WORDS.search(line):
            if above:
                break
            continue
        above.append((line, _cells(line, block, chosen)))
        if len(above) == 6:
            break
    while above and len(above[0][1]) != block.width and _skipped(*above[0]):
        above.pop(0)
    if not above:
        return _Header()
    line, cells = above[0]
    if len(cells) != block.width or (block.width == 1 and re.search(r"[,;|\t]", line)):
        return _Header(found=len(cells), line=line)
    if len(above) > 1 and len(above[1][1]) == block.width and _are_units(cells):
        return _Header(tuple(above[1][1]), tuple(cells))
    return _Header(tuple(cells))


def _skipped(line: str, cells: list[str]) -> bool:
    """Whether a line between names and values is a comment, or holds no columns."""
    return bool(_COMMENT.match(line)) or len(cells) == 1


def _are_units(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell.lower() not in _NO_UNIT]
    return bool(filled) and all(map(is_unit, filled))


def find_layout(
    path: Path,
    delimiter: str | None = None,
    header_delimiter: str | None = None,
    encoding: str | None = None,
) -> TextLayout:
    """Find values, names and units of a text file.

    Parameters
    ----------
    path : Path
    delimiter, header_delimiter, encoding : str, optional
        As the user states them.

    Raises
    ------
    CampaignError
        If there are no values, or the line above them does not name the columns.
    """
    encoding = find_encoding(path, encoding)
    lines = _first_lines(path, encoding)
    lead = 1 if lines and lines[0].lower().startswith("sep=") else 0  # as Excel writes it
    lines[:lead] = [""] * lead
    chosen = _NAMED.get(header_delimiter or "", header_delimiter)
    best: tuple[tuple[float, ...], _Block, _Header] | None = None
    for one in [_NAMED.get(delimiter, delimiter)] if delimiter else SNIFFED:
        for decimal in _decimals(lines, one):
            block = _find_block(lines, one, decimal)
            if block is None:
                continue
            header = _find_header(lines, block, chosen)
            rank = (block.rank[0], float(not header.found), *block.rank[1:])
            if best is None or rank > best[0]:
                best = rank, block, header
    if best is None:
        text = next((line for line in lines if line.strip()), "")[:60]
        raise CampaignError(
            "file has a header and no values",
            file=path.name,
            value=text,
            hint="no line holds numbers alone; set delimiter or encoding of this run",
        )
    _, block, header = best
    block = _with_bad_first_row(lines, block, header)
    if block is not best[1]:
        header = _find_header(lines, block, chosen)
    names = header.names or _numbered(path, block, header)
    _check_once(path, lines[: block.first], block, names)
    return TextLayout(
        encoding=encoding,
        delimiter=block.delimiter,
        decimal=block.decimal,
        first=block.first,
        names=names,
        units=_units_of(names, header.units),
    )


def _check_once(path: Path, lines: Sequence[str], block: _Block, names: tuple[str, ...]) -> None:
    """Raise where the names stand above the values twice: what is between them would be lost."""
    places = [k for k, line in enumerate(lines, 1) if tuple(_cells(line, block, None)) == names]
    if block.width > 1 and len(places) > 1:
        raise CampaignError(
            f"the names stand in line {places[0]} and once more in line {places[1]}",
            file=path.name,
            value=lines[places[0] - 1].strip()[:60],
            hint="write each part to a file of its own",
        )


def _with_bad_first_row(lines: Sequence[str], block: _Block, header: _Header) -> _Block:
    """Count a row with numbers and a wrong cell, which would pass for names, as values."""
    if not any(is_number(cell, block.decimal) for cell in header.names):
        return block
    for k in range(block.first - 1, -1, -1):
        if without_remark(lines[k]).strip():
            up = replace(block, first=k)
            above = _find_header(lines, up, None).names
            words = above and not any(is_number(cell, block.decimal) for cell in above)
            return up if words else block
    return block


def _numbered(path: Path, block: _Block, header: _Header) -> tuple[str, ...]:
    """Columns of a file without names are numbered from one."""
    if header.found:
        raise CampaignError(
            f"header has {number_of(header.found, 'column')} and the values {block.width},"
            f" split by {block.delimiter!r}",
            file=path.name,
            key="delimiter",
            value=header.line.strip()[:60],
            hint="set delimiter and header_delimiter of this run",
        )
    return tuple(str(k + 1) for k in range(block.width))


def _units_of(names: Sequence[str], row: Sequence[str]) -> dict[str, str]:
    """Units by column, of a row of units or of brackets in the names."""
    units = {}
    for k, name in enumerate(names):
        stated = row[k].strip().strip("[]()").strip() if row else ""
        found = stated or (unit_in_name(name) if re.search(r"[\])]\s*$", name) else None)
        if name and found:
            units[name] = found
    return units
