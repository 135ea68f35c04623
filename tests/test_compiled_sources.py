"""Compiled code is of the sources as they are, also those of other files than its own."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys

import numpy as np
import pytest
from numba.core import types

from bayesoleo._compiled import VERSIONS
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
        from bayesoleo._compiled import inner

        @inner
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
    # Python takes a file of the same second and size for the one that it has compiled.
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
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
{}
print(outer(1.0), before)
"""


def asked(first: str = "") -> tuple[float, bool]:
    """What the function makes of one in a new process, which does something before, and whether it
    was compiled before."""
    found = subprocess.run(
        [sys.executable, "-c", ASKED.format(first)], check=True, capture_output=True, text=True
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
    change(package, "numbers.py", "100.0", "10.0")  # as where a branch comes back
    assert asked() == (30.0, True)


CHANGED = """
from pathlib import Path
import changing.callee
file = Path(changing.callee.__file__)
file.write_text(file.read_text().replace("x + 1.0", "x + 2.0"))
"""
FULL = """
from bayesoleo._compiled import _CheckedFile
def full(self, name, data):
    raise OSError(28, "No space left on device")
_CheckedFile._save_data = full
"""


def test_what_a_process_had_read_before_a_file_changed_is_not_taken_for_the_file(package):
    assert asked(CHANGED) == (20.0, False)  # as Python has read it
    assert asked() == (30.0, False)


def test_what_could_not_be_written_is_not_taken_from_other_sources(package):
    assert asked() == (20.0, False)
    change(package, "callee.py", "x + 1.0", "x + 2.0")
    assert asked(FULL)[0] == 30.0
    assert asked()[0] == 30.0


@pytest.mark.slow
def test_of_many_versions_the_last_are_kept(package, tmp_path):
    for number in range(VERSIONS + 2):
        (package / "numbers.py").write_text(f"FACTOR = {number + 1}.0")
        assert asked() == (2.0 * (number + 1), False)
        os.utime(newest(tmp_path), (number + 1e9, number + 1e9))  # clocks of disks are coarse
    kept = [file for file in tmp_path.rglob("*.nbi") if ".outer-" in file.name]
    assert len(kept) == VERSIONS
    data = [file for file in tmp_path.rglob("*.nbc") if ".outer-" in file.name]
    assert {file.name.rsplit(".sha256", 1)[0] for file in data} == {
        file.name.rsplit(".sha256", 1)[0] for file in kept
    }


def newest(folder):
    found = [file for file in folder.rglob("*.nbi") if ".outer-" in file.name]
    return max(found, key=lambda file: file.stat().st_mtime_ns)


def test_files_of_another_date_and_what_is_not_called_change_nothing(package):
    assert asked() == (20.0, False)
    os.utime(package / "callee.py", (1e9, 1e9))
    change(package, "callee.py", "from bayes", "# With a comment.\nfrom bayes")
    change(package, "caller.py", "return 0", "return 1")
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
    found = {first}
    for value in (11.0, 11, np.array([1.0, 2.0]), np.array([1.0, 3.0]), types.float64):
        monkeypatch.setattr(middle, "FACTOR", value)
        _direct.cache_clear()  # what a process has read once does not change in it
        found.add(stamp())
    assert len(found) == 6
