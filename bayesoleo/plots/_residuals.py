"""Figures of residuals: over phase, velocity or stroke, and by harmonic."""

from __future__ import annotations

from typing import Literal

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bayesoleo import _schema as schema
from bayesoleo._types import Array
from bayesoleo.assessment._residual_breakdown import ORDERS, residual_breakdown as found_in
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._style import Scale, engineering

Against = Literal["phase", "velocity", "stroke"]


def residual(tree: xr.DataTree, output: str, against: Against = "phase") -> Figure:
    """Residual averaged over periods, before and after, one panel for each run.

    Parameters
    ----------
    tree : DataTree
        Needs ``residual``; for ``velocity`` and ``stroke`` the variable of that name in it.
    output : str
        Name of the channel.
    against : {"phase", "velocity", "stroke"}
        Horizontal axis. Against the latter two a cycle is a loop: where it is closed to a line the
        residual is a function of that coordinate, and a missing effect takes its shape.

    Returns
    -------
    Figure
        The grey band is one standard error of the average to either side of zero.
    """
    data = tree[schema.RESIDUAL].to_dataset()
    kinds = [
        (name, colour)
        for name, colour in (
            (schema.before(output), style.BEFORE),
            (schema.after(output), style.AFTER),
        )
        if name in data
    ]
    runs, remark = style.omitted(reading.runs(tree))
    curves = [[_curve(tree, data, name, run, against) for name, _ in kinds] for run in runs]
    y_scale = _scale(data[schema.before(output)], [y for row in curves for _, y in row])
    x_scale = _x_scale(data, against)
    grid = style.panels(runs, free_x=against != "phase")
    spans = []
    for axes, run, row in zip(grid.axes, runs, curves, strict=True):
        _noise(axes, data, output, run, y_scale)
        for (x, y), (_, colour) in zip(row, kinds, strict=True):
            axes.plot(x_scale.factor * x, y_scale.factor * y, color=colour, lw=1.2)
        if against == "phase":
            style.cycles(axes)
        spans.append(2 * style.magnitude(*(y for _, y in row)))
    style.share_y(grid.axes, spans, symmetric=True)
    _explain(grid.figure, len(kinds), remark, schema.noise(output) in data)
    phase = against == "phase"
    x_text = style.x_name(runs) if phase else x_scale.label(reading.coordinate_name(data, against))
    style.label_outside(grid.figure, x_text, y_scale.label(f"{output} residual"))
    return grid.figure


def _curve(
    tree: xr.DataTree, data: xr.Dataset, name: str, run: reading.RunView, against: Against
) -> tuple[Array, Array]:
    """What is drawn of one run, in SI."""
    mean = schema.mean(name)
    if against == "phase":
        if run.periodic and mean in data and np.isfinite(data[mean].values[run.index]).any():
            return reading.thin(_phases(data), data[mean].values[run.index])
        return reading.fold(
            reading.abscissa(tree, run), data[name].values[run.index], 2 * reading.BINS
        )
    position, e = reading.abscissa(tree, run), data[name].values[run.index]
    coordinate = data[against].values[run.index]
    if reading.is_resolved(position, coordinate):
        loop = [reading.fold(position, values)[1] for values in (coordinate, e)]
        if run.periodic:
            loop = [np.append(part, part[0]) for part in loop]
        return loop[0], loop[1]
    return _by_value(coordinate, e)


def _by_value(coordinate: Array, e: Array) -> tuple[Array, Array]:
    """Averages in bins of the coordinate with equally many samples each."""
    keep = np.flatnonzero(np.isfinite(coordinate) & np.isfinite(e))
    parts = np.array_split(keep[np.argsort(coordinate[keep])], min(60, max(keep.size // 20, 1)))
    return (
        np.array([coordinate[part].mean() for part in parts]),
        np.array([e[part].mean() for part in parts]),
    )


def _phases(data: xr.Dataset) -> Array:
    """The grid of the averages; if the tree has none it is regular."""
    if schema.PHASE in data.coords:
        return np.asarray(data[schema.PHASE].values, dtype=float)
    return (np.arange(data.sizes[schema.PHASE]) + 0.5) / data.sizes[schema.PHASE]


def _scale(variable: xr.DataArray, curves: list[Array]) -> Scale:
    return engineering(reading.unit(variable), style.magnitude(*curves))


def _x_scale(data: xr.Dataset, against: Against) -> Scale:
    if against == "phase":
        return Scale(1.0, "")
    return engineering(reading.unit(data[against]), style.magnitude(data[against].values))


def _noise(axes: Axes, data: xr.Dataset, output: str, run: reading.RunView, scale: Scale) -> None:
    """The band of the standard error, and zero."""
    axes.axhline(0.0, color=style.FAINT, lw=0.6, zorder=0)
    name = schema.noise(output)
    if run.periodic and name in data and np.isfinite(data[name].values[run.index]):
        half = scale.factor * float(data[name].values[run.index])
        axes.axhspan(-half, half, color=style.NOISE, lw=0, zorder=-1)


def _explain(figure: Figure, kinds: int, remark: str, noise: bool) -> None:
    """What the colours mean."""
    handles: list[Artist] = [style.line(style.BEFORE, "before" if kinds > 1 else "residual")]
    if kinds > 1:
        handles.append(style.line(style.AFTER, "after"))
    if noise:
        handles.append(style.band(style.NOISE, "± standard error of the average"))
    style.legend(figure, handles, remark)


TOP, BOTTOM, GAP, ROW = 0.75, 0.62, 0.75, 2.3
#: Coordinates shown of each output, those first that explain most.
SHOWN = 7


def residual_breakdown(tree: xr.DataTree) -> Figure:
    """Share of the repeating error by harmonic, and what of it a function of a coordinate explains.

    Parameters
    ----------
    tree : DataTree
        Of ``close`` or ``trace``, with a periodic run.

    Returns
    -------
    Figure
        One row an output. All shares are of the excess over the noise that the model as declared
        leaves, all runs together; what the extended model leaves is blue.
    """
    data = found_in(tree)
    outputs = [str(name) for name in data[schema.OUTPUT].values]
    height = TOP + len(outputs) * ROW + (len(outputs) - 1) * GAP + BOTTOM
    figure = style.blank(style.WIDTH, height)
    stages = [str(stage) for stage in data["stage"].values]
    colours = [style.BEFORE, style.AFTER][-len(stages) :] if len(stages) > 1 else [style.BEFORE]
    for row, output in enumerate(outputs):
        one = 100 * data.sel({schema.OUTPUT: output})
        bottom = (height - TOP - (row + 1) * ROW - row * GAP) / height
        _harmonics(figure, (0.075, bottom, 0.37, ROW / height), one, colours, output)
        _places(figure, (0.64, bottom, 0.34, ROW / height), one, colours)
    words = {"before": "model as declared", "after": "with what was added"}
    handles = [Patch(facecolor=c, label=words[s]) for s, c in zip(stages, colours, strict=True)]
    style.legend(figure, handles)
    return figure


def _harmonics(
    figure: Figure, box: tuple[float, float, float, float], one: xr.Dataset, colours: list[str],
    output: str,
) -> None:  # fmt: skip
    axes = figure.add_axes(box)
    style.dress(axes)
    width = 0.8 / len(colours)
    orders = np.arange(ORDERS + 1)
    for k, colour in enumerate(colours):
        axes.bar(orders + (k - (len(colours) - 1) / 2) * width, one["power"].values[k], width,
                 color=colour)  # fmt: skip
    axes.set_xticks(orders, [*map(str, orders[:-1]), f"≥ {ORDERS}"])
    axes.axhline(0, color=style.FAINT, lw=0.8)
    axes.set_xlabel("harmonic", fontsize=style.TEXT)
    axes.set_ylabel("share of the excess in %", fontsize=style.TEXT)
    axes.set_title(style.plain(output), loc="left", fontsize=style.TEXT, fontweight="bold")


def _places(
    figure: Figure, box: tuple[float, float, float, float], one: xr.Dataset, colours: list[str]
) -> None:
    axes = figure.add_axes(box)
    style.dress(axes)
    share = one["share"].values
    order = np.argsort(-share[0])[:SHOWN]
    width = 0.8 / len(colours)
    for k, colour in enumerate(colours):
        at = np.arange(order.size) + (k - (len(colours) - 1) / 2) * width
        axes.barh(at, np.clip(share[k][order], 0.0, 100.0), width, color=colour)
    names = [style.plain(str(one["coordinate"].values[k]), 34) for k in order]
    axes.set_yticks(np.arange(order.size), names, fontsize=style.SMALL)
    axes.set_ylim(order.size - 0.5, -0.5)
    axes.set_xlim(0, 100)
    axes.set_xlabel("explained by a function of it, one for all runs, in %", fontsize=style.TEXT)
