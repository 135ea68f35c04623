"""Speed, correctness and safety of the sampler, against other samplers of the same densities.

Run as ``python tests/benchmarks/posterior.py [--json] [--only speed,truth,peers,safety,machines]``.
Needs ``BAYESOLEO_DATA``; peers that are not installed are left out. Ratios are taken in one run. On
a busy machine wall time measures the others' work: figures by CPU time, of all threads, stand
beside it under names that end in ``_cpu``.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "posterior"))
#: Modules ``posterior_<part>`` with a function ``<part>_figures``. Imported when they are needed:
#: processes that are started by one begin with importing this file.
PARTS = ("speed", "truth", "peers", "safety", "machines")


def figures(part: str) -> dict[str, float]:
    """Figures of one part."""
    module = importlib.import_module(f"posterior_{part}")
    found: dict[str, float] = getattr(module, f"{part}_figures")()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one flat object")
    parser.add_argument("--only", default=",".join(PARTS), help="parts, by comma")
    given = parser.parse_args()
    result: dict[str, float] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # peers' own
        for name in given.only.split(","):
            part = figures(name)
            result |= part
            if not given.json:
                for key, value in part.items():
                    print(f"{key:36s} {value:.5g}", flush=True)
    if given.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
