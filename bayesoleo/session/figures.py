"""Figures of a session that :mod:`bayesoleo.plots` has no equivalent of."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.plots import reading, style
from bayesoleo.plots.units import engineering
from bayesoleo.session import residuals

#: Runs shown at most, and columns of the figure.
RUNS, COLUMNS = 12, 4


def fit_and_residual(data: xr.Dataset, output: str | None = None) -> Figure:
    """Measurement and prediction of each run, and the residual below them.

    Parameters
    ----------
    data : xarray.Dataset
        Of :func:`bayesoleo.session.residuals.residuals`.
    output : str, optional
        By default the first.
    """
    name = output or residuals.outputs(data)[0]
    measured = data[residuals.measured(name)]
    scale = engineering(reading.unit(measured), style.magnitude(measured.values))
    runs = [str(run) for run in data[schema.RUN].values[:RUNS]]
    columns = min(len(runs), COLUMNS)
    rows = -(-len(runs) // columns)
    figure = style.blank(2.6 * columns + 1.0, 2.9 * rows + 0.3)
    axes = figure.subplots(
        2 * rows, columns, squeeze=False, gridspec_kw={"height_ratios": [2, 1] * rows}
    )
    for place in axes.flat:
        place.set_visible(False)
    for number, run in enumerate(runs):
        row, column = 2 * (number // columns), number % columns
        upper, lower = axes[row, column], axes[row + 1, column]
        for place in (upper, lower):
            place.set_visible(True)
            style.dress(place)
        one = data.sel({schema.RUN: run})
        _curves(upper, lower, one, name, scale.factor)
        upper.set_title(style.plain(run, 24), fontsize=style.TEXT, loc="left")
        upper.tick_params(labelbottom=False)
        lower.set_xlabel(residuals.place(one), fontsize=style.SMALL)
        if column == 0:
            upper.set_ylabel(scale.label(name), fontsize=style.SMALL)
            lower.set_ylabel("residual", fontsize=style.SMALL)
    figure.subplots_adjust(0.09, 0.2 / rows, 0.98, 1 - 0.09 / rows, 0.25, 0.35)
    return figure


def _curves(upper: Axes, lower: Axes, one: xr.Dataset, name: str, factor: float) -> None:
    """Measured broad and pale, so that a prediction that lies on it can be seen on it."""
    place = residuals.place(one)
    x = np.asarray(one[place].values, dtype=float)
    x = x % 1.0 if place == schema.PHASE else x
    curves = [
        factor * np.asarray(one[key].values, dtype=float)
        for key in (residuals.measured(name), residuals.predicted(name), name)
    ]
    if place == schema.PHASE and reading.is_resolved(x, curves[0]):
        lines = [reading.fold(x, curve) for curve in curves]
    else:
        lines = [_in_order(x, curve) for curve in curves]
    many = lines[0][0].size > reading.BINS // 2
    shape = {"lw": 4.0, "alpha": 0.55} if many else {"lw": 0.0, "marker": "o", "ms": 3.5}
    upper.plot(*lines[0], color=style.MEASURED, **shape)
    upper.plot(*lines[1], color=style.BEFORE, lw=1.3)
    lower.axhline(0.0, color=style.NEUTRAL, lw=0.8)
    line = {"lw": 0.9} if many else {"lw": 0.0, "marker": "o", "ms": 2.5}
    lower.plot(*lines[2], color=style.BEFORE, **line)


def _in_order(x: Array, y: Array) -> tuple[Array, Array]:
    keep = np.isfinite(x) & np.isfinite(y)
    order = np.argsort(x[keep], kind="stable")
    return reading.thin(x[keep][order], y[keep][order])


def prediction(data: xr.Dataset) -> Figure:
    """Prediction of a function with its interval, over its input or the number of the sample.

    Parameters
    ----------
    data : xarray.Dataset
        Of :meth:`bayesoleo.session.Fit.predict` for a function.
    """
    place = str(data.attrs["place"])
    x, mean = np.asarray(data[place].values, dtype=float), data["mean"].values
    order = np.argsort(x, kind="stable")
    figure = style.blank(4.8, 3.0)
    axes = figure.subplots()
    style.dress(axes)
    low, high = data["low"].values[order], data["high"].values[order]
    axes.fill_between(x[order], low, high, color=style.NOISE, lw=0)
    axes.plot(x[order], mean[order], color=style.BEFORE, lw=1.3)
    axes.set_xlabel(place, fontsize=style.SMALL)
    axes.set_ylabel(str(data.attrs["output"]), fontsize=style.SMALL)
    figure.subplots_adjust(0.16, 0.17, 0.97, 0.96)
    return figure


def noise_and_frequency(data: xr.Dataset) -> Figure:
    """Noise of each channel over its largest, by run.

    Parameters
    ----------
    data : xarray.Dataset
        With the noise of each channel by run.
    """
    figure = style.blank(4.8, 2.2)
    axes = figure.subplots()
    style.dress(axes)
    places = np.arange(data.sizes[schema.RUN])
    for number, (name, values) in enumerate(data.data_vars.items()):
        scale = engineering(reading.unit(values), style.magnitude(values.values))
        relative = values.values / np.nanmax(values.values)
        colour = style.ENSEMBLES[number % len(style.ENSEMBLES)]
        axes.plot(places, relative, "o-", ms=3, lw=0.8, color=colour, label=scale.label(str(name)))
    axes.set_xticks(places, [style.plain(str(run), 10) for run in data[schema.RUN].values])
    axes.set_ylim(0, 1.1)
    axes.set_ylabel("noise over its largest", fontsize=style.SMALL)
    axes.legend(frameon=False, fontsize=style.SMALL)
    figure.subplots_adjust(0.14, 0.16, 0.97, 0.96)
    return figure
