"""The ranking of the candidate effects of one round."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bayesoleo.effects.titles import called, titles_for
from bayesoleo.plots import reading, style

LEFT, TOP, BOTTOM, ROW, RIGHT = 3.9, 0.55, 0.6, 0.27, 2.0


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
    height = TOP + ROW * max(len(shown), 2) + BOTTOM
    figure = style.blank(style.WIDTH, height)
    width = style.WIDTH - LEFT - RIGHT
    box = (LEFT / style.WIDTH, BOTTOM / height, width / style.WIDTH, 1 - (TOP + BOTTOM) / height)
    axes = figure.add_axes(box)
    style.dress(axes, ticks=6)
    accepted, alike = chosen(entry), similar(entry)
    for row, candidate in enumerate(shown):
        _bar(axes, row, candidate, candidate is accepted, any(candidate is c for c in alike))
    axes.set_ylim(max(len(shown), 2) - 0.5, -0.5)
    axes.set_yticks(range(len(shown)), [style.plain(called(name(c), titles), 56) for c in shown])
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0, labelsize=style.TEXT)
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


def _bar(axes: Axes, row: int, candidate: dict[str, Any], first: bool, alike: bool) -> None:
    """One candidate: bar, share, p-value, and whether it is or is like the accepted one."""
    colour = style.AFTER if first else style.SIMILAR if alike else style.NEUTRAL
    axes.barh(row, max(100 * candidate["gain"], 0.0), 0.68, color=colour)
    texts = (
        f"{100 * candidate['gain']:.1f} %".replace("-", "−"),
        format_p(candidate["p_value"]),
        "≈" if alike else "",
    )
    weight = "bold" if first else "normal"
    for inches, text, side in zip(
        (0.7, 1.55, 1.75), texts, ("right", "right", "left"), strict=True
    ):
        place = 1 + inches / (style.WIDTH - LEFT - RIGHT)
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
    handles = [Patch(facecolor=style.NEUTRAL, label="candidate")]
    if entry["accepted"]:
        handles = [
            Patch(facecolor=style.AFTER, label="accepted"),
            Patch(facecolor=style.SIMILAR, label="≈ not distinguishable from it"),
            *handles,
        ]
    remark = f"{hidden} more with less" if hidden > 0 else ""
    style.legend(figure, handles, remark)
