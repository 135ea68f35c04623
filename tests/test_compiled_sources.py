"""Compiled code is of the sources as they are, also those of other files than its own."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys

import pytest

from bayesoleo._compiled_sources import _direct, stamp_of

FILES = {
    "__init__.py": "",
    "caller.py": """
        from bayesoleo._compiled import jit
        from changing import middle

        @jit
        def outer(x):
            return middle.between(x)

        def unrelated():
            return 0
    """,
    "middle.py": """
        from bayesoleo._compiled import inner
        from changing.callee import added
        from changing.numbers import FACTOR

        @inner
        def between(x):
            return later(x) * FACTOR

        @inner
        def later(x):
            return added(x)
    """,
    "callee.py": """
        from bayesoleo._compiled import inlined

        @inlined
        def added(x):
            return x + 1.0
    """,
    "numbers.py": "FACTOR = 10.0",
    "other.py": "NOTHING = 1",
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package in which a compiled function calls those of other files."""
    folder = tmp_path / "changing"
    folder.mkdir()
    for name, text in FILES.items():
        lines = text.strip("\n").splitlines()
        indent = len(lines[0]) - len(lines[0].lstrip()) if lines else 0
        (folder / name).write_text("\n".join(line[indent:] for line in lines))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    return folder


def change(package, name: str, old: str, new: str) -> None:
    file = package / name
    text = file.read_text()
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))


ASKED = """
from bayesoleo._compiled import is_compiled
from changing.caller import outer
before = is_compiled(outer)
print(outer(1.0), before)
"""


def asked() -> tuple[float, bool]:
    """What the function makes of one in a new process, and whether it was compiled before."""
    found = subprocess.run(
        [sys.executable, "-c", ASKED], check=True, capture_output=True, text=True
    ).stdout.split()
    return float(found[0]), found[1] == "True"


def test_what_was_compiled_is_used_until_a_function_or_number_of_another_file_changes(package):
    assert asked() == (20.0, False)
    assert asked() == (20.0, True)
    change(package, "callee.py", "x + 1.0", "x + 2.0")
    assert asked() == (30.0, False)
    change(package, "numbers.py", "10.0", "100.0")
    assert asked() == (300.0, False)
    assert asked() == (300.0, True)


def test_files_of_another_date_and_of_what_is_not_called_change_nothing(package):
    assert asked() == (20.0, False)
    os.utime(package / "callee.py", (1e9, 1e9))
    change(package, "other.py", "1", "2")
    assert asked() == (20.0, True)


@pytest.fixture
def stamp(package, monkeypatch):
    monkeypatch.syspath_prepend(package.parent)
    yield lambda: stamp_of(importlib.import_module("changing.caller").outer)
    for name in [name for name in sys.modules if name.partition(".")[0] == "changing"]:
        del sys.modules[name]


def test_a_stamp_is_of_the_numbers_that_are_referred_to(stamp, monkeypatch):
    first = stamp()
    middle = sys.modules["changing.middle"]
    assert stamp() == first
    monkeypatch.setattr(middle, "FACTOR", 11.0)
    _direct.cache_clear()  # what a process has read once does not change in it
    assert stamp() != first
