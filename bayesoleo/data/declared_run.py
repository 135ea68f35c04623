"""What ``campaign.toml`` says about a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from bayesoleo.data.checked_table import FILE, check_keys, choose, get_unit, get_value
from bayesoleo.data.gaps import Stretches, read_stretches
from bayesoleo.errors import CampaignError

KINDS = ("periodic", "transient")
ROLES = ("fit", "hold-out")

_RUN = (
    *("label", "file", "kind", "frequency", "group", "role", "time", "sample_rate"),
    *("start", "stop", "mask", "delimiter", "header_delimiter", "conditions"),
)
_CONDITION = ("value", "unit", "sd")


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
    conditions: Mapping[str, float]
    condition_units: Mapping[str, str]
    condition_sd: Mapping[str, float]


def read_runs(tables: Sequence[Any]) -> tuple[RunDeclaration, ...]:
    runs: list[RunDeclaration] = []
    for number, table in enumerate(tables, 1):
        if not isinstance(table, dict):
            raise CampaignError(
                "is no table", file=FILE, key="runs", value=table, hint="write [[runs]]"
            )
        run = _run(table, f"number {number}")
        if run.label in {other.label for other in runs}:
            raise CampaignError(
                "two runs have this label", file=FILE, run=run.label, key="label", hint="rename one"
            )
        runs.append(run)
    if not any(run.role == "fit" for run in runs):
        raise CampaignError(
            "no run to fit", file=FILE, key="role", hint="give one run or more role = 'fit'"
        )
    return tuple(runs)


def _run(table: Mapping[str, Any], place: str) -> RunDeclaration:
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
        time=text("time", default=None),
        sample_rate=number("sample_rate", positive=True),
        start=number("start"),
        stop=number("stop"),
        mask=read_stretches(table.get("mask", []), label, FILE),
        delimiter=text("delimiter", default=None),
        header_delimiter=text("header_delimiter", default=None),
        **_conditions(table, label),
    )
    _check_consistent(run)
    return run


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
