"""What the page shows of the stored tables of ``calibration.py``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bayesoleo.posterior import uniformity

STORED = Path(__file__).resolve().parent / "tables"
MODELS = ("independent", "correlated", "discrepancy", "shared-discrepancy")
COLOURS = ("#d55e00", "#e69f00", "#0072b2", "#009e73")


def stored(study: str) -> dict | None:
    """The table of the last run; None if there is none."""
    path = STORED / f"calibration-{study}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def ranks_figure(study: str) -> Figure | None:
    """Distribution functions of the ranks, less the uniform one, with their band."""
    table = stored(study)
    if table is None:
        return None
    columns = min(len(table["names"]), 3)
    rows = -(-len(table["names"]) // columns)
    figure = Figure(figsize=(9, 0.5 + 1.9 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes, name, ranks in zip(panels, table["names"], table["ranks"], strict=False):
        test = uniformity(ranks)
        axes.fill_between(test.places, test.low, test.high, color="0.88", lw=0)
        axes.plot(test.places, test.difference, color="#0072b2", lw=1.4)
        axes.set_title(f"{name.replace('_', ' ')}, p = {test.p_value:.2g}", fontsize=9)
        axes.axhline(0, color="0.6", lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels[len(table["names"]) :]:
        axes.set_axis_off()
    figure.supxlabel("rank of the truth", fontsize=9)
    figure.supylabel("part of the ranks − uniform", fontsize=9)
    return figure


def print_ranks() -> None:
    """How far each study's ranks are from uniform ones."""
    print("study            replications   quantities outside their 95 % band")
    for study in ("spring", "oleo", "oleo-weighted"):
        table = stored(study)
        if table is None:
            continue
        told = [
            f"{name} (p = {p:.2g})"
            for name, p, inside in zip(
                table["names"], table["p_value"], table["inside"], strict=True
            )
            if not inside
        ]
        end = ", ".join(told) or f"none of {len(table['names'])}"
        print(f"{study:16} {table['replications']:>12}   {end}")


def print_imitation() -> None:
    """Part of each effect along each parameter's own direction, and what chance misfits have."""
    table = stored("coverage")
    if table is None:
        return
    names = "".join(f"{name.replace('friction', 'fr.')[:15]:>17}" for name in table["names"])
    print(f"{'':28}{names}{'all together':>17}")
    keys = ("effects", "imitation", "keeps_meaning", "taken_over")
    for effect, parts, kept, whole in zip(*(table[key] for key in keys), strict=True):
        cells = [
            f"{part:.3f}{' ' if keep else '*'}" for part, keep in zip(parts, kept, strict=True)
        ]
        print(f"{effect:28}" + "".join(f"{cell:>17}" for cell in [*cells, f"{whole:.3f} "]))
    chance = [*table["imitation_by_chance"], table["taken_over_by_chance"]]
    print(f"{'95 % of chance misfits below':28}" + "".join(f"{part:>16.3f} " for part in chance))
    print("* left out: imitated by the effect, or redefined by it")


def print_coverage() -> None:
    """Coverage of 90 % intervals and their widths, by error model and parameter."""
    table = stored("coverage")
    if table is None:
        return
    print(f"{'':24}" + "".join(f"{word:>24}" for word in MODELS))
    print(f"{'':24}" + f"{'kept  others   width':>24}" * len(MODELS))
    for a, name in enumerate(table["names"]):
        line = ""
        for found in (table[word] for word in MODELS):
            width = found["median_width_over_prior_sd"][a]
            line += f"{_part(found['each'][a])}{_part(found['each_left_out'][a])}{width:8.2g}"
        print(f"{name:24}{line}")
    line = ""
    for found in (table[word] for word in MODELS):
        width = found["pooled_width_over_prior_sd"]
        line += f"{_part(found['pooled'])}{_part(found['pooled_left_out'])}{width:8.2g}"
    print(f"{'pooled':24}{line}")
    errors = "".join(
        f"{'±':>7}{table[word]['pooled_standard_error']:6.1%}{'':11}" for word in MODELS
    )
    print(f"{'':24}{errors}".rstrip())
    print("\nCoverage where the parameter keeps its meaning, and elsewhere; median width of the")
    print("interval over the prior's standard deviation.")


def _part(value: float | None) -> str:
    return f"{'-' if value is None else format(value, '.0%'):>8}"


def coverage_figure() -> Figure | None:
    """Coverage by parameter and by effect, and widths."""
    table = stored("coverage")
    if table is None:
        return None
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    coverage, width, effects = figure.subplots(1, 3, width_ratios=(1.1, 1.0, 1.0))
    for k, (word, colour) in enumerate(zip(MODELS, COLOURS, strict=True)):
        found, shift = table[word], 0.19 * (k - 1.5)
        place = np.arange(len(table["names"])) + shift
        kept, others = (_numbers(found[key]) for key in ("each", "each_left_out"))
        coverage.plot(kept, place, "o", color=colour, ms=5, label=word)
        coverage.plot(others, place, "o", mfc="none", color=colour, ms=4, alpha=0.7)
        width.plot(found["median_width_over_prior_sd"], place, "o", color=colour, ms=5)
        effects.plot(
            _numbers(found["by_effect"]), np.arange(len(table["effects"])) + shift, "o",
            color=colour, ms=5,
        )  # fmt: skip
    for axes, names in ((coverage, table["names"]), (effects, table["effects"])):
        axes.axvline(0.9, color="0.6", lw=0.8)
        axes.set(xlim=(-0.03, 1.03), xlabel="coverage of 90 % intervals")
        axes.set_yticks(range(len(names)), [n.replace("_", " ") for n in names], fontsize=8)
        axes.set_ylim(len(names) - 0.5, -0.5)
    width.set(xscale="log", xlabel="width / prior's standard deviation")
    width.set_yticks(coverage.get_yticks(), [])
    width.set_ylim(coverage.get_ylim())
    for axes in (coverage, width, effects):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="0.93")
        axes.set_axisbelow(True)
    handles = coverage.get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    return figure


def _numbers(values: list[float | None]) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values])
