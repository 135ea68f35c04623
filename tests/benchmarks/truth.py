"""Whether what the package says is true: verdicts, intervals, inputs, solutions, names.

Run as ``python tests/benchmarks/truth.py [--json] [--only PART …] [--fraction 0.1]``. A part is a
module ``truth_<part>.py`` beside this one with a function ``figures(fraction, say)``. Together they
make one flat object. A fraction below one takes a fixed part of the cases, for a quick look; the
figures of the README come from all of them. The measured sets are found by ``BAYESOLEO_DATA``.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def parts() -> tuple[str, ...]:
    """Names of the parts that there are: modules that have figures."""
    found = []
    for path in sorted(HERE.glob("truth_*.py")):
        if "def figures(" in path.read_text(encoding="utf-8"):
            found.append(path.stem.removeprefix("truth_"))
    return tuple(found)


def figures(
    only: Sequence[str] = (), fraction: float = 1.0, say: Any = lambda _: None
) -> dict[str, float]:
    """All figures of some parts, by default of all.

    Parameters
    ----------
    only : sequence of str
        Parts.
    fraction : float
        Part of the cases that is run.
    say : callable
        Told what is being done.

    Returns
    -------
    dict of str to float
        One flat object; ``<part>_s`` are seconds of wall time of this machine now.
    """
    sys.path.insert(0, str(HERE))
    table: dict[str, float] = {}
    for name in only or parts():
        begin = time.perf_counter()
        found = importlib.import_module(f"truth_{name}").figures(fraction, say)
        doubled = sorted(set(found) & set(table))
        if doubled:
            raise ValueError(f"two parts give {', '.join(doubled)}")
        table |= found | {f"{name}_s": round(time.perf_counter() - begin, 1)}
    return table


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one flat JSON object, no more")
    parser.add_argument("--only", nargs="+", choices=parts(), default=(), metavar="PART",
                        help=f"some of {', '.join(parts())}")  # fmt: skip
    parser.add_argument("--fraction", type=float, default=1.0, help="part of the cases to run")
    options = parser.parse_args()

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    table = figures(options.only, options.fraction, say)
    if options.json:
        print(json.dumps(table))
        return
    width = max(map(len, table), default=0)
    for key, value in table.items():
        print(f"{key:{width}}  {value:.6g}")


if __name__ == "__main__":
    main()
