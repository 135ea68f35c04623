"""Figures of runs: records with the search of their period and the fit, and the errors of runs.

The search of the period is shown as in figures B.1 and B.2 of Verbeek (1993). Errors are those of
each run before and after, beside the estimates of single runs. Broadband runs show noise and
nonlinear distortion by frequency before there is a model.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from bayesoleo import _schema as schema
from bayesoleo._types import Array, Integers
from bayesoleo.data import _frequency_response as response
from bayesoleo.data._campaign import CampaignData
from bayesoleo.data._residual_time_shift import PeriodSearch
from bayesoleo.errors import InputError, number_of
from bayesoleo.estimation._between_runs import Hierarchy, between_runs
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._style import engineering

LEFT, TOP, BOTTOM, CHANNEL_ROW = 1.75, 0.5, 0.6, 0.56


def records(tree: xr.DataTree) -> Figure:
    """Measured channels over phase, one row for each run and one column for each channel.

    Parameters
    ----------
    tree : DataTree
        Needs ``records``.

    Returns
    -------
    Figure
    """
    names = reading.channels(tree)
    runs, remark = style.omitted(reading.runs(tree))
    row = CHANNEL_ROW if len(runs) > 4 else 1.2
    height = TOP + row * len(runs) + BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = (style.WIDTH - LEFT - 0.1) / max(len(names), 1)
    for column, name in enumerate(names):
        x = LEFT + column * wide
        for place, run in enumerate(runs):
            y = height - TOP - (place + 1) * row
            axes = style.add_axes(figure, x, y, 0.82 * wide, 0.86 * row)
            _channel(axes, tree, name, run, place == len(runs) - 1)
        _head(figure, tree, name, x + 0.41 * wide, height)
    for place, run in enumerate(runs):
        _row_label(figure, run, 1 - (TOP + (place + 0.55) * row) / height)
    centre = (LEFT + style.WIDTH - 0.1) / 2 / style.WIDTH
    text = style.x_name(runs) + (f" · {remark}" if remark else "")
    figure.text(centre, 0.12 / height, text, ha="center", fontsize=style.TEXT, color=style.INK)
    return figure


def _channel(axes: Axes, tree: xr.DataTree, name: str, run: reading.RunView, last: bool) -> None:
    """One channel of one run; all runs of a channel share its scale."""
    style.dress(axes, ticks=2)
    data = reading.variable(tree, schema.RECORDS, name)
    scale = engineering(reading.unit(data), style.magnitude(data.values))
    position, values = reading.abscissa(tree, run), scale.factor * data.values[run.index]
    if not run.periodic:
        axes.plot(*reading.thin(position, values, 4 * reading.BINS), color=style.INK, lw=1.0)
    elif reading.is_resolved(position, values):
        x, y = reading.fold(position, values)
        mark: dict[str, Any] = {"marker": "o", "ms": 2.0} if reading.is_few(x) else {}
        axes.plot(x, y, color=style.INK, lw=0.6 if mark else 1.2, **mark)
    else:
        order = position.argsort()
        axes.plot(*reading.thin(position[order], values[order]), color=style.INK, lw=0.4)
    axes.set_ylim(*_limits(scale.factor * data.values))
    if last:
        style.cycles(axes)
    else:
        axes.set_xlim(0.0, 1.0)
        axes.xaxis.set_visible(False)
        axes.spines["bottom"].set_visible(False)


def _limits(values: Array) -> tuple[float, float]:
    low, high = np.nanmin(values), np.nanmax(values)
    margin = 0.06 * (high - low) or 1.0
    return float(low - margin), float(high + margin)


def _head(figure: Figure, tree: xr.DataTree, name: str, x: float, height: float) -> None:
    """Name and unit of a channel above its column."""
    data = reading.variable(tree, schema.RECORDS, name)
    scale = engineering(reading.unit(data), style.magnitude(data.values))
    text = style.plain(scale.label(name))
    figure.text(
        x / style.WIDTH,
        1 - 0.3 / height,
        text,
        ha="center",
        va="bottom",
        fontsize=style.TEXT,
        color=style.INK,
        fontweight="bold",
    )


def _row_label(figure: Figure, run: reading.RunView, y: float) -> None:
    """Label, role and frequency of a run at the left of its row."""
    held_out = run.role == schema.HOLD_OUT
    colour = style.AFTER if held_out else style.FAINT
    label = style.plain(run.label, 18)
    figure.text(0.01, y, label, va="bottom", fontsize=style.SMALL, fontweight="bold")
    text = " · ".join(part for part in (run.role, run.remark) if part)
    figure.text(0.01, y, text, va="top", fontsize=style.SMALL - 1, color=colour)


HEIGHT = 5.2


def period_search(search: PeriodSearch, unit: str = "", name: str = "signal") -> Figure:
    """Residual time shift and autocovariance over two periods, and the valley at one period.

    Parameters
    ----------
    search : PeriodSearch
        From :func:`bayesoleo.data.period_search`.
    unit : str, optional
        SI unit of the signal.
    name : str, optional
        What was measured.

    Returns
    -------
    Figure
        Above both functions as they are (figure B.1); below the residual time shift next to one
        period, with the quadratic whose minimum is the period (figure B.2).
    """
    figure = style.blank(style.WIDTH, HEIGHT)
    boxes = ((0.085, 0.575, 0.4, 0.33), (0.585, 0.575, 0.4, 0.33), (0.085, 0.105, 0.9, 0.32))
    shift, covariance, zoom = (figure.add_axes(box) for box in boxes)
    square = f"({unit})^2" if unit else ""
    step = search.time_step
    for axes, values, words in (
        (shift, search.residual, "residual time shift"),
        (covariance, search.covariance, "autocovariance"),
    ):
        scale = _scale(square, unit, style.magnitude(values))
        axes.plot(step * search.shifts, scale[0] * values, color=style.AFTER, lw=1.2)
        axes.axvline(step * search.period_in_samples, color=style.BEFORE, lw=0.8)
        _dress(axes, "shift in s", f"{words}{scale[1]}")
    away = search.near - search.period_in_samples
    scale = _scale(square, unit, style.magnitude(search.near_residual))
    fine = np.linspace(away[0], away[-1], 300)
    zoom.plot(step * search.near, scale[0] * search.near_residual, "o", color=style.AFTER, ms=3)
    parabola = scale[0] * np.polyval(search.parabola, fine)
    zoom.plot(step * (fine + search.period_in_samples), parabola, color=style.BEFORE, lw=1.2)
    zoom.axvline(step * search.period_in_samples, color=style.BEFORE, lw=0.8)
    _dress(zoom, "shift in s", f"residual time shift{scale[1]}")
    handles: list[Artist] = [
        style.line(style.AFTER, name),
        style.line(style.BEFORE, "quadratic and its minimum, the period"),
    ]
    style.legend(figure, handles, f"{search.frequency:.6g} Hz")
    return figure


def _scale(square: str, unit: str, size: float) -> tuple[float, str]:
    """Factor and words for values in the square of a unit."""
    if not square:
        return 1.0, ""
    base = engineering(unit, float(np.sqrt(size)))
    return base.factor**2, f" in ({base.unit})²" if base.unit else ""


def _dress(axes: Axes, x: str, y: str) -> None:
    style.dress(axes, 4)
    axes.set_xlabel(x, fontsize=style.TEXT)
    axes.set_ylabel(y, fontsize=style.TEXT)


WINDOW = 240
"""Samples shown of a signal that changes faster than bins of phase can show."""


def fit(tree: xr.DataTree, output: str) -> Figure:
    """Measured channel against its prediction over phase, one panel for each run.

    Parameters
    ----------
    tree : DataTree
        Needs ``records`` and ``prediction``.
    output : str
        Name of the channel.

    Returns
    -------
    Figure
        Averages over the periods of a run; a transient as it is. A signal with too many harmonics
        for that is shown by a stretch of raw samples from the middle of its record. Where there
        are few samples in a period, each is a dot.
    """
    measured = reading.variable(tree, schema.RECORDS, output)
    scale = engineering(reading.unit(measured), style.magnitude(measured.values))
    names = [schema.before(output), schema.after(output)]
    shown = [name for name in names if name in tree[schema.PREDICTION]]
    runs, remark = style.omitted(reading.runs(tree))
    grid = style.panels(runs)
    spans = []
    for axes, run in zip(grid.axes, runs, strict=True):
        curves = [measured.values[run.index]]
        curves += [
            reading.variable(tree, schema.PREDICTION, name).values[run.index] for name in shown
        ]
        position = reading.abscissa(tree, run)
        scaled = [scale.factor * np.asarray(curve) for curve in curves]
        _draw(axes, position, scaled, run.periodic)
        spans.append(np.ptp(axes.get_ylim()))
    style.share_y(grid.axes, spans)
    handles = [style.line(style.MEASURED, "measured", 4.0)]
    text = "model, before" if len(shown) > 1 else "model"
    handles.append(style.line(style.BEFORE, text, 1.4, "--" if len(shown) > 1 else "-"))
    if len(shown) > 1:
        handles.append(style.line(style.AFTER, "model, after", 1.2))
    style.legend(grid.figure, handles, remark)
    style.label_outside(grid.figure, style.x_name(runs), scale.label(output))
    return grid.figure


def _draw(axes: Axes, position: Array, curves: list[Array], periodic: bool) -> None:
    """Measured broad and pale, so that a prediction that lies on it can be seen on it."""
    if not periodic:
        lines = [reading.thin(position, curve, 4 * reading.BINS) for curve in curves]
        style.cycles(axes)
    elif reading.is_resolved(position, curves[0]):
        lines = [reading.fold(position, curve) for curve in curves]
        style.cycles(axes)
    else:
        finite = np.flatnonzero(np.isfinite(curves[0]) & np.isfinite(position))
        middle = finite.size // 2
        part = finite[max(middle - WINDOW // 2, 0) : middle + WINDOW // 2]
        start = position[part[0]]
        x = start + (position[part] - start) % 1.0
        lines = [(x, curve[part]) for curve in curves]
        axes.set_xlim(x[0], x[-1])
        axes.tick_params(labelbottom=True)
    measured: dict[str, Any] = {"lw": 4.0, "alpha": 0.55, "solid_capstyle": "round"}
    if reading.is_few(lines[0][0]):
        measured = {"lw": 0.0, "marker": "o", "ms": 4.0}
    axes.plot(*lines[0], color=style.MEASURED, **measured)
    dashes = "--" if len(lines) > 2 else "-"
    axes.plot(*lines[1], color=style.BEFORE, lw=1.4, ls=dashes)
    if len(lines) > 2:
        axes.plot(*lines[2], color=style.AFTER, lw=1.2)


#: What errors are divided by.
_OF = {schema.RATIO_TO_EXPECTED: "expected", schema.RATIO_TO_NOISE: "standard error"}
ERROR_LEFT, ERROR_TOP, ERROR_BOTTOM, ERROR_ROW, ERROR_COLUMN = 2.4, 0.85, 0.6, 0.3, 3.6


def error(tree: xr.DataTree) -> Figure:
    """Repeating error over what is expected for each run, before and after, a column each output.

    Parameters
    ----------
    tree : DataTree
        Its ``summary`` attribute is read: the first round is before, the last is after.

    Returns
    -------
    Figure
        On a logarithmic axis; at 1 nothing is missing. Where the noise of no run is known, the rms
        of the raw residual is shown instead.
    """
    rounds = reading.summary(tree)["rounds"]
    first, last = rounds[0]["error"], rounds[-1]["error"]
    labels = _order(first)
    height = ERROR_TOP + ERROR_ROW * len(labels) + ERROR_BOTTOM
    # A single output needs no wide figure, in which a phone would show small letters.
    width = min(style.WIDTH, ERROR_LEFT + 0.15 + ERROR_COLUMN * max(len(first), 1))
    figure = style.blank(width, height)
    wide = (width - ERROR_LEFT - 0.15) / max(len(first), 1)
    for column, output in enumerate(first):
        left, high = ERROR_LEFT + column * wide, height - ERROR_TOP - ERROR_BOTTOM
        axes = style.add_axes(figure, left, ERROR_BOTTOM, 0.93 * wide, high)
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
    factor, text = 1.0, f"{reading.averaged_word(tree)} error / {_OF.get(key, '')}"
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
        text = "noise not known; rms in the table"
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
    floor = Line2D([], [], color=style.INK, lw=1.0, label="1: nothing missing")
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


def channels(campaign: CampaignData) -> Figure:
    """Each channel of the first four runs over time.

    Parameters
    ----------
    campaign : CampaignData

    Returns
    -------
    Figure
    """
    runs, names = campaign.runs[:4], list(campaign.channels)
    figure = Figure(figsize=(3.4 * len(runs) + 1.0, 1.5 * len(names) + 0.6), layout="constrained")
    grid = figure.subplots(len(names), len(runs), squeeze=False)
    for row, name in zip(grid, names, strict=True):
        size = float(np.max(np.abs(runs[0].samples[name])))
        shown = engineering(campaign.units[name], size)
        for axes, run in zip(row, runs, strict=True):
            time, values = _thinned(run.time, run.samples[name])
            axes.plot(time, shown.factor * values, lw=0.8, color=style.AFTER)
            axes.tick_params(labelsize=style.SMALL)
        row[0].set_ylabel(f"{style.plain(name)} [{shown.unit or '1'}]", fontsize=style.SMALL)
    for axes, run in zip(grid[0], runs, strict=True):
        axes.set_title(style.plain(run.label), fontsize=style.SMALL)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]", fontsize=style.SMALL)
    return figure


def _thinned(time: Array, values: Array) -> tuple[Array, Array]:
    """Smallest and largest value of each stretch, so that a long record draws in no time."""
    most = 2000
    if time.size <= 2 * most:
        return time, values
    length = time.size // most
    parts = values[: length * most].reshape(most, length)
    at = time[: length * most : length]
    pairs = np.column_stack([parts.min(axis=1), parts.max(axis=1)]).ravel()
    return np.repeat(at, 2), pairs


#: Kinds of lines with their colours and marks; one figure has few of them.
_KINDS = {
    response.EXCITED: (style.INK, "o"),
    response.EVEN: (style.ENSEMBLES[2], "^"),
    response.ODD: (style.ENSEMBLES[3], "v"),
    response.MIXED: (style.ENSEMBLES[5], "d"),
    response.SUBHARMONIC: (style.ENSEMBLES[6], "x"),
}
_TOTAL = style.ENSEMBLES[4]
RESPONSE_ROW, RESPONSE_GAP, MOST_LEVELS = 2.1, 0.75, 6
#: Ratio of the highest to the lowest frequency shown from which the axis is logarithmic.
_WIDE = 30.0


def frequency_response(data: xr.Dataset | xr.DataTree, output: str | None = None) -> Figure:
    """Best linear approximation and distortion of one output of multisine runs, a row each level.

    Parameters
    ----------
    data : Dataset or DataTree
        From :func:`bayesoleo.data.frequency_response`, or the group of a result.
    output : str, optional
        By default the first.

    Returns
    -------
    Figure
        Left the amplitude of the response with its standard deviations, by noise and, of two
        realisations or more, in total; right the amplitude of the output at excited and at
        detection lines with its noise. Above a row of a multisine is how many times the noise the
        distortion is, all lines of a kind together.
    """
    found = reading.dataset(data)
    names = [str(name) for name in found[schema.OUTPUT].values]
    if output is not None and output not in names:
        raise InputError("no such output", key="output", value=output, hint=", ".join(names))
    one = found.sel({schema.OUTPUT: output or names[0]})
    count = one.sizes[response.LEVEL]
    shown = min(count, MOST_LEVELS)
    height = 0.9 + shown * RESPONSE_ROW + (shown - 1) * RESPONSE_GAP + 0.55
    figure, kinds = style.blank(style.WIDTH, height), list[str]()
    for place in range(shown):
        level = one.isel({response.LEVEL: place})
        bottom = height - 0.9 - (place + 1) * RESPONSE_ROW - place * RESPONSE_GAP
        boxes = (0.8, bottom, 3.75, RESPONSE_ROW), (5.6, bottom, 4.25, RESPONSE_ROW)
        left, right = (style.add_axes(figure, *box) for box in boxes)
        lines = np.flatnonzero(response.within_band(level[response.KIND].values))
        _draw_response(left, level, lines)
        kinds += _draw_output(right, level, lines)
        style.name_above(left, _level_name(level))
        style.name_above(right, right=_distortion_words(level))
    for axes in (left, right):
        axes.set_xlabel("frequency in Hz", fontsize=style.TEXT)
    remark = f"first {shown} of {count} levels" if shown < count else ""
    style.legend(figure, _line_handles(dict.fromkeys(kinds)), remark)
    return figure


def _draw_response(axes: Axes, level: xr.Dataset, lines: Integers) -> None:
    """Amplitude of the response with its two standard deviations."""
    found = level["response"]
    if schema.PART in found.dims:
        values = np.hypot(*(found.isel({schema.PART: k}).values for k in (0, 1)))
    else:
        values = np.abs(found.values)
    frequency = level[schema.FREQUENCY].values
    scale = engineering(_response_unit(level), style.magnitude(values))
    for name, colour, mark in (
        ("noise_sd", style.MEASURED, "."),
        ("total_sd", _TOTAL, "s"),
    ):
        sd = scale.factor * level[name].values
        axes.plot(frequency[lines], sd[lines], mark, ms=3, color=colour)
    axes.plot(frequency[lines], scale.factor * values[lines], "o", ms=3, color=style.INK)
    _dress_spectrum(axes, frequency[lines])
    axes.set_ylabel(style.plain(scale.label("response"), 40), fontsize=style.TEXT)


def _draw_output(axes: Axes, level: xr.Dataset, lines: Integers) -> list[str]:
    """Amplitude of the output by kind of line, with its noise; the kinds that there are."""
    frequency, kind = level[schema.FREQUENCY].values, level[response.KIND].values
    amplitude = level["output_amplitude"].values
    scale = engineering(str(level["output_unit"].values), style.magnitude(amplitude))
    noise = scale.factor * level["output_noise"].values
    axes.plot(frequency[lines], noise[lines], ".", ms=3, color=style.MEASURED)
    scatter = scale.factor * (level["distortion_sd"] * level["input_amplitude"]).values
    axes.plot(frequency[lines], scatter[lines], "s", ms=3, color=_TOTAL)
    there = []
    for name, (colour, mark) in _KINDS.items():
        own = lines[kind[lines] == name]
        if own.size:
            there.append(name)
            axes.plot(frequency[own], scale.factor * amplitude[own], mark, ms=3, color=colour)
    _dress_spectrum(axes, frequency[lines])
    text = scale.label(f"amplitude of {level[schema.OUTPUT].item()}")
    axes.set_ylabel(style.plain(text, 40), fontsize=style.TEXT)
    return there + ["total"] * bool(np.isfinite(scatter).any())


def _dress_spectrum(axes: Axes, frequency: Array) -> None:
    style.dress(axes)
    # Zeros, which noise-free data have, are no point of a logarithmic axis.
    axes.set_yscale("log", nonpositive="mask")
    axes.tick_params(labelsize=style.SMALL)
    if frequency.max() > _WIDE * frequency.min():
        axes.set_xscale("log")


def _response_unit(level: xr.Dataset) -> str:
    drive = str(level["input_rms"].attrs.get(schema.UNITS, ""))
    return response.ratio_unit(str(level["output_unit"].values), drive)


def _level_name(level: xr.Dataset) -> str:
    """The rms of the input, and how many runs it was held at."""
    unit = str(level["input_rms"].attrs.get(schema.UNITS, ""))
    number, periods = int(level["realisations"]), int(level[schema.PERIODS])
    size = style.format_value(float(level["input_rms"]), unit)
    return f"{size} rms, {number_of(number, 'realisation')}, {number_of(periods, 'period')}"


def _distortion_words(level: xr.Dataset) -> str:
    """Distortion over noise by kind of line, where it is known."""
    ratios = (level["distortion"] / level["distortion_noise"]).values
    names = [str(name) for name in level[response.PARITY].values]
    texts = [f"{name} {ratio:.3g}" for name, ratio in zip(names, ratios, strict=True) if ratio > 0]
    scatter = float(level["stochastic"] / level["stochastic_noise"])
    texts += [f"realisations {scatter:.3g}"] if scatter > 0 else []
    return f"times the noise: {', '.join(texts)}" if texts else ""


def _line_handles(kinds: Iterable[str]) -> list[Artist]:
    """What the marks mean; noise is always shown."""
    found: list[Artist] = []
    for kind in kinds:
        total = kind == "total"
        colour, mark = (_TOTAL, "s") if total else _KINDS[kind]
        text = "between realisations" if total else f"{kind} lines"
        found.append(Line2D([], [], marker=mark, ls="", ms=4, color=colour, label=text))
    noise = Line2D([], [], marker=".", ls="", ms=5, color=style.MEASURED, label="noise")
    return [*found, noise]
