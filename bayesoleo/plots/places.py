"""Where the repeating error lives: by harmonic, and by what it may be a function of."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bayesoleo import schema
from bayesoleo.assessment.whereabouts import ORDERS
from bayesoleo.assessment.whereabouts import residual_breakdown as found_in
from bayesoleo.plots import style

TOP, BOTTOM, GAP, ROW = 0.75, 0.62, 0.75, 2.3
#: Coordinates shown of each output, those first that explain most.
SHOWN = 7


def residual_breakdown(tree: xr.DataTree) -> Figure:
    """Share of the repeating error by harmonic, and what of it a function of a coordinate explains.

    Parameters
    ----------
    tree : DataTree
        Of ``close`` or ``trace``, with a periodic run.

    Returns
    -------
    Figure
        One row an output. All shares are of the excess over the noise that the model as declared
        leaves, all runs together; what the extended model leaves is blue.
    """
    data = found_in(tree)
    outputs = [str(name) for name in data[schema.OUTPUT].values]
    height = TOP + len(outputs) * ROW + (len(outputs) - 1) * GAP + BOTTOM
    figure = style.blank(style.WIDTH, height)
    stages = [str(stage) for stage in data["stage"].values]
    colours = [style.BEFORE, style.AFTER][-len(stages) :] if len(stages) > 1 else [style.BEFORE]
    for row, output in enumerate(outputs):
        one = 100 * data.sel({schema.OUTPUT: output})
        bottom = (height - TOP - (row + 1) * ROW - row * GAP) / height
        _harmonics(figure, (0.075, bottom, 0.37, ROW / height), one, colours, output)
        _places(figure, (0.64, bottom, 0.34, ROW / height), one, colours)
    words = {"before": "model as declared", "after": "with what was added"}
    handles = [Patch(facecolor=c, label=words[s]) for s, c in zip(stages, colours, strict=True)]
    style.legend(figure, handles)
    return figure


def _harmonics(
    figure: Figure, box: tuple[float, float, float, float], one: xr.Dataset, colours: list[str],
    output: str,
) -> None:  # fmt: skip
    axes = figure.add_axes(box)
    style.dress(axes)
    width = 0.8 / len(colours)
    orders = np.arange(ORDERS + 1)
    for k, colour in enumerate(colours):
        axes.bar(orders + (k - (len(colours) - 1) / 2) * width, one["power"].values[k], width,
                 color=colour)  # fmt: skip
    axes.set_xticks(orders, [*map(str, orders[:-1]), f"≥ {ORDERS}"])
    axes.axhline(0, color=style.FAINT, lw=0.8)
    axes.set_xlabel("harmonic", fontsize=style.TEXT)
    axes.set_ylabel("share of the excess in %", fontsize=style.TEXT)
    axes.set_title(style.plain(output), loc="left", fontsize=style.TEXT, fontweight="bold")


def _places(
    figure: Figure, box: tuple[float, float, float, float], one: xr.Dataset, colours: list[str]
) -> None:
    axes = figure.add_axes(box)
    style.dress(axes)
    share = one["share"].values
    order = np.argsort(-share[0])[:SHOWN]
    width = 0.8 / len(colours)
    for k, colour in enumerate(colours):
        at = np.arange(order.size) + (k - (len(colours) - 1) / 2) * width
        axes.barh(at, np.clip(share[k][order], 0.0, 100.0), width, color=colour)
    names = [style.plain(str(one["coordinate"].values[k]), 34) for k in order]
    axes.set_yticks(np.arange(order.size), names, fontsize=style.SMALL)
    axes.set_ylim(order.size - 0.5, -0.5)
    axes.set_xlim(0, 100)
    axes.set_xlabel("explained by a function of it, one for all runs, in %", fontsize=style.TEXT)
