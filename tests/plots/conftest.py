"""The made-up results, once for all tests of this folder."""

from __future__ import annotations

import pytest
from synthetic_tree import oleo_tree, two_run_tree


@pytest.fixture(scope="session")
def oleo():
    return oleo_tree()


@pytest.fixture(scope="session")
def two_runs():
    return two_run_tree()
