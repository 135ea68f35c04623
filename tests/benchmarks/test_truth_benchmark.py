"""The benchmark of what is said runs, part by part, on a few of its cases."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def truth() -> Iterator[ModuleType]:
    """The benchmark, with its folder importable as when it is run by hand."""
    path = list(sys.path)
    sys.path.insert(0, str(Path(__file__).parent))
    import truth

    yield truth
    sys.path[:] = path


def test_parts_are_modules_with_figures(truth):
    """A part that is named can be imported."""
    for name in truth.parts():
        assert (Path(__file__).parent / f"truth_{name}.py").is_file()
