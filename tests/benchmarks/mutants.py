"""Whether the tests notice that a number means something else.

Each mutant is a small change of what a number means: a factor, a degree of freedom, a term of a
density, a test of convergence. The table is ``mutant_table.py``. The package and its tests are
copied to a temporary folder, the mutants are applied there one at a time, and the tests named
beside each must fail. They must pass without any of them. A mutant whose text does not stand in its
file exactly once is an error.

Run ``python tests/benchmarks/mutants.py --json``; ``--few`` tries a sample, ``--only WORDS`` those
whose names contain the words. What each mutant came to is told on standard error.

Programs that make mutants themselves (mutmut, cosmic-ray) were of no use here. They rewrite
functions that Numba compiles, they run thousands of mutants against a suite of minutes, and most of
their mutants are of no interest.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import Any

from mutant_table import MUTANTS, Mutant

ROOT = Path(__file__).parents[2]
#: Imported once, before processes are forked. Not the package: each process imports its own.
LIBRARIES = (
    "numba", "pandas", "scipy.integrate", "scipy.interpolate", "scipy.optimize", "scipy.signal",
    "scipy.stats", "sympy", "xarray", "emcee", "arviz_stats", "h5netcdf", "jsonschema", "tqdm.auto",
    "dask.array", "hypothesis", "jinja2", "pint", "xdist", "zarr", "pytest",
)  # fmt: skip
#: Of pytest: what serves reports only takes longer than most tests.
SETTINGS = (
    "-x", "-q", "-n", "0", "--assert=plain", "--tb=line", "-p", "no:cacheprovider",
    "-p", "no:unraisableexception", "-p", "no:threadexception", "-m", "",
)  # fmt: skip
#: Seconds of computing time that the tests of one mutant may take, and those of all without one;
#: and how often they may be waited for as long, on a machine with other work.
COMPUTING, ALL_COMPUTING, PATIENCE = 300, 3000, 10
#: Of the mutants, every so many are a sample.
SPARSE = 9
#: Marks of tests that are run only where a mutant names them.
SLOW = ("slow", "statistical")
#: How pytest ends: all passed; some failed; interrupted by an error of a module.
PASSED, NOTICED = 0, (1, 2)


@dataclass(frozen=True)
class Verdict:
    """How the tests of a mutant ended, and the seconds that they took."""

    killed: bool
    told: str
    seconds: float


def mutated(mutant: Mutant, source: str) -> str:
    """Source of a file with a mutant in it.

    Raises
    ------
    ValueError
        If the text to replace does not stand there exactly once.
    """
    found = source.count(mutant.old)
    if found != 1:
        raise ValueError(f"{mutant.name}: the text stands {found} times in {mutant.file}")
    changed = source.replace(mutant.old, mutant.new)
    ast.parse(changed)
    return changed


def is_compiled(source: str) -> bool:
    """Whether Numba compiles functions of a file."""
    return any(line.startswith(("@jit", "@inner")) for line in source.splitlines())


class WithoutSlow:
    """Of files whole, pytest runs the quick tests; a slow one where it is named itself.

    Parameters
    ----------
    chosen : sequence of str
        Files and tests.
    """

    def __init__(self, chosen: Sequence[str]) -> None:
        self._named = {name.partition("::")[2] for name in chosen} - {""}

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        """Leave out what takes long."""
        items[:] = [
            item
            for item in items
            if item.nodeid.partition("::")[2].partition("[")[0] in self._named
            or not any(item.get_closest_marker(mark) for mark in SLOW)
        ]


class Copy:
    """A copy of the package and its tests, in which mutants are tried.

    Numba knows a compiled function by its own file, but not by the files of functions that it
    calls. What was compiled is therefore forgotten where a mutant is in a file of compiled
    functions, and put back afterwards.
    """

    def __init__(self, folder: Path) -> None:
        self.root, self.kept = folder / "copy", folder / "compiled"
        for name in ("bayesoleo", "tests"):
            shutil.copytree(ROOT / name, self.root / name)
        shutil.copy2(ROOT / "pyproject.toml", self.root)
        self.log = folder / "log"

    def check(self, mutants: Iterable[Mutant]) -> Verdict:
        """The tests of mutants without any of them; what they compile is kept for later."""
        names = dict.fromkeys(name for mutant in mutants for name in mutant.tests)
        # Of a whole file no single test is named besides: pytest would run it twice.
        tests = [n for n in names if n.partition("::")[0] not in names or "::" not in n]
        found = self.run(tests, ALL_COMPUTING)
        for file in self._compiled():
            place = self.kept / file.relative_to(self.root)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(file, place)
        return found

    def try_one(self, mutant: Mutant) -> Verdict:
        """The tests of a mutant with it."""
        file = self.root / "bayesoleo" / mutant.file
        source, times = file.read_text("utf-8"), file.stat()
        changed, compiled = mutated(mutant, source), is_compiled(source)
        try:
            file.write_text(changed, encoding="utf-8")
            if compiled:
                self._forget()
            return self.run(mutant.tests)
        finally:
            file.write_text(source, encoding="utf-8")
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
            if compiled:
                self._forget()
                if self.kept.exists():
                    shutil.copytree(self.kept, self.root, dirs_exist_ok=True)

    def run(self, tests: Sequence[str], computing: int = COMPUTING) -> Verdict:
        """Run tests in a process of its own, for so many seconds of computing at most."""
        begun = time.monotonic()
        child = os.fork()
        if child == 0:
            self._be_pytest(tests, computing)
        status = None
        while status is None and time.monotonic() < begun + PATIENCE * computing:
            done, how = os.waitpid(child, os.WNOHANG)
            status = os.waitstatus_to_exitcode(how) if done else None
            time.sleep(0.05)
        if status is None:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise RuntimeError(f"the machine is too busy: {tests} have not ended")
        seconds = time.monotonic() - begun
        if status == -signal.SIGKILL:
            raise RuntimeError(f"killed from outside, for want of memory perhaps: {tests}")
        if status < 0:  # too much computing, or a crash
            return Verdict(True, f"ended by {signal.Signals(-status).name}", seconds)
        if status not in (PASSED, *NOTICED):
            raise RuntimeError(f"the tests do not run: {tests}\n{self._last(20)}")
        return Verdict(status != PASSED, self._last(), seconds)

    def _be_pytest(self, tests: Sequence[str], computing: int) -> None:
        """The child of :meth:`run`; it never returns."""
        status = 3
        try:
            import resource

            resource.setrlimit(resource.RLIMIT_CPU, (computing, computing + 10))
            output = os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for number in (1, 2):
                os.dup2(output, number)
            os.chdir(self.root)
            os.environ["PYTHONPATH"] = str(self.root)
            sys.path[0] = str(self.root)
            sys.dont_write_bytecode = True  # of a mutant
            import pytest

            chosen = [f"tests/{name}" for name in tests]
            status = int(pytest.main([*SETTINGS, *chosen], [WithoutSlow(chosen)]))
            here = str(sys.modules["bayesoleo"].__file__)
            status = status if here.startswith(str(self.root)) else 4
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)

    def _last(self, lines: int = 1) -> str:
        """What the tests said last."""
        with contextlib.suppress(OSError):
            said = self.log.read_text("utf-8", "replace").strip().splitlines()
            failed = [line for line in said if line.startswith(("FAILED", "ERROR"))]
            return "\n".join((failed or said)[-lines:])[:400]
        return ""

    def _compiled(self) -> list[Path]:
        """Files in which Numba keeps what it compiled of the package."""
        folders = (self.root / "bayesoleo").rglob("__pycache__")
        return [file for folder in folders for file in folder.glob("*.sha256*")]

    def _forget(self) -> None:
        for file in self._compiled():
            file.unlink()


def _package(mutant: Mutant) -> str:
    return mutant.file.partition("/")[0]


def chosen(few: bool = False, only: str = "") -> list[Mutant]:
    """Mutants that count: all, a sample over the packages, or those that are named.

    Compiled functions take long to compile again; a sample does without.
    """
    if only:
        found = [mutant for mutant in MUTANTS if only in mutant.name]
        if not found:
            raise ValueError(f"no mutant has {only!r} in its name")
        return found
    if few:
        sources = {m.file: (ROOT / "bayesoleo" / m.file).read_text("utf-8") for m in MUTANTS}
        small = [mutant for mutant in MUTANTS if not is_compiled(sources[mutant.file])]
        by_package = groupby(sorted(small, key=_package), key=_package)
        return [mutant for _, group in by_package for mutant in list(group)[::SPARSE]]
    return list(MUTANTS)


def measure(
    few: bool = False, only: str = "", report: Callable[[str], None] = lambda _: None
) -> dict[str, int]:
    """Try mutants; their number, and how many the tests notice.

    Raises
    ------
    RuntimeError
        If tests fail without a mutant.
    """
    for name in LIBRARIES:
        import_module(name)
    mutants, killed = chosen(few, only), 0
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = Copy(Path(folder))
        found = copy.check(mutants)
        if found.killed:
            raise RuntimeError(f"tests fail without a mutant: {found.told}")
        report(f"without a mutant all tests pass, {found.seconds:.0f} s")
        for mutant in mutants:
            found = copy.try_one(mutant)
            killed += found.killed
            word = "killed" if found.killed else "SURVIVED"
            report(f"{word:8} {found.seconds:4.0f} s  {mutant.name}: {found.told}")
    return {"mutants": len(mutants), "mutants_killed": killed}


def cli() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--few", action="store_true", help="a sample of the mutants")
    parser.add_argument("--only", default="", help="mutants whose names contain these words")
    wanted = parser.parse_args()
    for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[threads] = "1"  # a forked process has none of its parent's
    warnings.filterwarnings("ignore", message=".*multi-threaded.*")
    figures = measure(wanted.few, wanted.only, partial(print, file=sys.stderr, flush=True))
    if wanted.json:
        print(json.dumps(figures))
    else:
        print("\n".join(f"{key:18}{value:6}" for key, value in figures.items()))


if __name__ == "__main__":
    cli()
