"""Fixtures of more than one folder; being here, it lets tests import helpers from ``tests``."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture
def data_folder() -> Path:
    """Folder of measured and simulated sets; without it a test skips, and fails in CI."""
    folder = os.environ.get("BAYESOLEO_DATA")
    if folder and Path(folder).is_dir():
        return Path(folder)
    if os.environ.get("CI") == "true":
        pytest.fail("BAYESOLEO_DATA is not set to a folder")
    pytest.skip("BAYESOLEO_DATA is not set to a folder")
