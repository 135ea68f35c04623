"""The result in a few lines of a terminal, and the plain report where figures fail."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from bayesoleo import _schema as schema
from bayesoleo._report import sentences, structures, tables
from bayesoleo._report.structures import proposal_lines
from bayesoleo._storage.files import write_text_atomic
from bayesoleo._types import Array
from bayesoleo.effects._catalogue import called, listed
from bayesoleo.plots._discovery import chosen, name

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
    lines = [*sentences.unfinished(summary), *structures.lines(summary)]
    lines += sentences.remainder(summary)
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


COLOURS = {
    schema.NOTHING_MISSING: "green",
    schema.EFFECT_ADDED: "blue",
    schema.UNEXPLAINED: "yellow",
}


def print_summary(summary: Mapping[str, Any], console: Console) -> None:
    """Print verdict, error before and after, the effects found and where the files are.

    Parameters
    ----------
    summary : mapping
        As in ``summary.json``; its optional ``units`` and ``files`` are used.
    console : rich.console.Console
        Where to print. Labels of users are printed as they are, not as markup.
    """
    titles = sentences.titles(summary)
    console.print()
    console.print(Text(sentences.headline(summary), style=f"bold {COLOURS[summary['verdict']]}"))
    for line in sentences.unfinished(summary):
        console.print(Text(line, style="bold red"))
    for line in structures.lines(summary):
        console.print(Text(line))
    console.print(_errors(summary))
    for number, entry in enumerate(summary["rounds"], start=1):
        if entry["accepted"]:
            stayed = entry["accepted"] in summary["effects"]
            later = Text("" if stayed else "; it was taken out again later", style="dim")
            console.print(_accepted(number, entry, titles) + later)
    for line in sentences.remainder(summary):
        console.print(Text(line, style="dim"))
    objection = sentences.hold_out_objects(summary)
    for entry in summary.get("proposals", []):
        console.print(Text(" ".join(proposal_lines(entry, titles, objection)[:2]), style="dim"))
    for line in _warnings(summary):
        console.print(Text(line, style="yellow"))
    files = summary.get("files", {})
    if files:
        console.print()
    for what, path in files.items():
        console.print(Text.assemble((f"{what:<10}", "dim"), path), soft_wrap=True)


def _warnings(summary: Mapping[str, Any]) -> list[str]:
    """What is said of stability where not all is well."""
    runs = summary.get("stability", {}).values()
    bad = any(run["stable"] is False or run["branch_jumps"] for run in runs)
    return [sentences.stability(summary)] if bad else []


def _errors(summary: Mapping[str, Any]) -> RichTable:
    """Error by role and output; what was held out is bright."""
    content = tables.error_by_role(summary, summary.get("units", {}))
    table = RichTable(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    for column, text in enumerate(content.head):
        table.add_column(text, justify="left" if column < content.words else "right")
    for number, row in enumerate(content.rows):
        style = "" if number in content.marked else "dim"
        table.add_row(*(Text(cell) for cell in row), style=style)
    return table


def _accepted(number: int, entry: Mapping[str, Any], titles: Mapping[str, str]) -> Text:
    """The effect that a round added, and what cannot be told from it."""
    added = chosen(entry)
    if added is None:
        return Text(f"Round {number}: {called(entry['accepted'], titles)} added")
    p = sentences.significance(added)
    share = f"{100 * added['gain']:.0f} % of the excess"
    which = called(name(added), titles)
    text = Text.assemble(f"Round {number}: ", (which, "bold"), f" explains {share}")
    if p:
        text.append(f", {p}")
    others = [called(other, titles) for other in added["indistinguishable_from"]]
    if others:
        text.append(f"; these data cannot tell it from {listed(others, ' or ')}", style="dim")
    near = added.get("closest", [])
    if near:
        first = f"{called(near[0]['effect'], titles)} (cosine {near[0]['cosine']:.2f})"
        text.append(f"; it has no name, and is most like {first}", style="dim")
    return text


def sparkline(values: Array, width: int = 48) -> str:
    """A record as a line of blocks, for a terminal.

    Parameters
    ----------
    values : ndarray, shape (N,)
    width : int, optional
        Characters.
    """
    blocks = "▁▂▃▄▅▆▇█"
    parts = np.array_split(values, min(width, values.size))
    means = np.array([float(np.mean(part)) for part in parts])
    span = float(np.ptp(means)) or 1.0
    return "".join(blocks[round(7 * (m - means.min()) / span)] for m in means)
