"""The table ``[rig]`` of a campaign: what may be asked of the rig in a run yet to be made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bayesoleo.errors import CampaignError
from bayesoleo.units import parse_unit

_PARTS = ("low", "high", "unit")
_EXAMPLE = 'write { low = 1, high = 50, unit = "mm" }, or one of low and high'
#: Sizes of a change: the zero of their unit is zero.
_CHANGES = ("amplitude", "rate")


def read_rig(table: Any, file: str) -> dict[str, tuple[float, float]]:
    """Limits by name, SI; infinite where one is left out.

    Parameters
    ----------
    table : object
        What stands under ``[rig]``: ``amplitude``, ``frequency``, ``mean``, ``travel``, ``rate`` or
        an output, each ``{ low = …, high = …, unit = "…" }``.
    file : str
        For messages.

    Raises
    ------
    CampaignError
        On anything malformed.
    """
    if not isinstance(table, Mapping):
        raise CampaignError("is no table", file=file, key="rig", value=table, hint="write [rig]")
    return {name: _limit(name, entry, file) for name, entry in table.items()}


def _limit(name: str, entry: Any, file: str) -> tuple[float, float]:
    key = f"rig.{name}"
    if not isinstance(entry, Mapping) or not {"low", "high"} & entry.keys():
        raise CampaignError("malformed limit", file=file, key=key, value=entry, hint=_EXAMPLE)
    for part, value in entry.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        right = isinstance(value, str) if part == "unit" else number and math.isfinite(value)
        if part not in _PARTS or not right:
            wrong = f"{key}.{part}"
            raise CampaignError("malformed limit", file=file, key=wrong, value=value, hint=_EXAMPLE)
    if "unit" not in entry:
        raise CampaignError("limit without unit", file=file, key=f"{key}.unit", hint=_EXAMPLE)
    return to_limit(name, entry.get("low"), entry.get("high"), entry["unit"], key, file)


def to_limit(
    name: str, low: float | None, high: float | None, unit: str, key: str, file: str | None = None
) -> tuple[float, float]:
    """A limit in SI from one as it is written.

    Parameters
    ----------
    name : str
        What it limits.
    low, high : float or None
        In ``unit``; None where there is none.
    unit : str
        Any that pint reads.
    key, file : str
        For messages.
    """
    try:
        read = parse_unit(unit)
    except CampaignError as error:
        raise CampaignError(
            error.problem, file=file, key=f"{key}.unit", value=unit, hint=error.hint
        ) from error
    if name == "frequency" and read.si_name != "Hz":
        raise CampaignError(
            "is no frequency", file=file, key=f"{key}.unit", value=unit, hint="write it in Hz"
        )
    if low is not None and high is not None and low > high:
        raise CampaignError(
            "limits are the wrong way round", file=file, key=key, value=[low, high], hint=_EXAMPLE
        )
    shift = 0.0 if name in _CHANGES else read.shift
    a = -math.inf if low is None else low * read.factor + shift
    return a, math.inf if high is None else high * read.factor + shift
