"""Figures of point estimates: regions, profiles, replications, iterations, sensitivities."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy import interpolate

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import LabelledResult
from bayesoleo.errors import number_of
from bayesoleo.plots import _style as style
from bayesoleo.plots._reading import dataset

SIDE, GAP, REGION_LEFT, REGION_TOP, REGION_BOTTOM, COLUMNS = 2.6, 0.75, 0.85, 0.6, 0.55, 3
REGION_MOST = 12


def indifference(found: LabelledResult | xr.Dataset | xr.DataTree) -> Figure:
    """Contours of the objective and the ellipses of its second-order expansion, plane by plane.

    Parameters
    ----------
    found : LabelledResult, xarray.Dataset or xarray.DataTree
        The group ``indifference``.

    Returns
    -------
    Figure
        Solid where the contour is exact, dashed where it is Taylor's; the profiled section, in
        which the other parameters follow, in blue, the conditional one in vermilion. Planes beyond
        twelve are left out.
    """
    data = dataset(found)
    pairs = [str(pair) for pair in data["pair"].values][:REGION_MOST]
    figure, panels = panel_grid(len(pairs))
    colours = {"conditional": style.BEFORE, "profiled": style.AFTER}
    sections = [str(section) for section in data["section"].values]
    for axes, pair in zip(panels, pairs, strict=True):
        for section in sections:
            one = data.sel(pair=pair, section=section)
            colour = colours[section]
            closed_curve(axes, one["ellipse"].values, colour, "--", 1.0)
            closed_curve(axes, one["contour"].values, colour, "-", 1.8)
        names = [str(name) for name in data["name"].sel(pair=pair).values]
        centre = [float(data[schema.ESTIMATE].sel(parameter=name)) for name in names]
        axes.plot(*centre, "+", color=style.INK, ms=8)
        panel_labels(axes, names)
    handles = [style.line(colours[s], f"{s}, exact", 1.8) for s in sections]
    handles += [style.line(style.FAINT, "second order (Taylor)", 1.0, "--")]
    remark = (
        f"first {REGION_MOST} of {data.sizes['pair']} planes"
        if data.sizes["pair"] > REGION_MOST
        else ""
    )
    style.legend(figure, handles, remark or f"fall {float(data.attrs['epsilon']):.3g}")
    return figure


def profile(found: LabelledResult | xr.Dataset | xr.DataTree) -> Figure:
    """Fall of the profiled objective along each parameter, with the parabola of linearisation.

    Parameters
    ----------
    found : LabelledResult, xarray.Dataset or xarray.DataTree
        From :func:`bayesoleo.estimation.profile`.

    Returns
    -------
    Figure
        The level of the limits is drawn across; where the curve stays below it the data do not
        bound the parameter on that side.
    """
    data = dataset(found)
    names = [str(name) for name in data[schema.PARAMETER].values][:REGION_MOST]
    level = distributions.chi2.isf(1 - float(data.attrs["level"]), 1) / 2
    figure, panels = panel_grid(len(names))
    for axes, name in zip(panels, names, strict=True):
        one = data.sel(parameter=name)
        value, fall = one["value"].values, one["fall"].values
        keep = np.isfinite(value)
        centre = float(one[schema.ESTIMATE])
        half = float(one["linear_high"]) - centre
        if np.isfinite(half):
            x = np.linspace(centre - 1.3 * half, centre + 1.3 * half, 101)
            axes.plot(x, level * ((x - centre) / half) ** 2, "--", color=style.FAINT, lw=1.0)
        axes.plot(value[keep], fall[keep], "o", color=style.AFTER, ms=3)
        axes.plot(*_smooth(value[keep], fall[keep], centre), color=style.AFTER, lw=1.6)
        axes.axhline(level, color=style.NEUTRAL, lw=0.8)
        axes.set_ylim(0, 1.6 * level)
        # The parabola of a parameter that the data leave open would squeeze all else to a point.
        low, high = value[keep].min(), value[keep].max()
        if high > low:
            axes.set_xlim(low - 0.1 * (high - low), high + 0.1 * (high - low))
        panel_labels(axes, [name, "fall"])
    handles = [
        style.line(style.AFTER, f"{data.attrs['kind']}, others re-estimated"),
        style.line(style.FAINT, "linearised", 1.0, "--"),
    ]
    style.legend(figure, handles, f"level {100 * float(data.attrs['level']):.3g} %")
    return figure


def _smooth(value: np.ndarray, fall: np.ndarray, centre: float) -> tuple[np.ndarray, np.ndarray]:
    """The curve through points of a profile, the estimate among them.

    Interpolated is the root of the fall with the sign of the side, which of a normal objective is a
    straight line: few points give a smooth curve, and a monotone interpolant adds no bumps.
    """
    value, place = np.unique(np.append(value, centre), return_index=True)
    root = np.sqrt(np.maximum(np.append(fall, 0.0)[place], 0.0)) * np.sign(value - centre)
    if value.size < 2:
        return value, root**2
    fine = np.linspace(value[0], value[-1], 301)
    return fine, interpolate.PchipInterpolator(value, root)(fine) ** 2


def closed_curve(axes: Axes, curve: np.ndarray, colour: str, line: str, width: float) -> None:
    """A closed curve; where it is open it breaks off."""
    finite = np.isfinite(curve).all(axis=1)
    loop = (
        np.vstack((curve, curve[:1])) if finite.all() else np.where(finite[:, None], curve, np.nan)
    )
    axes.plot(*loop.T, line, color=colour, lw=width)


def panel_labels(axes: Axes, names: list[str]) -> None:
    """Names below and beside, few numbers."""
    style.dress(axes, 3)
    axes.ticklabel_format(useOffset=False, style="sci", scilimits=(-3, 4), useMathText=True)
    axes.yaxis.get_offset_text().set_fontsize(style.SMALL)
    axes.xaxis.get_offset_text().set_fontsize(style.SMALL)
    axes.set_xlabel(style.plain(names[0], 30), fontsize=style.TEXT)
    axes.set_ylabel(style.plain(names[1], 30), fontsize=style.TEXT)


def panel_grid(count: int) -> tuple[Figure, list[Axes]]:
    """Panels of one size in reading order."""
    columns = min(COLUMNS, max(count, 1))
    rows = math.ceil(max(count, 1) / columns)
    height = REGION_TOP + rows * (0.8 * SIDE + GAP) - GAP + 0.2 + REGION_BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = (style.WIDTH - REGION_LEFT) / COLUMNS
    panels = []
    for place in range(count):
        row, column = divmod(place, columns)
        x = REGION_LEFT + column * wide
        y = height - REGION_TOP - 0.2 - (row + 1) * 0.8 * SIDE - row * GAP
        panels.append(style.add_axes(figure, x, y, wide - 0.8, 0.8 * SIDE))
    return figure, panels


BINS = 41
WIDTHS = 4.5


def sampling_distribution(found: LabelledResult | xr.Dataset | xr.DataTree) -> Figure:
    """Histograms of the estimates about the truth, in standard deviations of the bound.

    Parameters
    ----------
    found : LabelledResult, xarray.Dataset or xarray.DataTree
        The group ``sampling_distribution``.

    Returns
    -------
    Figure
        The line is the normal density that the Cramér-Rao bound allows, the dashed one that of the
        noise propagated through the estimator.
    """
    data = dataset(found)
    names = [str(name) for name in data[schema.PARAMETER].values][:REGION_MOST]
    good = data["status"].values == 0
    figure, panels = panel_grid(len(names))
    bins = int(np.clip(2 * np.sqrt(good.sum()), 9, BINS))
    grid = np.linspace(-WIDTHS, WIDTHS, 200)
    for axes, name in zip(panels, names, strict=True):
        one = data.sel(parameter=name)
        unit = float(one["bound_sd"])
        scaled = (one["replicate"].values[good] - float(one["truth"])) / unit
        axes.hist(
            np.clip(scaled, -WIDTHS, WIDTHS), np.linspace(-WIDTHS, WIDTHS, bins).tolist(),
            density=True, color=style.SIMILAR,
        )  # fmt: skip
        axes.plot(grid, distributions.norm.pdf(grid), color=style.AFTER, lw=1.6)
        expected = float(one["expected_sd"]) / unit
        density = distributions.norm.pdf(grid / expected) / expected
        axes.plot(grid, density, "--", color=style.BEFORE, lw=1.2)
        axes.axvline(float(one["bias"]) / unit, color=style.INK, lw=0.8)
        style.dress(axes, 4)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.set_xlabel(style.plain(name, 30), fontsize=style.TEXT)
        text = f"bias {float(one['bias']) / unit:+.2f}\nefficiency {float(one['efficiency']):.2f}"
        axes.text(
            0.98, 0.97, text, transform=axes.transAxes, ha="right", va="top",
            fontsize=style.SMALL, color=style.FAINT,
        )  # fmt: skip
    handles: list[Artist] = [
        style.band(style.SIMILAR, number_of(int(good.sum()), "replication")),
        style.line(style.AFTER, "Cramér-Rao bound"),
        style.line(style.BEFORE, "linearised estimator", 1.2, "--"),
    ]
    style.legend(figure, handles, "distance from the truth in sd of the bound")
    return figure


def history(data: xr.Dataset) -> Figure:
    """Every parameter and the objective against the iteration.

    Parameters
    ----------
    data : xarray.Dataset
        The group ``point``, or ``estimate(...).to_dataset()``.

    Returns
    -------
    Figure
        One panel for each parameter, with the estimate and its linearised standard deviation as a
        band, and one for the objective. A new colour is another estimator.
    """
    names = [str(name) for name in data[schema.PARAMETER].values][: REGION_MOST - 1]
    methods = [str(name) for name in data["method"].values]
    stages = list(dict.fromkeys(methods))
    figure, panels = panel_grid(len(names) + 1)
    for axes, name in zip(panels, names, strict=False):
        one = data.sel({schema.PARAMETER: name})
        estimate, sd = float(one[schema.ESTIMATE]), float(one[schema.SD])
        if np.isfinite(sd):
            axes.axhspan(estimate - sd, estimate + sd, color=style.NOISE, lw=0)
        _way(axes, one[schema.HISTORY].values, methods, stages)
        axes.set_title(style.plain(name, 30), fontsize=style.TEXT, loc="left")
    _way(panels[len(names)], data[schema.OBJECTIVE].values, methods, stages)
    panels[len(names)].set_title("objective", fontsize=style.TEXT, loc="left")
    lines: list[Artist] = [
        style.line(colour, name) for name, colour in zip(stages, style.ENSEMBLES, strict=False)
    ]
    style.legend(figure, [*lines, style.band(style.NOISE, "estimate ± sd")])
    return figure


def _way(axes: Axes, values: np.ndarray, methods: list[str], stages: list[str]) -> None:
    """One line for each estimator, from where the one before it ended."""
    for stage, colour in zip(stages, style.ENSEMBLES, strict=False):
        own = np.flatnonzero([method == stage for method in methods])
        axes.plot(own, values[own], "o-", color=colour, lw=1.6, ms=3.5)
    style.dress(axes, 4)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_xlabel("iteration", fontsize=style.SMALL)


SENSITIVITY_ROW, SENSITIVITY_LEFT, SENSITIVITY_TOP, SENSITIVITY_BOTTOM = 0.32, 2.4, 1.5, 0.3
SENSITIVITY_MOST = 40
_SHADES = LinearSegmentedColormap.from_list("share", ["#ffffff", style.SIMILAR, style.AFTER])


def sensitivity(found: LabelledResult | xr.Dataset | xr.DataTree) -> Figure:
    """Sobol indices, or local changes in per cent, feature by parameter.

    Parameters
    ----------
    found : LabelledResult, xarray.Dataset or xarray.DataTree
        From :func:`~bayesoleo.estimation.global_sensitivity`, ``sobol`` or
        ``local_sensitivity``.

    Returns
    -------
    Figure
        Total shares with the first-order ones in brackets, or changes in per cent.
    """
    data = dataset(found)
    names = [str(name) for name in data[schema.PARAMETER].values]
    features = [str(name) for name in data["feature"].values][:SENSITIVITY_MOST]
    if "total" in data:
        shown = data["total"].values[:SENSITIVITY_MOST]
        first = data["first"].values[:SENSITIVITY_MOST]
        texts = [[f"{t:.2f} ({f:.2f})" for t, f in zip(a, b, strict=True)] for a, b in
                 zip(shown, first, strict=True)]  # fmt: skip
        title, top = "share of the variance, total (alone)", 1.0
    else:
        shown = data["percent"].values[:SENSITIVITY_MOST]
        texts = [[f"{value:+.3g} %" for value in row] for row in shown]
        step = "one prior sd" if data.attrs["per"] == "prior" else "1 % of the parameter"
        title, top = f"change by {step}", float(np.nanmax(np.abs(shown)))
    height = SENSITIVITY_TOP + SENSITIVITY_ROW * max(len(features), 2) + SENSITIVITY_BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = style.WIDTH - SENSITIVITY_LEFT - 0.9
    tall = SENSITIVITY_ROW * len(features)
    bottom = height - SENSITIVITY_TOP - tall
    axes = style.add_axes(figure, SENSITIVITY_LEFT, bottom, wide, tall)
    table(axes, np.abs(shown) / (top or 1.0), texts, features, names)
    figure.text(0.02, 1 - 0.1 / height, title, va="top", fontsize=style.TEXT, color=style.INK)
    return figure


def table(
    axes: Axes,
    shades: np.ndarray,
    texts: list[list[str]],
    rows: list[str],
    columns: list[str],
) -> None:
    """Cells from white to blue by values from 0 to 1, with their texts."""
    axes.imshow(np.nan_to_num(np.clip(shades, 0, 1)), cmap=_SHADES, vmin=0, vmax=1, aspect="auto")
    for r, line in enumerate(texts):
        for c, text in enumerate(line):
            colour = style.text_on(
                to_hex(_SHADES(float(np.nan_to_num(np.clip(shades[r, c], 0, 1)))))
            )
            axes.text(c, r, text, ha="center", va="center", fontsize=style.SMALL - 1, color=colour)
    axes.set_xticks(range(len(columns)), [style.plain(c, 24) for c in columns], rotation=30)
    axes.xaxis.tick_top()
    for label in axes.get_xticklabels():
        label.set_horizontalalignment("left")
    axes.set_yticks(range(len(rows)), [style.plain(r, 30) for r in rows])
    axes.tick_params(length=0, labelsize=style.SMALL)
    for spine in axes.spines.values():
        spine.set_visible(False)


PRIOR_LEFT, PRIOR_TOP, PRIOR_BOTTOM, PRIOR_ROW = 2.6, 0.55, 0.6, 0.26
PRIOR_MOST = 40
#: Above this a sensitivity is worth a look.
THRESHOLD = 0.05


def prior_sensitivity(data: xr.Dataset) -> Figure:
    """Sensitivities to prior and likelihood, a row for each quantity.

    Parameters
    ----------
    data : xarray.Dataset
        From :func:`bayesoleo.posterior.prior_sensitivity`.

    Returns
    -------
    Figure
        Left of the line a sensitivity is of no account. A quantity whose prior's lies right of it
        is written in colour.
    """
    names = [str(name) for name in data[schema.QUANTITY].values][:PRIOR_MOST]
    figure, axes = style.row_axes(
        [style.plain(name, 34) for name in names],
        PRIOR_ROW,
        margins=(PRIOR_LEFT, 0.3, PRIOR_TOP, PRIOR_BOTTOM),
        ticks=8,
        size=style.SMALL,
    )
    rows = np.arange(len(names))
    colours = {"prior": style.BEFORE, "likelihood": style.AFTER}
    for group, mark in (("prior", "D"), ("likelihood", "o")):
        values = data[group].values[: len(names)]
        axes.plot(values, rows, mark, ms=4.5, color=colours[group])
    axes.axvline(THRESHOLD, color=style.NEUTRAL, lw=0.8)
    axes.set_xlim(left=0.0)
    for label, diagnosis in zip(axes.get_yticklabels(), data["diagnosis"].values, strict=False):
        if str(diagnosis):
            label.set_color(style.BEFORE)
    axes.set_xlabel("sensitivity to a power of prior or likelihood", fontsize=style.TEXT)
    handles = [style.line(colours[g], g, 4.0) for g in ("prior", "likelihood")]
    style.legend(figure, handles)
    return figure
