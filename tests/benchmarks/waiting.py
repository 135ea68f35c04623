"""How long a user waits: commands from start to end, as they are typed, and single solves.

Each command runs in a process and a folder of its own. ``close_cold_extra_s`` is what an empty
cache of compiled code adds, ``first_word_s`` the time to the first line or bar that a user sees.
The demonstration has nothing compiled. The Silverbox is closed twice: ``silverbox_first_s`` has
the kernels of the campaign before it only, ``silverbox_s`` all that it needs, as ``close_warm_s``.
Times are those of this machine now; solves are CPU times of one thread. ``…_cpu_s`` is the CPU time
of a command and of the processes that help it: on two cores it cannot end in less than half of that
time. ``yardstick_s`` is the time of a fixed calculation in Python, before the commands and after
them: a machine that others use took twice as long for all of them on one day as on another.
``transient_ratio`` needs CasADi: see ``transients.py``. Run as
``python tests/benchmarks/waiting.py --json``, with the data found through ``BAYESOLEO_DATA``.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent))
import transients
from cases import campaign
from solves import scaling

from bayesoleo.data import dataset_folder
from bayesoleo.systems import system

ROOT = Path(__file__).resolve().parents[2]
#: The campaign of fourteen runs and what it is closed with.
WALL = ("shaker-wall", "--model", "f16n2d2", "--quick")
SILVERBOX = ROOT / "studies" / "measured"


class Waited(NamedTuple):
    """Seconds to the first output of a command, to its end, and of CPU time."""

    first: float
    end: float
    cpu: float


def waited(arguments: Sequence[str], folder: Path, more: Mapping[str, str]) -> Waited:
    """How long one command takes.

    Raises
    ------
    RuntimeError
        If it failed, with what it wrote.
    """
    line = [sys.executable, "-m", "bayesoleo", *arguments]
    begin, before = time.perf_counter(), _cpu_of_children()
    process = subprocess.Popen(
        line, cwd=folder, env={**os.environ, **more}, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert process.stdout is not None
    first = process.stdout.read(1)
    seen = time.perf_counter() - begin
    rest = process.stdout.read()
    status = process.wait()
    if status:
        raise RuntimeError((first + rest).decode(errors="replace")[-2000:])
    return Waited(seen, time.perf_counter() - begin, _cpu_of_children() - before)


def _cpu_of_children() -> float:
    """CPU seconds of processes that have ended and were waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def yardstick() -> float:
    """Seconds of ten million additions in Python."""
    begin, total = time.perf_counter(), 0
    for k in range(10_000_000):
        total += k
    assert total == 49_999_995_000_000
    return time.perf_counter() - begin


def _caches(folder: Path) -> dict[str, str]:
    """Where compiled code is kept, for the environment of a command."""
    return {"BAYESOLEO_CACHE": str(folder / "cache"), "NUMBA_CACHE_DIR": str(folder / "numba")}


def commands(say: Callable[[str], object]) -> dict[str, float]:
    """Seconds of whole commands."""
    table, before = dict[str, float](), yardstick()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cache, nothing = (_caches(folder / name) for name in ("compiled", "nothing"))
        wall = ["close", str(dataset_folder(WALL[0])), *WALL[1:]]
        cold = waited([*wall, "--out", "cold"], folder, cache)
        say(f"close, nothing compiled: first word {cold.first:.2f} s, {cold.end:.1f} s")
        warm = waited([*wall, "--out", "warm"], folder, cache)
        say(f"close, compiled: {warm.end:.1f} s")
        table |= {
            "first_word_s": cold.first,
            "close_warm_s": warm.end,
            "close_warm_cpu_s": warm.cpu,
            "close_cold_extra_s": cold.end - warm.end,
        }
        demo = waited(["demo"], folder, nothing)
        table |= {"demo_s": demo.end, "demo_cpu_s": demo.cpu}
        say(f"demo: {demo.end:.1f} s")
        if (SILVERBOX / "silverbox").is_dir():
            model = SILVERBOX / "silverbox" / "model.py"
            line = ["close", str(SILVERBOX / "silverbox"), "--model", str(model), "--quick"]
            for key, out in (("silverbox_first_s", "first"), ("silverbox_s", "again")):
                took = waited([*line, "--out", out], folder, cache)
                table |= {key: took.end, key.replace("_s", "_cpu_s"): took.cpu}
                say(f"{key}: {took.end:.1f} s")
    return table | {"yardstick_s": (before + yardstick()) / 2}


def solves() -> dict[str, float]:
    """CPU times of periodic solves by the number of dofs, and of transients against CVODES."""
    found = scaling(system("f16n2d2"), campaign())
    table = {key: value for key, value in found.items() if "dofs" in key}
    return table | {
        key: value for key, value in transients.figures().items() if not key.startswith("cvodes_1")
    }


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", action="store_true", help="one flat object")
    parser.add_argument("--only", choices=("commands", "solves"), help="one part")
    given = parser.parse_args()
    table: dict[str, float] = {}
    if given.only != "solves":
        table |= commands(lambda text: print(text, file=sys.stderr, flush=True))
    if given.only != "commands":
        table |= solves()
    if given.json:
        print(json.dumps(table))
        return
    for key, value in table.items():
        print(f"{key:28} {value:.4g}")


if __name__ == "__main__":
    main()
