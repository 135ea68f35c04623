"""Fixtures of more than one folder, and which worker runs what; being here, it lets tests import
helpers from ``tests``."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from threadpoolctl import threadpool_limits

# Workers of pytest-xdist fill the cores. With threads of linear algebra besides, which wait for one
# another in a loop, some tests take ten times as long. The environment is for workers and commands,
# the limit for this process, where a plugin has loaded NumPy before.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
threadpool_limits(1, user_api="blas")
# For the same reason a search has no other processes; tests of these ask for them.
os.environ.setdefault("BAYESOLEO_PROCESSES", "0")

#: Modules that take turns over the compiled solvers, the integrator of shooting and the collocation
#: of periodic motions. One worker runs them all, and first: a minute of compilation is done once,
#: where workers that begin with an empty cache would each do it at the same time.
COMPILING = (
    "test_solver_benchmark.py",
    "test_orbits.py",
    "test_initial_value.py",
    "test_shooting_orbits.py",
)
#: Modules whose slow tests take a minute or more each, the longest first: one that is begun last
#: would end alone.
LONG = (
    "test_reference_campaigns.py",
    "test_proposed_run_tells.py",
    "test_structure_probabilities.py",
    "test_truth_benchmark.py",
    "test_structure_cases.py",
)
#: Modules of many quick tests that take minutes together, which one worker runs.
MANY = (
    "test_work_is_kept.py",
    "test_close_results.py",
    "test_closed_loop.py",
    "test_examples.py",
    "test_html_report.py",
)
#: Folders whose tests hardly need these; they are what the others run meanwhile.
UNCOMPILED = ("data", "docs", "effects", "model", "plots", "posterior", "storage")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest slow tests first, then what compiles the most, and what would end alone."""
    root = Path(__file__).parent

    def turn(item: pytest.Item) -> int:
        if item.path.name in LONG and item.get_closest_marker("slow"):
            return LONG.index(item.path.name) - len(LONG)
        if item.path.name in COMPILING:
            return 0
        if item.path.name in MANY:
            return 1
        return 2 if item.path.relative_to(root).parts[0] in UNCOMPILED else 3

    items.sort(key=turn)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests that are not begun by ``BAYESOLEO_TESTS_UNTIL``, seconds since 1970, are skipped."""
    if time.time() > float(os.environ.get("BAYESOLEO_TESTS_UNTIL", "inf")):
        pytest.skip("the time for tests is over (BAYESOLEO_TESTS_UNTIL)")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """A module's quick tests go to one worker, or its fixtures would be set up by each.

    Long tests are few and unlike in length: of them a worker takes over what another one has left.
    The mark ``xdist_group`` would say as much, but pytest-xdist 3.8 writes it where pytest 9.2 does
    not read it.
    """
    from xdist.scheduler import LoadFileScheduling

    if "not slow" not in config.option.markexpr:
        return None  # as the option --dist says

    class ByModule(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            module = super()._split_scope(nodeid)
            return "compiling" if module.rpartition("/")[2] in COMPILING else module

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
