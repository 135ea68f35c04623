"""Print the tables of Verbeek (1993), chapter 6, as this package finds them.

Run as ``python tests/benchmarks/tables.py --table 6.5to6.2`` or, on the campaign ``shaker-plain``
below ``BAYESOLEO_DATA``, with another table, variant and drive; ``--help`` lists them. What is
computed is in ``studies/thesis_tables.py`` and ``studies/shaker_tables.py``, which the gallery's
pages use as well.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import drop_tests
import shaker_tables
import thesis_tables


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--table",
        nargs="+",
        default=["6.5to6.2"],
        choices=["6.5to6.2", "drop", *shaker_tables.TABLES],
        help="which, by default 6.5to6.2",
    )
    parser.add_argument("--drive", default="force", choices=["force", "displacement"])
    parser.add_argument("--variant", default="thesis", choices=["thesis", "linked"])
    parser.add_argument("--jobs", type=int, default=None, help="threads")
    asked = parser.parse_args()
    if "6.5to6.2" in asked.table:
        found = {
            variant: thesis_tables.table_6_5_to_6_2(variant, asked.jobs)
            for variant in thesis_tables.VARIANTS
        }
        thesis_tables.print_comparison(found)
    if "drop" in asked.table:
        fits = drop_tests.fitted(shaker_tables.Shaker.load(asked.jobs).reduced.records, asked.jobs)
        drop_tests.print_damping(fits)
        drop_tests.print_drops(drop_tests.predictions_of(fits))
    rest = [table for table in asked.table if table in shaker_tables.TABLES]
    if rest:
        shaker = shaker_tables.Shaker.load(asked.jobs)
        for table in rest:
            shaker_tables.TABLES[table](shaker, asked.variant, asked.drive)


if __name__ == "__main__":
    main()
