"""What the posterior predicts, held against the measurement."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo.plots import reading, style
from bayesoleo.plots.units import engineering

BAND = "#8cbbd9"


def predictive(tree: xr.DataTree, output: str) -> Figure:
    """Measured average about the prediction, with the 95 % band of the posterior prediction.

    Parameters
    ----------
    tree : DataTree
        Needs ``posterior_predictive``, ``observed_data`` and ``prediction``.
    output : str
        Name of the channel.

    Returns
    -------
    Figure
        The prediction is subtracted: at full scale band and measurement are one line.
    """
    data = reading.variable(tree, schema.POSTERIOR_PREDICTIVE, output)
    labels = [str(label) for label in data[schema.RUN].values] if schema.RUN in data.coords else []
    runs = [r for r in reading.runs(tree) if r.periodic and (not labels or r.label in labels)]
    runs, remark = style.omitted(runs)
    rows = {run.label: _row(tree, data, output, run, labels) for run in runs}
    largest = style.magnitude(*(part for row in rows.values() for part in row[1:]))
    observed = reading.variable(tree, schema.OBSERVED_DATA, output)
    scale = engineering(reading.unit(data) or reading.unit(observed), largest)
    grid = style.panels(runs)
    for axes, run in zip(grid.axes, runs, strict=True):
        phase, low, high, measured = rows[run.label]
        low, high = scale.factor * low, scale.factor * high
        axes.axhline(0.0, color=style.FAINT, lw=0.6, zorder=0)
        axes.fill_between(phase, low, high, color=BAND, lw=0)
        axes.plot(phase, scale.factor * measured, color=style.INK, lw=0.7)
        style.cycles(axes)
    spans = [2 * style.magnitude(*rows[run.label][1:]) for run in runs]
    style.share_y(grid.axes, spans, symmetric=True)
    average = style.line(style.INK, "measured average", 0.9)
    band = style.band(BAND, "95 % of the posterior prediction")
    style.legend(grid.figure, [average, band], remark)
    text = scale.label(f"{output} − prediction")
    style.label_outside(grid.figure, style.x_name(runs), text)
    return grid.figure


def _row(
    tree: xr.DataTree, data: xr.DataArray, output: str, run: reading.Run, labels: list[str]
) -> tuple[reading.Array, reading.Array, reading.Array, reading.Array]:
    """Phase, band about its median, measured average about the prediction; ``BINS`` points."""
    place = labels.index(run.label) if labels else run.index
    values = data.transpose(schema.CHAIN, schema.DRAW, schema.RUN, schema.PHASE).values[:, :, place]
    flat = values.reshape(-1, values.shape[-1])
    size = flat.shape[1]
    low, median, high = np.nanquantile(flat, [0.025, 0.5, 0.975], axis=0)
    grid = (np.arange(size) + 0.5) / size
    if schema.PHASE in data.coords:
        grid = np.asarray(data[schema.PHASE].values, dtype=float)
    # At the samples the prediction is exact; between points of the grid the median is not.
    predicted = tree[schema.PREDICTION].to_dataset()
    last = schema.after(output) if schema.after(output) in predicted else schema.before(output)
    observed = reading.variable(tree, schema.OBSERVED_DATA, output).values[run.index]
    e = observed - predicted[last].values[run.index]
    centres, measured = reading.fold(reading.abscissa(tree, run), e)
    below, above = (np.interp(centres, grid, part - median, period=1.0) for part in (low, high))
    return centres, below, above, measured
