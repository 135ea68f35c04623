"""The page in place of one that could not be made: what the summary says, without figures."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable, Mapping
from typing import Any

from bayesoleo.report import sentences, tables
from bayesoleo.storage import write_text_atomic

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title></head>
<body>
<h1>{headline}</h1>
{lines}
{tables}
</body>
</html>
"""


def write_plain_report(summary: Mapping[str, Any], path: str | os.PathLike[str]) -> list[str]:
    """Write a page with the sentences and tables of a summary.

    Parameters
    ----------
    summary : mapping
        As in ``summary.json``.
    path : path-like
        Replaced as a whole or not at all.

    Returns
    -------
    list of str
        Empty: no figure was tried.
    """
    units = summary.get("units", {})
    lines = [*sentences.unfinished(summary), *sentences.remainder(summary)]
    shown = [tables.error_by_role(summary, units), tables.parameters(summary)]
    page = _PAGE.format(
        title=html.escape(f"{summary['campaign']} · {summary['model']}"),
        headline=html.escape(sentences.headline(summary)),
        lines="\n".join(f"<p>{html.escape(line)}</p>" for line in lines),
        tables="\n".join(map(_table, shown)),
    )
    write_text_atomic(path, page)
    return []


def _table(table: tables.Table) -> str:
    rows = [_row(table.head, "th"), *(_row(row, "td") for row in table.rows)]
    return f"<table>{''.join(rows)}</table>"


def _row(cells: Iterable[str], kind: str) -> str:
    return f"<tr>{''.join(f'<{kind}>{html.escape(cell)}</{kind}>' for cell in cells)}</tr>"
