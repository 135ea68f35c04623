"""Close the loop on the reference jobs and print the error before and after, as in the README.

Run as ``python tests/benchmarks/close.py [--json] [--job NAME …]``. The data are found through
``BAYESOLEO_DATA``. Times are stated beside what was reached; they are those of this machine now.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from bayesoleo.data import dataset_folder
from bayesoleo.modelfile import load_model
from bayesoleo.systems import system
from bayesoleo.workflow import Settings, close

MEASURED = Path(__file__).parents[2] / "studies" / "measured"

#: Name, model and drive of each job; measured ones bring their own model file.
JOBS: dict[str, tuple[str | None, str | None]] = {
    "silverbox": (None, None),
    "mr_damper": (None, None),
    "mbari_gas_spring": (None, None),
    "shaker-plain f16n2d2": ("f16n2d2", "displacement"),
    "shaker-plain f16n1d2": ("f16n1d2", "displacement"),
    "shaker-plain f16n2d1 by force": ("f16n2d1", "model"),
    "shaker-wall f16n2d2": ("f16n2d2", "displacement"),
    "shaker-breakaway f16n2d2": ("f16n2d2", "displacement"),
    "shaker-fast-rebound f16n2d2": ("f16n2d2", "displacement"),
    "shaker-compliance f16n2d2": ("f16n2d2", "displacement"),
}


def run(job: str, quick: bool) -> dict[str, object]:
    """Close the loop on one job and collect what the table shows."""
    name, drive = JOBS[job]
    begin = time.perf_counter()
    if name is None:
        campaign, model = MEASURED / job, load_model(f"{MEASURED / job / 'model.py'}:model")
    else:
        campaign, model = dataset_folder(job.split()[0]), system(name)
    tree = close(campaign, model, Settings(drive=drive, quick=quick), progress=True)
    summary = json.loads(tree.attrs["summary"])
    return {
        "verdict": summary["verdict"],
        "effects": summary["effects"],
        "before": summary["error_before"]["hold-out"],
        "after": summary["error_after"]["hold-out"],
        "by_run": summary["rounds"][-1]["error"],
        "notes": summary["notes"],
        "seconds": time.perf_counter() - begin,
    }


def row(job: str, result: dict) -> str:
    """One line of the table; SI units."""

    def cells(table: dict) -> str:
        parts = [
            f"{output}: rms {v['rms']:.3g}, repeating {v['repeating']:.3g},"
            f" ratio {v['ratio_to_noise']:.2f}"
            for output, v in table.items()
        ]
        return "; ".join(parts)

    found = ", ".join(result["effects"]) or "none"
    return (
        f"| {job} | {cells(result['before'])} | {cells(result['after'])} |"
        f" {found} | {result['verdict']} | {result['seconds']:.0f} s |"
    )


def main() -> None:
    """Run the jobs asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--job", action="append", choices=list(JOBS), help="by default all")
    parser.add_argument("--full", action="store_true", help="sample to the default effective size")
    options = parser.parse_args()
    results = {}
    if not options.json:
        print("| job | before, hold-out | after, hold-out | effects | verdict | time |")
        print("|---|---|---|---|---|---|")
    for job in options.job or list(JOBS):
        results[job] = run(job, not options.full)
        if not options.json:
            print(row(job, results[job]), flush=True)
    if options.json:
        print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
