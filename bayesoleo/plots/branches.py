"""A branch of periodic answers: how large they are, which of them last, and where they meet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from bayesoleo.plots import style
from bayesoleo.plots.units import Scale, engineering, format_unit
from bayesoleo.prediction.branch import AnswerBranch
from bayesoleo.solvers.branches.follow import BranchPoint

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
        From :func:`bayesoleo.prediction.branch.follow_branch`; several along one value, where not
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
