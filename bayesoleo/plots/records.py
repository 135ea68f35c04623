"""The records as measured: every channel of every run over one period."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.plots import reading, style
from bayesoleo.plots.units import engineering

LEFT, TOP, BOTTOM, ROW = 1.75, 0.5, 0.6, 0.56


def records(tree: xr.DataTree) -> Figure:
    """Measured channels over phase, one row for each run and one column for each channel.

    Parameters
    ----------
    tree : DataTree
        Needs ``records``.

    Returns
    -------
    Figure
    """
    names = reading.channels(tree)
    runs, remark = style.omitted(reading.runs(tree))
    row = ROW if len(runs) > 4 else 1.2
    height = TOP + row * len(runs) + BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = (style.WIDTH - LEFT - 0.1) / max(len(names), 1)
    for column, name in enumerate(names):
        x = LEFT + column * wide
        for place, run in enumerate(runs):
            y = height - TOP - (place + 1) * row
            box = (x / style.WIDTH, y / height, 0.82 * wide / style.WIDTH, 0.86 * row / height)
            _channel(figure, box, tree, name, run, place == len(runs) - 1)
        _head(figure, tree, name, x + 0.41 * wide, height)
    for place, run in enumerate(runs):
        _row_label(figure, run, 1 - (TOP + (place + 0.55) * row) / height)
    centre = (LEFT + style.WIDTH - 0.1) / 2 / style.WIDTH
    text = style.x_name(runs) + (f" · {remark}" if remark else "")
    figure.text(centre, 0.12 / height, text, ha="center", fontsize=style.TEXT, color=style.INK)
    return figure


def _channel(
    figure: Figure,
    box: tuple[float, float, float, float],
    tree: xr.DataTree,
    name: str,
    run: reading.RunView,
    last: bool,
) -> None:
    """One channel of one run; all runs of a channel share its scale."""
    axes = figure.add_axes(box)
    style.dress(axes, ticks=2)
    data = reading.variable(tree, schema.RECORDS, name)
    scale = engineering(reading.unit(data), style.magnitude(data.values))
    position, values = reading.abscissa(tree, run), scale.factor * data.values[run.index]
    if reading.is_resolved(position, values):
        axes.plot(*reading.fold(position, values), color=style.INK, lw=1.2)
    else:
        order = position.argsort()
        axes.plot(*reading.thin(position[order], values[order]), color=style.INK, lw=0.4)
    style.cycles(axes)
    axes.set_ylim(*_limits(scale.factor * data.values))
    axes.tick_params(labelbottom=last)
    if not last:
        axes.spines["bottom"].set_visible(False)
        axes.tick_params(bottom=False)


def _limits(values: Array) -> tuple[float, float]:
    low, high = np.nanmin(values), np.nanmax(values)
    margin = 0.06 * (high - low) or 1.0
    return float(low - margin), float(high + margin)


def _head(figure: Figure, tree: xr.DataTree, name: str, x: float, height: float) -> None:
    """Name and unit of a channel above its column."""
    data = reading.variable(tree, schema.RECORDS, name)
    scale = engineering(reading.unit(data), style.magnitude(data.values))
    text = style.plain(scale.label(name))
    figure.text(
        x / style.WIDTH,
        1 - 0.3 / height,
        text,
        ha="center",
        va="bottom",
        fontsize=style.TEXT,
        color=style.INK,
        fontweight="bold",
    )


def _row_label(figure: Figure, run: reading.RunView, y: float) -> None:
    """Label, role and frequency of a run at the left of its row."""
    held_out = run.role == schema.HOLD_OUT
    colour = style.AFTER if held_out else style.FAINT
    label = style.plain(run.label, 18)
    figure.text(0.01, y, label, va="bottom", fontsize=style.SMALL, fontweight="bold")
    text = " · ".join(part for part in (run.role, run.remark) if part)
    figure.text(0.01, y, text, va="top", fontsize=style.SMALL - 1, color=colour)
