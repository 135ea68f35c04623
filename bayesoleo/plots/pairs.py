"""Draws of two parameters with the regions that the estimate would have given instead."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from bayesoleo import schema
from bayesoleo.errors import ResultsError
from bayesoleo.plots import style
from bayesoleo.plots.draws import draws
from bayesoleo.plots.regions import MOST, closed_curve, panel_grid, panel_labels

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
    planes = [plane for plane in planes if all(name in posterior for name in plane[1])][:MOST]
    if not planes:
        raise ResultsError("posterior and indifference region have no plane in common")
    # The shadow of the whole region, where it was made.
    data = data.isel(section=-1)
    normal = float(stats.chi2.cdf(2 * float(data.attrs["epsilon"]), 2))
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
