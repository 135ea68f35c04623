"""How many kinds of files are read without conversion, and how fast a large one is.

Run ``python tests/benchmarks/reading.py --json`` for one flat object. ``formats_read`` of
``formats_tried`` files hold, after loading, what was written into them; a file that cannot be made
because its writer is not installed counts as tried. ``tracebacks`` counts errors that are no
message for a person. A text file of five million rows with four columns is loaded as a campaign in
a process of its own: its time and CPU time in s, and the largest memory in GB.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from reading_files import CASES, Case, campaign, check

from bayesoleo.errors import BayesoleoError

ROWS = 5_000_000


def attempt(case: Case, folder: Path) -> tuple[bool, str, bool]:
    """Whether a file was read, what went wrong, and whether that was a traceback."""
    try:
        made = campaign(case, folder)
    except Exception as error:  # the writer is missing, or of another version
        return False, f"not written: {error}", False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check(case, made)
    except BayesoleoError as error:
        return False, str(error), False
    except AssertionError as error:
        return False, f"wrong values: {error}", False
    except Exception as error:
        return False, f"{type(error).__name__}: {error}", True
    return True, "", False


def all_kinds() -> dict[str, object]:
    """Try every kind of file."""
    read = tracebacks = 0
    failed = {}
    with tempfile.TemporaryDirectory() as root:
        for number, case in enumerate(CASES):
            good, problem, traceback = attempt(case, Path(root) / str(number))
            read += good
            tracebacks += traceback
            if not good:
                failed[case.name] = problem
    for name, problem in failed.items():
        print(f"{name}: {problem}", file=sys.stderr)
    return {"formats_read": read, "formats_tried": len(CASES), "tracebacks": tracebacks}


def write_large(folder: Path) -> None:
    """A campaign of one text file of five million rows."""
    from bayesoleo.data._campaign_toml import FILE

    rate, block = 1000.0, 100_000
    with (folder / "large.csv").open("w") as stream:
        stream.write("time_s,x_mm,F_N,p_bar\n")
        for first in range(0, ROWS, block):
            at = (first + np.arange(block)) / rate
            turn = 2 * np.pi * 0.5 * at
            values = np.column_stack([at, 10 * np.sin(turn), 90 * np.cos(turn), 5 + np.sin(turn)])
            np.savetxt(stream, values, delimiter=",", fmt=("%.3f", "%.5f", "%.3f", "%.6f"))
    channels = "".join(
        f'[channels.{name}]\ncolumn = "{column}"\nunit = "{unit}"\n'
        for name, column, unit in (
            ("displacement", "x_mm", "mm"),
            ("force", "F_N", "N"),
            ("pressure", "p_bar", "bar"),
        )
    )
    run = '[[runs]]\nlabel = "a"\nfile = "large.csv"\nfrequency = 0.5\n'
    (folder / FILE).write_text(f'format = 1\nname = "large"\n{channels}{run}')


def load_large(folder: str) -> None:
    """Load it and print time and memory; runs in a process of its own."""
    from bayesoleo.data import load_campaign

    started, begin = time.perf_counter(), time.process_time()
    (run,) = load_campaign(folder, progress=True).runs
    seconds, used = time.perf_counter() - started, time.process_time()
    assert run.time.size == ROWS
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    times = {"rows_5m_s": round(seconds, 2), "rows_5m_cpu_s": round(used - begin, 2)}
    print(json.dumps(times | {"rows_5m_gb": round(memory, 3)}))


def large() -> dict[str, float]:
    """Time and memory of five million rows."""
    with tempfile.TemporaryDirectory() as folder:
        write_large(Path(folder))
        command = [sys.executable, __file__, "--load", folder]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one flat JSON object")
    parser.add_argument("--load", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.load:
        load_large(given.load)
        return
    found = {**all_kinds(), **large()}
    print(json.dumps(found) if given.json else "\n".join(f"{k} {v}" for k, v in found.items()))


if __name__ == "__main__":
    main()
