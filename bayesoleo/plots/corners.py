"""The posterior, pair by pair."""

from __future__ import annotations

import re

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from bayesoleo._types import Array
from bayesoleo.plots import style
from bayesoleo.plots.draws import chosen, draws, point_table, unit_of
from bayesoleo.plots.units import Scale, engineering, format_number

MOST = 10
#: Characters of a name in one line below a panel, lines, and what each takes in inches.
ACROSS, LINES, LINE = 15, 3, 0.13


def corner(tree: xr.DataTree, parameters: list[str] | None = None) -> Figure:
    """Marginal densities and pairs of the posterior, with the point estimate as lines.

    Parameters
    ----------
    tree : DataTree
        Needs ``posterior``.
    parameters : list of str, optional
        Those shown; by default at most ten: first those of the effects added, then those shared by
        all runs.

    Returns
    -------
    Figure
        Contours hold 39 and 86 % of the draws (one and two standard deviations of a normal).
    """
    import corner as corner_package

    names = chosen(tree, MOST) if parameters is None else list(parameters)
    values = [draws(tree, name).ravel() for name in names]
    scales = [
        engineering(unit_of(tree, n), style.magnitude(v))
        for n, v in zip(names, values, strict=True)
    ]
    shown = np.column_stack([s.factor * v for s, v in zip(scales, values, strict=True)])
    point = point_table(tree)
    truths = [
        s.factor * point[n][0] if n in point else None for n, s in zip(names, scales, strict=True)
    ]
    labels = [_label(name, scale) for name, scale in zip(names, scales, strict=True)]
    margin = 0.59 + LINE * max(text.count("\n") + 1 for text in labels)
    size = max(1.05 * len(names) + margin, 3.2)
    figure = style.blank(size, size)
    corner_package.corner(
        shown,
        fig=figure,
        bins=24,
        range=[_range(column, truth) for column, truth in zip(shown.T, truths, strict=True)],
        smooth=1.0,
        levels=(0.393, 0.865),
        plot_datapoints=False,
        plot_density=False,
        fill_contours=True,
        color=style.AFTER,
        max_n_ticks=3,
        quiet=True,
    )
    _arrange(figure, margin)
    _mark(figure, truths)
    _tidy(figure, labels, shown)
    handles = [
        style.band(style.AFTER, "posterior"),
        style.line(style.BEFORE, "point estimate", 1.2),
    ]
    if len(names) > 1:
        figure.legend(handles=handles, loc="upper right", frameon=False, fontsize=style.TEXT)
    return figure


def _range(values: Array, truth: float | None) -> tuple[float, float]:
    """All but the outermost draws, and the point in any case; never of zero width."""
    low, high = np.quantile(values, [0.002, 0.998])
    if truth is not None and np.isfinite(truth):
        low, high = min(low, truth), max(high, truth)
    if high <= low:
        half = max(abs(low), 1.0) * 1e-6
        return low - half, high + half
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def _mark(figure: Figure, truths: list[float | None]) -> None:
    """Lines at the point estimate; corner's own marks fail on a single parameter."""
    count = len(truths)
    axes = np.array(figure.axes).reshape(count, count)
    for row in range(count):
        for column in range(row + 1):
            x, y = truths[column], truths[row]
            if x is not None:
                axes[row, column].axvline(x, color=style.BEFORE, lw=1.0)
            if y is not None and column < row:
                axes[row, column].axhline(y, color=style.BEFORE, lw=1.0)


def _arrange(figure: Figure, margin: float) -> None:
    """Margins in inches, as everywhere."""
    size = figure.get_figwidth()
    figure.subplots_adjust(
        left=margin / size, right=1 - 0.15 / size, bottom=margin / size, top=1 - 0.4 / size,
        wspace=0.07, hspace=0.07,
    )  # fmt: skip


def _tidy(figure: Figure, labels: list[str], shown: Array) -> None:
    """Titles with value and spread, names and units on the outer axes, readable numbers."""
    count, size = len(labels), figure.get_figwidth()
    axes = np.array(figure.axes).reshape(count, count)
    for i in range(count):
        mean, sd = shown[:, i].mean(), shown[:, i].std()
        text = f"{format_number(mean, sd)} ± {format_number(sd, sd)}"
        axes[i, i].set_title(text, fontsize=style.SMALL - 0.5, color=style.INK, pad=4)
        _axis(axes[count - 1, i], "x", labels[i], size)
        if i > 0:
            _axis(axes[i, 0], "y", labels[i], size)
    for panel in axes.ravel():
        panel.tick_params(length=2.5, color=style.FAINT)
        for spine in panel.spines.values():
            spine.set_color(style.NEUTRAL)


def _label(name: str, scale: Scale) -> str:
    """Name and unit below each other; a panel is too narrow for both in one line."""
    text = style.plain(name.replace("log_variance_", "log var. "), ACROSS * LINES)
    lines = [""]
    for part in re.split(r"(?<=[_ ])|(?=\[)", text):
        if lines[-1] and len(lines[-1] + part.rstrip()) > ACROSS and len(lines) < LINES:
            lines.append("")
        lines[-1] += part
    lines = [style.plain(line.rstrip(), ACROSS + 4) for line in lines]
    return "\n".join([*lines, f"[{scale.unit}]"] if scale.unit else lines)


def _axis(axes: Axes, which: str, label: str, size: float) -> None:
    """Few numbers, without offsets; the name at a fixed distance in a figure of ``size`` inches."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(MaxNLocator(3, prune="both", steps=[1, 2, 5, 10]))
    formatter = ScalarFormatter(useOffset=False)
    formatter.set_scientific(False)
    axis.set_major_formatter(formatter)
    axis.set_tick_params(labelsize=style.SMALL - 1, labelrotation=45)
    axis.set_label_text(label, fontsize=style.SMALL, color=style.INK)
    place = axes.get_position()
    if which == "x":
        axis.set_label_coords(0.5, -0.48 / (place.height * size))
    else:
        axis.set_label_coords(-0.5 / (place.width * size), 0.5)
