"""Figures of records: channels over one period, the search of the period, the fit.

The search of the period is shown as in figures B.1 and B.2 of Verbeek (1993).
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesoleo import _schema as schema
from bayesoleo._types import Array
from bayesoleo.data._residual_time_shift import PeriodSearch
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._style import engineering

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
            axes = style.add_axes(figure, x, y, 0.82 * wide, 0.86 * row)
            _channel(axes, tree, name, run, place == len(runs) - 1)
        _head(figure, tree, name, x + 0.41 * wide, height)
    for place, run in enumerate(runs):
        _row_label(figure, run, 1 - (TOP + (place + 0.55) * row) / height)
    centre = (LEFT + style.WIDTH - 0.1) / 2 / style.WIDTH
    text = style.x_name(runs) + (f" · {remark}" if remark else "")
    figure.text(centre, 0.12 / height, text, ha="center", fontsize=style.TEXT, color=style.INK)
    return figure


def _channel(axes: Axes, tree: xr.DataTree, name: str, run: reading.RunView, last: bool) -> None:
    """One channel of one run; all runs of a channel share its scale."""
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


HEIGHT = 5.2


def period_search(search: PeriodSearch, unit: str = "", name: str = "signal") -> Figure:
    """Residual time shift and autocovariance over two periods, and the valley at one period.

    Parameters
    ----------
    search : PeriodSearch
        From :func:`bayesoleo.data.period_search`.
    unit : str, optional
        SI unit of the signal.
    name : str, optional
        What was measured.

    Returns
    -------
    Figure
        Above both functions as they are (figure B.1); below the residual time shift next to one
        period, with the quadratic whose minimum is the period (figure B.2).
    """
    figure = style.blank(style.WIDTH, HEIGHT)
    boxes = ((0.085, 0.575, 0.4, 0.33), (0.585, 0.575, 0.4, 0.33), (0.085, 0.105, 0.9, 0.32))
    shift, covariance, zoom = (figure.add_axes(box) for box in boxes)
    square = f"({unit})^2" if unit else ""
    step = search.time_step
    for axes, values, words in (
        (shift, search.residual, "residual time shift"),
        (covariance, search.covariance, "autocovariance"),
    ):
        scale = _scale(square, unit, style.magnitude(values))
        axes.plot(step * search.shifts, scale[0] * values, color=style.AFTER, lw=1.2)
        axes.axvline(step * search.period_in_samples, color=style.BEFORE, lw=0.8)
        _dress(axes, "shift in s", f"{words}{scale[1]}")
    away = search.near - search.period_in_samples
    scale = _scale(square, unit, style.magnitude(search.near_residual))
    fine = np.linspace(away[0], away[-1], 300)
    zoom.plot(step * search.near, scale[0] * search.near_residual, "o", color=style.AFTER, ms=3)
    parabola = scale[0] * np.polyval(search.parabola, fine)
    zoom.plot(step * (fine + search.period_in_samples), parabola, color=style.BEFORE, lw=1.2)
    zoom.axvline(step * search.period_in_samples, color=style.BEFORE, lw=0.8)
    _dress(zoom, "shift in s", f"residual time shift{scale[1]}")
    handles: list[Artist] = [
        style.line(style.AFTER, name),
        style.line(style.BEFORE, "quadratic and its minimum, the period"),
    ]
    style.legend(figure, handles, f"{search.frequency:.6g} Hz")
    return figure


def _scale(square: str, unit: str, size: float) -> tuple[float, str]:
    """Factor and words for values in the square of a unit."""
    if not square:
        return 1.0, ""
    base = engineering(unit, float(np.sqrt(size)))
    return base.factor**2, f" in ({base.unit})²" if base.unit else ""


def _dress(axes: Axes, x: str, y: str) -> None:
    style.dress(axes, 4)
    axes.set_xlabel(x, fontsize=style.TEXT)
    axes.set_ylabel(y, fontsize=style.TEXT)


WINDOW = 240
"""Samples shown of a signal that changes faster than bins of phase can show."""


def fit(tree: xr.DataTree, output: str) -> Figure:
    """Measured channel against its prediction over phase, one panel for each run.

    Parameters
    ----------
    tree : DataTree
        Needs ``records`` and ``prediction``.
    output : str
        Name of the channel.

    Returns
    -------
    Figure
        Averages over the periods of a run. A signal with too many harmonics for that is shown by a
        stretch of raw samples from the middle of its record.
    """
    measured = reading.variable(tree, schema.RECORDS, output)
    scale = engineering(reading.unit(measured), style.magnitude(measured.values))
    names = [schema.before(output), schema.after(output)]
    shown = [name for name in names if name in tree[schema.PREDICTION]]
    runs, remark = style.omitted(reading.runs(tree))
    grid = style.panels(runs)
    spans = []
    for axes, run in zip(grid.axes, runs, strict=True):
        curves = [measured.values[run.index]]
        curves += [
            reading.variable(tree, schema.PREDICTION, name).values[run.index] for name in shown
        ]
        position = reading.abscissa(tree, run)
        _draw(axes, position, [scale.factor * np.asarray(curve) for curve in curves])
        spans.append(np.ptp(axes.get_ylim()))
    style.share_y(grid.axes, spans)
    handles = [style.line(style.MEASURED, "measured", 4.0)]
    text = "model, before" if len(shown) > 1 else "model"
    handles.append(style.line(style.BEFORE, text, 1.4, "--" if len(shown) > 1 else "-"))
    if len(shown) > 1:
        handles.append(style.line(style.AFTER, "model, after", 1.2))
    style.legend(grid.figure, handles, remark)
    style.label_outside(grid.figure, style.x_name(runs), scale.label(output))
    return grid.figure


def _draw(axes: Axes, position: Array, curves: list[Array]) -> None:
    """Measured broad and pale, so that a prediction that lies on it can be seen on it."""
    if reading.is_resolved(position, curves[0]):
        lines = [reading.fold(position, curve) for curve in curves]
        style.cycles(axes)
    else:
        finite = np.flatnonzero(np.isfinite(curves[0]) & np.isfinite(position))
        middle = finite.size // 2
        part = finite[max(middle - WINDOW // 2, 0) : middle + WINDOW // 2]
        start = position[part[0]]
        x = start + (position[part] - start) % 1.0
        lines = [(x, curve[part]) for curve in curves]
        axes.set_xlim(x[0], x[-1])
        axes.tick_params(labelbottom=True)
    axes.plot(*lines[0], color=style.MEASURED, lw=4.0, alpha=0.55, solid_capstyle="round")
    dashes = "--" if len(lines) > 2 else "-"
    axes.plot(*lines[1], color=style.BEFORE, lw=1.4, ls=dashes)
    if len(lines) > 2:
        axes.plot(*lines[2], color=style.AFTER, lw=1.2)
