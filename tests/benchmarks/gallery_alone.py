"""Run each page of the gallery alone: copied into an empty folder, without the repository.

Run with ``python tests/benchmarks/gallery_alone.py [NAME …]``, for example ``demo chaos``; without
names all pages are run, which takes some minutes. A page passes if it ends without an error and
makes at least one figure. The exit status is 1 if a page fails. The last line of the output has
the counts; ``--json`` prints them as ``{"pages": 25, "alone": 25}``.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import bayesoleo

STUDIES = Path(__file__).resolve().parents[2] / "studies"
PAGES = {page.stem.removeprefix("plot_"): page for page in sorted(STUDIES.glob("*/plot_*.py"))}
#: Runs a page as a script, then writes the number of figures it made to the last line of stderr.
COUNTING = """
import runpy, sys
from matplotlib.figure import Figure
made, begin = [], Figure.__init__
def counted(self, *args, **options):
    made.append(1)
    begin(self, *args, **options)
Figure.__init__ = counted
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
print(f"\\nfigures: {len(made)}", file=sys.stderr)
"""


def run_alone(page: Path, timeout: float = 900.0) -> subprocess.CompletedProcess[str]:
    """Run a copy of a page in an empty folder; only the package is on the path.

    Parameters
    ----------
    page : Path
        Of the gallery.
    timeout : float
        Seconds.
    """
    environment = {name: value for name, value in os.environ.items() if name != "BAYESOLEO_DATA"}
    environment["MPLBACKEND"] = "agg"
    with tempfile.TemporaryDirectory() as folder:
        copy = shutil.copy(page, folder)
        # A link to the package alone: its parent folder would bring the whole repository.
        place = Path(folder) / "path"
        place.mkdir()
        (place / "bayesoleo").symlink_to(Path(bayesoleo.__path__[0]))
        environment["PYTHONPATH"] = str(place)
        return subprocess.run(
            [sys.executable, "-c", COUNTING, copy],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )


def figures_of(done: subprocess.CompletedProcess[str]) -> int:
    """Number of figures that a run made; 0 if it failed."""
    last = (done.stderr.splitlines() or [""])[-1]
    ended = done.returncode == 0 and last.startswith("figures: ")
    return int(last.removeprefix("figures: ")) if ended else 0


def main() -> int:
    """Run the pages that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="pages; all by default")
    parser.add_argument("--json", action="store_true", help="print the counts alone")
    given = parser.parse_args()
    names, alone = given.names or list(PAGES), 0
    for name in names:
        start = time.perf_counter()
        done = run_alone(PAGES[name])
        figures = figures_of(done)
        alone += figures > 0
        if given.json:
            continue
        outcome = f"{figures} figures" if figures else "failed" if done.returncode else "no figure"
        print(f"{name:24} {outcome:12} {time.perf_counter() - start:6.1f} s", flush=True)
        if done.returncode:
            print(done.stderr)
    print(json.dumps({"pages": len(names), "alone": alone}))
    return 0 if alone == len(names) else 1


if __name__ == "__main__":
    sys.exit(main())
