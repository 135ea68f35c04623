"""What the pages of the measured sets have in common: figures, and tables beside published errors.

Published errors and their sources stand in the ``SOURCE.md`` of each set; a black box is trained on
tens of thousands of samples and names no cause.
"""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

#: Black boxes.
GP_NARX, SUBNET = "GP-NARX", "SUBNET"
#: By key of ``tests/benchmarks/measured.py``: what it is, its unit, and what has been published for
#: the same records, by method.
PUBLISHED: dict[str, tuple[str, str, dict[str, float]]] = {
    "silverbox_arrow_mV": ("Silverbox, arrow", "mV", {GP_NARX: 0.60, SUBNET: 1.4}),
    "silverbox_arrow_inside_mV": (
        "Silverbox, arrow without extrapolation", "mV", {GP_NARX: 0.26, SUBNET: 0.32},
    ),
    "silverbox_multisine_mV": ("Silverbox, multisine", "mV", {GP_NARX: 0.30, SUBNET: 0.36}),
    "emps_fit_N": ("EMPS, force", "N", {}),
    "emps_pulses_N": ("EMPS, force on the pulses", "N", {}),
    "emps_position_mm": (
        "EMPS, position on the pulses", "mm", {"best": 0.452, "linear": 5.53},
    ),
    "tanks_estimation_V": ("cascaded tanks, estimation", "V", {}),
    "tanks_validation_V": ("cascaded tanks, validation", "V", {"best grey box": 0.19}),
    "brfd_holdout_kip": ("friction damper with backlash", "kip", {}),
    "pendulum_validation_mrad": ("single pendulum, validation", "mrad", {}),
    "mr_damper_holdout_N": ("MR damper, larger of two runs", "N", {}),
    "mbari_fit_psi": ("gas spring, fitted half", "psi", {}),
    "mbari_holdout_psi": ("gas spring, other half", "psi", {}),
}  # fmt: skip
#: By the short name of a set, what it is and who measured and published it.
SOURCES = {
    "silverbox": ("Silverbox", "Wigren and Schoukens 2013"),
    "emps": ("EMPS drive", "Janot, Gautier and Brunot 2019"),
    "tanks": ("cascaded tanks", "Schoukens and Noël 2017"),
    "brfd": ("friction damper", "Coble, Huggins, Cao, Ricles and Downey 2022"),
    "pendulum": ("single pendulum", "dynamicslab, MultiArm-Pendulum"),
    "mr_damper": ("MR damper", "Vargas 2021"),
    "mbari": ("gas spring", "osrf, mbari_wec_gz"),
}
TABLE = Path(__file__).resolve().parent / "tables" / "measured.json"


def print_errors(figures: dict[str, Any], start: str = "") -> None:
    """Print root mean squares of the errors beside those that have been published."""
    print(f"{'root mean square of the error':40}{'here':>10}   published")
    for key, (title, unit, published) in PUBLISHED.items():
        if key.startswith(start) and key in figures:
            others = ", ".join(f"{value:g} {name}" for name, value in published.items())
            print(f"{title:40}{figures[key]:>7.3g} {unit:4} {others}".rstrip())


def stored() -> dict[str, Any]:
    """Figures of the last run over all sets."""
    return dict(json.loads(TABLE.read_text(encoding="utf-8"))["figures"])


def print_all_errors() -> None:
    """Print the errors of all sets, and where they come from."""
    print_errors(stored())
    print("\nThe sets were measured by, or published through:")
    for title, source in SOURCES.values():
        print(f"  {title:18}{source}")


def print_all_found() -> None:
    """Print what was found in each set, and how long the search took."""
    figures = stored()
    for short, (title, _) in SOURCES.items():
        if f"{short}_certainty" not in figures:
            print(f"{title}: {figures[f'{short}_failed']}")
            continue
        certainty = figures[f"{short}_certainty"] or "no name"
        print(f"{title}: {certainty}, {figures[f'{short}_seconds']:.0f} s")
        print(textwrap.indent(figures[f"{short}_found"] or "nothing was added", "  "))


def beside_published() -> Figure:
    """Errors here and elsewhere, over the smallest that has been published."""
    figures = stored()
    rows = [(key, *PUBLISHED[key]) for key in PUBLISHED if PUBLISHED[key][2] and key in figures]
    figure, axes = plt.subplots(figsize=(9, 0.55 * len(rows) + 1.2), layout="constrained")
    for place, (key, _, unit, others) in enumerate(rows):
        least = min(others.values())
        for name, value in others.items():
            # Names of methods that are close to each other stand on either side.
            side = "right" if value == least else "left"
            axes.plot(value / least, place, "D", ms=6, mfc="none", color="#6b7280")
            axes.annotate(
                name, (value / least, place), (-4 if side == "right" else 4, 7),
                textcoords="offset points", ha=side, fontsize=8, color="#4b5563",
            )  # fmt: skip
        axes.plot(figures[key] / least, place, "o", ms=8, color="#0072b2")
        axes.annotate(
            f"{figures[key]:.3g} {unit}", (figures[key] / least, place), (0, -14),
            textcoords="offset points", ha="center", fontsize=8, color="#0072b2",
        )  # fmt: skip
    axes.axvline(1.0, color="#d1d5db", lw=1.0, zorder=0)
    axes.set_yticks(range(len(rows)), [title for _, title, *_ in rows])
    axes.set(xscale="log", xlabel="error over the smallest published one")
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.margins(x=0.12)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(left=False)
    return figure


def course(tree: xr.DataTree, output: str, run: str, scale: float, unit: str) -> Figure:
    """One run over time: measured and predicted, and the residual before and after."""
    groups = ("records", "prediction", "residual")
    records, predicted, residual = (tree[name].to_dataset().sel(run=run) for name in groups)
    known = np.isfinite(records[output].values)
    time = records["time"].values[known]
    figure, (above, below) = plt.subplots(
        2, figsize=(10, 5.5), sharex=True, layout="constrained", height_ratios=(3, 2)
    )
    curves = (
        (records[output], "#b4bac3", 2.5, "measured"),
        (predicted[f"{output}_before"], "#d55e00", 1.0, "model as declared"),
        (predicted[f"{output}_after"], "#0072b2", 1.0, "with what was found"),
    )
    for values, colour, width, label in curves:
        above.plot(time, scale * values.values[known], color=colour, lw=width, label=label)
    for stage, colour in (("before", "#d55e00"), ("after", "#0072b2")):
        values = residual[f"{output}_{stage}"].values[known]
        below.plot(time, scale * values, color=colour, lw=0.8)
    above.set(ylabel=f"{output} in {unit}")
    above.set_title(f"run {run}", loc="left")
    below.set(xlabel="time in s", ylabel=f"residual in {unit}")
    above.legend(frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
    return figure
