"""Figures of the error of each run before and after, and of the estimates of single runs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from bayesoleo import _schema as schema
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation._between_runs import Hierarchy, between_runs
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._style import engineering

#: What errors are divided by.
_OF = {schema.RATIO_TO_EXPECTED: "expected", schema.RATIO_TO_NOISE: "noise"}
ERROR_LEFT, ERROR_TOP, ERROR_BOTTOM, ROW = 2.4, 0.85, 0.6, 0.3


def error(tree: xr.DataTree) -> Figure:
    """Repeating error over what is expected for each run, before and after, a column each output.

    Parameters
    ----------
    tree : DataTree
        Its ``summary`` attribute is read: the first round is before, the last is after.

    Returns
    -------
    Figure
        On a logarithmic axis; at 1 nothing is missing. Where no run has a noise floor, as with
        transients, the rms of the raw residual is shown instead.
    """
    rounds = reading.summary(tree)["rounds"]
    first, last = rounds[0]["error"], rounds[-1]["error"]
    labels = _order(first)
    height = ERROR_TOP + ROW * len(labels) + ERROR_BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = (style.WIDTH - ERROR_LEFT - 0.15) / max(len(first), 1)
    for column, output in enumerate(first):
        x = (ERROR_LEFT + column * wide) / style.WIDTH
        box = (
            x,
            ERROR_BOTTOM / height,
            0.93 * wide / style.WIDTH,
            1 - (ERROR_TOP + ERROR_BOTTOM) / height,
        )
        axes = figure.add_axes(box)
        _column(axes, tree, output, labels, first[output], last[output], len(rounds) > 1)
        _rows(axes, labels, first[output], column == 0)
        axes.set_title(style.plain(output), fontsize=style.TEXT, fontweight="bold", pad=6)
    style.legend(figure, _handles(len(rounds) > 1))
    return figure


def _order(error: dict[str, Any]) -> list[str]:
    """Labels of all runs, those fitted first."""
    roles = {label: run["role"] for runs in error.values() for label, run in runs.items()}
    return sorted(roles, key=lambda label: roles[label] == schema.HOLD_OUT)


def _column(
    axes: Axes,
    tree: xr.DataTree,
    output: str,
    labels: list[str],
    first: dict[str, Any],
    last: dict[str, Any],
    two: bool,
) -> None:
    """One output."""
    entries = [run for runs in (first, last) for run in runs.values()]
    key = _ratio_key(entries)
    values = [run[key] for run in entries if run[key]]
    factor, text = 1.0, f"repeating error / {_OF.get(key, '')}"
    if key == schema.RMS:
        scale = engineering(_unit(tree, output), max(values, default=0.0))
        factor, text = scale.factor, scale.label("rms")
    else:
        axes.axvline(1.0, color=style.INK, lw=1.0, zorder=0.5)
        values.append(1.0)
    for row, label in enumerate(labels):
        pair = [
            factor * runs[label][key] if runs.get(label, {}).get(key) else None
            for runs in (first, last)
        ]
        _dumbbell(axes, row, pair[0], pair[1], two)
    _logarithmic(axes, factor * np.array(values or [1.0]))
    axes.set_xlabel(text, fontsize=style.TEXT)


def _ratio_key(entries: list[dict[str, Any]]) -> str:
    """What is shown: the ratio to what is expected, else to the noise, else the rms."""
    for key in _OF:
        if any(entry.get(key) is not None for entry in entries):
            return key
    return schema.RMS


def _dumbbell(axes: Axes, row: int, before: float | None, after: float | None, two: bool) -> None:
    """One run: where it was, where it is, and the way between."""
    if before is None or after is None:
        place = axes.get_yaxis_transform()
        text = "no noise floor; rms in the table"
        axes.text(0.03, row, text, transform=place, va="center", fontsize=7, color=style.FAINT)
        return
    if two:
        axes.plot([before, after], [row, row], color=style.NEUTRAL, lw=2.2, zorder=1)
        axes.plot(before, row, "o", ms=6.5, mfc="white", mec=style.BEFORE, mew=1.6, zorder=2)
    axes.plot(after, row, "o", ms=6.5, color=style.AFTER, zorder=3)


def _rows(axes: Axes, labels: list[str], first: dict[str, Any], named: bool) -> None:
    """Labels of the runs; hold-out runs lie on a pale ground below the fitted ones."""
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_yticks(range(len(labels)), [style.plain(label, 24) for label in labels])
    axes.tick_params(axis="y", length=0, labelleft=named)
    axes.spines[["left", "right", "top"]].set_visible(False)
    roles = [first.get(label, {}).get("role") for label in labels]
    for role, colour in ((schema.FIT, style.FAINT), (schema.HOLD_OUT, style.AFTER)):
        rows = [row for row, own in enumerate(roles) if own == role]
        if not rows:
            continue
        if role == schema.HOLD_OUT:
            axes.axhspan(rows[0] - 0.5, rows[-1] + 0.5, color="#eef4f9", lw=0, zorder=-2)
        if named:
            _bracket(axes, role, (rows[0] + rows[-1]) / 2, colour)


def _bracket(axes: Axes, role: str, middle: float, colour: str) -> None:
    """The role, beside the labels of its runs."""
    axes.annotate(
        role,
        (0, middle),
        (12 - ERROR_LEFT * 72, 0),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        va="center",
        fontsize=style.SMALL,
        color=colour,
    )


def _logarithmic(axes: Axes, values: Array) -> None:
    """A logarithmic axis of at least half a decade with plain numbers at 1, 2 and 5."""
    low, high = 0.8 * values.min(), 1.25 * values.max()
    if high / low < 3.0:
        middle = np.sqrt(low * high)
        low, high = middle / 1.8, middle * 1.8
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    span = high / low
    marks = (1, 1.5, 2, 3, 5, 7) if span < 8 else (1, 2, 5) if span < 300 else (1,)
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    places = [m * 10.0**k for k in decades for m in marks if low <= m * 10.0**k <= high]
    axes.xaxis.set_major_locator(FixedLocator(places))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.tick_params(labelsize=style.SMALL, color=style.FAINT)
    axes.grid(axis="x", color=style.NOISE, lw=0.6, zorder=-1)
    axes.set_axisbelow(True)


def _unit(tree: xr.DataTree, output: str) -> str:
    data = reading.group(tree, schema.RECORDS)
    return "" if data is None or output not in data else reading.unit(data[output])


def _handles(two: bool) -> list[Artist]:
    """What the marks mean."""

    hollow = Line2D([], [], marker="o", ls="", ms=6.5, mfc="white", mec=style.BEFORE, mew=1.6)
    hollow.set_label("before")
    full = Line2D([], [], marker="o", ls="", ms=6.5, color=style.AFTER)
    full.set_label("after" if two else "error")
    floor = Line2D([], [], color=style.INK, lw=1.0, label="noise floor")
    return [hollow, full, floor] if two else [full, floor]


HIGH, GAP, BY_RUN_TOP, BY_RUN_BOTTOM, BY_RUN_LEFT = 1.7, 0.65, 0.65, 0.35, 0.85
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
    height = BY_RUN_TOP + rows * HIGH + (rows - 1) * GAP + BY_RUN_BOTTOM
    figure = style.blank(style.WIDTH, height)
    good = each["status"].values == "converged"
    view = _compared(each)
    wide = (style.WIDTH - BY_RUN_LEFT) / _COLUMNS
    for k, name in enumerate(names):
        row, column = divmod(k, _COLUMNS)
        bottom = height - BY_RUN_TOP - (row + 1) * HIGH - row * GAP
        left = BY_RUN_LEFT + column * wide
        axes = style.add_axes(figure, left, bottom, 0.84 * wide, HIGH)
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
        style.name_above(axes, right=text)
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
