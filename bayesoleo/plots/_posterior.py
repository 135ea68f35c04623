"""Figures of the posterior: corner, pairs, comparison with the point estimate, chains."""

from __future__ import annotations

import re

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._types import Array
from bayesoleo.errors import ResultsError, number_of
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._discovery import chosen as accepted
from bayesoleo.plots._estimates import REGION_MOST, closed_curve, panel_grid, panel_labels
from bayesoleo.plots._style import Scale, engineering, format_number, format_value


def point_table(tree: xr.DataTree) -> dict[str, tuple[float, float, str]]:
    """Estimate, linearised sd and unit of every parameter; empty without a point."""
    point = reading.group(tree, schema.POINT)
    if point is None or schema.ESTIMATE not in point:
        return {}
    names = [str(name) for name in point[schema.PARAMETER].values]
    units = point[schema.UNIT].values if schema.UNIT in point else [""] * len(names)
    sd = point[schema.SD].values if schema.SD in point else np.full(len(names), np.nan)
    rows = zip(names, point[schema.ESTIMATE].values, sd, units, strict=True)
    return {name: (float(value), float(s), str(unit)) for name, value, s, unit in rows}


def chosen(tree: xr.DataTree, most: int) -> list[str]:
    """The parameters worth a panel: those of the effects added, then shared ones, then by run.

    Parameters
    ----------
    tree : DataTree
        Needs ``posterior``.
    most : int
        How many.

    Returns
    -------
    list of str
        In the order of the posterior.
    """
    posterior = tree[schema.POSTERIOR].to_dataset()
    names = [
        str(n) for n in posterior.data_vars if posterior[n].dims == (schema.CHAIN, schema.DRAW)
    ]
    new = _new_parameters(tree)

    def rank(name: str) -> tuple[bool, bool, int]:
        secondary = "[" in name or schema.of_errors(name)
        return name not in new, secondary, names.index(name)

    return sorted(sorted(names, key=rank)[:most], key=names.index)


def draws(tree: xr.DataTree, name: str) -> Array:
    """Draws of one parameter, shape (chain, draw)."""
    values = (
        reading.variable(tree, schema.POSTERIOR, name).transpose(schema.CHAIN, schema.DRAW).values
    )
    return np.asarray(values, dtype=float)


def unit_of(tree: xr.DataTree, name: str) -> str:
    """Unit from the point, or from the posterior itself."""
    table = point_table(tree)
    return (
        table[name][2]
        if name in table
        else reading.unit(reading.variable(tree, schema.POSTERIOR, name))
    )


def _new_parameters(tree: xr.DataTree) -> set[str]:
    """Parameters that came with the effects accepted."""
    new: set[str] = set()
    for entry in reading.summary(tree).get("rounds", []):
        candidate = accepted(entry)
        if candidate is not None:
            new |= set(candidate["expected"])
    return new


CORNER_MOST = 10
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

    names = chosen(tree, CORNER_MOST) if parameters is None else list(parameters)
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
        no_fill_contours=True,  # no white below them: no draws are there to be hidden
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
        axes[i, i].set_title(text, y=1.0, fontsize=style.SMALL - 0.5, color=style.INK, pad=4)
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


#: Draws shown of a posterior.
SHOWN = 1500
CLOUD = "#8cbbd9"


def pairs(tree: xr.DataTree) -> Figure:
    """Draws of the posterior under the contours of the indifference region, plane by plane.

    Parameters
    ----------
    tree : DataTree
        Needs ``posterior`` and ``indifference``.

    Returns
    -------
    Figure
        Solid the exact contour, dashed Taylor's ellipse; dotted the ellipse that would hold as much
        of a normal posterior with the draws' covariance. The title says what part of the draws the
        contour holds, and what part a normal posterior's would.

    Raises
    ------
    ResultsError
        If a group is missing, or they share no plane.
    """
    for group in (schema.POSTERIOR, schema.INDIFFERENCE):
        if group not in tree.children:
            raise ResultsError(f"needs the group {group!r}")
    data, posterior = tree[schema.INDIFFERENCE].to_dataset(), tree[schema.POSTERIOR]
    planes = [
        (str(pair), [str(name) for name in data["name"].sel(pair=pair).values])
        for pair in data["pair"].values
    ]
    planes = [plane for plane in planes if all(name in posterior for name in plane[1])][
        :REGION_MOST
    ]
    if not planes:
        raise ResultsError("posterior and indifference region have no plane in common")
    # The shadow of the whole region, where it was made.
    data = data.isel(section=-1)
    normal = float(distributions.chi2.cdf(2 * float(data.attrs["epsilon"]), 2))
    figure, panels = panel_grid(len(planes))
    for axes, (pair, names) in zip(panels, planes, strict=True):
        values = np.column_stack([draws(tree, name).ravel() for name in names])
        held = _panel(axes, data.sel(pair=pair), values, float(data.attrs["epsilon"]))
        panel_labels(axes, names)
        axes.set_title(
            f"holds {100 * held:.0f} % ({100 * normal:.0f} %)", fontsize=style.SMALL, loc="left"
        )
    handles = [
        style.band(CLOUD, "draws"),
        style.line(style.BEFORE, "indifference, exact", 1.8),
        style.line(style.BEFORE, "second order", 1.0, "--"),
        style.line(style.INK, "normal, of the draws", 1.0, ":"),
    ]
    style.legend(figure, handles, "in brackets: of a normal posterior")
    return figure


def _panel(axes: Axes, plane: xr.Dataset, values: np.ndarray, epsilon: float) -> float:
    """One plane; gives the part of the draws inside the exact contour."""
    thin = values[:: max(1, len(values) // SHOWN)]
    axes.plot(*thin.T, ".", ms=1.6, color=CLOUD, mec="none", rasterized=True)
    contour = plane["contour"].values
    closed_curve(axes, plane["ellipse"].values, style.BEFORE, "--", 1.0)
    closed_curve(axes, contour, style.BEFORE, "-", 1.8)
    closed_curve(axes, _ellipse(values, epsilon), style.INK, ":", 1.0)
    return inside(contour, values)


def _ellipse(values: np.ndarray, epsilon: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    circle = np.sqrt(2 * epsilon) * np.column_stack([np.cos(angle), np.sin(angle)])
    factor = np.linalg.cholesky(np.cov(values, rowvar=False))
    return np.asarray(values.mean(axis=0) + circle @ factor.T)


def inside(contour: np.ndarray, values: np.ndarray) -> float:
    """Part of points (M, 2) inside a closed polygon (p, 2); NaN where it is open."""
    if not np.isfinite(contour).all():
        return float("nan")
    from matplotlib.path import Path

    # In units of the contour's size: a path's own tolerance knows no units.
    low, size = contour.min(axis=0), np.ptp(contour, axis=0)
    path = Path((contour - low) / size)
    return float(path.contains_points((values - low) / size).mean())


FOREST_LEFT, RIGHT, FOREST_TOP, FOREST_BOTTOM, ROW = 2.3, 2.2, 0.55, 0.6, 0.3
FOREST_MOST = 40


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
    names = [name for name in table if name in tree["posterior"]][:FOREST_MOST]
    labels = [style.plain(name, 30) for name in names]
    margins = FOREST_LEFT, RIGHT, FOREST_TOP, FOREST_BOTTOM
    figure, axes = style.row_axes(labels, ROW, margins=margins, ticks=9)
    largest = 3.2
    for row, name in enumerate(names):
        largest = max(largest, _row(axes, row, draws(tree, name).ravel(), table[name]))
    axes.axvline(0.0, color=style.NEUTRAL, lw=0.8, zorder=0)
    axes.set_xlim(-min(largest, 12.0), min(largest, 12.0))
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


TRACE_LEFT, TRACE_TOP, TRACE_BOTTOM, HIGH, GAP = 1.0, 0.6, 0.6, 0.75, 0.32
WALKERS = 2
POINTS = 250


def trace(tree: xr.DataTree, most: int = 7) -> Figure:
    """Some walkers of each ensemble over the draws, and the log posterior.

    Parameters
    ----------
    tree : DataTree
        Needs ``posterior``; ``sample_stats`` for the log posterior.
    most : int
        How many parameters.

    Returns
    -------
    Figure
        Two walkers of each ensemble, one colour an ensemble: colours that keep apart show
        ensembles that do not agree.
    """
    names = chosen(tree, most)
    stats = reading.group(tree, schema.SAMPLE_STATS)
    rows = [(name, unit_of(tree, name), draws(tree, name)) for name in names]
    if stats is not None and schema.LP in stats:
        lp = stats[schema.LP].transpose(schema.CHAIN, schema.DRAW).values
        rows.append(("log posterior", "", lp))
    columns = 2 if len(rows) > 2 else 1
    lines = -(-len(rows) // columns)
    height = TRACE_TOP + lines * (HIGH + GAP) - GAP + TRACE_BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = (style.WIDTH - 0.1) / columns
    for place, (name, unit, values) in enumerate(rows):
        line, column = divmod(place, columns)
        x, y = TRACE_LEFT + column * wide, height - TRACE_TOP - (line + 1) * HIGH - line * GAP
        axes = style.add_axes(figure, x, y, wide - TRACE_LEFT - 0.15, HIGH)
        _chains(axes, name, unit, values, _ensembles(tree, values.shape[0]))
        axes.tick_params(labelbottom=place + columns >= len(rows))
    middle = 0.12 / height
    figure.text(0.5, middle, "draw", ha="center", fontsize=style.TEXT, color=style.INK)
    count = np.unique(_ensembles(tree, rows[0][2].shape[0])).size
    remark = f"{WALKERS} walkers of each of {number_of(count, 'ensemble')}"
    style.legend(figure, [], remark)
    return figure


def _chains(axes: Axes, name: str, unit: str, values: Array, ensembles: Array) -> None:
    """A few walkers, thinned to what a screen can show."""
    style.dress(axes, ticks=3)
    spread = values.std()
    scale = engineering(unit, style.magnitude(values))
    step = max(values.shape[1] // POINTS, 1)
    index = np.arange(0, values.shape[1], step)
    # A narrow posterior of a large value (a log posterior, an area) is shown about its mean.
    offset = float(values.mean()) if spread < 1e-3 * abs(values.mean()) else 0.0
    if offset:
        scale = engineering(unit, 3 * float(spread))
    for number, label in enumerate(np.unique(ensembles)):
        colour = style.ENSEMBLES[number % len(style.ENSEMBLES)]
        for chain in np.flatnonzero(ensembles == label)[:WALKERS]:
            shown = scale.factor * (values[chain, index] - offset)
            axes.plot(index, shown, color=colour, lw=0.5, alpha=0.7)
    axes.set_xlim(0, max(values.shape[1] - 1, 1))
    text = style.plain(scale.label(f"{name} − mean" if offset else name), 50)
    axes.set_title(text, loc="left", y=1.0, fontsize=style.SMALL, pad=3, color=style.INK)


def _ensembles(tree: xr.DataTree, chains: int) -> Array:
    """To which ensemble each chain belongs; one for all where the tree does not say."""
    posterior = tree[schema.POSTERIOR]
    if schema.ENSEMBLE in posterior.coords:
        return np.asarray(posterior[schema.ENSEMBLE].values, dtype=float)
    return np.zeros(chains)
