"""The scatter of an estimator over replications, parameter by parameter, against theory."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from scipy import stats

from bayesoleo import schema
from bayesoleo.estimation.shown import LabelledResult
from bayesoleo.plots import style
from bayesoleo.plots.reading import dataset
from bayesoleo.plots.regions import MOST, panel_grid

BINS = 41
WIDTHS = 4.5


def sampling_distribution(found: LabelledResult | xr.Dataset | xr.DataTree) -> Figure:
    """Histograms of the estimates about the truth, in standard deviations of the bound.

    Parameters
    ----------
    found : LabelledResult, xarray.Dataset or xarray.DataTree
        The group ``sampling_distribution``.

    Returns
    -------
    Figure
        The line is the normal density that the Cramér-Rao bound allows, the dashed one that of the
        noise propagated through the estimator.
    """
    data = dataset(found)
    names = [str(name) for name in data[schema.PARAMETER].values][:MOST]
    good = data["status"].values == 0
    figure, panels = panel_grid(len(names))
    bins = int(np.clip(2 * np.sqrt(good.sum()), 9, BINS))
    grid = np.linspace(-WIDTHS, WIDTHS, 200)
    for axes, name in zip(panels, names, strict=True):
        one = data.sel(parameter=name)
        unit = float(one["bound_sd"])
        scaled = (one["replicate"].values[good] - float(one["truth"])) / unit
        axes.hist(
            np.clip(scaled, -WIDTHS, WIDTHS), np.linspace(-WIDTHS, WIDTHS, bins).tolist(),
            density=True, color=style.SIMILAR,
        )  # fmt: skip
        axes.plot(grid, stats.norm.pdf(grid), color=style.AFTER, lw=1.6)
        expected = float(one["expected_sd"]) / unit
        axes.plot(grid, stats.norm.pdf(grid, 0, expected), "--", color=style.BEFORE, lw=1.2)
        axes.axvline(float(one["bias"]) / unit, color=style.INK, lw=0.8)
        style.dress(axes, 4)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.set_xlabel(style.plain(name, 30), fontsize=style.TEXT)
        text = f"bias {float(one['bias']) / unit:+.2f}\nefficiency {float(one['efficiency']):.2f}"
        axes.text(
            0.98, 0.97, text, transform=axes.transAxes, ha="right", va="top",
            fontsize=style.SMALL, color=style.FAINT,
        )  # fmt: skip
    handles: list[Artist] = [
        style.band(style.SIMILAR, f"{int(good.sum())} replications"),
        style.line(style.AFTER, "Cramér-Rao bound"),
        style.line(style.BEFORE, "linearised estimator", 1.2, "--"),
    ]
    style.legend(figure, handles, "distance from the truth in sd of the bound")
    return figure
