"""The point estimate held against the posterior, parameter by parameter."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bayesoleo.plots import style
from bayesoleo.plots.draws import draws, point_table
from bayesoleo.plots.units import format_value

LEFT, RIGHT, TOP, BOTTOM, ROW = 2.3, 2.2, 0.55, 0.6, 0.3
MOST = 40


def point_against_posterior(tree: xr.DataTree) -> Figure:
    """Mode with its linearised standard deviation against intervals of the posterior.

    Parameters
    ----------
    tree : DataTree
        Needs ``point`` and ``posterior``.

    Returns
    -------
    Figure
        In posterior standard deviations about the posterior mean, so that all parameters share an
        axis; where both rows agree the linearised interval would have done.
    """
    table = point_table(tree)
    names = [name for name in table if name in tree["posterior"]][:MOST]
    height = TOP + ROW * max(len(names), 2) + BOTTOM
    figure = style.blank(style.WIDTH, height)
    width = style.WIDTH - LEFT - RIGHT
    box = (LEFT / style.WIDTH, BOTTOM / height, width / style.WIDTH, 1 - (TOP + BOTTOM) / height)
    axes = figure.add_axes(box)
    style.dress(axes, ticks=9)
    largest = 3.2
    for row, name in enumerate(names):
        largest = max(largest, _row(axes, row, draws(tree, name).ravel(), table[name]))
    axes.axvline(0.0, color=style.NEUTRAL, lw=0.8, zorder=0)
    axes.set_ylim(max(len(names), 2) - 0.5, -0.5)
    axes.set_xlim(-min(largest, 12.0), min(largest, 12.0))
    axes.set_yticks(range(len(names)), [style.plain(name, 30) for name in names])
    axes.tick_params(axis="y", length=0, labelsize=style.TEXT)
    axes.spines["left"].set_visible(False)
    text = "distance from the posterior mean in posterior standard deviations"
    axes.set_xlabel(text, fontsize=style.TEXT)
    style.legend(figure, _handles())
    return figure


def _row(axes: Axes, row: int, values: np.ndarray, point: tuple[float, float, str]) -> float:
    """One parameter; gives how far it reaches."""
    estimate, linear_sd, unit = point
    mean, sd = float(values.mean()), float(values.std()) or 1.0
    outer = (np.quantile(values, [0.025, 0.975]) - mean) / sd
    inner = (np.quantile(values, [0.25, 0.75]) - mean) / sd
    axes.plot(outer, [row - 0.13] * 2, color=style.SIMILAR, lw=2.5, solid_capstyle="butt")
    axes.plot(inner, [row - 0.13] * 2, color=style.AFTER, lw=5, solid_capstyle="butt")
    place = (estimate - mean) / sd
    reach = 1.96 * linear_sd / sd if np.isfinite(linear_sd) else 0.0
    axes.plot([place - reach, place + reach], [row + 0.2] * 2, color=style.BEFORE, lw=1.3)
    axes.plot(place, row + 0.2, "D", ms=4.5, color=style.BEFORE)
    text = f"{format_value(estimate, unit, sd)}"
    axes.text(
        1.03, row, text, transform=axes.get_yaxis_transform(), va="center",
        fontsize=style.SMALL, color=style.INK,
    )  # fmt: skip
    return float(1.08 * max(*np.abs(outer), abs(place) + reach))


def _handles() -> list[Artist]:
    """What the lines mean."""
    return [
        style.line(style.AFTER, "posterior, 50 %", 5.0),
        style.line(style.SIMILAR, "posterior, 95 %", 2.5),
        Line2D(
            [], [], color=style.BEFORE, marker="D", ms=4.5, lw=1.3,
            label="point estimate ± 1.96 linearised sd",
        ),
    ]  # fmt: skip
