"""The made-up results of the plots' tests, here too."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

PATH = Path(__file__).parents[1] / "plots" / "synthetic_tree.py"


@pytest.fixture(scope="session")
def synthetic():
    spec = importlib.util.spec_from_file_location("synthetic_tree_of_reports", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def oleo(synthetic):
    return synthetic.oleo_tree()


@pytest.fixture(scope="session")
def two_runs(synthetic):
    return synthetic.two_run_tree()
