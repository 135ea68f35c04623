"""Commands answer what the machine and the input do to them; a sample of the benchmark."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from bayesoleo._machine_code import cache_folder

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="forks, and sends SIGKILL"),
    # The children begin no thread before they are replaced or end.
    pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning"),
]


@pytest.fixture(scope="module")
def faults() -> Iterator[ModuleType]:
    """The benchmark, with its folder importable as when it is run by hand."""
    path = list(sys.path)
    sys.path.insert(0, str(Path(__file__).parent))
    import faults

    yield faults
    sys.path[:] = path


@pytest.fixture
def bench(faults, tmp_path, monkeypatch):
    """A campaign, and the kernels that other tests have compiled."""
    # Set by the bench itself; this has it put back afterwards.
    monkeypatch.setenv("BAYESOLEO_CACHE", str(cache_folder().parent))
    return faults.Bench(tmp_path, few=True)


def check(count, kills: int, faults: int) -> None:
    assert (count.kills, count.faults) == (kills, faults)
    assert count.remarks == []
    assert count.kills_recovered == kills
    assert count.faults_answered == faults
    assert count.silent_changes == count.segfaults == 0


def test_a_command_that_is_killed_or_has_no_room(bench):
    bench.kills("reduce", 2)
    bench.full_disk("reduce", 2)
    check(bench.count, 2, 2)


@pytest.mark.slow
def test_estimates_that_are_killed_or_have_no_room(bench):
    bench.kills("estimate", 3)
    bench.full_disk("estimate", 3)
    check(bench.count, 3, 3)


@pytest.mark.slow
def test_a_sample_of_mutants_is_noticed(bench):
    bench.mutants()
    assert bench.count.mutants_killed == bench.count.mutants >= 8


NAMES = ("label up, simulated", "label newline, estimated", "100 000 columns", "file /etc")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_hostile_input(bench, monkeypatch, name):
    monkeypatch.setattr(
        sys.modules["faults"], "INPUTS", {name: sys.modules["hostile"].INPUTS[name]}
    )
    bench.inputs()
    check(bench.count, 0, 1)
