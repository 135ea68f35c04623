"""The file ``campaign.toml``: every table and key is checked.

An unknown key is an error, so that a misspelt key does not silently become a default. The tables
describe the campaign, its channels, its runs and, in ``[rig]``, the limits of a future run.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any, cast

import numpy as np

from bayesoleo._units import Unit, check_kind, parse_unit
from bayesoleo.data._sample_quality import Stretches, read_stretches
from bayesoleo.data._text_layout import TIME_UNITS
from bayesoleo.errors import CampaignError, choose

FILE = "campaign.toml"

_PARTS = ("low", "high", "unit")
_EXAMPLE = 'write { low = 1, high = 50, unit = "mm" }, or one of low and high'
#: Sizes of a change: the zero of their unit is zero.
_CHANGES = ("amplitude", "rate")
KINDS = ("periodic", "transient")
ROLES = ("fit", "hold-out")
_RUN = (
    *("label", "file", "kind", "frequency", "group", "role", "time", "sample_rate"),
    *("time_unit", "start", "stop", "rows", "segment", "mask", "columns", "delimiter"),
    *("header_delimiter", "encoding", "conditions"),
)
_CONDITION = ("value", "unit", "sd")
FORMAT = 1
_TOP = (
    *("format", "name", "description", "controlled", "dataset", "outside_files", "channels"),
    *("rig", "runs"),
)
_CHANNEL = ("column", "unit", "scale", "offset", "accuracy", "bandwidth", "held")


def load_table(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise _no_campaign(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CampaignError(
            f"not valid TOML: {error}", file=path.name, hint=_slip(path, str(error))
        ) from error
    _check_texts(table)
    return table


def _check_texts(table: Mapping[str, Any], run: str | None = None) -> None:
    """Refuse null characters in keys and texts: netCDF cannot keep them."""
    for key, value in table.items():
        items = value if isinstance(value, list) else [value]
        if any("\0" in text for text in (key, *items) if isinstance(text, str)):
            raise CampaignError(
                "text holds a null character", file=FILE, run=run, key=key, value=value,
                hint="leave it out",
            )  # fmt: skip
        for item in items:
            if isinstance(item, Mapping):
                _check_texts(item, str(item.get("label", run)) if key == "runs" else run)


def _slip(path: Path, problem: str) -> str | None:
    """What to write in a line that holds text without quotes."""
    place = re.search(r"at line (\d+)", problem)
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    line = lines[int(place[1]) - 1] if place and int(place[1]) <= len(lines) else ""
    key, _, value = (part.strip() for part in line.partition("="))
    if re.match(r"[^\s\"'\[{#]*[A-Za-z]", value) and value not in ("true", "false"):
        return f'text needs quotes: {key} = "{value}"'
    number = re.match(r"([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*[A-Za-z/%°]+$", value)
    if number:
        return f"a number stands alone: {key} = {number[1]}"
    return None


def _no_campaign(path: Path) -> CampaignError:
    """What is there instead of the file, or how far its path leads."""
    hint, folder = f"a campaign is a folder with a {FILE}", path.parent
    if folder.is_file():
        return CampaignError("is a file; a folder is expected", file=folder, hint=hint)
    if not folder.exists():
        return CampaignError("no such folder", file=folder, hint=hint)
    return CampaignError("no such file", file=path, hint=hint)


def get_value(
    table: Mapping[str, Any],
    key: str,
    kind: type,
    hint: str,
    run: str | None = None,
    **default: Any,
) -> Any:
    """A value of the expected kind; ``default=`` makes it optional."""
    if key not in table:
        if "default" in default:
            return default["default"]
        raise CampaignError("missing", file=FILE, run=run, key=key, hint=f"write {hint}")
    value = table[key]
    good = isinstance(value, Real) if kind is float else isinstance(value, kind)
    odd = isinstance(value, bool) and kind is not bool
    if odd or not good or (kind is float and not np.isfinite(value)):
        raise CampaignError(
            "wrong kind of value", file=FILE, run=run, key=key, value=value, hint=f"write {hint}"
        )
    return float(value) if kind is float else value


def check_keys(
    table: Mapping[str, Any], allowed: Sequence[str], run: str | None, inside: str = ""
) -> None:
    for key in table:
        if key not in allowed:
            raise CampaignError(
                "unknown key", file=FILE, run=run, key=inside + key, hint=choose(key, allowed)
            )


def get_unit(name: str, text: str, key: str, run: str | None = None) -> Unit:
    """Parse a unit and add where it stood to what is wrong with it."""
    try:
        unit = parse_unit(text)
        check_kind(name, unit)
    except CampaignError as error:
        raise CampaignError(
            error.problem, file=FILE, run=run, key=key, value=error.value, hint=error.hint
        ) from error
    return unit


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


@dataclass(frozen=True)
class RunDeclaration:
    """What ``campaign.toml`` says about a run; times in s, conditions SI."""

    label: str
    file: str
    kind: str
    frequency: float | None
    group: str
    role: str
    time: str | None
    sample_rate: float | None
    start: float | None
    stop: float | None
    mask: Stretches
    delimiter: str | None
    header_delimiter: str | None
    encoding: str | None
    time_unit: str | None
    rows: tuple[int, int] | None
    segment: int | tuple[str, float] | None
    columns: Mapping[str, str]
    conditions: Mapping[str, float]
    condition_units: Mapping[str, str]
    condition_sd: Mapping[str, float]


def read_runs(tables: Sequence[Any], channels: Sequence[str]) -> tuple[RunDeclaration, ...]:
    runs: list[RunDeclaration] = []
    for number, table in enumerate(tables, 1):
        if not isinstance(table, dict):
            raise CampaignError(
                "is no table", file=FILE, key="runs", value=table, hint="write [[runs]]"
            )
        run = _run(table, f"number {number}", channels)
        if run.label in {other.label for other in runs}:
            raise CampaignError(
                "two runs have this label", file=FILE, run=run.label, key="label", hint="rename one"
            )
        runs.append(run)
    if not runs:
        raise CampaignError("no run is declared", file=FILE, key="runs", hint="write [[runs]]")
    return tuple(runs)


def _run(table: Mapping[str, Any], place: str, channels: Sequence[str]) -> RunDeclaration:
    label = get_value(table, "label", str, "a name in quotes", run=place)
    check_keys(table, _RUN, label)

    def text(key: str, **default: Any) -> Any:
        return get_value(table, key, str, "text in quotes", run=label, **default)

    def number(key: str, positive: bool = False) -> float | None:
        value = get_value(table, key, float, "a number", run=label, default=None)
        if positive and value is not None and value <= 0:
            raise CampaignError(
                "must be positive",
                file=FILE,
                run=label,
                key=key,
                value=value,
                hint="write it in Hz",
            )
        return cast(float | None, value)

    kind = _one_of(text("kind", default="periodic"), KINDS, "kind", label)
    run = RunDeclaration(
        label=label,
        file=text("file"),
        kind=kind,
        frequency=number("frequency", positive=True),
        group=text("group", default=""),
        role=_one_of(text("role", default="fit"), ROLES, "role", label),
        time=None if "time" not in table else column_name(table["time"], "time", label),
        sample_rate=number("sample_rate", positive=True),
        start=number("start"),
        stop=number("stop"),
        mask=read_stretches(table.get("mask", []), label, FILE),
        delimiter=text("delimiter", default=None),
        header_delimiter=text("header_delimiter", default=None),
        encoding=text("encoding", default=None),
        time_unit=text("time_unit", default=None),
        rows=_rows(table.get("rows"), label),
        segment=_segment(table.get("segment"), label),
        columns=_run_columns(table.get("columns", {}), label, channels),
        **_conditions(table, label),
    )
    _check_consistent(run)
    return run


def column_name(value: Any, key: str, run: str | None = None) -> str:
    """Name of a column; a whole number counts columns of a file without names, from one."""
    if (isinstance(value, str) and value) or (type(value) is int and value > 0):
        return str(value)
    raise CampaignError(
        "is no column",
        file=FILE,
        run=run,
        key=key,
        value=value,
        hint="write its name in quotes, or its number where the file has no names",
    )


def _rows(value: Any, run: str) -> tuple[int, int] | None:
    """First and last row of values, from one, both included."""
    if value is None:
        return None
    whole = isinstance(value, list) and len(value) == 2 and all(type(v) is int for v in value)
    if not whole or not 1 <= value[0] < value[1]:
        raise CampaignError(
            "must be the first and the last row",
            file=FILE,
            run=run,
            key="rows",
            value=value,
            hint="write rows = [1, 5000]; rows of values are counted from 1",
        )
    return value[0], value[1]


def _segment(value: Any, run: str) -> int | tuple[str, float] | None:
    """A part between restarts of time, counted from one, or a column and its value."""
    if value is None or (type(value) is int and value > 0):
        return value
    if isinstance(value, Mapping) and set(value) == {"column", "value"}:
        number = value["value"]
        if isinstance(number, int | float) and not isinstance(number, bool):
            return column_name(value["column"], "segment.column", run), float(number)
    raise CampaignError(
        "is no part of a file",
        file=FILE,
        run=run,
        key="segment",
        value=value,
        hint="write segment = 2 for the part after time first starts anew, or "
        'segment = { column = "run", value = 2 }',
    )


def _run_columns(table: Any, run: str, channels: Sequence[str]) -> dict[str, str]:
    """Columns of a run that differ from those of its channels."""
    if not isinstance(table, Mapping):
        raise CampaignError(
            "is no table",
            file=FILE,
            run=run,
            key="columns",
            value=table,
            hint='write columns = { force = "force 2" }',
        )
    for name in table:
        if name not in channels:
            raise CampaignError(
                "no such channel",
                file=FILE,
                run=run,
                key=f"columns.{name}",
                hint=choose(name, channels),
            )
    return {name: column_name(value, f"columns.{name}", run) for name, value in table.items()}


def _one_of(value: str, allowed: Sequence[str], key: str, run: str) -> str:
    if value not in allowed:
        raise CampaignError(
            f"unknown {key}", file=FILE, run=run, key=key, value=value, hint=choose(value, allowed)
        )
    return value


def _check_consistent(run: RunDeclaration) -> None:
    problem: tuple[str, str, object, str] | None = None
    if run.kind == "periodic" and run.frequency is None:
        problem = (
            "periodic run without frequency",
            "frequency",
            None,
            "write it in Hz, or kind = 'transient'",
        )
    elif run.kind == "transient" and run.frequency is not None:
        problem = ("transient run with a frequency", "frequency", run.frequency, "leave it out")
    elif run.time is not None and run.sample_rate is not None:
        problem = (
            "time and sample_rate are both given",
            "sample_rate",
            run.sample_rate,
            "leave one out",
        )
    elif run.time_unit is not None and run.time_unit not in TIME_UNITS:
        problem = (
            "is no unit of time",
            "time_unit",
            run.time_unit,
            f"write one of: {', '.join(TIME_UNITS)}",
        )
    elif run.rows is not None and run.segment is not None:
        problem = ("rows and segment are both given", "segment", run.segment, "leave one out")
    elif run.start is not None and run.stop is not None and run.stop <= run.start:
        problem = ("stop is not after start", "stop", run.stop, "write both in seconds")
    if problem is not None:
        text, key, value, hint = problem
        raise CampaignError(text, file=FILE, run=run.label, key=key, value=value, hint=hint)


def _conditions(table: Mapping[str, Any], label: str) -> dict[str, dict[str, Any]]:
    conditions = get_value(
        table, "conditions", dict, "a table [runs.conditions]", run=label, default={}
    )
    values, units, sds = {}, {}, {}
    for name, entry in conditions.items():
        key = f"conditions.{name}"
        if not isinstance(entry, dict):
            raise CampaignError(
                "malformed condition",
                file=FILE,
                run=label,
                key=key,
                value=entry,
                hint="write { value = 4.9, unit = 'bar' }",
            )
        check_keys(entry, _CONDITION, label, key + ".")
        entry = {f"{key}.{part}": value for part, value in entry.items()}
        unit = get_unit(
            name,
            get_value(entry, f"{key}.unit", str, "a unit in quotes", run=label),
            f"{key}.unit",
            label,
        )
        values[name] = float(
            unit.to_si(get_value(entry, f"{key}.value", float, "a number", run=label))
        )
        units[name] = unit.si_name
        sd = get_value(entry, f"{key}.sd", float, "a positive number", run=label, default=None)
        if sd is not None and sd <= 0:
            raise CampaignError("must be positive", file=FILE, run=label, key=f"{key}.sd", value=sd)
        if sd is not None:
            sds[name] = sd * unit.factor
    return {"conditions": values, "condition_units": units, "condition_sd": sds}


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
    held : bool
        Whether its value is held from one sample to the next where it is an input.
    """

    name: str
    column: str
    unit: str
    si_unit: str
    scale: float = 1.0
    offset: float | str = 0.0
    accuracy: float | None = None
    bandwidth: float | None = None
    held: bool = False

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
    outside_files: bool
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
    runs = read_runs(
        get_value(table, "runs", list, "a table [[runs]] for each run"), list(channels)
    )
    outside = table.get("outside_files", False)
    if not isinstance(outside, bool):
        raise CampaignError(
            "wrong kind of value",
            file=FILE,
            key="outside_files",
            value=outside,
            hint="write true or false, without quotes",
        )
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
        outside_files=outside,
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


def _declared_column(table: Mapping[str, Any], key: str) -> str:
    if key not in table:
        raise CampaignError("missing", file=FILE, key=key, hint="write a column of the run files")
    return column_name(table[key], key)


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
        column=_declared_column(table, f"{inside}.column"),
        unit=unit.name,
        si_unit=unit.si_name,
        scale=scale,
        offset=offset,
        accuracy=None if accuracy is None else accuracy * unit.factor,
        bandwidth=bandwidth,
        held=get_value(table, f"{inside}.held", bool, "true or false", default=False),
    )
