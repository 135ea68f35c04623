"""Where a user's machine keeps what need not be computed again."""

from __future__ import annotations

import os
from pathlib import Path

import platformdirs


def user_cache() -> Path:
    """``BAYESOLEO_CACHE`` or the user's cache folder; it need not exist."""
    chosen = os.environ.get("BAYESOLEO_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("bayesoleo"))
