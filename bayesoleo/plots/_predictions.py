"""Figures of predictions: posterior predictive, other runs, trajectories, branches."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike
from scipy import special

from bayesoleo import _schema as schema
from bayesoleo._schema import LabelledResult
from bayesoleo._types import Array
from bayesoleo.errors import ResultsError
from bayesoleo.estimation._multiple_shooting import EstimatedTrajectory
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._reading import dataset
from bayesoleo.plots._style import Scale, engineering, format_unit
from bayesoleo.prediction._branches import AnswerBranch
from bayesoleo.solvers._branches import BranchPoint

BAND, INNER = "#cfe3f1", "#7fb2d6"
#: Halvings of the interval in which a limit lies, as wide as the draws' own limits are apart: a
#: thousandth of that is less than a line's width.
HALVINGS = 10


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
    # That of the mixture lies between those of its parts.
    parts = centres + special.ndtri(probability) * sd[:, None]
    low, high = parts.min(axis=0), parts.max(axis=0)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        below = special.ndtr((middle - centres) / sd[:, None]).mean(axis=0) < probability
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(0.5 * (low + high))


FORECAST_HIGH, FORECAST_GAP, FORECAST_TOP, FORECAST_BOTTOM, LEFT = 1.6, 0.7, 0.75, 0.55, 0.85
#: More runs than this are not shown; the figure says so.
MOST = 12


def forecast(found: LabelledResult | xr.Dataset | xr.DataTree, output: str | None = None) -> Figure:
    """Band and measurement of each run, with the probability integral transform beside it.

    Parameters
    ----------
    found : LabelledResult, xarray.Dataset or xarray.DataTree
        Of :meth:`bayesoleo.Fit.predict` or the command ``predict``.
    output : str, optional
        By default the first.

    Returns
    -------
    Figure
        On the left the interval of a sample, its mean and what was measured; on the right the
        histogram of the transform: flat where the prediction is calibrated, hollow where it is too
        wide, horned where it is too narrow.
    """
    data = dataset(found)
    one = data.isel(output=0) if output is None else data.sel(output=output)
    runs = [str(run) for run in one[schema.RUN].values][:MOST]
    height = (
        FORECAST_TOP + len(runs) * FORECAST_HIGH + (len(runs) - 1) * FORECAST_GAP + FORECAST_BOTTOM
    )
    figure = style.blank(style.WIDTH, height)
    scale = engineering(str(one[schema.UNIT].values), style.magnitude(one["measured"].values))
    for k, run in enumerate(runs):
        bottom = height - FORECAST_TOP - (k + 1) * FORECAST_HIGH - k * FORECAST_GAP
        _band(figure, bottom, one.sel(run=run), scale.factor)
        _transform(figure, bottom, one.sel(run=run))
    level = f"{100 * float(data.attrs['level']):.3g} % interval"
    handles: list[Artist] = [
        style.band(style.SIMILAR, level),
        style.line(style.AFTER, "mean"),
        style.line(style.INK, "measured", 1.0),
    ]
    rest = one.sizes[schema.RUN] - len(runs)
    more = f", {rest} more runs not shown" if rest else ""
    style.legend(figure, handles, scale.label(str(one[schema.OUTPUT].values)) + more)
    return figure


def _band(figure: Figure, bottom: float, one: xr.Dataset, factor: float) -> None:
    axes = style.add_axes(figure, LEFT, bottom, 6.2, FORECAST_HIGH)
    style.dress(axes)
    time = one[schema.TIME].values
    axes.fill_between(
        time, factor * one["low"].values, factor * one["high"].values, color=style.SIMILAR, lw=0
    )
    axes.plot(time, factor * one["mean"].values, color=style.AFTER, lw=1.2)
    axes.plot(time, factor * one["measured"].values, color=style.INK, lw=0.8)
    axes.set_xlim(0, float(np.nanmax(time)))
    axes.set_xlabel("time in s", fontsize=style.SMALL, labelpad=2)
    rms, expected = (factor * float(one[key]) for key in ("rms", "expected_rms"))
    run = style.plain(str(one[schema.RUN].values), 40)
    style.name_above(axes, run, f"rms {rms:.3g}, expected {expected:.3g}")


def _transform(figure: Figure, bottom: float, one: xr.Dataset) -> None:
    axes = style.add_axes(figure, LEFT + 6.2 + 0.6, bottom, 2.2, FORECAST_HIGH)
    style.dress(axes)
    bins = one["bin"].values
    axes.bar(bins, one["pit"].values, width=1 / bins.size, color=style.SIMILAR)
    axes.axhline(1.0, color=style.INK, lw=0.8)
    axes.set_xlim(0, 1)
    axes.set_xlabel("probability integral transform", fontsize=style.SMALL, labelpad=2)
    style.name_above(axes, right=f"inside {100 * float(one['coverage']):.1f} %")


TRAJECTORY_HIGH, TRAJECTORY_GAP, TRAJECTORY_TOP, TRAJECTORY_BOTTOM = 1.25, 0.22, 0.5, 0.5


def trajectory(
    found: EstimatedTrajectory,
    *,
    units: Mapping[str, str] | None = None,
    truth: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
) -> Figure:
    """Draw every state of a motion over time, measured or not.

    Parameters
    ----------
    found : EstimatedTrajectory
        One of :attr:`bayesoleo.estimation.ShootingEstimate.trajectories`.
    units : mapping of str to str, optional
        SI unit of each state by its name.
    truth : mapping of str to (times, values), optional
        Known motions by the name of the state, to compare with.

    Returns
    -------
    Figure
        A panel a state. Samples are shown where an output is called like the state.
    """
    names, count = found.names, len(found.names)
    height = (
        TRAJECTORY_TOP + count * TRAJECTORY_HIGH + (count - 1) * TRAJECTORY_GAP + TRAJECTORY_BOTTOM
    )
    figure = style.blank(style.WIDTH, height)
    samples = np.linspace(found.time[0], found.time[-1], found.predicted.shape[1])
    for k, name in enumerate(names):
        y = height - TRAJECTORY_TOP - (k + 1) * TRAJECTORY_HIGH - k * TRAJECTORY_GAP
        axes = figure.add_axes((0.085, y / height, 0.9, TRAJECTORY_HIGH / height))
        style.dress(axes, 4)
        scale = engineering((units or {}).get(name, ""), style.magnitude(found.states[:, k]))
        if truth is not None and name in truth:
            times, values = truth[name]
            known = scale.factor * np.asarray(values)
            axes.plot(times, known, color=style.INK, lw=1.2, ls=":", zorder=4)
        axes.plot(found.time, scale.factor * found.states[:, k], color=style.AFTER, lw=1.6)
        if name in found.outputs:
            row = found.outputs.index(name)
            measured = found.predicted[row] + found.residual[row]
            axes.plot(samples, scale.factor * measured, ".", color=style.BEFORE, ms=3, zorder=3)
        words = name if name in found.outputs else f"{name}, not measured"
        axes.set_ylabel(style.plain(scale.label(words)), fontsize=style.TEXT)
        axes.set_xlim(found.time[0], found.time[-1])
        axes.tick_params(labelbottom=k == count - 1)
        axes.set_xlabel("time in s" if k == count - 1 else "", fontsize=style.TEXT)
        axes.yaxis.set_label_coords(-0.05, 0.5)
    handles: list[Artist] = [style.line(style.AFTER, "found")]
    mark = style.line(style.BEFORE, "measured")
    mark.set(marker=".", ls="none", ms=6)
    if set(names) & set(found.outputs):
        handles.append(mark)
    if truth is not None:
        handles.append(style.line(style.INK, "truth", 1.2, ":"))
    style.legend(figure, handles)
    return figure


HEIGHT = 4.6
#: Marker and word of what is special on a branch.
MARKS = {"fold": ("o", "fold"), "doubling": ("D", "the period doubles")}
#: Multipliers below this part of the largest shown are at the bottom of the logarithmic axis.
LEAST = 1e-3


def branch(found: AnswerBranch | Sequence[AnswerBranch], output: str) -> Figure:
    """Draw the response along a branch, and the Floquet multipliers below it.

    Parameters
    ----------
    found : AnswerBranch, or sequence of them
        From :func:`bayesoleo.prediction.follow_branch`; several along one value, where not
        all answers are on one branch.
    output : str
        Whose swing is drawn: half of largest less least value.

    Returns
    -------
    Figure
        Stable answers are drawn in full, unstable ones dashed. Below them is the size of every
        multiplier, where one is the limit of stability.
    """
    figure = style.blank(style.WIDTH, HEIGHT)
    above = figure.add_axes((0.085, 0.40, 0.9, 0.50))
    below = figure.add_axes((0.085, 0.115, 0.9, 0.22), sharex=above)
    every = [found] if isinstance(found, AnswerBranch) else list(found)
    size = style.magnitude(*(each.swing(output) for each in every))
    scale = engineering(every[0].units.get(output, ""), size)
    for each in every:
        _draw(above, below, each, output, scale)
    _dress(above, below, every, scale.label(f"swing of {output}"))
    style.legend(figure, _legend(every))
    return figure


def _draw(above: Axes, below: Axes, found: AnswerBranch, output: str, scale: Scale) -> None:
    for stable, points in _pieces(found):
        x = [point.value for point in points]
        y = [scale.factor * found.swing_of(point, output) for point in points]
        kind: dict[str, Any] = (
            {"color": style.AFTER} if stable else {"color": style.BEFORE, "ls": "--"}
        )
        above.plot(x, y, lw=1.8, solid_capstyle="round", **kind)
        sizes = np.array([np.abs(point.multipliers) for point in points])
        below.plot(x, np.maximum(sizes, LEAST), lw=1.2, **kind)
    for item in found.branch.special:
        size = scale.factor * found.swing_of(item.point, output)
        face: dict[str, Any] = {
            "ms": 6,
            "mfc": "white",
            "mec": style.INK,
            "mew": 1.2,
            "ls": "none",
            "zorder": 5,
        }
        above.plot([item.point.value], [size], MARKS[item.kind][0], **face)


def _pieces(found: AnswerBranch) -> Iterator[tuple[bool, list[BranchPoint]]]:
    """Stretches of one stability, each ending in the special orbit that begins the next."""
    special = iter([item.point for item in found.branch.special])
    piece: list[BranchPoint] = []
    for before, point in pairwise((None, *found.branch.points)):
        assert point is not None
        if before is not None and before.unstable != point.unstable:
            turn = next(special, point)
            if (before.unstable == 0) != (point.unstable == 0):
                yield before.unstable == 0, [*piece, turn]
                piece = [turn]
        piece.append(point)
    if piece:
        yield piece[-1].unstable == 0, piece


def _dress(above: Axes, below: Axes, every: Sequence[AnswerBranch], y: str) -> None:
    for axes in (above, below):
        style.dress(axes, 5)
    above.tick_params(labelbottom=False)
    above.set_ylim(bottom=0.0)
    above.set_ylabel(y, fontsize=style.TEXT)
    below.axhline(1.0, color=style.INK, lw=0.8)
    below.set_yscale("log")
    low, high = below.get_ylim()
    below.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 30 * low else (1.0,)))
    below.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    below.yaxis.set_minor_formatter(NullFormatter())
    below.tick_params(which="minor", length=0)
    below.set_ylabel("|multipliers|", fontsize=style.TEXT)
    for axes in (above, below):
        axes.yaxis.set_label_coords(-0.055, 0.5)
    values, first = np.concatenate([each.values for each in every]), every[0]
    if values.size:
        above.set_xlim(values.min(), values.max())
    words = {"amplitude": "input over the planned one"}.get(first.along, first.along)
    unit = Scale(1.0, format_unit(first.units.get(first.along, "")))
    below.set_xlabel(unit.label(style.plain(words)), fontsize=style.TEXT)


def _legend(every: Sequence[AnswerBranch]) -> list[Artist]:
    handles: list[Artist] = [style.line(style.AFTER, "stable")]
    if any(each.unstable.any() for each in every):
        handles.append(style.line(style.BEFORE, "unstable: no rig stays on it", 1.6, "--"))
    for kind, (marker, words) in MARKS.items():
        if any(each.branch.of_kind(kind) for each in every):
            mark = style.line(style.INK, words)
            mark.set(marker=marker, ls="none", mfc="white", ms=6)
            handles.append(mark)
    return handles
