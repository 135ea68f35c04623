"""Common style of all figures, and engineering units of axes.

Colours are few, distinguishable by the colour-blind, and each has one meaning. Sizes are in inches
and margins fixed, instead of found by a layout engine: that is fast, and a figure looks the same
for 2 runs and for 14. Values are in SI and shown with prefixes: 0.0123 m as 12.3 mm.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import TICKDOWN, TICKLEFT
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from numpy.typing import NDArray

from bayesoleo import _schema as schema
from bayesoleo._types import Array
from bayesoleo.plots._reading import RunView

# Okabe and Ito (2008), where that is too pale a darker shade: before is vermilion, after is blue,
# wherever they are shown. Text has a contrast of 4.5 on white at least, lines and marks of 3.
BEFORE = "#c04a00"
AFTER = "#0072b2"
SIMILAR = "#8fc3e3"
MEASURED = "#8a919c"
NOISE = "#cfd5de"
NEUTRAL = "#c3c9d2"
INK = "#22262e"
FAINT = "#6b7280"
ENSEMBLES = ("#0072b2", "#c04a00", "#00805d", "#b0558a", "#946c00", "#3f8fbd", "#7a5195", "#222222")

WIDTH = 10.0
TEXT, SMALL = 9.0, 8.0
MOST_PANELS = 24
"""More runs than this are not shown; the figure says so."""


@dataclass(frozen=True)
class Panels:
    """A figure of small multiples and its axes in reading order."""

    figure: Figure
    axes: list[Axes]
    columns: int


def contrast(one: str, other: str) -> float:
    """Contrast of two colours from 1 to 21, as the Web Content Accessibility Guidelines define it.

    Parameters
    ----------
    one, other : str
        As Matplotlib reads colours.
    """
    low, high = sorted(_luminance(colour) for colour in (one, other))
    return (high + 0.05) / (low + 0.05)


def _luminance(colour: str) -> float:
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def text_on(ground: str) -> str:
    """Black or white, whichever can be read better on a ground."""
    return max(("black", "white"), key=lambda colour: contrast(colour, ground))


def plain(text: str, most: int = 60) -> str:
    """A user's text for a figure: one line, not too long, ``$`` no mathematics."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    if len(line) > most:
        # What tells labels apart is as often at their end as at their beginning.
        line = line[: most - most // 2 - 1] + "…" + line[len(line) - most // 2 :]
    return line.replace("$", r"\$")


def blank(width: float, height: float) -> Figure:
    """An empty figure of a size in inches."""
    return Figure(figsize=(width, height), facecolor="white")


def add_axes(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Axes in a figure, their place and size in inches."""
    wide, high = figure.get_size_inches()
    return figure.add_axes((left / wide, bottom / high, width / wide, height / high))


def name_above(axes: Axes, left: str = "", right: str = "") -> None:
    """Write a bold title on the left of axes, a faint remark on the right."""
    if left:
        axes.set_title(left, loc="left", y=1.0, fontsize=SMALL, pad=3, fontweight="bold")
    if right:
        axes.set_title(right, loc="right", y=1.0, fontsize=SMALL, pad=3, color=FAINT)


def row_axes(
    labels: Sequence[str],
    row: float,
    *,
    margins: tuple[float, float, float, float],
    ticks: int,
    size: float = TEXT,
) -> tuple[Figure, Axes]:
    """A figure with one row for each label, the first on top.

    Parameters
    ----------
    labels : sequence of str
        Written on the left.
    row : float
        Height of a row, inches; there is room for two at least.
    margins : tuple of float
        Left, right, top and bottom, inches.
    ticks : int
        Intervals of the horizontal axis at most.
    size : float
        Of the labels, points.
    """
    left, right, top, bottom = margins
    count = max(len(labels), 2)
    height = top + row * count + bottom
    figure = blank(WIDTH, height)
    wide, high = (WIDTH - left - right) / WIDTH, 1 - (top + bottom) / height
    axes = figure.add_axes((left / WIDTH, bottom / height, wide, high))
    dress(axes, ticks)
    axes.set_ylim(count - 0.5, -0.5)
    axes.set_yticks(range(len(labels)), labels)
    axes.tick_params(axis="y", length=0, labelsize=size)
    return figure, axes


def dress(axes: Axes, ticks: int = 4) -> None:
    """Remove what is not data; at most ``ticks`` intervals an axis, numbers without offsets."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(labelsize=SMALL, color=FAINT, labelcolor=INK, length=3)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(ticks, steps=[1, 2, 2.5, 5, 10]))
        formatter = ScalarFormatter(useOffset=False)
        formatter.set_scientific(False)
        axis.set_major_formatter(formatter)


def panels(runs: Sequence[RunView], *, free_x: bool = False) -> Panels:
    """Small multiples, one for each run, with the run's label, role and frequency on top.

    Parameters
    ----------
    runs : sequence of RunView
        Those shown.
    free_x : bool
        Whether every panel has its own horizontal axis, which takes room for its numbers.

    Returns
    -------
    Panels
    """
    count = max(len(runs), 1)
    columns = count if count <= 3 else 4 if count > 6 else 3
    rows = math.ceil(count / columns)
    high = {1: 3.0, 2: 2.2}.get(rows, 1.35)
    gap, top, bottom, left, right = (0.62 if free_x else 0.42), 0.75, 0.62, 0.85, 0.1
    height = top + rows * high + (rows - 1) * gap + bottom
    figure = blank(WIDTH, height)
    wide = (WIDTH - left - right) / columns
    axes = []
    for place, run in enumerate(runs):
        row, column = divmod(place, columns)
        x, y = left + column * wide, height - top - (row + 1) * high - row * gap
        panel = add_axes(figure, x, y, 0.86 * wide, high)
        dress(panel)
        title(panel, run)
        # The axis of a panel stays where no panel of the next row stands below it.
        panel.tick_params(labelbottom=free_x or place + columns >= len(runs))
        axes.append(panel)
    return Panels(figure, axes, columns)


def title(axes: Axes, run: RunView) -> None:
    """Label on the left, frequency on the right; hold-out runs are marked by weight and word.

    Their height is given: Matplotlib would lay out all numbers of the axes to look for it.
    """
    held_out = run.role == schema.HOLD_OUT
    text = " · ".join(part for part in ("hold-out" if held_out else "", run.remark) if part)
    width = axes.get_position().width * WIDTH
    label = plain(run.label, max(int((width - 0.065 * len(text)) / 0.085), 6))
    axes.set_title(label, loc="left", y=1.0, fontsize=SMALL, pad=3, color=INK, fontweight="bold")
    colour = AFTER if held_out else FAINT
    axes.set_title(text, loc="right", y=1.0, fontsize=SMALL - 0.5, pad=3, color=colour)


def label_outside(figure: Figure, x: str, y: str) -> None:
    """One label for all horizontal and one for all vertical axes."""
    height = figure.get_figheight()
    figure.text(0.5, 0.14 / height, plain(x), ha="center", va="bottom", fontsize=TEXT, color=INK)
    middle = 0.5 * (1 + (0.62 - 0.75) / height)
    figure.text(
        0.012, middle, plain(y), ha="left", va="center", rotation=90, fontsize=TEXT, color=INK
    )


def legend(figure: Figure, handles: Sequence[Artist], remark: str = "") -> None:
    """What the colours mean, in one row on top, with a remark at its right end."""
    height = figure.get_figheight()
    figure.legend(
        handles=list(handles),
        loc="upper left",
        bbox_to_anchor=(0.06, 1 - 0.04 / height),
        ncols=len(handles),
        frameon=False,
        fontsize=TEXT,
        handlelength=1.8,
        borderaxespad=0.2,
    )
    figure.text(0.985, 1 - 0.15 / height, remark, ha="right", va="top", fontsize=SMALL, color=FAINT)


def line(colour: str, text: str, width: float = 1.6, style: str = "-") -> Line2D:
    """A line for a legend."""
    return Line2D([], [], color=colour, lw=width, ls=style, label=text)


def band(colour: str, text: str) -> Patch:
    """A band for a legend."""
    return Patch(facecolor=colour, edgecolor="none", label=text)


def omitted(runs: Sequence[RunView]) -> tuple[list[RunView], str]:
    """The runs shown, and what is said where some are not."""
    remark = f"first {MOST_PANELS} of {len(runs)} runs" if len(runs) > MOST_PANELS else ""
    return list(runs[:MOST_PANELS]), remark


def share_y(axes: Sequence[Axes], spans: Sequence[float], symmetric: bool = False) -> None:
    """Give panels one vertical scale, unless that would flatten some of them to a line.

    Parameters
    ----------
    axes : sequence of Axes
        The panels.
    spans : sequence of float
        Largest minus smallest value of each.
    symmetric : bool
        Whether zero stays in the middle.
    """
    if not axes:
        return
    positive = [span for span in spans if np.isfinite(span) and span > 0.0]
    shared = not positive or max(positive) < 10.0 * min(positive)
    limits = np.array([panel.get_ylim() for panel in axes])
    if symmetric:
        limits = np.abs(limits).max(axis=1)[:, None] * np.array([-1.0, 1.0])
    for place, panel in enumerate(axes):
        low, high = (limits[:, 0].min(), limits[:, 1].max()) if shared else limits[place]
        panel.set_ylim(low, high)
    _number_left_only(axes, shared)


def _number_left_only(axes: Sequence[Axes], shared: bool) -> None:
    """Numbers on the leftmost panels are enough where the scale is shared."""
    leftmost = min((panel.get_position().x0 for panel in axes), default=0.0)
    for panel in axes:
        if shared and panel.get_position().x0 > leftmost + 1e-6:
            places = panel.yaxis.get_major_locator().tick_values(*panel.get_ylim())
            without_numbers(panel, y=places)


#: Where the axis over one period has numbers.
QUARTERS = {0.0: "0", 0.25: "¼", 0.5: "½", 0.75: "¾", 1.0: "1"}


def cycles(axes: Axes) -> None:
    """A horizontal axis over one period."""
    axes.set_xlim(0.0, 1.0)
    if axes.xaxis.get_tick_params().get("labelbottom", True):
        axes.set_xticks(list(QUARTERS), list(QUARTERS.values()))
    else:
        without_numbers(axes, x=list(QUARTERS))


def without_numbers(
    axes: Axes, *, x: Sequence[float] | None = None, y: Sequence[float] | None = None
) -> None:
    """Ticks at places within the limits of an axis, without numbers, in place of its own.

    They are one artist; an axis has five for each tick, which take most of the time of a figure of
    many panels.
    """
    marks: dict[str, Any] = {"color": FAINT, "ls": "none", "ms": 3, "mew": 0.8, "clip_on": False}
    if x is not None:
        axes.xaxis.set_visible(False)
        inside = _between(x, axes.get_xlim())
        marks |= {"marker": TICKDOWN, "transform": axes.get_xaxis_transform()}
        axes.add_artist(Line2D(inside, 0 * inside, **marks))
    if y is not None:
        axes.yaxis.set_visible(False)
        inside = _between(y, axes.get_ylim())
        marks |= {"marker": TICKLEFT, "transform": axes.get_yaxis_transform()}
        axes.add_artist(Line2D(0 * inside, inside, **marks))


def _between(places: Sequence[float], limits: tuple[float, float]) -> Array:
    """Places that are within limits."""
    found = np.asarray(places, dtype=float)
    return found[(min(limits) <= found) & (found <= max(limits))]


def x_name(runs: Sequence[RunView]) -> str:
    """What stands under panels over one period."""
    text = "phase in cycles"
    if all(run.periodic for run in runs):
        return text
    transient = "time as a part of the record"
    return f"{text} (transient: {transient})" if any(run.periodic for run in runs) else transient


def magnitude(*arrays: NDArray[np.float64]) -> float:
    """Largest absolute value, by which the unit of an axis is chosen; 0 if there is none."""
    finite = [np.abs(array[np.isfinite(array)]) for array in arrays]
    return max((float(array.max()) for array in finite if array.size), default=0.0)


PREFIXES = {"n": 1e-9, "µ": 1e-6, "m": 1e-3, "c": 1e-2, "": 1.0, "k": 1e3, "M": 1e6, "G": 1e9}
VALUE_SMALL = ("n", "µ", "m")
ALL = (*VALUE_SMALL, "", "k", "M", "G")
# What is in use: nobody reads kilometres of stroke or kiloseconds, and centimetres only squared.
ALLOWED = {
    "m": (*VALUE_SMALL, ""),
    "s": (*VALUE_SMALL, ""),
    "K": ("m", ""),
    "mol": (*VALUE_SMALL, ""),
    "rad": (*VALUE_SMALL, ""),
} | dict.fromkeys(("N", "Pa", "V", "A", "W", "J", "Hz"), ALL)
ALLOWED_POWERS = {"m": (*VALUE_SMALL, "c", "")}
LEADING = re.compile(
    r"^(mol|rad|Pa|Hz|[NmsVAWJK])(?![A-Za-zµ])\s*(?:(?:\*\*|\^)\s*)?([23²³])?(?=$|\D)(.*)$"
)
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
DIMENSIONLESS = ("", "1", "-", "dimensionless")


@dataclass(frozen=True)
class Scale:
    """How values of an SI unit are shown: ``shown = factor * value``, in ``unit``."""

    factor: float
    unit: str

    def label(self, name: str) -> str:
        """Text of an axis: ``force in kN``; of a dimensionless quantity its name alone."""
        return f"{name} in {self.unit}" if self.unit else name


def engineering(unit: str, magnitude: float) -> Scale:
    """Choose prefix or power of ten for values of about a magnitude.

    Parameters
    ----------
    unit : str
        SI unit as stored: ``N``, ``N/m``, ``m**2``, ``N*s/m``; empty or ``1`` if dimensionless.
    magnitude : float
        Typical absolute value, in ``unit``.

    Returns
    -------
    Scale
    """
    size = abs(magnitude)
    if not math.isfinite(size) or size == 0.0:
        return Scale(1.0, format_unit(unit))
    match = LEADING.match(unit.strip())
    return _power_of_ten(unit, size) if match is None else _prefixed(match, unit, size)


def format_unit(unit: str) -> str:
    """A unit for reading: ``N*s^2/m**2`` as ``N·s²/m²``, empty if dimensionless."""
    if unit.strip() in DIMENSIONLESS:
        return ""
    text = re.sub(r"(?:\*\*|\^)\s*(-?\d+)", lambda m: m[1].translate(SUPERSCRIPTS), unit.strip())
    text = re.sub(r"\s*\*\s*|(?<=\w)\s+(?=\w)", "·", text).replace(" / ", "/")
    return re.sub(r"^ln\(\((\w*)\)²\)$", r"ln \1²", text)


def format_value(value: float | None, unit: str = "", sd: float | None = None) -> str:
    """A value with its unit, in as many digits as its standard deviation leaves.

    Parameters
    ----------
    value : float or None
        In ``unit``; None gives a dash.
    unit : str
        SI unit as stored.
    sd : float, optional
        Two digits of it are kept; four significant digits of the value without it.

    Returns
    -------
    str
    """
    if value is None or not math.isfinite(value):
        return "–"
    scale = engineering(unit, max(abs(value), abs(sd or 0.0)))
    return f"{format_number(value * scale.factor, sd and sd * scale.factor)} {scale.unit}".strip()


def format_number(value: float | None, sd: float | None = None) -> str:
    """A number in as many digits as its standard deviation leaves (four without one)."""
    if value is None or not math.isfinite(value):
        return "–"
    if sd is None or not math.isfinite(sd) or sd <= 0.0:
        text = f"{value:#.4g}" if 1e-3 <= abs(value) < 1e4 else f"{value:.4g}"
        if 9999.5 <= abs(value) < 1e5:
            text = f"{float(text):.0f}"
        return text.rstrip(".").replace("-", "−")
    decimals = 1 - math.floor(math.log10(sd))
    rounded = round(value, decimals) + 0.0
    return f"{rounded:.{min(max(decimals, 0), 12)}f}".replace("-", "−")


def _prefixed(match: re.Match[str], unit: str, size: float) -> Scale:
    """The largest allowed prefix on the leading symbol that leaves a value of at least 1."""
    symbol, power_text, rest = match[1], match[2], match[3]
    power = {None: 1, "2": 2, "3": 3, "²": 2, "³": 3}[power_text]
    allowed = ALLOWED_POWERS.get(symbol, ALLOWED[symbol]) if power > 1 else ALLOWED[symbol]
    fitting = [prefix for prefix in allowed if size / PREFIXES[prefix] ** power >= 1.0]
    prefix = max(fitting or allowed[:1], key=lambda name: PREFIXES[name])
    factor = 1.0 / PREFIXES[prefix] ** power
    if not 1.0 <= size * factor < 1e5:
        return _power_of_ten(unit, size)
    return Scale(factor, prefix + format_unit(f"{symbol}{'' if power == 1 else f'^{power}'}{rest}"))


def _power_of_ten(unit: str, size: float) -> Scale:
    """For units that take no prefix: a power of ten in front of the unit."""
    exponent = 3 * math.floor(math.log10(size) / 3)
    if -3 <= exponent <= 3 and 1e-2 <= size < 1e5:
        return Scale(1.0, format_unit(unit))
    text = f"10{str(exponent).translate(SUPERSCRIPTS)} {format_unit(unit)}"
    return Scale(10.0**-exponent, text.strip())
