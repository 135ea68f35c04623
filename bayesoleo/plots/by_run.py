"""Estimates of single runs side by side, with what all of them say of mean and spread."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo.errors import InputError
from bayesoleo.estimation import Hierarchy, between_runs
from bayesoleo.plots import style
from bayesoleo.plots.units import engineering

HIGH, GAP, TOP, BOTTOM, LEFT = 1.7, 0.65, 0.65, 0.35, 0.85
_COLUMNS = 2


def by_run(each: xr.Dataset) -> Figure:
    """Every parameter by run, two standard deviations each, about the common mean.

    Parameters
    ----------
    each : xarray.Dataset
        Of ``estimate_each``.

    Returns
    -------
    Figure
        A panel a parameter. The line is the mean over runs, the band twice the standard deviation
        between runs that is left when the estimates' own is taken off. Runs that did not converge
        are crosses and count for neither; in the title, the probability of so much scatter by
        noise. A parameter that the runs do not determine has neither line nor band.
    """
    names = [str(name) for name in each[schema.PARAMETER].values]
    rows = math.ceil(len(names) / _COLUMNS)
    height = TOP + rows * HIGH + (rows - 1) * GAP + BOTTOM
    figure = style.blank(style.WIDTH, height)
    good = each["status"].values == "converged"
    view = _compared(each)
    wide = (style.WIDTH - LEFT) / _COLUMNS
    for k, name in enumerate(names):
        row, column = divmod(k, _COLUMNS)
        bottom = height - TOP - (row + 1) * HIGH - row * GAP
        axes = figure.add_axes(
            (
                (LEFT + column * wide) / style.WIDTH,
                bottom / height,
                0.84 * wide / style.WIDTH,
                HIGH / height,
            )
        )
        style.dress(axes)
        _panel(axes, each.sel({schema.PARAMETER: name}), view, name, good)
    handles: list[Artist] = [
        style.line(style.INK, "run ± 2 sd", 1.0),
        style.line(style.AFTER, "mean over runs"),
        style.band(style.SIMILAR, "± 2 sd between runs"),
    ]
    style.legend(figure, handles if view is not None else handles[:1])
    return figure


def _compared(each: xr.Dataset) -> Hierarchy | None:
    """Mean and spread over the runs; None where too few of them can be compared."""
    try:
        return between_runs(each)
    except InputError:
        return None


def _panel(
    axes: Axes, one: xr.Dataset, view: Hierarchy | None, name: str, good: np.ndarray
) -> None:
    values, place = one[schema.ESTIMATE].values, np.arange(good.size)
    scale = engineering(str(one[schema.UNIT].values), style.magnitude(values))
    if view is not None and name in view.names:
        k = view.names.index(name)
        mean, spread = scale.factor * view.mean[k], scale.factor * view.spread[k]
        axes.axhspan(mean - 2 * spread, mean + 2 * spread, color=style.SIMILAR, lw=0)
        axes.axhline(mean, color=style.AFTER, lw=1.2)
        p_value = view.p_value[k]
        text = f"p equal = {p_value:.2g}" if p_value >= 1e-3 else "p equal < 0.001"
        axes.set_title(text, loc="right", fontsize=style.SMALL, pad=3, color=style.FAINT)
    axes.errorbar(
        place[good],
        scale.factor * values[good],
        2 * scale.factor * one[schema.SD].values[good],
        fmt="o",
        ms=3.5,
        lw=1.0,
        color=style.INK,
    )
    axes.plot(place[~good], scale.factor * values[~good], "x", ms=5, color=style.BEFORE)
    runs = [style.plain(str(run), 8) for run in one[schema.RUN].values]
    axes.set_xticks(place, runs)
    axes.set_xlim(-0.6, good.size - 0.4)
    axes.set_title(
        style.plain(scale.label(name), 45), loc="left", fontsize=style.SMALL, pad=3,
        fontweight="bold",
    )  # fmt: skip
