"""A motion that multiple shooting found, with what was measured of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from bayesoleo.estimation.trajectories.multiple_shooting import EstimatedTrajectory
from bayesoleo.plots import style
from bayesoleo.plots.units import engineering

HIGH, GAP, TOP, BOTTOM = 1.25, 0.22, 0.5, 0.5


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
    height = TOP + count * HIGH + (count - 1) * GAP + BOTTOM
    figure = style.blank(style.WIDTH, height)
    samples = np.linspace(found.time[0], found.time[-1], found.predicted.shape[1])
    for k, name in enumerate(names):
        y = height - TOP - (k + 1) * HIGH - k * GAP
        axes = figure.add_axes((0.085, y / height, 0.9, HIGH / height))
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
