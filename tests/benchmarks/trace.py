"""How often the loop is right, and how long a round takes.

Run as ``python tests/benchmarks/trace.py [--json] [--fraction 0.01] [--results FILE]``. It closes
the loop on a sample of the campaigns of ``studies/identification.py`` - or takes the rows that a
file of that study holds - and times one round with the whole catalogue: on six runs a second time,
and on the fourteen of ``campaigns/shaker-wall`` where ``BAYESOLEO_DATA`` has them. Times are wall
times of this machine now, with the processor's beside them.

A sample of a dozen campaigns tells a rate of one in twenty from none only by luck. So the figures
of the committed table of all campaigns stand beside it, as ``table_<figure>``, and
``sample_as_in_table`` says whether the code of today still does what the table's did.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import identification as study
import identification_rows as rows
import numpy as np

from bayesoleo.data import ReducedCampaign, dataset_folder, load_campaign, reduce_campaign
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._round import examine
from bayesoleo.discovery._state import fit_state
from bayesoleo.systems import system

FOURTEEN_RUNS = "shaker-wall"
#: Figures of the committed table that are repeated beside the sample's.
OF_TABLE = (
    "campaigns", "right_at_3x", "false_additions", "mean_class_size", "outside_named_as_certain",
)  # fmt: skip


def round_of(reduced: ReducedCampaign, model: str) -> tuple[float, float, int]:
    """Seconds of one round after the first fit, on the wall and of all threads, and how many
    candidates it scored."""
    numerics, roles = Numerics(), assign(reduced.records)
    state = fit_state(Assembly(system(model), study.DRIVE), roles, numerics)
    begin, worked = time.perf_counter(), time.process_time()
    outcome = examine(state, roles, numerics, effects=None, seed=0, callback=lambda _: None)
    return time.perf_counter() - begin, time.process_time() - worked, len(outcome.ranking)


def times() -> dict[str, Any]:
    """Rounds on fourteen runs, the first thing done here, and on six, done before."""
    found: dict[str, Any] = {}
    if os.environ.get("BAYESOLEO_DATA"):
        reduced = reduce_campaign(load_campaign(dataset_folder(FOURTEEN_RUNS)))
        found["round_s"], found["round_cpu_s"], found["candidates"] = round_of(
            reduced, study.SYSTEM
        )
    wall = study.Campaign("wall_heat_capacity", "heat_loss", 10.0, 0)
    model, values = study.truth(wall, np.random.default_rng(0))
    six = study.simulated(model, values, 0)
    round_of(six, study.SYSTEM)
    found["round_six_runs_s"], found["round_six_runs_cpu_s"], _ = round_of(six, study.SYSTEM)
    found.setdefault("round_s", found["round_six_runs_s"])
    return found


def of_table(sample: Sequence[rows.Row], table: Mapping[str, Any] | None) -> dict[str, Any]:
    """Figures of the committed table, and how far a sample repeats it.

    Parameters
    ----------
    sample : sequence of mapping
        Rows of campaigns that were run now.
    table : mapping or None
        As :func:`identification_rows.stored` gives it; None if there is none.

    Returns
    -------
    dict
        Of each figure of :data:`OF_TABLE`, the version of the package that made the table, and
        the part of the sample to which the same effects were added in the same order as in the
        table. A campaign that failed repeats a table that lacks it, since that keeps no failures.
        All are None without a table, the last also without a sample.
    """
    if table is None:
        names = [*(f"table_{name}" for name in (*OF_TABLE, "version")), "sample_as_in_table"]
        return dict.fromkeys(names)
    figures = rows.summarise(table["rows"])
    found = {f"table_{name}": figures[name] for name in OF_TABLE}
    found["table_version"] = table["version"]
    added = {_campaign(row): row["added"] for row in table["rows"]}
    alike = [row.get("added") == added.get(_campaign(row)) for row in sample]
    found["sample_as_in_table"] = float(np.mean(alike)) if alike else None
    return found


def _campaign(row: rows.Row) -> tuple[Any, ...]:
    return row["effect"], row["target"], row["factor"], row["replication"]


def main() -> None:
    """Time a round, close the loop on a sample, print one flat object."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--fraction", type=float, default=0.01, help="of the study's campaigns")
    parser.add_argument("--results", type=Path, help="rows of a study instead of a sample")
    options = parser.parse_args()
    result = times()
    if options.results is None:
        chosen = study.planned()
        found = [study.run(item) for item in chosen[: round(options.fraction * len(chosen))]]
    else:
        found = rows.read(options.results)
    result |= rows.summarise(found)
    result |= of_table(found, rows.stored())
    if options.json:
        print(json.dumps(result))
    else:
        print("\n".join(f"{name:26} {value}" for name, value in result.items()))


if __name__ == "__main__":
    main()
