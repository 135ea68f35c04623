"""Close the loop on the measured sets and compare the errors with what has been published.

Run with ``python tests/benchmarks/measured.py --json`` for one flat object, or without ``--json``
for a table. Campaigns and models are those of ``studies/measured``; the data are found through
``BAYESOLEO_DATA``. ``--only SET`` measures one set. Each set takes one to several minutes; its
result is kept in the folder ``--out`` and used again while neither the package nor the set's
campaign and model have changed, so that a run that was stopped goes on.

Each set gives its errors, and

``<set>_first_effect``, ``<set>_effects``
    the effect that was added first, and all of the final model;
``<set>_found``
    these with 95 % intervals of their parameters, as lines of text;
``<set>_certainty``
    ``certain``, ``probable``, ``likeness`` or empty;
``<set>_seconds``
    time of ``bayesoleo close --quick`` without the import of the package: with its files and its
    report, compilation included;
``<set>_cpu_seconds``
    CPU time of that, summed over the threads of one process: what a busy machine leaves alone.
    With ``--jobs 1`` it is all of it; with more, worker processes are not counted;
``<set>_memory_GB``
    most memory that the process has used;
``<set>_failed``
    why there are no errors.

===================== ============================================================================
key                   error, root mean square
===================== ============================================================================
silverbox_arrow       simulation of the arrow from the parameters of Schroeder80mV alone, mV
silverbox_arrow_…     the same up to the largest amplitude of the estimation data
silverbox_multisine   the same of the random multisines
silverbox_offset      offset of the sensor in Schroeder80mV, with which all three are simulated, mV
emps_fit, _pulses     force, N
emps_position         position on the pulses, simulated from the measured force, mm
tanks_estimation, …   level, V
brfd_holdout          force of the run at 1 Hz and 1 in, kip
pendulum_validation   angle of the validation records, mrad
mr_damper_holdout     force, the larger of two runs, N
mbari_fit, _holdout   pressure, psi
===================== ============================================================================
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "studies"))
import measured_sets


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one flat object")
    sets = list(measured_sets.SETS)
    parser.add_argument("--only", nargs="+", default=sets, choices=sets, metavar="SET")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="threads")
    parser.add_argument("--out", type=Path, default=measured_sets.OUT, help="folder of results")
    chosen = parser.parse_args()
    found = measured_sets.all_kept(chosen.only, chosen.out, chosen.jobs)
    if chosen.json:
        print(json.dumps(found))
        return
    for key, value in found.items():
        print(f"{key:28} {value}")


if __name__ == "__main__":
    main()
