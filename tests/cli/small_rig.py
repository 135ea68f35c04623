"""A small good campaign and model to break, as text and as numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

CAMPAIGN = """
format = 1
name = "mass on a spring"

[channels.force]
column = "f_N"
unit = "N"
[channels.displacement]
column = "x_mm"
unit = "mm"

[[runs]]
label = "slow"
file = "slow.csv"
frequency = 1.0
role = "fit"
[[runs]]
label = "fast"
file = "fast.csv"
frequency = 2.0
role = "hold-out"
"""

MODEL = """
from bayesoleo import Model, Output, Parameter

model = Model(
    "linear oscillator",
    inputs={"force": "N"},
    dofs={"position": "m"},
    parameters={
        "mass": Parameter(1.0, "kg", fixed=True),
        "damping": Parameter(5.0, "N*s/m", relative_sd=1.0),
        "stiffness": Parameter(2e3, "N/m", relative_sd=0.5),
    },
    equations={
        "position": "mass*ddot(position) + damping*dot(position) + stiffness*position - force"
    },
    outputs={"displacement": Output("position", "m")},
)
"""


def rows(frequency: float) -> np.ndarray:
    """Time, force in N and displacement in mm over four periods."""
    rng = np.random.default_rng(5)
    time = np.arange(400) / (100 * frequency)
    w = 2 * np.pi * frequency
    force = 20 * np.cos(w * time)
    answer = (20 / (2e3 - w**2 + 5j * w) * np.exp(1j * w * time)).real * 1e3
    noise = rng.normal(size=(2, time.size)) * [[0.02], [0.01]]
    return np.column_stack([time, force + noise[0], answer + noise[1]])


def write_rows(path: Path, values: np.ndarray, header: str = "time_s,f_N,x_mm") -> None:
    np.savetxt(path, values, delimiter=",", header=header, comments="", fmt="%.10g")
