"""Figures of residual tests: all tests of one residual, and the assessment of an output."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from bayesoleo import _schema as schema
from bayesoleo._display import LabelledResult
from bayesoleo.assessment._assess import LAGS, correlograms, dependence_on, outliers_of
from bayesoleo.assessment._residual_breakdown import Series
from bayesoleo.assessment._residual_tests import autocorrelation_time, normality, runs_of_signs
from bayesoleo.errors import InputError
from bayesoleo.plots import _style as style
from bayesoleo.plots._estimates import table
from bayesoleo.plots._reading import dataset
from bayesoleo.plots._style import Scale, engineering

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
    quantiles = stats.norm.ppf((np.arange(size) + 0.5) / size)
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
