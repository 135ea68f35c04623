"""The fit: what was measured against what the model predicts, before and after."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.plots import reading, style
from bayesoleo.plots.units import engineering

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
