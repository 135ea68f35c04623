"""Speed, correctness and safety of the sampler, against other samplers of the same densities.

Run as ``python tests/benchmarks/posterior.py [--json] [--only speed,truth]``; the parts are speed,
truth, peers, curved, safety and machines. Needs ``BAYESOLEO_DATA``; peers that are not installed
are left out. Ratios are taken in one run. On a busy machine wall time measures the others' work:
figures by CPU time, of all threads, stand beside it under names that end in ``_cpu``. What is found
is told on the error stream as it comes.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
import traceback
import warnings
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "posterior"))
#: Modules ``posterior_<part>`` with a function ``<part>_figures``. Imported when they are needed:
#: processes that are started by one begin with importing this file.
PARTS = ("speed", "truth", "peers", "curved", "safety", "machines")


def figures(part: str) -> dict[str, float]:
    """Figures of one part."""
    module = importlib.import_module(f"posterior_{part}")
    found: dict[str, float] = getattr(module, f"{part}_figures")()
    return found


def told(part: str) -> dict[str, float]:
    """Figures of one part; on the error stream when it begins, what it found and what it took.

    A part that fails says so and leaves the others their turn: its figure is ``<part>_failed``.
    """
    say = partial(print, file=sys.stderr, flush=True)
    say(f"{part} ...")
    wall, used = time.perf_counter(), time.process_time()
    try:
        found = figures(part)
    except Exception:
        traceback.print_exc()
        found = {f"{part}_failed": 1}
    for key, value in found.items():
        say(f"  {key:36s} {value:.5g}")
    wall, used = time.perf_counter() - wall, time.process_time() - used
    say(f"{part}: {wall:.0f} s, {used:.0f} s of CPU in this process")
    return found


def main() -> int:
    """The command; 1 if a part failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one flat object")
    parser.add_argument("--only", default=",".join(PARTS), help="parts, by comma")
    given = parser.parse_args()
    parts = given.only.split(",")
    unknown = set(parts) - set(PARTS)
    if unknown:
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    result: dict[str, float] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # peers' own
        for part in parts:
            result |= told(part)
    if given.json:
        print(json.dumps(result))
    return int(any(key.endswith("_failed") for key in result))


if __name__ == "__main__":
    sys.exit(main())
