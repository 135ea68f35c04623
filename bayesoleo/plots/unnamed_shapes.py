"""The shape of an effect without a name: a curve with its band, or a map."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.plots import style
from bayesoleo.plots.reading import dataset
from bayesoleo.plots.units import engineering

HEIGHT = 3.6
#: Half-width of a band that holds 95 % of a normal density.
BAND = 1.96


def nonparametric_shape(found: xr.Dataset | xr.DataTree) -> Figure:
    """A nonparametric effect over the quantities that it follows.

    Parameters
    ----------
    found : xarray.Dataset or xarray.DataTree
        The group ``nonparametric`` of a result, or the result.

    Returns
    -------
    Figure
        Of one quantity the function and its 95 % band; of two a map of the function and one of its
        standard deviation.
    """
    if isinstance(found, xr.DataTree) and schema.NONPARAMETRIC in found.children:
        found = found[schema.NONPARAMETRIC].to_dataset()
    data = dataset(found)
    figure = style.blank(style.WIDTH, HEIGHT)
    names = [str(name) for name in data["quantity"].values]
    units = [str(unit) for unit in data["quantity_unit"].values]
    scales = [
        engineering(unit, style.magnitude(row))
        for unit, row in zip(units, data["place"].values, strict=True)
    ]
    labels = [s.label(style.plain(n)) for n, s in zip(names, scales, strict=True)]
    places = [row * s.factor for row, s in zip(data["place"].values, scales, strict=True)]
    value, sd = data["value"].values, data["sd"].values
    scale = engineering(data["value"].attrs[schema.UNITS], style.magnitude(value))
    if len(names) == 1:
        axes = figure.add_axes((0.09, 0.17, 0.89, 0.75))
        _curve(axes, places[0], value * scale.factor, sd * scale.factor)
        axes.set_xlabel(labels[0], fontsize=style.TEXT)
        axes.set_ylabel(scale.label("nonparametric effect"), fontsize=style.TEXT)
        return figure
    panels = ((0.09, value, "nonparametric effect"), (0.58, sd, "standard deviation"))
    for left, shown, what in panels:
        axes = figure.add_axes((left, 0.17, 0.33, 0.72))
        _map(figure, axes, places, shown * scale.factor, scale.label(what))
        axes.set_xlabel(labels[0], fontsize=style.TEXT)
        axes.set_ylabel(labels[1], fontsize=style.TEXT)
    return figure


def _curve(axes: Axes, place: Array, value: Array, sd: Array) -> None:
    style.dress(axes, ticks=6)
    low, high = value - BAND * sd, value + BAND * sd
    axes.axhline(0.0, color=style.FAINT, linewidth=0.6)
    axes.fill_between(place, low, high, color=style.SIMILAR, linewidth=0, label="95 % band")
    axes.plot(place, value, color=style.AFTER, linewidth=1.3, label="estimate")
    axes.set_xlim(place[0], place[-1])
    # The ends, where few samples lie, must not flatten the rest.
    inner = slice(place.size // 20, -place.size // 20)
    room = 0.1 * (high[inner].max() - low[inner].min())
    axes.set_ylim(low[inner].min() - room, high[inner].max() + room)
    axes.legend(frameon=False, fontsize=style.SMALL, loc="best")


def _map(figure: Figure, axes: Axes, places: list[Array], value: Array, label: str) -> None:
    style.dress(axes, ticks=5)
    side = round(np.sqrt(value.size))
    grid = [place.reshape(side, side) for place in places]
    top = style.magnitude(value) or 1.0
    signed = bool((value < 0).any())
    shown = axes.pcolormesh(
        *grid, value.reshape(side, side), cmap="RdBu_r" if signed else "Blues",
        vmin=-top if signed else 0.0, vmax=top, shading="gouraud", rasterized=True,
    )  # fmt: skip
    axes.set_title(label, fontsize=style.TEXT, loc="left", color=style.INK)
    bar = figure.colorbar(shown, ax=axes, fraction=0.05, pad=0.03)
    bar.ax.tick_params(labelsize=style.SMALL)
