"""``campaign.toml`` as a whole: the campaign, its channels and its runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayesoleo.data.checked_table import (
    FILE,
    check_keys,
    choose,
    get_unit,
    get_value,
    load_table,
)
from bayesoleo.data.declared_run import RunDeclaration, read_runs
from bayesoleo.data.rig import read_rig
from bayesoleo.errors import CampaignError
from bayesoleo.units import parse_unit

FORMAT = 1

_TOP = ("format", "name", "description", "controlled", "dataset", "channels", "rig", "runs")
_CHANNEL = ("column", "unit", "scale", "offset", "accuracy", "bandwidth")


@dataclass(frozen=True)
class Channel:
    """A measured quantity and where it stands in the run files.

    Parameters
    ----------
    name : str
        As a model calls it.
    column : str
        Column or variable in the run files.
    unit, si_unit : str
        Unit in the files, and the SI unit of the loaded samples.
    scale : float
        Applied first to the values in the file.
    offset : float or str
        Added next, in ``unit``; ``-mean`` removes the run's mean after ``start`` and ``stop`` have
        cut it.
    accuracy : float, optional
        Systematic accuracy, two standard deviations, SI.
    bandwidth : float, optional
        Frequency up to which the channel counts as an input, Hz; infinite for all of it. Where it
        is not given the channel's spectrum decides.
    """

    name: str
    column: str
    unit: str
    si_unit: str
    scale: float = 1.0
    offset: float | str = 0.0
    accuracy: float | None = None
    bandwidth: float | None = None

    def to_si(self, values: np.ndarray) -> np.ndarray:
        """SI samples of a run from what its file holds: scale, offset, unit, in this order."""
        scaled = self.scale * values
        shifted = scaled - np.mean(scaled) if isinstance(self.offset, str) else scaled + self.offset
        return parse_unit(self.unit).to_si(shifted)


@dataclass(frozen=True)
class Declaration:
    """What ``campaign.toml`` says."""

    name: str
    description: str
    controlled: str | None
    dataset: str | None
    channels: Mapping[str, Channel]
    runs: tuple[RunDeclaration, ...]
    rig: Mapping[str, tuple[float, float]]


def read_declaration(path: Path) -> Declaration:
    """Read and check ``campaign.toml``.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    Declaration
        Its content.

    Raises
    ------
    CampaignError
        On anything missing, unknown or of the wrong kind.
    """
    table = load_table(path)
    check_keys(table, _TOP, None)
    if table.get("format") != FORMAT or isinstance(table.get("format"), bool):
        raise CampaignError(
            "unknown campaign format",
            file=FILE,
            key="format",
            value=table.get("format", "nothing"),
            hint=f"write format = {FORMAT}",
        )
    channels = _channels(
        get_value(table, "channels", dict, "a table [channels.<name>] for each channel")
    )
    runs = read_runs(get_value(table, "runs", list, "a table [[runs]] for each run"))
    controlled = get_value(table, "controlled", str, "a channel's name", default=None)
    if controlled is not None and controlled not in channels:
        raise CampaignError(
            "controlled channel is not declared",
            file=FILE,
            key="controlled",
            value=controlled,
            hint=choose(controlled, channels),
        )
    return Declaration(
        name=get_value(table, "name", str, "a name in quotes"),
        description=get_value(table, "description", str, "text in quotes", default=""),
        controlled=controlled,
        dataset=get_value(table, "dataset", str, "a registered set's name", default=None),
        channels=channels,
        runs=runs,
        rig=read_rig(table.get("rig", {}), FILE),
    )


def _channels(tables: Mapping[str, Any]) -> dict[str, Channel]:
    if not tables:
        raise CampaignError(
            "no channel is declared", file=FILE, key="channels", hint="write [channels.<name>]"
        )
    channels = {name: _channel(name, table) for name, table in tables.items()}
    _check_columns(channels)
    return channels


def _check_columns(channels: Mapping[str, Channel]) -> None:
    """Raise where two channels are one column: what is compared with itself is no measurement."""
    owner: dict[str, str] = {}
    for name, channel in channels.items():
        if channel.column in owner:
            raise CampaignError(
                f"is the column of channel {owner[channel.column]} already",
                file=FILE,
                key=f"channels.{name}.column",
                value=channel.column,
                hint="name the column that holds this channel, or leave one of the two out",
            )
        owner[channel.column] = name


def _channel(name: str, table: Any) -> Channel:
    inside = f"channels.{name}"
    if not isinstance(table, dict):
        raise CampaignError(
            "is no table", file=FILE, key=inside, value=table, hint=f"write [{inside}]"
        )
    check_keys(table, _CHANNEL, None, inside + ".")
    table = {f"{inside}.{key}": value for key, value in table.items()}
    unit = get_unit(
        name, get_value(table, f"{inside}.unit", str, "a unit in quotes"), f"{inside}.unit"
    )
    offset = table.get(f"{inside}.offset")
    if offset != "-mean":
        offset = get_value(table, f"{inside}.offset", float, "a number, or '-mean'", default=0.0)
    scale = get_value(table, f"{inside}.scale", float, "a number", default=1.0)
    accuracy = get_value(table, f"{inside}.accuracy", float, "a positive number", default=None)
    hint = "the highest frequency in Hz that counts as an input, or inf"
    bandwidth = table.get(f"{inside}.bandwidth")
    if bandwidth != np.inf:
        bandwidth = get_value(table, f"{inside}.bandwidth", float, hint, default=None)
    for key, value in (
        ("scale", scale != 0),
        ("accuracy", accuracy is None or accuracy > 0),
        ("bandwidth", bandwidth is None or bandwidth > 0),
    ):
        if not value:
            raise CampaignError("must not be zero or negative", file=FILE, key=f"{inside}.{key}")
    return Channel(
        name=name,
        column=get_value(table, f"{inside}.column", str, "a column of the run files"),
        unit=unit.name,
        si_unit=unit.si_name,
        scale=scale,
        offset=offset,
        accuracy=None if accuracy is None else accuracy * unit.factor,
        bandwidth=bandwidth,
    )
