"""Reliability of the probabilities of structures, from the stored tables of a long study.

The tables are written by ``structure_probabilities.py``, a row for each simulated campaign.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

OUTSIDE = "outside"
#: Bands of probabilities in which statements are held against the truth.
BANDS = ((0.5, 0.8), (0.8, 0.95), (0.95, 1.0001))
#: Finer ones for the figure.
FINE = (0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0001)
#: How effects are drawn: from the whole catalogue by the default prior, or of sixteen usual ones.
CATALOGUE, SIXTEEN = "catalogue", "sixteen"
_FOLDER = Path(__file__).resolve().parent / "tables"
TABLES = {draw: _FOLDER / f"structures-{draw}.json" for draw in (CATALOGUE, SIXTEEN)}


def stored(draw: str = CATALOGUE) -> dict[str, Any] | None:
    """The table of the last run; None if there is none."""
    path = TABLES[draw]
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def statements(row: Mapping[str, Any]) -> list[tuple[float, bool]]:
    """Each thing that is said of a campaign with its probability, and whether it is true."""
    said = [
        (row["nothing"], row["what"] == "nothing"),
        (row["only_outside"], row["what"] == OUTSIDE),
    ]
    return said + [(p, name in row["truth"]) for name, p in row["effects"].items()]


def brier(row: Mapping[str, Any]) -> tuple[float, float]:
    """Brier score of the probabilities, and of the most probable structure taken for certain."""
    effects, outside, _ = row["best"][0]
    truth = {"nothing": row["what"] == "nothing", OUTSIDE: row["what"] == OUTSIDE}
    truth |= dict.fromkeys(row["truth"], True)
    said = {"nothing": row["nothing"], OUTSIDE: row["only_outside"], **row["effects"]}
    taken = dict.fromkeys(effects, 1.0) or {OUTSIDE if outside else "nothing": 1.0}
    names = {*truth, *said, *taken}
    scores = [
        sum((given.get(name, 0.0) - truth.get(name, False)) ** 2 for name in names)
        for given in (said, taken)
    ]
    return scores[0], scores[1]


def log_score(row: Mapping[str, Any]) -> float:
    """Mean of minus the logarithm of the probability given to what is true of each statement."""
    said = statements(row)
    chances = [p if true else 1.0 - p for p, true in said]
    return float(-np.mean(np.log(np.maximum(chances, 1e-6))))


def _bands(said: np.ndarray) -> dict[str, float]:
    """By band, how many statements were made, with which mean probability, and how many are true;
    and the largest difference of both."""
    table: dict[str, float] = {}
    errors = []
    for low, high in BANDS:
        band = said[(said[:, 0] >= low) & (said[:, 0] < high)]
        key = f"{low:g}_to_{min(high, 1.0):g}"
        table[f"statements_{key}"] = len(band)
        if len(band):
            table[f"said_{key}"], table[f"true_{key}"] = map(float, band.mean(axis=0))
            errors.append(abs(float(band[:, 0].mean() - band[:, 1].mean())))
    return table | {"calibration_error": max(errors, default=float("nan"))}


def figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Reliability of all statements, and how campaigns with something outside are called."""
    done = [row for row in rows if "failed" not in row]
    said = np.array([item for row in done for item in statements(row)], dtype=float)
    table: dict[str, float] = {
        "structure_campaigns": len(done),
        "structure_failed": len(rows) - len(done),
    }
    table |= _bands(said)
    table["sure_and_wrong"] = 1.0 - table.get(f"true_{BANDS[-1][0]:g}_to_1", float("nan"))
    scores = np.array([brier(row) for row in done])
    table["brier"], table["brier_winner"] = map(float, scores.mean(axis=0))
    winner = table["brier_winner"]
    table["brier_ratio"] = table["brier"] / winner if winner else float("nan")
    table["log_score"] = float(np.mean([log_score(row) for row in done]))
    strange = [row["outside"] > 0.5 for row in done if row["what"] == OUTSIDE]
    table["outside_called_outside"] = float(np.mean(strange)) if strange else float("nan")
    by_mix = [item for row in done for item in row.get("by_mix", ())]
    if by_mix:
        found = _bands(np.array(by_mix, dtype=float))
        table |= {f"{key}_by_mix": value for key, value in found.items()}
    table["structure_seconds"] = float(np.mean([row["seconds"] for row in done]))
    return table


def readme_rows() -> list[str]:
    """Rows of the table in the README: what was said in each band, and what is true."""
    said = "mean probability said; part that is true"
    tables = {draw: table for draw in TABLES if (table := stored(draw)) is not None}
    found = {draw: figures(table["rows"]) for draw, table in tables.items()}
    rows = [
        f"| statements about structures of probability 0.5–0.8, 0.8–0.95, above 0.95, {what}:"
        f" {said} | {_cells(found[draw], mix)} | `calibration_error{end}` |"
        for draw, what, end, mix in (
            (CATALOGUE, "effects drawn from the whole catalogue", "", ""),
            (SIXTEEN, "sixteen usual effects", "_sixteen", ""),
            (SIXTEEN, "the same under a prior of the sixteen alone", "_by_mix", "_by_mix"),
        )
        if draw in found
    ]
    outside = [
        [row["outside"] > 0.5 for row in table["rows"] if row["what"] == OUTSIDE]
        for table in tables.values()
    ]
    shares = "; ".join(f"{sum(one)} of {len(one)}" for one in outside)
    title = 'a law outside the catalogue: probability of "outside" above one half'
    return [*rows, f"| {title} | {shares} | `outside_called_outside` |"]


def _cells(found: Mapping[str, float], end: str) -> str:
    keys = [f"{low:g}_to_{min(high, 1.0):g}{end}" for low, high in BANDS]
    said, true = (
        ", ".join(f"{found[f'{what}_{key}']:.2f}" for key in keys) for what in ("said", "true")
    )
    counts = ", ".join(f"{found[f'statements_{key}']}" for key in keys)
    return f"{said}; {true} ({counts} statements)"


#: What a table is of, and its colour.
TITLES = {
    CATALOGUE: ("effects drawn from the whole catalogue", "#0072b2"),
    SIXTEEN: ("sixteen usual effects", "#d55e00"),
}


def reliability_figure() -> Figure | None:
    """How often statements are true, by the probability with which they were made."""
    tables = {draw: table for draw in TABLES if (table := stored(draw)) is not None}
    if not tables:
        return None
    figure = Figure(figsize=(4.4 * len(tables), 4.2), layout="constrained")
    panels = figure.subplots(1, len(tables), squeeze=False, sharey=True)[0]
    for axes, (draw, table) in zip(panels, tables.items(), strict=True):
        title, colour = TITLES[draw]
        _draw_reliability(axes, table["rows"], colour)
        axes.set_title(f"{title}, {table['campaigns']} campaigns", fontsize=10)
        axes.set_xlabel("probability that was stated")
    panels[0].set_ylabel("part of the statements that is true")
    return figure


def _draw_reliability(axes: Axes, rows: Sequence[Mapping[str, Any]], colour: str) -> None:
    said = np.array([item for row in rows for item in statements(row)], dtype=float)
    axes.plot([0, 1], [0, 1], color="0.6", lw=0.8)
    for low, high in pairwise(FINE):
        band = said[(said[:, 0] >= low) & (said[:, 0] < high)]
        if not len(band):
            continue
        mean, true = band.mean(axis=0)
        # Wilson's interval of 90 %.
        z, count = 1.645, len(band)
        centre = (true + z**2 / (2 * count)) / (1 + z**2 / count)
        half = z * np.sqrt(true * (1 - true) / count + z**2 / (4 * count**2)) / (1 + z**2 / count)
        axes.plot([mean, mean], [centre - half, centre + half], color=colour, lw=1.4)
        axes.plot(mean, true, "o", color=colour, ms=5)
        axes.annotate(f"{count}", (mean, true), (6, -10), textcoords="offset points", fontsize=8)
    axes.set(xlim=(0, 1.02), ylim=(0, 1.02))
    axes.spines[["top", "right"]].set_visible(False)


def print_figures() -> None:
    """Calibration error, scores, and what was wrong, with counts."""
    for draw in TABLES:
        table = stored(draw)
        if table is None:
            continue
        found = figures(table["rows"])
        failed = f"{table['failed']} more could not be simulated"
        print(f"{TITLES[draw][0]}: {table['campaigns']} campaigns, {failed}")
        _print_bands(found, "")
        for key in ("calibration_error", "sure_and_wrong", "brier_ratio", "outside_called_outside"):
            print(f"  {key.replace('_', ' '):24} {found[key]:.3f}")
        if "calibration_error_by_mix" in found:
            print("  the same evidence under a prior of these sixteen effects only")
            _print_bands(found, "_by_mix")


def _print_bands(found: Mapping[str, float], end: str) -> None:
    for low, high in BANDS:
        key = f"{low:g}_to_{min(high, 1.0):g}{end}"
        count, said, true = (
            found.get(f"{what}_{key}", float("nan")) for what in ("statements", "said", "true")
        )
        print(f"  said {said:.3f} on average: {count:4.0f} statements, {true:.3f} true")
