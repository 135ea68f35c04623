"""How a period is found: figures B.1 and B.2 of Verbeek (1993)."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesoleo.data.period_search import PeriodSearch
from bayesoleo.plots import style
from bayesoleo.plots.units import engineering

HEIGHT = 5.2


def period_search(search: PeriodSearch, unit: str = "", name: str = "signal") -> Figure:
    """Residual time shift and autocovariance over two periods, and the valley at one period.

    Parameters
    ----------
    search : PeriodSearch
        From :func:`bayesoleo.data.period_search`.
    unit : str, optional
        SI unit of the signal.
    name : str, optional
        What was measured.

    Returns
    -------
    Figure
        Above both functions as they are (figure B.1); below the residual time shift next to one
        period, with the quadratic whose minimum is the period (figure B.2).
    """
    figure = style.blank(style.WIDTH, HEIGHT)
    boxes = ((0.085, 0.575, 0.4, 0.33), (0.585, 0.575, 0.4, 0.33), (0.085, 0.105, 0.9, 0.32))
    shift, covariance, zoom = (figure.add_axes(box) for box in boxes)
    square = f"({unit})^2" if unit else ""
    step = search.time_step
    for axes, values, words in (
        (shift, search.residual, "residual time shift"),
        (covariance, search.covariance, "autocovariance"),
    ):
        scale = _scale(square, unit, style.magnitude(values))
        axes.plot(step * search.shifts, scale[0] * values, color=style.AFTER, lw=1.2)
        axes.axvline(step * search.period_in_samples, color=style.BEFORE, lw=0.8)
        _dress(axes, "shift in s", f"{words}{scale[1]}")
    away = search.near - search.period_in_samples
    scale = _scale(square, unit, style.magnitude(search.near_residual))
    fine = np.linspace(away[0], away[-1], 300)
    zoom.plot(step * search.near, scale[0] * search.near_residual, "o", color=style.AFTER, ms=3)
    parabola = scale[0] * np.polyval(search.parabola, fine)
    zoom.plot(step * (fine + search.period_in_samples), parabola, color=style.BEFORE, lw=1.2)
    zoom.axvline(step * search.period_in_samples, color=style.BEFORE, lw=0.8)
    _dress(zoom, "shift in s", f"residual time shift{scale[1]}")
    handles: list[Artist] = [
        style.line(style.AFTER, name),
        style.line(style.BEFORE, "quadratic and its minimum, the period"),
    ]
    style.legend(figure, handles, f"{search.frequency:.6g} Hz")
    return figure


def _scale(square: str, unit: str, size: float) -> tuple[float, str]:
    """Factor and words for values in the square of a unit."""
    if not square:
        return 1.0, ""
    base = engineering(unit, float(np.sqrt(size)))
    return base.factor**2, f" in ({base.unit})²" if base.unit else ""


def _dress(axes: Axes, x: str, y: str) -> None:
    style.dress(axes, 4)
    axes.set_xlabel(x, fontsize=style.TEXT)
    axes.set_ylabel(y, fontsize=style.TEXT)
