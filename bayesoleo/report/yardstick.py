"""What an error is held against: what is expected of it, by the noise and by what is not known of
the parameters; of results that were stored without that, the noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayesoleo import schema

#: A ratio above which an error counts, where a result does not say its own limit.
FLOOR = 1.15


def ratio(errors: Mapping[str, Any]) -> float | None:
    """Error over what is expected of it; None where nothing repeats."""
    value = errors.get(schema.RATIO_TO_EXPECTED, errors[schema.RATIO_TO_NOISE])
    return None if value is None else float(value)


def too_large(errors: Mapping[str, Any]) -> bool:
    """Whether an error is larger than chance allows."""
    found = ratio(errors)
    return found is not None and found > (errors.get("limit") or FLOOR)


def too_small(errors: Mapping[str, Any]) -> bool:
    """Whether an error is smaller than chance allows, so that its noise was measured too large."""
    found = ratio(errors)
    return found is not None and found < (errors.get("lowest") or 0.0)


def words(summary: Mapping[str, Any]) -> str:
    """What the errors of a summary are multiples of."""
    errors = summary["rounds"][-1].get("error", {}).values()
    entries = [e for tables in (errors, summary["error_after"].values())
               for table in tables for e in table.values()]  # fmt: skip
    known = any(schema.RATIO_TO_EXPECTED in entry for entry in entries)
    return "what is expected" if known else "its noise"
