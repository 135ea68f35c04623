"""Which parameters matter: a table of shares or of per cents, as colours with their numbers."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo.estimation.shown import LabelledResult
from bayesoleo.plots import style
from bayesoleo.plots.reading import dataset

ROW, LEFT, TOP, BOTTOM = 0.32, 2.4, 1.5, 0.3
MOST = 40
_SHADES = LinearSegmentedColormap.from_list("share", ["#ffffff", style.SIMILAR, style.AFTER])


def sensitivity(found: LabelledResult | xr.Dataset | xr.DataTree) -> Figure:
    """Sobol indices, or local changes in per cent, feature by parameter.

    Parameters
    ----------
    found : LabelledResult, xarray.Dataset or xarray.DataTree
        From :func:`~bayesoleo.estimation.global_sensitivity`, ``sobol`` or
        ``local_sensitivity``.

    Returns
    -------
    Figure
        Total shares with the first-order ones in brackets, or changes in per cent.
    """
    data = dataset(found)
    names = [str(name) for name in data[schema.PARAMETER].values]
    features = [str(name) for name in data["feature"].values][:MOST]
    if "total" in data:
        shown = data["total"].values[:MOST]
        first = data["first"].values[:MOST]
        texts = [[f"{t:.2f} ({f:.2f})" for t, f in zip(a, b, strict=True)] for a, b in
                 zip(shown, first, strict=True)]  # fmt: skip
        title, top = "share of the variance, total (alone)", 1.0
    else:
        shown = data["percent"].values[:MOST]
        texts = [[f"{value:+.3g} %" for value in row] for row in shown]
        step = "one prior sd" if data.attrs["per"] == "prior" else "1 % of the parameter"
        title, top = f"change by {step}", float(np.nanmax(np.abs(shown)))
    height = TOP + ROW * max(len(features), 2) + BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = style.WIDTH - LEFT - 0.9
    tall = ROW * len(features)
    axes = figure.add_axes(
        (LEFT / style.WIDTH, 1 - (TOP + tall) / height, wide / style.WIDTH, tall / height)
    )
    table(axes, np.abs(shown) / (top or 1.0), texts, features, names)
    figure.text(0.02, 1 - 0.1 / height, title, va="top", fontsize=style.TEXT, color=style.INK)
    return figure


def table(
    axes: Axes,
    shades: np.ndarray,
    texts: list[list[str]],
    rows: list[str],
    columns: list[str],
) -> None:
    """Cells from white to blue by values from 0 to 1, with their texts."""
    axes.imshow(np.nan_to_num(np.clip(shades, 0, 1)), cmap=_SHADES, vmin=0, vmax=1, aspect="auto")
    for r, line in enumerate(texts):
        for c, text in enumerate(line):
            colour = "white" if np.nan_to_num(shades[r, c]) > 0.75 else style.INK
            axes.text(c, r, text, ha="center", va="center", fontsize=style.SMALL - 1, color=colour)
    axes.set_xticks(range(len(columns)), [style.plain(c, 24) for c in columns], rotation=30)
    axes.xaxis.tick_top()
    for label in axes.get_xticklabels():
        label.set_horizontalalignment("left")
    axes.set_yticks(range(len(rows)), [style.plain(r, 30) for r in rows])
    axes.tick_params(length=0, labelsize=style.SMALL)
    for spine in axes.spines.values():
        spine.set_visible(False)
