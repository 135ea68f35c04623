"""Fixtures of more than one folder; being here, it lets tests import helpers from ``tests``."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Folder of data sets that ``BAYESOLEO_DATA`` names; skips where it is unset."""
    named = os.environ.get("BAYESOLEO_DATA")
    if not named:
        pytest.skip("needs data sets: BAYESOLEO_DATA names no folder")
    return Path(named)


@pytest.fixture(scope="session")
def data_set(data_folder: Path) -> Callable[[str], Path]:
    """Find one set below that folder; it fails, not skips, where a named folder lacks it."""

    def find(name: str) -> Path:
        folder = data_folder / name
        if not folder.is_dir():
            pytest.fail(f"BAYESOLEO_DATA names a folder without {name}: {folder}")
        return folder

    return find
