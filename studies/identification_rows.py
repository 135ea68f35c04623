"""What came out of the campaigns of ``identification.py``: rows, the figures that sum them up, and
the table that the gallery shows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

#: Campaigns with nothing missing, and what the catalogue has no name for.
NONE, STRANGE = "none", ("ripple", "late_drag", "inner_wall")
#: Multiples of the detection limit.
FACTORS = (1.0, 3.0, 10.0)
#: Largest class of effects that counts as an answer.
LARGEST_CLASS = 3
TABLE = Path(__file__).resolve().parent / "tables" / "identification.json"
#: What of a row the table keeps.
COLUMNS = (
    "effect", "target", "factor", "replication", "added", "same", "verdict", "certain", "place",
    "p_value", "ratio", "seconds",
)  # fmt: skip

Row = Mapping[str, Any]


def right(row: Row) -> bool:
    """Whether the first effect added, or one of at most two that data cannot tell from it, is the
    one in the data."""
    if not row["added"] or 1 + len(row["same"]) > LARGEST_CLASS:
        return False
    # Of the same effect in another place the class says where; of others the effect is enough.
    named = {row["added"][0], *(name.replace(" @ ", " at ") for name in row["same"])}
    return bool(named & {row["effect"], f"{row['effect']} at {row['target']}"})


def named(rows: Sequence[Row], factor: float | None = None) -> list[Row]:
    """Rows whose data have an effect of the catalogue in them, at one multiple of its limit."""
    return [
        row
        for row in rows
        if row["effect"] not in (NONE, *STRANGE) and factor in (None, row["factor"])
    ]


def plain(rows: Sequence[Row]) -> list[Row]:
    """Rows whose data lack nothing."""
    return [row for row in rows if row["effect"] == NONE]


def strange(rows: Sequence[Row]) -> list[Row]:
    """Rows whose data have something that the catalogue lacks."""
    return [row for row in rows if row["effect"] in STRANGE]


def alone(row: Row) -> bool:
    """Whether one name is the answer: something was added, and no other effect looks like it."""
    return bool(row["added"]) and not row["same"]


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """The study's figures: fractions, and the mean size of classes."""
    done = [row for row in rows if "failed" not in row]
    table: dict[str, Any] = {"campaigns": len(done), "failed": len(rows) - len(done)}
    for factor in FACTORS:
        table[f"right_at_{factor:g}x"] = _mean([right(row) for row in named(done, factor)])
    table["false_additions"] = _mean([bool(row["added"]) for row in plain(done)])
    table["mean_class_size"] = _mean([1 + len(r["same"]) for r in named(done) if r["added"]])
    table["outside_given_a_name"] = _mean([bool(row["added"]) for row in strange(done)])
    table["outside_named_as_certain"] = _mean([row["certain"] for row in strange(done)])
    for factor in FACTORS[1:]:
        found = named(done, factor)
        table[f"certain_at_{factor:g}x"] = _mean([row["certain"] for row in found])
        table[f"certain_and_wrong_at_{factor:g}x"] = sum(
            row["certain"] and not right(row) for row in found
        )
        table[f"one_name_and_right_at_{factor:g}x"] = _mean(
            [alone(row) and right(row) for row in found]
        )
    return table


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a file of results, an unfinished last line left out."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def store(rows: Sequence[Row], planned: int, command: str, seed: int) -> None:
    """Write the compact table: a row a line, so that versions of it can be compared."""
    done = sorted((row for row in rows if "failed" not in row), key=_order)
    head = {
        "command": command,
        "seed": seed,
        "version": version("bayesoleo"),
        "planned": planned,
        "failed": len(rows) - len(done),
        "columns": COLUMNS,
    }
    lines = ",\n".join(json.dumps([_brief(row[name]) for name in COLUMNS]) for row in done)
    text = json.dumps(head)[:-1] + f', "rows": [\n{lines}\n]}}\n'
    TABLE.write_text(text, encoding="utf-8")


def stored() -> dict[str, Any] | None:
    """The table of the last run, its rows as mappings; None if there is none."""
    if not TABLE.is_file():
        return None
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    rows = [dict(zip(table["columns"], values, strict=True)) for values in table["rows"]]
    return table | {"rows": rows}


def _order(row: Row) -> tuple[Any, ...]:
    return row["effect"], row["target"], row["factor"], row["replication"]


def _brief(value: Any) -> Any:
    return float(f"{value:.3g}") if isinstance(value, float) else value
