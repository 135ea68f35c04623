"""Fixtures of more than one folder, and which worker runs what; being here, it lets tests import
helpers from ``tests``."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

#: Folders whose tests hardly need the compiled solvers. They come first: with an empty cache one
#: worker compiles meanwhile what the others would compile as well, were they to need it at once.
UNCOMPILED = ("data", "docs", "effects", "model", "plots", "posterior", "storage")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of a group first, which compile the most, then what needs nothing compiled."""
    root = Path(__file__).parent

    def turn(item: pytest.Item) -> int:
        if item.get_closest_marker("xdist_group"):
            return 0
        return 1 if item.path.relative_to(root).parts[0] in UNCOMPILED else 2

    items.sort(key=turn)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """A module's tests go to one worker, or its fixtures would be set up by each."""
    from xdist.scheduler import LoadGroupScheduling

    class ByModule(LoadGroupScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return super()._split_scope(nodeid).split("::")[0]

    config.option.loadscopereorder = False  # as sorted above, not the most numerous first
    return ByModule(config, log)


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
