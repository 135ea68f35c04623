"""What to measure next: how well runs over the range of a rig would tell rival effects apart."""

from __future__ import annotations

import json

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from bayesoleo import schema
from bayesoleo.effects.titles import called, listed
from bayesoleo.plots import reading, style
from bayesoleo.plots.units import Scale, engineering

LEFT, TOP, BOTTOM, RIGHT, HIGH = 0.85, 0.75, 0.62, 1.2, 2.8
#: Separations below and above are not told apart by colour.
LEAST, MOST = 0.1, 100.0


def proposal(tree: xr.DataTree, number: int = 0) -> Figure:
    """Standard deviations by which a run of some frequency and amplitude separates the rivals.

    Parameters
    ----------
    tree : DataTree
        With the group ``proposal``.
    number : int
        Which of its rounds, from 0.

    Returns
    -------
    Figure
        Of the least separated pair, at the mean position that is best for each frequency and
        amplitude; runs that the rig cannot do are left blank. Dots: the runs that were made; star:
        the best of those that were not.
    """
    data = tree[schema.PROPOSAL].to_dataset().isel({schema.ROUND: number})
    sigma = data["sigma"].max(schema.MEAN)
    scale = engineering(reading.unit(data[schema.AMPLITUDE]), float(data[schema.AMPLITUDE].max()))
    height = TOP + HIGH + BOTTOM
    figure = style.blank(style.WIDTH * 0.72, height)
    width = figure.get_figwidth()
    box = (LEFT / width, BOTTOM / height, 1 - (LEFT + RIGHT) / width, HIGH / height)
    axes = figure.add_axes(box)
    style.dress(axes)
    mesh = axes.pcolormesh(
        _edges(data[schema.FREQUENCY].values),
        _edges(scale.factor * data[schema.AMPLITUDE].values),
        sigma.values,
        norm=LogNorm(LEAST, MOST),
        cmap="YlGnBu",
    )
    bar = figure.colorbar(
        mesh, cax=figure.add_axes((1 - 0.95 / width, box[1], 0.16 / width, box[3]))
    )
    bar.set_label("separation in standard deviations", fontsize=style.SMALL)
    bar.ax.tick_params(labelsize=style.SMALL)
    bar.ax.yaxis.set_major_formatter("{x:g}")
    _marks(axes, tree, data, scale)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("frequency in Hz", fontsize=style.TEXT)
    drive = tree[schema.PROPOSAL].attrs["drive"]
    axes.set_ylabel(scale.label(f"amplitude of {drive}"), fontsize=style.TEXT)
    titles = reading.summary(tree).get("titles", {})
    rivals = listed([called(one, titles) for one in json.loads(str(data["rivals"].values))])
    handles = [
        Line2D([], [], color=style.INK, marker="o", ms=4, ls="", label="runs made"),
        Line2D([], [], color=style.BEFORE, marker="*", ms=11, ls="", label="best run"),
    ]
    style.legend(figure, handles, style.plain(rivals, 70))
    return figure


def _marks(axes: Axes, tree: xr.DataTree, data: xr.Dataset, scale: Scale) -> None:
    """The runs that were made, and the best one that was not."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_locator(LogLocator(10, (1, 2, 5)))
    axes.yaxis.set_major_locator(LogLocator(10, (1, 2, 5)))
    limits = axes.get_xlim(), axes.get_ylim()
    observed = reading.group(tree, schema.RECORDS)
    drive = str(tree[schema.PROPOSAL].attrs["drive"])
    if observed is not None and drive in observed:
        rows = observed[drive].values
        half = (np.nanmax(rows, axis=1) - np.nanmin(rows, axis=1)) / 2
        made = [run.frequency for run in reading.runs(tree)]
        axes.plot(made, scale.factor * half, "o", color=style.INK, ms=4, clip_on=False, zorder=3)
    if np.isfinite(data["information"].values).any():
        best = data.isel(data["rank"].argmin(...))
        axes.plot(
            float(best[schema.FREQUENCY]),
            scale.factor * float(best[schema.AMPLITUDE]),
            "*",
            color=style.BEFORE,
            ms=13,
            zorder=4,
        )
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])


def _edges(values: np.ndarray) -> np.ndarray:
    """Edges of cells about values a factor apart."""
    if values.size == 1:
        return np.array([values[0] / 1.5, values[0] * 1.5])
    middle = np.sqrt(values[1:] * values[:-1])
    return np.concatenate(([values[0] ** 2 / middle[0]], middle, [values[-1] ** 2 / middle[-1]]))
