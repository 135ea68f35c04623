"""Tables in the terminal; labels of users are printed as they are, not as markup."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], words: int = 1) -> Table:
    """A plain table.

    Parameters
    ----------
    head : sequence of str
        Titles of the columns.
    rows : sequence of sequence
        Cells; numbers get four digits, ``None`` and NaN a dash.
    words : int
        How many columns from the left hold words and are aligned on the left, as are those in which
        no cell begins with a number.
    """
    made = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    for column, title in enumerate(head):
        # What does not fit goes on in the next line: an ellipsis would take digits away.
        on_left = column < words or not any(_is_number(row[column]) for row in rows)
        made.add_column(Text(title), justify="left" if on_left else "right", overflow="fold")
    for row in rows:
        made.add_row(*(Text(cell_text(cell)) for cell in row))
    return made


def _is_number(cell: Any) -> bool:
    text = cell_text(cell).lstrip("−-<± ")
    return text[:1].isdigit() or text == ""


def cell_text(value: Any) -> str:
    """A value as a table shows it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {cell_text(item)}" for key, item in value.items()) or "–"
    if isinstance(value, list | tuple | set):
        return ", ".join(cell_text(item) for item in value) or "–"
    return str(value)


def print_mapping(content: Mapping[str, Any], console: Console) -> None:
    """Print nested facts: plain values first, then one table for every list or mapping of records.

    Parameters
    ----------
    content : mapping
        Names to values, to mappings of name to record, or to lists of records, where a record is a
        mapping.
    console : rich.console.Console
        Where to print.
    """
    facts = {key: value for key, value in content.items() if _records(value) is None}
    if facts:
        width = max(len(key) for key in facts) + 2
        for key, value in facts.items():
            label = f"{key.replace('_', ' '):<{width}}"
            console.print(Text.assemble((label, "dim"), cell_text(value)), soft_wrap=True)
    for key, value in content.items():
        rows = _records(value)
        if rows is not None:
            head = list(dict.fromkeys(name for row in rows for name in row))
            cells = [[row.get(name) for name in head] for row in rows]
            console.print()
            titles = [name.replace("_", " ") for name in head]
            console.print(Text(key.replace("_", " "), style="bold"))
            words = _leading_words(cells)
            console.print(table(titles, cells, words))


def _records(value: Any) -> list[dict[str, Any]] | None:
    """Rows of a table, where a value is one."""
    if isinstance(value, Mapping) and value and all(isinstance(v, Mapping) for v in value.values()):
        return [{"name": name, **row} for name, row in value.items()]
    if isinstance(value, list | tuple) and value and all(isinstance(v, Mapping) for v in value):
        return [dict(row) for row in value]
    return None


def _leading_words(rows: Sequence[Sequence[Any]]) -> int:
    """How many columns from the left hold words."""
    count = 0
    for column in zip(*rows, strict=True):
        if any(isinstance(cell, int | float) for cell in column):
            break
        count += 1
    return count


def plain(value: Any) -> Any:
    """A value as JSON can hold it: no NumPy scalars, None where a number is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | None) else str(value)
