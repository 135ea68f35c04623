"""A small good campaign, as text and as numbers."""

from __future__ import annotations

import numpy as np

TOML = """
format = 1
name = "small"
controlled = "displacement"
[channels.displacement]
column = "x_mm"
unit = "mm"
[channels.force]
column = "f_kN"
unit = "kN"
[[runs]]
label = "a"
file = "a.csv"
kind = "periodic"
frequency = 1.0
[runs.conditions]
initial_pressure = { value = 4.9, unit = "bar", sd = 0.1 }
"""


def table(periods: float = 3.0, rate: int = 50, frequency: float = 1.0) -> np.ndarray:
    """Time, displacement in mm and force in kN."""
    time = np.arange(round(periods * rate / frequency)) / rate
    phase = 2 * np.pi * frequency * time
    return np.column_stack([time, 10 * np.sin(phase) + 3, np.cos(phase) + 0.2 * np.cos(3 * phase)])
