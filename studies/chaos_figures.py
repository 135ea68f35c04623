"""Figures of the page ``plot_chaos.py``."""

from __future__ import annotations

from collections.abc import Mapping

import chaos
import numpy as np
from matplotlib.figure import Figure

from bayesoleo import system
from bayesoleo.plots import _style as style

COLOURS = dict(zip(chaos.CASES, ("#0072b2", "#56b4e9", "#009e73", "#e69f00"), strict=True))
#: Width of the strip in which the fifty estimates of a case stand side by side.
STRIP = 0.8


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
