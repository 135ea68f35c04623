"""Predictions of runs that were not used, with their intervals, and how well they were foreseen."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo.estimation.shown import LabelledResult
from bayesoleo.plots import style
from bayesoleo.plots.reading import dataset
from bayesoleo.plots.units import engineering

HIGH, GAP, TOP, BOTTOM, LEFT = 1.6, 0.7, 0.75, 0.55, 0.85
#: More runs than this are not shown; the figure says so.
MOST = 12


def forecast(found: LabelledResult | xr.Dataset | xr.DataTree, output: str | None = None) -> Figure:
    """Band and measurement of each run, with the probability integral transform beside it.

    Parameters
    ----------
    found : LabelledResult, xarray.Dataset or xarray.DataTree
        Of :func:`bayesoleo.forecast.predict`.
    output : str, optional
        By default the first.

    Returns
    -------
    Figure
        On the left the interval of a sample, its mean and what was measured; on the right the
        histogram of the transform: flat where the prediction is calibrated, hollow where it is too
        wide, horned where it is too narrow.
    """
    data = dataset(found)
    one = data.isel(output=0) if output is None else data.sel(output=output)
    runs = [str(run) for run in one[schema.RUN].values][:MOST]
    height = TOP + len(runs) * HIGH + (len(runs) - 1) * GAP + BOTTOM
    figure = style.blank(style.WIDTH, height)
    scale = engineering(str(one[schema.UNIT].values), style.magnitude(one["measured"].values))
    for k, run in enumerate(runs):
        bottom = height - TOP - (k + 1) * HIGH - k * GAP
        _band(figure, bottom, one.sel(run=run), scale.factor)
        _transform(figure, bottom, one.sel(run=run))
    level = f"{100 * float(data.attrs['level']):.3g} % interval"
    handles: list[Artist] = [
        style.band(style.SIMILAR, level),
        style.line(style.AFTER, "mean"),
        style.line(style.INK, "measured", 1.0),
    ]
    rest = one.sizes[schema.RUN] - len(runs)
    more = f", {rest} more runs not shown" if rest else ""
    style.legend(figure, handles, scale.label(str(one[schema.OUTPUT].values)) + more)
    return figure


def _band(figure: Figure, bottom: float, one: xr.Dataset, factor: float) -> None:
    height = figure.get_figheight()
    axes = figure.add_axes((LEFT / style.WIDTH, bottom / height, 6.2 / style.WIDTH, HIGH / height))
    style.dress(axes)
    time = one[schema.TIME].values
    axes.fill_between(
        time, factor * one["low"].values, factor * one["high"].values, color=style.SIMILAR, lw=0
    )
    axes.plot(time, factor * one["mean"].values, color=style.AFTER, lw=1.2)
    axes.plot(time, factor * one["measured"].values, color=style.INK, lw=0.8)
    axes.set_xlim(0, float(np.nanmax(time)))
    axes.set_xlabel("time in s", fontsize=style.SMALL, labelpad=2)
    axes.set_title(
        style.plain(str(one[schema.RUN].values), 40),
        loc="left",
        fontsize=style.SMALL,
        pad=3,
        fontweight="bold",
    )
    axes.set_title(
        f"rms {factor * float(one['rms']):.3g}, expected {factor * float(one['expected_rms']):.3g}",
        loc="right",
        fontsize=style.SMALL,
        pad=3,
        color=style.FAINT,
    )


def _transform(figure: Figure, bottom: float, one: xr.Dataset) -> None:
    height, left = figure.get_figheight(), LEFT + 6.2 + 0.6
    axes = figure.add_axes((left / style.WIDTH, bottom / height, 2.2 / style.WIDTH, HIGH / height))
    style.dress(axes)
    bins = one["bin"].values
    axes.bar(bins, one["pit"].values, width=1 / bins.size, color=style.SIMILAR)
    axes.axhline(1.0, color=style.INK, lw=0.8)
    axes.set_xlim(0, 1)
    axes.set_xlabel("probability integral transform", fontsize=style.SMALL, labelpad=2)
    axes.set_title(
        f"inside {100 * float(one['coverage']):.1f} %",
        loc="right",
        fontsize=style.SMALL,
        pad=3,
        color=style.FAINT,
    )
