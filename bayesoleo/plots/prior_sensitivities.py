"""How much each quantity leans on its prior and on its data."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo.plots import style

LEFT, TOP, BOTTOM, ROW = 2.6, 0.55, 0.6, 0.26
MOST = 40
#: Above this a sensitivity is worth a look.
THRESHOLD = 0.05


def prior_sensitivity(data: xr.Dataset) -> Figure:
    """Sensitivities to prior and likelihood, a row for each quantity.

    Parameters
    ----------
    data : xarray.Dataset
        From :func:`bayesoleo.posterior.outcome.prior_sensitivity`.

    Returns
    -------
    Figure
        Left of the line a sensitivity is of no account. A quantity whose prior's lies right of it
        is written in colour.
    """
    names = [str(name) for name in data[schema.QUANTITY].values][:MOST]
    height = TOP + ROW * max(len(names), 2) + BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = style.WIDTH - LEFT - 0.3
    box = LEFT / style.WIDTH, BOTTOM / height, wide / style.WIDTH, 1 - (TOP + BOTTOM) / height
    axes = figure.add_axes(box)
    style.dress(axes, ticks=8)
    rows = np.arange(len(names))
    colours = {"prior": style.BEFORE, "likelihood": style.AFTER}
    for group, mark in (("prior", "D"), ("likelihood", "o")):
        values = data[group].values[: len(names)]
        axes.plot(values, rows, mark, ms=4.5, color=colours[group])
    axes.axvline(THRESHOLD, color=style.NEUTRAL, lw=0.8)
    axes.set_xlim(left=0.0)
    axes.set_ylim(max(len(names), 2) - 0.5, -0.5)
    axes.set_yticks(rows, [style.plain(name, 34) for name in names])
    axes.tick_params(axis="y", length=0, labelsize=style.SMALL)
    for label, diagnosis in zip(axes.get_yticklabels(), data["diagnosis"].values, strict=False):
        if str(diagnosis):
            label.set_color(style.BEFORE)
    axes.set_xlabel("sensitivity to a power of prior or likelihood", fontsize=style.TEXT)
    handles = [style.line(colours[g], g, 4.0) for g in ("prior", "likelihood")]
    style.legend(figure, handles)
    return figure
