"""Fixtures: where measured data are, and small campaigns to break."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

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


@pytest.fixture
def make_campaign(tmp_path: Path) -> Callable[..., Path]:
    """Write a small good campaign, changed as told."""

    def make(
        replace: dict[str, str] | None = None,
        rows: np.ndarray | None = None,
        text: str | None = None,
        header: str = "time_s,x_mm,f_kN",
    ) -> Path:
        toml = TOML
        for old, new in (replace or {}).items():
            assert old in toml
            toml = toml.replace(old, new)
        (tmp_path / "campaign.toml").write_text(toml)
        if text is None:
            values = table() if rows is None else rows
            lines = [
                ",".join("" if np.isnan(cell) else f"{cell:.15g}" for cell in row) for row in values
            ]
            text = "\n".join([header, *lines]) + "\n"
        (tmp_path / "a.csv").write_text(text)
        return tmp_path

    return make
