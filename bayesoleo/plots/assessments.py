"""What an assessment found, in one figure: correlogram, fit against noise, dependence."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo.estimation.shown import LabelledResult
from bayesoleo.plots import style
from bayesoleo.plots.reading import dataset
from bayesoleo.plots.sensitivities import table

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

    def box(left: float, bottom: float, wide: float, tall: float) -> Axes:
        size = style.WIDTH, height
        return figure.add_axes((left / size[0], bottom / size[1], wide / size[0], tall / size[1]))

    top = height - 0.6 - HIGH
    _correlogram(box(0.85, top, 4.9, HIGH), one)
    _ratios(box(6.6, top, 3.2, HIGH), one, runs)
    shares = one["share"].values
    sure = one["share_p"].values * shares.size < 0.01
    texts = [[f"{100 * s:.2g} %" if p else "" for s, p in zip(row, known, strict=True)]
             for row, known in zip(shares, sure, strict=True)]  # fmt: skip
    table(box(1.6, 0.3, 7.5, cells), np.where(sure, shares, 0.0), texts, runs, variables)
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
