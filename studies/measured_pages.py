"""What the pages of the measured sets have in common: figures, and tables beside published errors.

Published errors and their sources stand in the ``SOURCE.md`` of each set; a black box is trained on
tens of thousands of samples and names no cause.
"""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

#: By key of ``tests/benchmarks/measured.py``: what it is, its unit, and what has been published.
PUBLISHED: dict[str, tuple[str, str, str]] = {
    "silverbox_arrow_mV": ("Silverbox, arrow", "mV", "0.60 GP-NARX, 1.4 SUBNET"),
    "silverbox_arrow_inside_mV": (
        "Silverbox, arrow without extrapolation", "mV", "0.26 GP-NARX, 0.32 SUBNET",
    ),
    "silverbox_multisine_mV": ("Silverbox, multisine", "mV", "0.30 GP-NARX, 0.36 SUBNET"),
    "emps_fit_N": ("EMPS, force", "N", ""),
    "emps_pulses_N": ("EMPS, force on the pulses", "N", ""),
    "emps_position_mm": ("EMPS, position on the pulses", "mm", "0.452 best, 5.53 linear"),
    "tanks_estimation_V": ("cascaded tanks, estimation", "V", ""),
    "tanks_validation_V": ("cascaded tanks, validation", "V", "0.19 best grey box"),
    "brfd_holdout_kip": ("friction damper with backlash", "kip", ""),
    "pendulum_validation_mrad": ("single pendulum, validation", "mrad", ""),
    "mr_damper_holdout_N": ("MR damper, larger of two runs", "N", "14.7 Dahl, on a fitted run"),
    "mbari_fit_psi": ("gas spring, fitted half", "psi", ""),
    "mbari_holdout_psi": ("gas spring, other half", "psi", ""),
}  # fmt: skip


def print_errors(figures: dict[str, Any], start: str = "") -> None:
    """Print root mean squares of the errors beside those that have been published."""
    print(f"{'root mean square of the error':40}{'here':>10}   published")
    for key, (title, unit, published) in PUBLISHED.items():
        if key.startswith(start) and key in figures:
            print(f"{title:40}{figures[key]:>7.3g} {unit:4} {published}".rstrip())


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
