"""Time of a round of the search on fourteen runs, over what it took without structures.

The revision before is taken out of the repository, and both are timed in turn in processes of their
own, by the processor's time of all threads, with kernels that were compiled before. The runs are
those of ``campaigns/shaker-wall`` where ``BAYESOLEO_DATA`` has them, else six simulated ones.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: The last revision that compared no structures and looked for no disturbances.
BEFORE = "9fb3155"
#: Rounds of each, of which the quickest counts; one more fills the caches.
REPEATS = 3
TIMED = """
import json, sys
sys.path.insert(0, "tests/benchmarks")
import trace
found = trace.times()
print(json.dumps(found.get("round_cpu_s", found["round_six_runs_cpu_s"])))
"""


def round_ratio(_: int = 0) -> dict[str, float]:
    """Processor seconds of a round now, before, and their ratio.

    Raises
    ------
    subprocess.CalledProcessError
        If the repository has no history.
    """
    with tempfile.TemporaryDirectory() as folder:
        packed = subprocess.run(
            ["git", "archive", BEFORE, "bayesoleo", "studies", "tests/benchmarks"],
            cwd=ROOT, check=True, capture_output=True,
        )  # fmt: skip
        with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as files:
            files.extractall(folder, filter="data")
        spent: dict[Path, list[float]] = {Path(folder): [], ROOT: []}
        for _ in range(REPEATS + 1):
            for tree, times in spent.items():
                times.append(_seconds(tree))
        before, now = (min(times[1:]) for times in spent.values())
    return {"round_ratio": now / before, "round_cpu_s": now, "round_before_cpu_s": before}


def _seconds(tree: Path) -> float:
    """Of a round in one tree."""
    done = subprocess.run(
        [sys.executable, "-c", TIMED],
        cwd=tree, env=os.environ | {"PYTHONPATH": str(tree)}, check=True, capture_output=True,
        text=True,
    )  # fmt: skip
    return float(json.loads(done.stdout.splitlines()[-1]))


if __name__ == "__main__":
    print(json.dumps(round_ratio()))
