"""Figures of the identification study, from however many of its rows there are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import identification_rows as study
import matplotlib.pyplot as plt
import numpy as np
from identification_rows import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from bayesoleo.effects import FAMILIES, find_effect
from bayesoleo.plots import AFTER, BEFORE, INK, SIMILAR

NOTHING = "nothing"
#: Outcomes by class, from best to worst, with the colour of each.
OUTCOMES = {
    "the effect alone": AFTER,
    "in a class of 2 or 3": SIMILAR,
    "in a larger class": "#d9dde3",
    "another effect": BEFORE,
    "nothing added": "#aab1bb",
}


def confusion_figure(rows: Sequence[Row], factor: float) -> Figure:
    """Effect in the data against effect named, at one multiple of the limit."""
    chosen = study.named(rows, factor)
    truths = _ordered({row["effect"] for row in chosen})
    answers = [_answer(row) for row in chosen]
    columns = [*truths, *_ordered(set(answers) - {*truths, NOTHING}), NOTHING]
    counts = np.zeros((len(truths), len(columns)))
    for row, answer in zip(chosen, answers, strict=True):
        counts[truths.index(row["effect"]), columns.index(answer)] += 1
    part = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    size = 0.2 * len(columns) + 3.2, 0.2 * len(truths) + 2.6
    figure, axes = plt.subplots(figsize=size, layout="constrained")
    shown = axes.imshow(np.where(part > 0, part, np.nan), cmap="Blues", vmin=0, vmax=1)
    _name(axes, truths, columns)
    axes.set_title(f"{factor:g} times the detection limit, {len(chosen)} campaigns", loc="left")
    bar = figure.colorbar(shown, ax=axes, shrink=0.5)
    bar.set_label("part of an effect's campaigns")
    return figure


def _name(axes: Axes, truths: Sequence[str], columns: Sequence[str]) -> None:
    """Names along both sides, and a faint grid."""
    words = [name.replace("_", " ") for name in columns]
    axes.set_xticks(range(len(columns)), words, rotation=90, fontsize=7)
    axes.set_yticks(range(len(truths)), [t.replace("_", " ") for t in truths], fontsize=7)
    axes.set_xticks(np.arange(len(columns) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(truths) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="#eceff3", linewidth=0.6)
    axes.tick_params(which="both", length=0)
    axes.set(xlabel="named", ylabel="in the data")


def _answer(row: Row) -> str:
    """The effect in the data where it is named or in the class of what is, else what is named."""
    if not row["added"]:
        return NOTHING
    return str(row["effect"]) if study.right(row) else str(row["added"][0]).split(" at ")[0]


def _ordered(effects: set[str]) -> list[str]:
    """By family, in the catalogue's order of families."""
    return sorted(effects, key=lambda name: (FAMILIES.index(find_effect(name).family), name))


def outcome_figure(rows: Sequence[Row]) -> Figure:
    """What came out at each multiple of the limit, and sizes of classes."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(10, 3.4), layout="constrained", width_ratios=(3, 2)
    )
    present = [f for f in study.FACTORS if study.named(rows, f)]
    kinds = {f: [_outcome(row) for row in study.named(rows, f)] for f in present}
    start = np.zeros(len(present))
    for kind, colour in OUTCOMES.items():
        part = np.array([np.mean([one == kind for one in kinds[f]]) for f in present])
        left.barh(range(len(present)), part, left=start, color=colour, label=kind, height=0.6)
        start += part
    left.set_yticks(range(len(present)), [f"{f:g} ×  ({len(kinds[f])})" for f in present])
    left.set(xlabel="part of campaigns", ylabel="size in detection limits", xlim=(0, 1))
    left.axvline(0.9, color=INK, linewidth=0.8, linestyle=":")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3, frameon=False, fontsize=8)
    sizes = np.array([1 + len(row["same"]) for row in study.named(rows) if row["added"]], dtype=int)
    bins = np.bincount(np.minimum(sizes, 7), minlength=8)[1:]
    right.bar(range(1, 8), bins, color=AFTER, width=0.7)
    right.set_xticks(range(1, 8), [*map(str, range(1, 7)), "7 +"])
    right.set(xlabel="effects in the class", ylabel="campaigns")
    return figure


def _outcome(row: Row) -> str:
    if not row["added"]:
        return "nothing added"
    if study.right(row):
        return "in a class of 2 or 3" if row["same"] else "the effect alone"
    found = study.right({**row, "same": row["same"][:2]}) or row["effect"] in row["same"]
    return "in a larger class" if found else "another effect"


def power_figure(rows: Sequence[Row]) -> Figure:
    """Part that is found and part that is named rightly, by family, against the size."""
    families: dict[str, list[Row]] = {}
    for row in study.named(rows):
        families.setdefault(find_effect(row["effect"]).family, []).append(row)
    present = [family for family in FAMILIES if family in families]
    columns = 6
    figure, grid = plt.subplots(
        -(-len(present) // columns), columns, figsize=(10, 4.2), sharex=True, sharey=True,
        layout="constrained", squeeze=False,
    )  # fmt: skip
    for axes in grid.flat[len(present) :]:
        axes.remove()
    for axes, family in zip(grid.flat, present, strict=False):
        _curve(axes, families[family], lambda row: bool(row["added"]), SIMILAR, "something added")
        _curve(axes, families[family], study.right, AFTER, "the right one")
        axes.set_title(f"{family} ({len(families[family])})", loc="left", fontsize=9)
        axes.set(xscale="log", xlim=(0.85, 11.8), ylim=(-0.03, 1.03))
        axes.set_xticks(study.FACTORS, [f"{f:g}" for f in study.FACTORS])
        axes.minorticks_off()
        axes.axhline(0.9, color=INK, linewidth=0.6, linestyle=":")
    for axes in grid.flat[max(len(present) - columns, 0) : len(present)]:
        axes.tick_params(labelbottom=True)  # with nothing beneath, where a row is not full
    figure.supxlabel("size in detection limits", fontsize=9)
    figure.supylabel("part of campaigns", fontsize=9)
    grid[0, 0].legend(frameon=False, fontsize=7, loc="lower right")
    return figure


def _curve(axes: Axes, rows: Sequence[Row], judge: object, colour: str, label: str) -> None:
    """Part of campaigns with its 90 % interval (Clopper and Pearson 1934)."""
    assert callable(judge)
    at = [f for f in study.FACTORS if any(row["factor"] == f for row in rows)]
    hits = np.array([sum(map(judge, (r for r in rows if r["factor"] == f))) for f in at])
    count = np.array([sum(row["factor"] == f for row in rows) for f in at])
    low, high = interval(hits, count)
    axes.fill_between(at, low, high, color=colour, alpha=0.15, linewidth=0)
    axes.plot(at, hits / count, color=colour, marker="o", markersize=4, label=label)


def interval(
    hits: NDArray[np.int64], count: NDArray[np.int64], level: float = 0.9
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Exact interval of a binomial's part."""
    tail = (1 - level) / 2
    low = np.where(hits > 0, stats.beta.ppf(tail, np.maximum(hits, 1e-9), count - hits + 1), 0.0)
    free = np.maximum(count - hits, 1e-9)
    high = np.where(hits < count, stats.beta.ppf(1 - tail, hits + 1, free), 1.0)
    return low, high


def print_table(table: Mapping[str, object]) -> None:
    """The study's figures, with exact 90 % intervals of the fractions."""
    rows = table["rows"]
    assert isinstance(rows, list)
    print(f"{len(rows)} of {table['planned']} campaigns, version {table['version']}")
    _print("campaigns that failed", f"{table['failed']:4d} of {table['planned']:4d}")
    for factor in study.FACTORS:
        _print_size(study.named(rows, factor), f"{factor:>2g} times the limit")
    false = [bool(row["added"]) for row in study.plain(rows)]
    _print("nothing lacks, something added", _fraction(false))
    strange = study.strange(rows)
    certain, given = [row["certain"] for row in strange], [bool(row["added"]) for row in strange]
    _print("outside the catalogue, given a likely name", _fraction(given))
    _print("outside the catalogue, called certain", _fraction(certain))


def _print_size(rows: Sequence[Row], size: str) -> None:
    """What was named at one size, and how surely."""
    right = [study.right(row) for row in rows]
    one = [study.alone(row) and study.right(row) for row in rows]
    wrong = [row["certain"] and not study.right(row) for row in rows]
    _print(f"{size}, right alone or in a class of 3", _fraction(right))
    _print(f"{size}, one name, and it is right", _fraction(one))
    _print(f"{size}, called certain", _fraction([row["certain"] for row in rows]))
    _print(f"{size}, certain and wrong", _fraction(wrong))


def _print(what: str, figure: str) -> None:
    print(f"{what:<52}{figure}")


def _fraction(values: Sequence[bool]) -> str:
    if not values:
        return "no campaigns yet"
    low, high = interval(np.array([sum(values)]), np.array([len(values)]))
    return f"{sum(values):4d} of {len(values):4d}   {low[0]:6.1%} to {high[0]:6.1%}"
