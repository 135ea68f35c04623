"""Writing of campaigns in the raw format, so that simulated data are read like measured data."""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bayesoleo._types import Array, Float
from bayesoleo._units import parse_unit
from bayesoleo.data._campaign_toml import FILE, FORMAT
from bayesoleo.errors import CampaignError

TIME_COLUMN = "time_s"
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_PLAIN_FILE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


@dataclass(frozen=True)
class SimulatedRun:
    """A run to write.

    Parameters
    ----------
    label : str
        Unique in its campaign.
    time : ndarray, shape (N,)
        Equidistant sample times, s.
    samples : mapping of str to ndarray, shape (N,)
        Each channel, SI.
    frequency : float, optional
        Approximate frequency, Hz; None for a transient.
    group, role, kind : str
        As in ``campaign.toml``.
    conditions : mapping of str to tuple
        ``(value, unit)`` or ``(value, unit, sd)`` of each known constant, in that unit.
    mask : sequence of (float, float)
        Stretches that are not to count, from and to, s.
    """

    label: str
    time: Float[Array, " samples"]
    samples: Mapping[str, Float[Array, " samples"]]
    frequency: float | None = None
    group: str = ""
    role: str = "fit"
    kind: str = "periodic"
    conditions: Mapping[str, tuple[float, str] | tuple[float, str, float]] = field(
        default_factory=dict
    )
    mask: Sequence[tuple[float, float]] = ()


def write_campaign(
    folder: str | os.PathLike[str],
    *,
    name: str,
    channels: Mapping[str, tuple[str, str]],
    runs: Sequence[SimulatedRun],
    description: str = "",
    controlled: str | None = None,
    overwrite: bool = False,
) -> Path:
    """Write ``campaign.toml`` and one CSV file a run; :func:`load_campaign` reads them back.

    Parameters
    ----------
    folder : path-like
        Made if it is not there.
    name, description : str
        Of the campaign.
    channels : mapping of str to (str, str)
        Column and unit in the files, by channel.
    runs : sequence of SimulatedRun
        With samples in SI.
    controlled : str, optional
        The channel that the rig controls.
    overwrite : bool
        Write into a folder that holds files.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    CampaignError
        If the folder holds files, or something cannot be written so that it reads back.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())) and not overwrite:
        raise CampaignError(
            "folder is not empty", file=folder, hint="choose another, or pass overwrite=True"
        )
    _check_columns(channels)
    files = _file_names([run.label for run in runs])
    folder.mkdir(parents=True, exist_ok=True)
    for run, file in zip(runs, files, strict=True):
        _write_samples(folder / file, run, channels)
    text = _head(name, description, controlled, channels)
    text += "".join(_run_table(run, file) for run, file in zip(runs, files, strict=True))
    # Last, so that a campaign.toml never stands for runs that are not written yet.
    (folder / FILE).write_text(text, encoding="utf-8", newline="\n")
    return folder


def _check_columns(channels: Mapping[str, tuple[str, str]]) -> None:
    taken = {TIME_COLUMN}
    for channel, (column, unit) in channels.items():
        parse_unit(unit)
        clean = column.strip() == column and not re.search(r'[",\n\r]|^#|^$', column)
        if not clean or column in taken or not column.isprintable():
            raise CampaignError(
                f"channel {channel!r} needs a column name of its own, without commas or quotes",
                column=column,
                hint="write one such as stroke_mm",
            )
        taken.add(column)


def _file_names(labels: Sequence[str]) -> list[str]:
    """A file for each label; labels that make poor or equal file names are numbered instead."""
    if len(set(labels)) < len(labels):
        twice = next(label for label in labels if list(labels).count(label) > 1)
        raise CampaignError("two runs have this label", run=twice, hint="rename one")
    plain = all(_PLAIN_FILE.fullmatch(label) for label in labels)
    # Some file systems hold A.csv and a.csv to be one file.
    if plain and len({label.lower() for label in labels}) == len(labels):
        return [f"{label}.csv" for label in labels]
    return [f"run-{number:03d}.csv" for number in range(1, len(labels) + 1)]


def _write_samples(path: Path, run: SimulatedRun, channels: Mapping[str, tuple[str, str]]) -> None:
    columns = [np.asarray(run.time, dtype=float)]
    for channel, (column, unit) in channels.items():
        if channel not in run.samples or np.shape(run.samples[channel]) != np.shape(run.time):
            raise CampaignError(
                f"channel {channel!r} has no sample for every time", run=run.label, column=column
            )
        columns.append(parse_unit(unit).from_si(run.samples[channel]))
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([TIME_COLUMN, *(column for column, _ in channels.values())])
        # Python floats print the shortest digits that read back to the same number.
        writer.writerows(np.column_stack(columns).tolist())


def _head(
    name: str, description: str, controlled: str | None, channels: Mapping[str, tuple[str, str]]
) -> str:
    lines = [f"format = {FORMAT}", f"name = {_string(name)}"]
    lines.append(f"description = {_string(description)}")
    if controlled is not None:
        lines.append(f"controlled = {_string(controlled)}")
    for channel, (column, unit) in channels.items():
        lines += ["", f"[channels.{_key(channel)}]"]
        lines += [f"column = {_string(column)}", f"unit = {_string(unit)}"]
    return "\n".join(lines) + "\n"


def _run_table(run: SimulatedRun, file: str) -> str:
    lines = ["", "[[runs]]", f"label = {_string(run.label)}", f"file = {_string(file)}"]
    lines.append(f"kind = {_string(run.kind)}")
    if run.frequency is not None:
        lines.append(f"frequency = {float(run.frequency)!r}")
    lines += [f"group = {_string(run.group)}", f"role = {_string(run.role)}"]
    if run.mask:
        lines.append(f"mask = {[[float(first), float(last)] for first, last in run.mask]}")
    if run.conditions:
        lines.append("[runs.conditions]")
    for name, (value, unit, *sd) in run.conditions.items():
        entry = f"value = {float(value)!r}, unit = {_string(str(unit))}"
        entry += f", sd = {float(sd[0])!r}" if sd else ""
        lines.append(f"{_key(name)} = {{ {entry} }}")
    return "\n".join(lines) + "\n"


def _string(text: str) -> str:
    """TOML basic string. JSON escapes the same way, but for the delete character."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(text: str) -> str:
    return text if _BARE_KEY.fullmatch(text) else _string(text)
