"""A labelled result that prints as a table, in a terminal and in a notebook."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import Any

import xarray as xr

from bayesoleo import _schema as schema


@dataclass(frozen=True, eq=False, repr=False)
class LabelledResult:
    """Labelled arrays with the words that a person reads first.

    Parameters
    ----------
    data : xarray.Dataset
        Everything; a group of a result.
    text : str
        The table.
    """

    data: xr.Dataset
    text: str

    def __getitem__(self, name: str) -> xr.DataArray:
        """A variable of the data."""
        return self.data[name]

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return self.text

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.text)}</pre>{self.data._repr_html_()}"


def columns(head: list[str], rows: list[list[str]]) -> str:
    """A plain table: the first column on the left, the others on the right."""
    table = [head, *rows]
    width = [max(len(row[k]) for row in table) for k in range(len(head))]
    lines = []
    for row in table:
        cells = [
            row[0].ljust(width[0]),
            *(c.rjust(w) for c, w in zip(row[1:], width[1:], strict=True)),
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def variable(dims: tuple[str, ...], values: Any, name: str, unit: str) -> xr.Variable:
    """A variable with a title for people and its unit."""
    return xr.Variable(dims, values, {schema.LONG_NAME: name, schema.UNITS: unit})
