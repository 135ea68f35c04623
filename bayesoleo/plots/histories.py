"""The way of an estimate, iteration by iteration."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bayesoleo import schema
from bayesoleo.plots import style
from bayesoleo.plots.regions import MOST, panel_grid


def history(data: xr.Dataset) -> Figure:
    """Every parameter and the objective against the iteration.

    Parameters
    ----------
    data : xarray.Dataset
        The group ``point``, or ``estimate(...).to_dataset()``.

    Returns
    -------
    Figure
        One panel for each parameter, with the estimate and its linearised standard deviation as a
        band, and one for the objective. A new colour is another estimator.
    """
    names = [str(name) for name in data[schema.PARAMETER].values][: MOST - 1]
    methods = [str(name) for name in data["method"].values]
    stages = list(dict.fromkeys(methods))
    figure, panels = panel_grid(len(names) + 1)
    for axes, name in zip(panels, names, strict=False):
        one = data.sel({schema.PARAMETER: name})
        estimate, sd = float(one[schema.ESTIMATE]), float(one[schema.SD])
        if np.isfinite(sd):
            axes.axhspan(estimate - sd, estimate + sd, color=style.NOISE, lw=0)
        _way(axes, one[schema.HISTORY].values, methods, stages)
        axes.set_title(style.plain(name, 30), fontsize=style.TEXT, loc="left")
    _way(panels[len(names)], data[schema.OBJECTIVE].values, methods, stages)
    panels[len(names)].set_title("objective", fontsize=style.TEXT, loc="left")
    lines: list[Artist] = [
        style.line(colour, name) for name, colour in zip(stages, style.ENSEMBLES, strict=False)
    ]
    style.legend(figure, [*lines, style.band(style.NOISE, "estimate ± sd")])
    return figure


def _way(axes: Axes, values: np.ndarray, methods: list[str], stages: list[str]) -> None:
    """One line for each estimator, from where the one before it ended."""
    for stage, colour in zip(stages, style.ENSEMBLES, strict=False):
        own = np.flatnonzero([method == stage for method in methods])
        axes.plot(own, values[own], "o-", color=colour, lw=1.6, ms=3.5)
    style.dress(axes, 4)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_xlabel("iteration", fontsize=style.SMALL)
