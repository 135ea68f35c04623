"""Repeat experiments by simulation and hold bias and scatter against theory.

Run as ``python tests/benchmarks/replications.py [--json] [--out DIR] [gas-spring] [oleo]``: 10 000
experiments on the gas spring and 1 000 on an oleo run of the campaign ``shaker-plain``, which is
found through ``BAYESOLEO_DATA``. With ``--out`` finished blocks are kept there, and the same
command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import replications

REPEAT = {"gas-spring": replications.repeat_gas_spring, "oleo": replications.repeat_oleo}


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("which", nargs="*", help=f"by default all: {', '.join(REPEAT)}")
    parser.add_argument("--number", type=int, help="of replications, instead of the usual one")
    parser.add_argument("--out", help="folder for finished blocks")
    parser.add_argument("--jobs", type=int, help="threads")
    parser.add_argument("--json", action="store_true", help="print one flat JSON object")
    asked = parser.parse_args()
    if unknown := set(asked.which) - set(REPEAT):
        parser.error(f"unknown: {', '.join(unknown)}; there are {', '.join(REPEAT)}")
    numbers: dict[str, float] = {}
    for name in asked.which or REPEAT:
        size = {} if asked.number is None else {"replications": asked.number}
        out = replications.folder(asked.out, name)
        timed = REPEAT[name](**size, out=out, jobs=asked.jobs)
        if not asked.json:
            print(f"{name}\n{timed.found}\n{timed.seconds:.1f} s, CPU {timed.cpu_seconds:.1f} s\n")
        prefix = name.replace("-", "_")
        numbers |= {f"{prefix}_{key}": value for key, value in timed.numbers().items()}
    if asked.json:
        print(json.dumps(numbers, indent=1))


if __name__ == "__main__":
    main()
