"""What the posterior predicts, held against the measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy import special

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.errors import ResultsError
from bayesoleo.plots import reading, style
from bayesoleo.plots.units import engineering

BAND, INNER = "#cfe3f1", "#7fb2d6"
#: Halvings of the interval in which a limit lies.
HALVINGS = 30


@dataclass(frozen=True)
class _Row:
    """One run about the prediction at the estimate, all of shape (points,)."""

    phase: Array
    measured: Array
    model: tuple[Array, Array]
    average: tuple[Array, Array]


def predictive(tree: xr.DataTree, output: str, level: float = 0.95) -> Figure:
    """Measured average about the prediction, with the band in which the posterior expects it.

    Parameters
    ----------
    tree : DataTree
        Needs ``period_predictive``, ``records`` and ``prediction``.
    output : str
        Name of the channel.
    level : float, optional
        Of the bands.

    Returns
    -------
    Figure
        The prediction at the estimate is subtracted: at full scale band and measurement are one
        line. The dark band is the model's answer, uncertain as its parameters are; the light one is
        what the average over the run's periods would be if the run were repeated, errors included
        as the error model has them. A line that leaves the light band is a misfit that neither
        explains.

    Raises
    ------
    ResultsError
        If there is no prediction of that output, or it is of an earlier version of the package.
    """
    if schema.PERIOD_PREDICTIVE not in tree.children:
        raise ResultsError(
            f"needs the group {schema.PERIOD_PREDICTIVE!r}", hint="sample the posterior first"
        )
    data = tree[schema.PERIOD_PREDICTIVE].to_dataset()
    if schema.average_sd(output) not in data:
        raise ResultsError(
            "the posterior predictive has no averages of this output",
            value=output,
            hint=f"it has {', '.join(_shown(data)) or 'none'}; sample again if it is older",
        )
    labels = [str(label) for label in data[schema.RUN].values]
    runs = [r for r in reading.runs(tree) if r.periodic and r.label in labels]
    runs, remark = style.omitted(runs)
    rows = {run.label: _row(tree, data.sel(run=run.label), output, run, level) for run in runs}
    drawn = {label: (row.measured, *row.average) for label, row in rows.items()}
    unit = reading.unit(data[output])
    scale = engineering(unit, style.magnitude(*(part for row in drawn.values() for part in row)))
    grid = style.panels(runs)
    for axes, run in zip(grid.axes, runs, strict=True):
        row = rows[run.label]
        for colour, (low, high) in ((BAND, row.average), (INNER, row.model)):
            axes.fill_between(
                row.phase, scale.factor * low, scale.factor * high, color=colour, lw=0
            )
        axes.axhline(0.0, color=style.FAINT, lw=0.6)
        axes.plot(row.phase, scale.factor * row.measured, color=style.INK, lw=0.7)
        style.cycles(axes)
    spans = [2 * style.magnitude(*drawn[run.label]) for run in runs]
    style.share_y(grid.axes, spans, symmetric=True)
    handles = [
        style.line(style.INK, "measured average", 0.9),
        style.band(BAND, f"{100 * level:.3g} % of such averages"),
        style.band(INNER, f"{100 * level:.3g} % of the model's answers"),
    ]
    style.legend(grid.figure, handles, remark)
    text = scale.label(f"{output} − prediction")
    style.label_outside(grid.figure, style.x_name(runs), text)
    return grid.figure


def _shown(data: xr.Dataset) -> list[str]:
    """Outputs of which there are averages."""
    return [str(name) for name in data.data_vars if schema.average_sd(str(name)) in data]


def _row(
    tree: xr.DataTree, data: xr.Dataset, output: str, run: reading.RunView, level: float
) -> _Row:
    about = data[schema.expected(output)] - data[schema.at_estimate(output)]
    draws = about.transpose(schema.CHAIN, schema.DRAW, schema.PHASE).values
    draws = draws.reshape(-1, draws.shape[-1])
    sd = data[schema.average_sd(output)].transpose(schema.CHAIN, schema.DRAW).values.ravel()
    good = np.isfinite(draws).all(axis=1) & np.isfinite(sd)
    tails = (1 - level) / 2, (1 + level) / 2
    model = np.quantile(draws[good], tails, axis=0)
    average = [_quantile(draws[good], sd[good], tail) for tail in tails]
    # At the samples the prediction is exact; between points of the grid it is not.
    predicted = tree[schema.PREDICTION].to_dataset()
    last = schema.after(output) if schema.after(output) in predicted else schema.before(output)
    observed = reading.variable(tree, schema.RECORDS, output).values[run.index]
    e = observed - predicted[last].values[run.index]
    centres, measured = reading.fold(reading.abscissa(tree, run), e, draws.shape[1])
    grid = np.asarray(data[schema.PHASE].values, dtype=float)
    model, average = (
        [np.interp(centres, grid, part, period=1.0) for part in band] for band in (model, average)
    )
    return _Row(centres, measured, (model[0], model[1]), (average[0], average[1]))


def _quantile(centres: Array, sd: Array, probability: float) -> Array:
    """Quantile of an equal mixture of normals (K, p) with standard deviations (K,), shape (p,).

    Of draws of the average themselves it would be as ragged as they are few.
    """
    low = centres.min(axis=0) - 9 * sd.max()
    high = centres.max(axis=0) + 9 * sd.max()
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        below = special.ndtr((middle - centres) / sd[:, None]).mean(axis=0) < probability
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(0.5 * (low + high))
