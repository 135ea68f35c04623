"""Compiled functions whose instructions become those of their callers."""

import os
import subprocess
import sys

import pytest

MODULE = """
from bayesoleo._compiled import inner, jit

@inner
def twice(x):
    return 2.0 * x

@inner
def shifted(x):
    if x.size > 5:
        raise ValueError("too many", x.size)
    return twice(x) + 1.0

@jit
def first(x):
    return 3.0 * shifted(x) + twice(x)

@jit
def second(x):
    return shifted(x) - x[0]
"""
CALLED = """
import numpy as np
from chain import first, second, shifted, twice
from bayesoleo._linked_code import LinkedCode

x = np.array([1.5, -2.0])
print(*first(x), *second(x))
try:
    first(np.ones(6))
except ValueError as error:
    print(*error.args)
for function in (twice, shifted, first):
    (found,) = function.overloads.values()
    print(isinstance(found.library, LinkedCode), sum(function.stats.cache_hits.values()))
"""
#: By hand: 3 (2 x + 1) + 2 x and 2 x + 1 - 1.5.
EXPECTED = [15.0, -13.0, 2.5, -4.5]


@pytest.fixture
def run(tmp_path):
    """Call both functions in a process of its own."""
    (tmp_path / "chain.py").write_text(MODULE)
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
    }
    command = [sys.executable, "-c", CALLED]

    def called():
        said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        numbers, told, *lines = said.stdout.splitlines()
        assert told == "too many 6"
        assert [float(number) for number in numbers.split()] == EXPECTED
        return [line.split() for line in lines]

    return called


def kept(tmp_path, function):
    return sorted((tmp_path / "cache").rglob(f"chain.{function}-*.nb*"))


def test_a_chain_of_calls_is_in_the_code_of_its_first_function(run, tmp_path):
    """Only that one has machine code; on disk the others are instructions."""
    assert run() == [["True", "0"], ["True", "0"], ["False", "0"]]
    assert all(kept(tmp_path, name) for name in ("twice", "shifted", "first", "second"))
    linked = {}
    for name in ("shifted", "first"):
        (code,) = (file for file in kept(tmp_path, name) if file.suffix == ".nbc")
        linked[name] = b"bitcode" in code.read_bytes()
    assert linked == {"shifted": True, "first": False}


def test_what_is_on_disk_serves_callers_that_are_compiled_later(run, tmp_path):
    run()
    for file in [*kept(tmp_path, "first"), *kept(tmp_path, "second")]:
        file.unlink()
    assert run() == [["True", "1"], ["True", "1"], ["False", "0"]]


def test_callers_on_disk_need_nothing_else(run, tmp_path):
    run()
    for file in [*kept(tmp_path, "twice"), *kept(tmp_path, "shifted")]:
        file.unlink()
    text = CALLED.split("try")[0]
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
    }
    said = subprocess.run(
        [sys.executable, "-c", text + "print(len(twice.overloads))"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert said.stdout.split() == [*map(str, EXPECTED), "0"]
    assert not kept(tmp_path, "twice")
