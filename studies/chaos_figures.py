"""Figures of the page ``plot_chaos.py``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import chaos
import numpy as np
from matplotlib.figure import Figure

from bayesoleo import system
from bayesoleo.plots import style

COLOURS = dict(zip(chaos.CASES, ("#0072b2", "#56b4e9", "#009e73", "#e69f00"), strict=True))
#: Width of the strip in which the fifty estimates of a case stand side by side.
STRIP = 0.8


def draw_landscape(
    rhos: np.ndarray, time: np.ndarray, misfit: np.ndarray, lengths: Sequence[float]
) -> Figure:
    """Misfit over one parameter for records of several lengths; one is that of other motions."""
    figure = style.blank(style.WIDTH, 2.9)
    wide = 0.9 / len(lengths)
    for k, length in enumerate(lengths):
        axes = figure.add_axes((0.07 + k * wide, 0.18, 0.86 * wide, 0.62))
        style.dress(axes, 4)
        values = misfit[:, time <= length].mean(axis=1)
        axes.plot(rhos, values, color=style.AFTER, lw=1.2)
        axes.axvline(28.0, color=style.BEFORE, lw=0.9)
        axes.set_xlim(rhos[0], rhos[-1])
        axes.set_ylim(bottom=0.0)
        axes.set_title(f"record of {length:g} s", loc="left", fontsize=style.SMALL, pad=3)
        axes.set_xlabel("ρ", fontsize=style.TEXT)
        if k == 0:
            axes.set_ylabel("misfit over variance", fontsize=style.TEXT)
    style.legend(
        figure,
        [style.line(style.AFTER, "single shooting"), style.line(style.BEFORE, "truth", 0.9)],
        "σ, β and the initial state at their true values",
    )
    return figure


def draw_spread(table: Mapping[tuple[str, str, str], chaos.Spread]) -> Figure:
    """Errors of all fits in standard errors; of single shooting in per cent."""
    figure = style.blank(style.WIDTH, 5.6)
    top = figure.add_axes((0.085, 0.48, 0.9, 0.43))
    low = figure.add_axes((0.085, 0.09, 0.9, 0.27))
    _strips(top, table, "multiple")
    top.axhspan(-3, 3, color=style.NOISE, alpha=0.35, lw=0, zorder=0)
    top.axhline(0.0, color=style.INK, lw=0.8)
    top.set_ylim(-4, 4)
    top.set_ylabel("error in standard errors", fontsize=style.TEXT)
    _strips(low, table, "single")
    low.set_yscale("log")
    low.set_ylim(0.1, 1e4)
    low.set_ylabel("single shooting:\n|error| in %", fontsize=style.TEXT)
    handles = [style.line(COLOURS[c], f"{c[0]}: {', '.join(c[1])}") for c in chaos.CASES]
    for handle in handles:
        handle.set(marker=".", ls="none", ms=8)
    handles.append(style.band(style.NOISE, "three standard errors"))
    style.legend(figure, handles, f"{chaos.SEEDS} records each")
    return figure


def _strips(axes, table, way: str) -> None:
    """One strip for each parameter of each case."""
    style.dress(axes, 4)
    places, words = [], []
    for case in chaos.CASES:
        if (*case, way) not in table:
            continue
        found, names = table[*case, way], list(system(case[0]).parameters)
        error = found.theta - chaos.truth(case[0])
        values = (
            error / found.sd if way == "multiple" else 100 * np.abs(error / chaos.truth(case[0]))
        )
        for k, name in enumerate(names):
            place = len(places) + STRIP * (np.arange(len(error)) / (len(error) - 1) - 0.5)
            axes.plot(place, values[:, k], ".", color=COLOURS[case], ms=5)
            places.append(len(places))
            words.append({"sigma": "σ", "rho": "ρ", "beta": "β"}.get(name, name))
    axes.set_xticks(places, words)
    axes.set_xlim(-0.7, len(places) - 0.3)
