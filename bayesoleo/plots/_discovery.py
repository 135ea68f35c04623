"""Figures of the search: ranking of the candidates, proposed runs, nonparametric shapes."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from bayesoleo import _schema as schema
from bayesoleo._types import Array
from bayesoleo.effects._catalogue import called, listed, titles_for
from bayesoleo.errors import InputError
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._reading import dataset
from bayesoleo.plots._style import Scale, engineering

RANKING_LEFT, RANKING_TOP, RANKING_BOTTOM, ROW, RANKING_RIGHT = 3.9, 0.55, 0.6, 0.27, 2.0


def ranking(tree: xr.DataTree, number: int = 0, most: int = 15) -> Figure:
    """Share of the excess error that each candidate explains, with its p-value.

    Parameters
    ----------
    tree : DataTree
        Its ``summary`` attribute is read.
    number : int
        Which round, from 0.
    most : int
        How many candidates are shown, the best first.

    Returns
    -------
    Figure
        The accepted effect is blue, those the data cannot tell from it are pale blue and
        marked ``≈``.
    """
    summary = reading.summary(tree)
    entry, titles = summary["rounds"][number], summary.get("titles", {})
    candidates = sorted(entry["candidates"], key=lambda candidate: -candidate["gain"])
    shown = candidates[:most]
    labels = [style.plain(called(name(c), titles), 56) for c in shown]
    margins = RANKING_LEFT, RANKING_RIGHT, RANKING_TOP, RANKING_BOTTOM
    figure, axes = style.row_axes(labels, ROW, margins=margins, ticks=6)
    accepted, alike = chosen(entry), similar(entry)
    for row, candidate in enumerate(shown):
        _bar(axes, row, candidate, candidate is accepted, any(candidate is c for c in alike))
    axes.spines["left"].set_visible(False)
    largest = max([100 * candidate["gain"] for candidate in shown], default=0.0)
    axes.set_xlim(0.0, max(1.02 * largest, 10.0))
    axes.set_xlabel("share of the excess error explained in %", fontsize=style.TEXT)
    if not shown:
        axes.text(0.2, 0.5, "no candidate was scored", va="center", color=style.FAINT)
    _explain(figure, entry, len(candidates) - len(shown))
    return figure


def name(candidate: Mapping[str, Any]) -> str:
    """Id of an effect, and what it sits on where that is said: how it is known, not called."""
    target = candidate.get("target")
    return f"{candidate['effect']} @ {target}" if target else str(candidate["effect"])


def title(candidate: Mapping[str, Any]) -> str:
    """What a candidate is called: its effect's title, and what it sits on where that is said."""
    effect = str(candidate["effect"])
    known = {effect: candidate["title"]} if candidate.get("title") else {}
    text = titles_for([effect], known).get(effect, effect.replace("_", " "))
    return f"{text} ({candidate['target']})" if candidate.get("target") else text


def chosen(entry: Mapping[str, Any]) -> dict[str, Any] | None:
    """The accepted candidate of a round; of several with its id the one at its target."""
    if entry["accepted"] is None:
        return None
    where = entry.get("accepted_target")
    own = (c for c in entry["candidates"] if c["effect"] == entry["accepted"])
    return next((c for c in own if where is None or c.get("target") == where), None)


def similar(entry: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The candidates that are said not to be distinguishable from the accepted one."""
    accepted = chosen(entry)
    if accepted is None:
        return []
    listed = set(accepted["indistinguishable_from"])
    ids = Counter(candidate["effect"] for candidate in entry["candidates"])
    found = []
    for candidate in entry["candidates"]:
        effect = candidate["effect"]
        # An id alone does not say which of several targets is meant; the other's own list does.
        back = {accepted["effect"], name(accepted)} & set(candidate["indistinguishable_from"])
        by_id = effect in listed and (ids[effect] == 1 or bool(back))
        if candidate is not accepted and (name(candidate) in listed or by_id):
            found.append(candidate)
    return found


def format_p(value: float | None) -> str:
    """A p-value; None, where it was not computed, gives nothing."""
    if value is None:
        return ""
    return (
        "p < 0.001" if value < 1e-3 else f"p = {value:.3f}" if value < 0.1 else f"p = {value:.2f}"
    )


def format_share(gain: float) -> str:
    """A part of the excess error in per cent; a negative one explains nothing of it."""
    if not gain > 0.0:
        return "none"
    return f"{100 * gain:.1f} %" if gain >= 0.0005 else "< 0.1 %"


def format_probability(value: float) -> str:
    """A probability in the two digits that its computation warrants."""
    return "> 0.99" if value > 0.995 else "< 0.01" if value < 0.005 else f"{value:.2f}"


def _bar(axes: Axes, row: int, candidate: dict[str, Any], first: bool, alike: bool) -> None:
    """One candidate: bar, share, p-value, and whether it is or is like the accepted one."""
    colour = style.AFTER if first else style.SIMILAR if alike else style.MEASURED
    axes.barh(row, max(100 * candidate["gain"], 0.0), 0.68, color=colour)
    texts = (
        format_share(candidate["gain"]),
        format_p(candidate["p_value"]),
        "≈" if alike else "",
    )
    weight = "bold" if first else "normal"
    for inches, text, side in zip(
        (0.7, 1.55, 1.75), texts, ("right", "right", "left"), strict=True
    ):
        place = 1 + inches / (style.WIDTH - RANKING_LEFT - RANKING_RIGHT)
        axes.text(
            place,
            row,
            text,
            transform=axes.get_yaxis_transform(),
            ha=side,
            va="center",
            fontsize=style.SMALL,
            fontweight=weight,
            color=style.INK if first else style.FAINT,
        )


def _explain(figure: Figure, entry: dict[str, Any], hidden: int) -> None:
    """What the colours mean, and how many candidates are not shown."""
    handles = [Patch(facecolor=style.MEASURED, label="candidate")]
    if entry["accepted"]:
        handles = [
            Patch(facecolor=style.AFTER, label="accepted"),
            Patch(facecolor=style.SIMILAR, label="≈ not distinguishable from it"),
            *handles,
        ]
    remark = f"{hidden} more with less" if hidden > 0 else ""
    style.legend(figure, handles, remark)


#: Inches: narrow, so that text stays readable where a phone shrinks it.
STRUCTURES_WIDTH, BARS, STRUCTURES_TOP, STRUCTURES_ROW, STRUCTURES_BOTTOM = (
    5.4,
    3.3,
    0.75,
    0.42,
    0.1,
)
COLUMN = 0.34
#: Effects and structures that are shown have this probability at least.
SHOWN, MOST_EFFECTS, MOST_STRUCTURES = 0.01, 10, 5
#: Key of the row of what lies outside the catalogue.
OUTSIDE = "outside"


def structures(tree: xr.DataTree) -> Figure:
    """Probability that nothing is missing, that each effect acts, and of the leading structures.

    Parameters
    ----------
    tree : DataTree
        Its ``summary`` attribute is read.

    Returns
    -------
    Figure
        Left: a bar for nothing, for each effect of at least 1 %, and for something outside the
        catalogue. Right: a column for each of the leading structures, with a dot in the row of each
        effect that it has; hollow where it follows from scores and was not estimated.

    Raises
    ------
    InputError
        If the result holds no probabilities of structures.
    """
    summary = reading.summary(tree)
    found, titles = summary.get("structures"), summary.get("titles", {})
    if not found:
        hint = "search once more: those of older or unfinished searches are not known"
        raise InputError("the result holds no probabilities of structures", hint=hint)
    effects = [e for e in found["effects"] if e["probability"] >= SHOWN][:MOST_EFFECTS]
    rows = [("", "nothing missing", found["nothing"])]
    rows += [(name(e), called(name(e), titles), e["probability"]) for e in effects]
    rows += [(OUTSIDE, "something outside the catalogue", found["outside"])]
    height = STRUCTURES_TOP + STRUCTURES_ROW * len(rows) + STRUCTURES_BOTTOM
    figure = style.blank(STRUCTURES_WIDTH, height)
    added = {f"{e} @ {t}" for e, t in zip(summary["effects"], summary["targets"], strict=True)}
    place = 0.05, STRUCTURES_BOTTOM, BARS - 0.05, STRUCTURES_ROW * len(rows)
    bars = style.add_axes(figure, *place)
    for row, (key, label, probability) in enumerate(rows):
        colour = style.AFTER if key in added else style.MEASURED
        _probability_bar(bars, row, label, probability, colour)
    bars.set_xlim(0.0, 1.0)
    shown = [one for one in found["list"] if one["probability"] >= SHOWN][:MOST_STRUCTURES]
    left = BARS + 0.2
    dots = style.add_axes(figure, left, place[1], COLUMN * MOST_STRUCTURES, place[3])
    for column, one in enumerate(shown):
        _structure_dots(dots, column, one, [key for key, _, _ in rows])
    dots.set_xlim(-0.5, MOST_STRUCTURES - 0.5)
    for axes in (bars, dots):
        axes.set_axis_off()
        axes.set_ylim(len(rows) - 0.5, -0.5)
    _structure_heads(figure, left)
    return figure


def _probability_bar(axes: Axes, row: int, label: str, probability: float, colour: str) -> None:
    """A bar below its label, with the number at the right."""
    axes.barh(row + 0.17, 1.0, 0.22, color=style.NOISE, alpha=0.5)
    axes.barh(row + 0.17, probability, 0.22, color=colour)
    bold = "bold" if colour == style.AFTER else "normal"
    text: dict[str, Any] = {
        "va": "center",
        "fontsize": style.TEXT,
        "color": style.INK,
        "fontweight": bold,
    }
    axes.text(0.0, row - 0.2, style.plain(label, 38), ha="left", **text)
    axes.text(1.0, row - 0.2, format_probability(probability), ha="right", **text)


def _structure_dots(axes: Axes, column: int, one: Mapping[str, Any], keys: list[str]) -> None:
    """The column of a structure: its probability, and a dot for each of its members."""
    members = {*one["effects"], *([OUTSIDE] if one["outside"] else [])} or {""}
    own = [row for row, key in enumerate(keys) if key in members]
    axes.plot([column] * len(keys), range(len(keys)), "o", color=style.NOISE, ms=4, clip_on=False)
    axes.plot([column] * len(own), own, color=style.INK, lw=1.4)
    fill = style.INK if one["estimated"] else "white"
    axes.plot([column] * len(own), own, "o", color=style.INK, mfc=fill, ms=7, clip_on=False)
    axes.text(
        column, -0.62, format_probability(one["probability"]), rotation=60, fontsize=style.SMALL,
        ha="center", va="bottom", color=style.INK,
    )  # fmt: skip


def _structure_heads(figure: Figure, left: float) -> None:
    """Titles of bars and columns."""
    for x, text in ((0.05, "probability"), (left, "leading structures")):
        figure.text(
            x / STRUCTURES_WIDTH, 1 - 0.05 / figure.get_figheight(), text,
            fontsize=style.SMALL, color=style.FAINT, va="top",
        )  # fmt: skip


PROPOSAL_LEFT, PROPOSAL_TOP, PROPOSAL_BOTTOM, PROPOSAL_RIGHT, HIGH = 0.85, 0.75, 0.62, 1.2, 2.8
#: Separations below and above are not told apart by colour.
LEAST, MOST = 0.1, 100.0


def proposal(tree: xr.DataTree, number: int = 0) -> Figure:
    """Standard deviations by which a run of some frequency and amplitude separates the rivals.

    Parameters
    ----------
    tree : DataTree
        With the group ``proposal``.
    number : int
        Which of its rounds, from 0.

    Returns
    -------
    Figure
        Of the least separated pair, at the mean position that is best for each frequency and
        amplitude; runs that the rig cannot do are left blank. Dots: the runs that were made; star:
        the best of those that were not.
    """
    data = tree[schema.PROPOSAL].to_dataset().isel({schema.ROUND: number})
    told = data["sigma"] if np.isfinite(data["sigma"]).any() else data["information"]
    sigma = told.max(schema.MEAN)
    scale = engineering(reading.unit(data[schema.AMPLITUDE]), float(data[schema.AMPLITUDE].max()))
    height = PROPOSAL_TOP + HIGH + PROPOSAL_BOTTOM
    figure = style.blank(style.WIDTH * 0.72, height)
    width = figure.get_figwidth()
    box = (
        PROPOSAL_LEFT / width,
        PROPOSAL_BOTTOM / height,
        1 - (PROPOSAL_LEFT + PROPOSAL_RIGHT) / width,
        HIGH / height,
    )
    axes = figure.add_axes(box)
    style.dress(axes)
    mesh = axes.pcolormesh(
        _edges(data[schema.FREQUENCY].values),
        _edges(scale.factor * data[schema.AMPLITUDE].values),
        sigma.values,
        norm=LogNorm(LEAST, MOST),
        cmap="YlGnBu",
    )
    bar = figure.colorbar(
        mesh, cax=figure.add_axes((1 - 0.95 / width, box[1], 0.16 / width, box[3]))
    )
    label = "separation in standard deviations" if told.name == "sigma" else "information in bits"
    bar.set_label(label, fontsize=style.SMALL)
    bar.ax.tick_params(labelsize=style.SMALL)
    bar.ax.yaxis.set_major_formatter("{x:g}")
    _marks(axes, tree, data, scale)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("frequency in Hz", fontsize=style.TEXT)
    drive = tree[schema.PROPOSAL].attrs["drive"]
    axes.set_ylabel(scale.label(f"amplitude of {drive}"), fontsize=style.TEXT)
    titles = reading.summary(tree).get("titles", {})
    names = [e for one in json.loads(str(data["rivals"].values)) for e in one.split(" + ")]
    rivals = listed([called(one, titles) for one in dict.fromkeys(names)])
    handles = [
        Line2D([], [], color=style.INK, marker="o", ms=4, ls="", label="runs made"),
        Line2D([], [], color=style.BEFORE, marker="*", ms=11, ls="", label="best run"),
    ]
    style.legend(figure, handles, style.plain(rivals, 70))
    return figure


def _marks(axes: Axes, tree: xr.DataTree, data: xr.Dataset, scale: Scale) -> None:
    """The runs that were made, and the best one that was not."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_locator(LogLocator(10, (1, 2, 5)))
    axes.yaxis.set_major_locator(LogLocator(10, (1, 2, 5)))
    limits = axes.get_xlim(), axes.get_ylim()
    observed = reading.group(tree, schema.RECORDS)
    drive = str(tree[schema.PROPOSAL].attrs["drive"])
    if observed is not None and drive in observed:
        rows = observed[drive].values
        half = (np.nanmax(rows, axis=1) - np.nanmin(rows, axis=1)) / 2
        made = [run.frequency for run in reading.runs(tree)]
        axes.plot(made, scale.factor * half, "o", color=style.INK, ms=4, clip_on=False, zorder=3)
    if np.isfinite(data["information"].values).any():
        best = data.isel(data["rank"].argmin(...))
        axes.plot(
            float(best[schema.FREQUENCY]),
            scale.factor * float(best[schema.AMPLITUDE]),
            "*",
            color=style.BEFORE,
            ms=13,
            zorder=4,
        )
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])


def _edges(values: np.ndarray) -> np.ndarray:
    """Edges of cells about values a factor apart."""
    if values.size == 1:
        return np.array([values[0] / 1.5, values[0] * 1.5])
    middle = np.sqrt(values[1:] * values[:-1])
    return np.concatenate(([values[0] ** 2 / middle[0]], middle, [values[-1] ** 2 / middle[-1]]))


HEIGHT = 3.6
#: Half-width of a band that holds 95 % of a normal density.
BAND = 1.96


def nonparametric_shape(found: xr.Dataset | xr.DataTree) -> Figure:
    """A nonparametric effect over the quantities that it follows.

    Parameters
    ----------
    found : xarray.Dataset or xarray.DataTree
        The group ``nonparametric`` of a result, or the result.

    Returns
    -------
    Figure
        Of one quantity the function and its 95 % band; of two a map of the function and one of its
        standard deviation.
    """
    if isinstance(found, xr.DataTree) and schema.NONPARAMETRIC in found.children:
        found = found[schema.NONPARAMETRIC].to_dataset()
    data = dataset(found)
    figure = style.blank(style.WIDTH, HEIGHT)
    names = [str(name) for name in data["quantity"].values]
    units = [str(unit) for unit in data["quantity_unit"].values]
    scales = [
        engineering(unit, style.magnitude(row))
        for unit, row in zip(units, data["place"].values, strict=True)
    ]
    labels = [s.label(style.plain(n)) for n, s in zip(names, scales, strict=True)]
    places = [row * s.factor for row, s in zip(data["place"].values, scales, strict=True)]
    value, sd = data["value"].values, data["sd"].values
    scale = engineering(data["value"].attrs[schema.UNITS], style.magnitude(value))
    if len(names) == 1:
        axes = figure.add_axes((0.09, 0.17, 0.89, 0.75))
        _curve(axes, places[0], value * scale.factor, sd * scale.factor)
        axes.set_xlabel(labels[0], fontsize=style.TEXT)
        axes.set_ylabel(scale.label("nonparametric effect"), fontsize=style.TEXT)
        return figure
    panels = ((0.09, value, "nonparametric effect"), (0.58, sd, "standard deviation"))
    for left, shown, what in panels:
        axes = figure.add_axes((left, 0.17, 0.33, 0.72))
        _map(figure, axes, places, shown * scale.factor, scale.label(what))
        axes.set_xlabel(labels[0], fontsize=style.TEXT)
        axes.set_ylabel(labels[1], fontsize=style.TEXT)
    return figure


def _curve(axes: Axes, place: Array, value: Array, sd: Array) -> None:
    style.dress(axes, ticks=6)
    low, high = value - BAND * sd, value + BAND * sd
    axes.axhline(0.0, color=style.FAINT, linewidth=0.6)
    axes.fill_between(place, low, high, color=style.SIMILAR, linewidth=0, label="95 % band")
    axes.plot(place, value, color=style.AFTER, linewidth=1.3, label="estimate")
    axes.set_xlim(place[0], place[-1])
    # The ends, where few samples lie, must not flatten the rest.
    inner = slice(place.size // 20, -place.size // 20)
    room = 0.1 * (high[inner].max() - low[inner].min())
    axes.set_ylim(low[inner].min() - room, high[inner].max() + room)
    axes.legend(frameon=False, fontsize=style.SMALL, loc="best")


def _map(figure: Figure, axes: Axes, places: list[Array], value: Array, label: str) -> None:
    style.dress(axes, ticks=5)
    side = round(np.sqrt(value.size))
    grid = [place.reshape(side, side) for place in places]
    top = style.magnitude(value) or 1.0
    signed = bool((value < 0).any())
    shown = axes.pcolormesh(
        *grid, value.reshape(side, side), cmap="RdBu_r" if signed else "Blues",
        vmin=-top if signed else 0.0, vmax=top, shading="gouraud", rasterized=True,
    )  # fmt: skip
    axes.set_title(label, fontsize=style.TEXT, loc="left", color=style.INK)
    bar = figure.colorbar(shown, ax=axes, fraction=0.05, pad=0.03)
    bar.ax.tick_params(labelsize=style.SMALL)
