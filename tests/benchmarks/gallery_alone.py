"""Run each page of the gallery alone: copied into an empty folder, without the repository.

Run with ``python tests/benchmarks/gallery_alone.py [NAME …]``, for example ``demo chaos``; without
names all pages are run, which takes some minutes. The exit status is 1 if a page fails.
"""

from __future__ import annotations

import argparse
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
            [sys.executable, copy],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )


def main() -> int:
    """Run the pages that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="pages; all by default")
    failed = 0
    for name in parser.parse_args().names or PAGES:
        start = time.perf_counter()
        done = run_alone(PAGES[name])
        failed += done.returncode != 0
        outcome = "failed" if done.returncode else "ran"
        print(f"{name:24} {outcome:8} {time.perf_counter() - start:6.1f} s", flush=True)
        if done.returncode:
            print(done.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
