"""Figures of residuals: over phase, velocity or stroke, by harmonic, and their tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import LabelledResult
from bayesoleo._types import Array
from bayesoleo.assessment._assess import LAGS, correlograms, dependence_on, outliers_of
from bayesoleo.assessment._residual_breakdown import ORDERS, Series, residual_breakdown as found_in
from bayesoleo.assessment._residual_tests import autocorrelation_time, normality, runs_of_signs
from bayesoleo.errors import InputError
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._estimates import table
from bayesoleo.plots._reading import dataset
from bayesoleo.plots._style import Scale, engineering

Against = Literal["phase", "velocity", "stroke"]


def residual(tree: xr.DataTree, output: str, against: Against = "phase") -> Figure:
    """Residual averaged over periods, before and after, one panel for each run.

    Parameters
    ----------
    tree : DataTree
        Needs ``residual``; for ``velocity`` and ``stroke`` the variable of that name in it.
    output : str
        Name of the channel.
    against : {"phase", "velocity", "stroke"}
        Horizontal axis. Against the latter two a cycle is a loop: where it is closed to a line the
        residual is a function of that coordinate, and a missing effect takes its shape.

    Returns
    -------
    Figure
        The grey band is one standard error of the average to either side of zero.
    """
    data = tree[schema.RESIDUAL].to_dataset()
    kinds = [
        (name, colour)
        for name, colour in (
            (schema.before(output), style.BEFORE),
            (schema.after(output), style.AFTER),
        )
        if name in data
    ]
    runs, remark = style.omitted(reading.runs(tree))
    curves = [[_curve(tree, data, name, run, against) for name, _ in kinds] for run in runs]
    y_scale = _scale(data[schema.before(output)], [y for row in curves for _, y in row])
    x_scale = _x_scale(data, against)
    grid = style.panels(runs, free_x=against != "phase")
    spans = []
    for axes, run, row in zip(grid.axes, runs, curves, strict=True):
        _noise(axes, data, output, run, y_scale)
        for (x, y), (_, colour) in zip(row, kinds, strict=True):
            mark: dict[str, Any] = {"marker": "o", "ms": 2.5} if reading.is_few(x) else {}
            axes.plot(x_scale.factor * x, y_scale.factor * y, color=colour, lw=1.2, **mark)
        if against == "phase":
            style.cycles(axes)
        spans.append(2 * style.magnitude(*(y for _, y in row)))
    style.share_y(grid.axes, spans, symmetric=True)
    known = schema.noise(output) in data and any(run.periodic for run in runs)
    _explain(grid.figure, len(kinds), remark, known)
    phase = against == "phase"
    x_text = style.x_name(runs) if phase else x_scale.label(reading.coordinate_name(data, against))
    style.label_outside(grid.figure, x_text, y_scale.label(f"{output} residual"))
    return grid.figure


def _curve(
    tree: xr.DataTree, data: xr.Dataset, name: str, run: reading.RunView, against: Against
) -> tuple[Array, Array]:
    """What is drawn of one run, in SI."""
    if against == "phase":
        return reading.averaged_residual(tree, name, run)
    position, e = reading.abscissa(tree, run), data[name].values[run.index]
    coordinate = data[against].values[run.index]
    if reading.is_resolved(position, coordinate):
        known = np.where(np.isfinite(coordinate + e), position, np.nan)
        bins = reading.BINS if run.periodic else 4 * reading.BINS
        loop = [reading.fold(known, values, bins)[1] for values in (coordinate, e)]
        if run.periodic and loop[0].size:
            loop = [np.append(part, part[0]) for part in loop]
        return loop[0], loop[1]
    return _by_value(coordinate, e)


def _by_value(coordinate: Array, e: Array) -> tuple[Array, Array]:
    """Averages in bins of the coordinate with equally many samples each."""
    keep = np.flatnonzero(np.isfinite(coordinate) & np.isfinite(e))
    parts = np.array_split(keep[np.argsort(coordinate[keep])], min(60, max(keep.size // 20, 1)))
    return (
        np.array([coordinate[part].mean() for part in parts]),
        np.array([e[part].mean() for part in parts]),
    )


def _scale(variable: xr.DataArray, curves: list[Array]) -> Scale:
    return engineering(reading.unit(variable), style.magnitude(*curves))


def _x_scale(data: xr.Dataset, against: Against) -> Scale:
    if against == "phase":
        return Scale(1.0, "")
    return engineering(reading.unit(data[against]), style.magnitude(data[against].values))


def _noise(axes: Axes, data: xr.Dataset, output: str, run: reading.RunView, scale: Scale) -> None:
    """The band of the standard error, and zero."""
    axes.axhline(0.0, color=style.FAINT, lw=0.6, zorder=0)
    name = schema.noise(output)
    if run.periodic and name in data and np.isfinite(data[name].values[run.index]):
        half = scale.factor * float(data[name].values[run.index])
        axes.axhspan(-half, half, color=style.NOISE, lw=0, zorder=-1)


def _explain(figure: Figure, kinds: int, remark: str, noise: bool) -> None:
    """What the colours mean."""
    handles: list[Artist] = [style.line(style.BEFORE, "before" if kinds > 1 else "residual")]
    if kinds > 1:
        handles.append(style.line(style.AFTER, "after"))
    if noise:
        handles.append(style.band(style.NOISE, "± standard error of the average"))
    style.legend(figure, handles, remark)


TOP, BOTTOM, GAP, ROW = 0.75, 0.62, 0.75, 2.3
#: Coordinates shown of each output, those first that explain most.
SHOWN = 7
#: Excess of which parts are shown: an error that is 15 % larger than its noise.
LEAST_EXCESS = 1.15**2 - 1


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
        leaves, all runs together; what the extended model leaves is blue. Outputs without such an
        excess have no shares, and are named instead.
    """
    data = found_in(tree)
    large = {
        str(n): has_excess(e)
        for n, e in zip(data[schema.OUTPUT].values, data["excess"].values, strict=True)
    }
    outputs, rest = ([n for n in large if large[n] is kept] for kept in (True, False))
    if not outputs:
        return _nothing_repeats(rest)
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
    style.legend(figure, handles, f"no excess: {style.plain(', '.join(rest))}" if rest else "")
    return figure


def has_excess(excess: float) -> bool:
    """Whether an excess over the noise is so large that parts of it mean something.

    Parameters
    ----------
    excess : float
        Mean square of an averaged error over that of its noise, less one.
    """
    return bool(excess > LEAST_EXCESS)


def _nothing_repeats(outputs: list[str]) -> Figure:
    """A line of text in place of shares."""
    figure = style.blank(style.WIDTH, 1.0)
    text = f"no error beyond the noise: {style.plain(', '.join(outputs))}"
    figure.text(0.5, 0.5, text, ha="center", va="center", fontsize=style.TEXT, color=style.INK)
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
        # Estimates of no power scatter about zero; what is drawn below it would be read as a loss.
        power = np.maximum(one["power"].values[k], 0.0)
        axes.bar(orders + (k - (len(colours) - 1) / 2) * width, power, width, color=colour)
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


_HIGH, _GAP, _COLUMNS = 1.8, 0.75, 3


def residual_tests(series: Series, variables: Sequence[str] | None = None) -> Figure:
    """The residual of one output in one run, as every test sees it.

    Parameters
    ----------
    series : Series
        See :func:`~bayesoleo.assessment.series_of_problem` and
        :func:`~bayesoleo.assessment.series_of_tree`.
    variables : sequence of str, optional
        That the residual is drawn against; by default all that the series knows.

    Returns
    -------
    Figure
        On top the residual in time, outliers ringed. Then the test on runs, as the number of sign
        changes so far beside what chance gives; order statistics against a normal distribution; the
        autocorrelation, and that of what does not repeat. Then the residual against each variable
        with its mean by bin and two standard errors.

    Raises
    ------
    InputError
        If the series does not know a variable.
    """
    names = list(series.variables) if variables is None else list(variables)
    for name in names:
        if name not in series.variables:
            raise InputError(
                "the residual has no such variable", run=series.run, key="variables", value=name,
                hint=f"there are {', '.join(series.variables)}",
            )  # fmt: skip
    rows = 2 + math.ceil(len(names) / _COLUMNS)
    height = 0.55 + rows * (_HIGH + _GAP)
    figure = style.blank(style.WIDTH, height)
    scale = engineering(series.unit or "1", style.magnitude(series.residual))
    _in_time(_box(figure, 0, 0, _COLUMNS), series, scale)
    _signs(_box(figure, 1, 0), series)
    _normal(_box(figure, 1, 1), series)
    _correlation(_box(figure, 1, 2), series)
    for place, name in enumerate(names):
        row, column = divmod(place, _COLUMNS)
        _against(_box(figure, 2 + row, column), series, name, scale)
    unit = f" in {scale.unit}" if scale.unit else ""
    style.legend(figure, [], f"residual of {series.output}{unit}, run {style.plain(series.run)}")
    return figure


def _box(figure: Figure, row: int, column: int, width: int = 1) -> Axes:
    height = figure.get_figheight()
    cell = (style.WIDTH - 0.85) / _COLUMNS
    bottom = height - 0.55 - (row + 1) * _HIGH - row * _GAP
    wide = (width - 1) * cell + 0.78 * cell
    axes = style.add_axes(figure, 0.75 + column * cell, bottom, wide, _HIGH)
    style.dress(axes)
    return axes


def _titled(axes: Axes, left: str, right: str, below: str) -> None:
    style.name_above(axes, left, right)
    axes.set_xlabel(style.plain(below), fontsize=style.SMALL, labelpad=2)


def _p(p_value: float) -> str:
    """A probability, whose size no longer matters below a thousandth."""
    return f"p = {p_value:.2g}" if p_value >= 1e-3 else "p < 0.001"


def _in_time(axes: Axes, series: Series, scale: Scale) -> None:
    time = np.arange(series.residual.size) * series.time_step
    residual = scale.factor * series.residual
    places, _, limit = outliers_of(series)
    axes.plot(time, residual, ".", ms=1.5, color=style.MEASURED)
    axes.axhline(0, color=style.INK, lw=0.6)
    axes.plot(time[places], residual[places], "o", ms=8, mfc="none", mec=style.BEFORE)
    rms = scale.factor * float(np.sqrt(np.mean(series.residual**2)))
    _titled(
        axes,
        f"outliers beyond {limit:.1f} sd: {places.size}",
        f"rms {rms:.3g}, mean {residual.mean():.2g}",
        "time in s" if series.periodic or series.time_step != 1.0 else "sample",
    )


def _signs(axes: Axes, series: Series) -> None:
    """Sign changes so far less those that chance would have given, and its 95 % band."""
    signs = np.sign(series.residual[series.residual != 0])
    changes = np.concatenate(([0.0], np.cumsum(np.diff(signs) != 0)))
    part = np.mean(signs > 0)
    chance = 2 * part * (1 - part)
    order = np.arange(signs.size)
    band = 1.96 * np.sqrt(order * chance * (1 - chance))
    axes.fill_between(order, -band, band, color=style.NOISE, lw=0)
    axes.plot(order, changes - chance * order, color=style.BEFORE, lw=1.2)
    found = runs_of_signs(series.residual)
    _titled(
        axes,
        "runs of signs",
        f"z = {found.statistic:.1f}, {_p(found.p_value)}",
        "sample; sign changes less chance, 95 % of it",
    )


def _normal(axes: Axes, series: Series) -> None:
    """Order statistics in standard deviations against those of a normal distribution."""
    size = series.residual.size
    quantiles = distributions.norm.ppf((np.arange(size) + 0.5) / size)
    spread = max(float(series.residual.std()), np.finfo(float).tiny)
    axes.plot(quantiles, quantiles, color=style.INK, lw=0.6)
    axes.plot(
        quantiles,
        np.sort(series.residual - series.residual.mean()) / spread,
        ".",
        ms=2,
        color=style.BEFORE,
    )
    skewness, kurtosis, found = normality(series.residual)
    _titled(
        axes,
        f"skew {skewness:.2f}, kurtosis {kurtosis:.2f}",
        _p(found.p_value) if np.isfinite(found.p_value) else "",
        "normal quantile; residual in sd",
    )


def _correlation(axes: Axes, series: Series) -> None:
    whole, noise = correlograms(series)
    lag = np.arange(whole.size) / LAGS
    axes.plot(lag, whole, color=style.BEFORE, lw=1.2)
    if series.periodic:
        axes.plot(lag, noise, color=style.AFTER, lw=1.2)
    axes.axhline(0, color=style.FAINT, lw=0.6)
    unit = (
        "lag in periods; blue: what does not repeat"
        if series.periodic
        else "lag in eighths of the record"
    )
    _titled(
        axes, "autocorrelation", f"time {autocorrelation_time(series.noise()):.1f} samples", unit
    )


def _against(axes: Axes, series: Series, name: str, scale: Scale) -> None:
    values = series.variables[name]
    own = engineering(series.units.get(name, "1") or "1", style.magnitude(values))
    found = dependence_on(series, name)
    axes.plot(
        own.factor * values, scale.factor * series.residual, ".", ms=1.2, color=style.MEASURED
    )
    axes.errorbar(
        own.factor * found.centres,
        scale.factor * found.means,
        2 * scale.factor * found.errors,
        fmt="o-",
        ms=3,
        lw=1.0,
        color=style.BEFORE,
    )
    axes.axhline(0, color=style.INK, lw=0.6)
    p_value = found.outcome.p_value
    _titled(
        axes,
        f"explains {100 * found.share:.2g} %",
        _p(p_value) if np.isfinite(p_value) else "",
        own.label(name),
    )


HIGH = 2.1


def assessment(
    found: LabelledResult | xr.Dataset | xr.DataTree, output: str | None = None
) -> Figure:
    """Correlograms, the lack of fit and the dependence of one output's residuals.

    Parameters
    ----------
    found : LabelledResult, xarray.Dataset or xarray.DataTree
        The group ``assessment``.
    output : str, optional
        By default the first.

    Returns
    -------
    Figure
        Above on the left the autocorrelation over two periods, of the residual and of what does not
        repeat: peaks at whole periods are the model's error. On the right what repeats over its
        noise, by run. Below the part of the residual's variance that each variable explains.
    """
    data = dataset(found)
    one = data.isel(output=0) if output is None else data.sel(output=output)
    runs = [str(run) for run in one[schema.RUN].values]
    one = one.dropna("variable", how="all", subset=["share"])
    variables = [str(name) for name in one["variable"].values]
    cells = 0.26 * max(len(runs), 2)
    height = 0.6 + HIGH + 1.45 + cells + 0.3
    figure = style.blank(style.WIDTH, height)
    top = height - 0.6 - HIGH
    _correlogram(style.add_axes(figure, 0.85, top, 4.9, HIGH), one)
    _ratios(style.add_axes(figure, 6.6, top, 3.2, HIGH), one, runs)
    shares = one["share"].values
    sure = one["share_p"].values * shares.size < 0.01
    texts = [[f"{100 * s:.2g} %" if p else "" for s, p in zip(row, known, strict=True)]
             for row, known in zip(shares, sure, strict=True)]  # fmt: skip
    axes = style.add_axes(figure, 1.6, 0.3, 7.5, cells)
    table(axes, np.where(sure, shares, 0.0), texts, runs, variables)
    handles = [
        style.line(style.BEFORE, "residual"),
        style.line(style.AFTER, "what does not repeat"),
    ]
    style.legend(
        figure, handles, f"{one[schema.OUTPUT].values!s}: share of variance explained below"
    )
    return figure


def _correlogram(axes: Axes, one: xr.Dataset) -> None:
    lag = one["lag"].values
    for key, colour in (("correlogram", style.BEFORE), ("noise_correlogram", style.AFTER)):
        for row in one[key].values:
            axes.plot(lag, row, color=colour, lw=0.9, alpha=0.7)
    axes.axhline(0, color=style.FAINT, lw=0.6)
    style.dress(axes, 4)
    axes.set_xlim(0, lag[-1])
    axes.set_xlabel("lag in periods", fontsize=style.TEXT)
    axes.set_ylabel("autocorrelation", fontsize=style.TEXT)


def _ratios(axes: Axes, one: xr.Dataset, runs: list[str]) -> None:
    ratio = one["ratio_to_noise"].values
    if not np.isfinite(ratio).any():
        axes.set_axis_off()
        return
    limit = max(1.2 * float(np.nanmax(ratio)), 2.0)
    axes.plot(range(len(runs)), ratio, "o", color=style.BEFORE, ms=5)
    axes.axhline(1.0, color=style.AFTER, lw=1.0)
    style.dress(axes, 4)
    if limit > 20:
        axes.set_yscale("log")
    axes.set_ylim(0.5 if limit > 20 else 0.0, limit)
    axes.set_xlim(-0.6, len(runs) - 0.4)
    axes.set_xticks(range(len(runs)), [style.plain(run, 8) for run in runs])
    axes.set_ylabel("repeating over its noise", fontsize=style.TEXT)
