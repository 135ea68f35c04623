"""Regions of equal fit and profiles: exact against what linearisation says."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import interpolate, stats

from bayesoleo import schema
from bayesoleo.estimation.shown import LabelledResult
from bayesoleo.plots import style
from bayesoleo.plots.reading import dataset

SIDE, GAP, LEFT, TOP, BOTTOM, COLUMNS = 2.6, 0.75, 0.85, 0.6, 0.55, 3
MOST = 12


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
    pairs = [str(pair) for pair in data["pair"].values][:MOST]
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
    remark = f"first {MOST} of {data.sizes['pair']} planes" if data.sizes["pair"] > MOST else ""
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
    names = [str(name) for name in data[schema.PARAMETER].values][:MOST]
    level = stats.chi2.isf(1 - float(data.attrs["level"]), 1) / 2
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
    height = TOP + rows * (0.8 * SIDE + GAP) - GAP + 0.2 + BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = (style.WIDTH - LEFT) / COLUMNS
    panels = []
    for place in range(count):
        row, column = divmod(place, columns)
        x = LEFT + column * wide
        y = height - TOP - 0.2 - (row + 1) * 0.8 * SIDE - row * GAP
        box = x / style.WIDTH, y / height, (wide - 0.8) / style.WIDTH, 0.8 * SIDE / height
        panels.append(figure.add_axes(box))
    return figure, panels
