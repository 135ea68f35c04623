"""Fixtures: where measured data are, and small campaigns to break."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_table import TOML, table


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
