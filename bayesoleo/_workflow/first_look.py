"""A first look at a folder of measurements: what ``bayesoleo init`` guesses and writes.

Columns, units, time, sampling, runs and frequencies are read off the files. What files cannot say
is written as a line that begins with ``TO FILL IN``. Nothing that exists is overwritten.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from bayesoleo._types import Array
from bayesoleo._units import SECOND_MEANINGS, check_kind, parse_unit
from bayesoleo._workflow.model_files import write_first_model
from bayesoleo.data._campaign import CampaignData, load_campaign
from bayesoleo.data._campaign_toml import FILE
from bayesoleo.data._files import read_file
from bayesoleo.data._reduction import reduce_campaign
from bayesoleo.data._residual_time_shift import guess_frequency
from bayesoleo.data._text_layout import (
    TIME_UNITS,
    FileColumns,
    is_time,
    time_unit,
    unit_in_name,
)
from bayesoleo.errors import BayesoleoError, CampaignError, number_of

MODEL, PICTURE = "model.py", "channels.png"
TO_FILL_IN = "TO FILL IN"
#: Endings and names of files that hold no run.
_OTHER = (".toml", ".py", ".md", ".png", ".jpg", ".svg", ".pdf", ".html", ".zip", ".docx", ".ipynb")
_ABOUT = re.compile(r"^(readme|licen[cs]e|source|notes?|changelog|results\.nc)", re.IGNORECASE)
#: Quantities by SI unit, as models call them.
_QUANTITIES = {
    "m": "displacement",
    "N": "force",
    "Pa": "pressure",
    "K": "temperature",
    "V": "voltage",
    "m/s": "velocity",
    "m/s²": "acceleration",
    "rad": "angle",
    "N*m": "torque",
    "A": "current",
}
#: Words in a column's name, the quantity, and the unit that is assumed where the file has none.
_WORDS = (
    (re.compile(r"force|load|kraft|last|^f\d*$|^fz", re.IGNORECASE), "force", "N"),
    (re.compile(r"disp|dist|stroke|pos|weg|travel|^x\d*$", re.IGNORECASE), "displacement", "mm"),
    (re.compile(r"press|druck|^p\d*$", re.IGNORECASE), "pressure", "bar"),
    (re.compile(r"temp", re.IGNORECASE), "temperature", "degC"),
    (re.compile(r"acc|beschl", re.IGNORECASE), "acceleration", "m/s**2"),
    (re.compile(r"angle|winkel|theta|phi", re.IGNORECASE), "angle", "rad"),
)
#: Samples that a run has at least, and columns that are taken for channels at most.
_FEWEST, _MOST = 20, 24
#: Of a time column whose name does not tell.
_EVEN = f"{TO_FILL_IN}: it increases evenly, and is taken for time in s; time_unit states another"
#: Units of two meanings: what pint reads and the names that tell it, the other and its names.
_FIRST_MASS = re.compile(r"mass|weight|gewicht", re.IGNORECASE)
_SECOND_ACCELERATION = re.compile(r"(?i:acc|beschl)|^[aA][xyzXYZ]?(_|\d|$)")
_MEANINGS = {
    "g": ("gram", _FIRST_MASS, "standard gravity", _SECOND_ACCELERATION),
    "mg": ("milligram", _FIRST_MASS, "a thousandth of standard gravity", _SECOND_ACCELERATION),
    "C": (
        "coulomb",
        re.compile(r"charge|ladung", re.IGNORECASE),
        "degree Celsius",
        re.compile(r"(?i:temp)|^T[a-z]{0,4}(_|\d|$)"),
    ),
}
#: Units of mass that stand for forces.
_AS_FORCE = {"lb": "lbf", "lbs": "lbf", "kg": "kgf", "g": "gf", "t": "tf"}


@dataclass(frozen=True)
class LookedAt:
    """A run file as the first look sees it.

    Parameters
    ----------
    file : str
        Relative to the folder.
    table : FileColumns
    time : str or None
        Column of time.
    seconds : ndarray, shape (N,)
        Times, s; of an unknown rate, sample numbers.
    rate : float or None
        Hz, where it does not follow from a time column and is known.
    source : str
        Where the times come from, in words.
    """

    file: str
    table: FileColumns
    time: str | None
    seconds: Array
    rate: float | None
    source: str


@dataclass(frozen=True)
class GuessedChannel:
    """A channel with the words that say how sure its unit is."""

    name: str
    column: str
    unit: str
    why: str
    known: bool


@dataclass(frozen=True)
class GuessedRun:
    """A run of a file: which part, and how it seems to move."""

    label: str
    look: LookedAt
    rows: slice
    segment: int | None
    frequency: float | None
    role: str
    problem: str = ""


@dataclass(frozen=True)
class Started:
    """What was found and written.

    Parameters
    ----------
    written : tuple of Path
        Files that are new.
    kept : tuple of Path
        Files that were there and are as they were.
    questions : tuple of str
        What has to be filled in, one sentence each.
    notes : tuple of str
        What was left out and why.
    campaign : CampaignData
        As it loads now.
    """

    written: tuple[Path, ...]
    kept: tuple[Path, ...]
    questions: tuple[str, ...]
    notes: tuple[str, ...]
    campaign: CampaignData


@dataclass
class _Draft:
    """What becomes ``campaign.toml``."""

    folder: Path
    channels: tuple[GuessedChannel, ...]
    runs: tuple[GuessedRun, ...]
    notes: list[str] = field(default_factory=list)


def start_campaign(
    folder: Path, *, progress: bool = False, callback: Callable[[str], None] = lambda _: None
) -> Started:
    """Look at the files of a folder; write a campaign and a model to start from.

    Parameters
    ----------
    folder : Path
        With the run files, in it or in folders of it.
    progress : bool, optional
        Whether to show bars of files that take long.
    callback : callable, optional
        Is told what is being done.

    Returns
    -------
    Started

    Raises
    ------
    CampaignError
        If there is a campaign already, or no file holds a record.
    """
    toml = folder / FILE
    if not folder.is_dir():
        raise CampaignError("no such folder", file=folder, hint="name the folder of the run files")
    if toml.exists():
        raise CampaignError(
            "there is a campaign already, which is not overwritten",
            file=toml,
            hint="rename it to start anew, or go on with bayesoleo check",
        )
    looks, notes = _look(folder, progress, callback)
    looks = _alike(looks, notes)
    channels = _channels(looks, notes)
    draft = _Draft(folder, channels, _runs(looks, channels, callback), notes)
    campaign = _written(draft, toml, callback)
    written, kept = [toml], []
    for name, write in ((MODEL, write_first_model), (PICTURE, _draw)):
        path = folder / name
        if path.exists():
            kept.append(path)
            continue
        write(campaign, path)
        written.append(path)
    questions = tuple(_questions(draft))
    return Started(tuple(written), tuple(kept), questions, tuple(draft.notes), campaign)


def _draw(campaign: CampaignData, path: Path) -> None:
    from bayesoleo.plots._runs import channels

    channels(campaign).savefig(path, dpi=130)


def _files(folder: Path) -> list[Path]:
    found = [*folder.iterdir(), *(p for d in folder.iterdir() if d.is_dir() for p in d.iterdir())]
    return sorted(
        path
        for path in found
        if path.is_file()
        and path.suffix.lower() not in _OTHER
        and not _ABOUT.match(path.name)
        and not any(part.startswith((".", "bayesoleo-")) for part in path.relative_to(folder).parts)
    )


def _look(
    folder: Path, progress: bool, callback: Callable[[str], None]
) -> tuple[list[LookedAt], list[str]]:
    looks, notes = [], []
    for path in _files(folder):
        file = path.relative_to(folder).as_posix()
        callback(f"looking at {file}")
        try:
            table = read_file(path, wanted=(), every=True, progress=progress)
            looks.append(_timed(file, table))
            notes += [f"column {name} was left out: {why}" for name, why in table.faults.items()]
        except BayesoleoError as error:
            notes.append(f"{file} was left out: {error}")
    if not looks:
        why = f": {notes[0]}" if notes else ""
        raise CampaignError(
            f"no file here holds a record{why}", file=folder, hint="name the folder of run files"
        )
    return looks, notes


def _timed(file: str, table: FileColumns) -> LookedAt:
    """Find the times of a file, or how it was sampled."""
    longest = max((values.size for values in table.columns.values()), default=0)
    if longest < _FEWEST:
        raise CampaignError(f"has {number_of(longest, 'sample')}", file=file)
    for name in sorted(table.columns, key=lambda n: not is_time(re.split(r"[/.]", n)[-1])):
        values = table.columns[name]
        unit = (table.units.get(name) or time_unit(name) or unit_in_name(name) or "").lower()
        named = is_time(re.split(r"[/.]", name)[-1]) or unit in TIME_UNITS
        named = named or re.search(r"time|zeit|stamp", name, re.IGNORECASE) is not None
        if named and values.size > _FEWEST and _increases(values):
            seconds = values * TIME_UNITS.get(unit, 1.0)
            source = f"column {name}" + (f", in {unit}" if unit in TIME_UNITS else ", taken as s")
            return LookedAt(file, table, name, seconds, None, source)
    rate, source = _stated_rate(table)
    even = None if rate and "states" in source else _even_column(table)
    if even is not None:
        return LookedAt(file, table, even, table.columns[even], None, _EVEN)
    sizes = [values.size for values in table.columns.values()]
    size = max(set(sizes), key=lambda n: (sizes.count(n), n))
    return LookedAt(file, table, None, np.arange(size) / (rate or 1.0), rate, source)


def _even_column(table: FileColumns) -> str | None:
    """A column that increases by equal steps, and does not merely count samples."""
    for name, values in table.columns.items():
        steps = np.diff(values)
        if values.size < _FEWEST or not np.all(steps > 0):
            continue
        if np.ptp(steps) < 0.02 * np.median(steps) and not np.allclose(steps, 1.0):
            return name
    return None


def _increases(values: Array) -> bool:
    """Whether times increase, but for restarts and an empty end."""
    filled = values[np.isfinite(values)]
    return filled.size > _FEWEST and float(np.mean(np.diff(filled) > 0)) > 0.98


def _stated_rate(table: FileColumns) -> tuple[float | None, str]:
    if table.sample_rate:
        return next(iter(table.sample_rate.values())), "as the file states"
    for name in ("fs", "Fs", "FS", "sampling freq", "sample_rate", "Ts", "dt", "Delta"):
        values = table.columns.get(name)
        one = values[np.isfinite(values)] if values is not None else np.empty(0)
        number = float(one[0]) if one.size == 1 else table.numbers.get(name)
        if number is not None and number > 0:
            short = name in ("Ts", "dt", "Delta")
            return (1 / number if short else number), f"from {name} = {number:g} of the file"
    return None, ""


def _alike(looks: list[LookedAt], notes: list[str]) -> list[LookedAt]:
    """The files that have the columns of most; the first one has no others."""
    kinds = [frozenset(look.table.columns) for look in looks]
    usual = max(set(kinds), key=lambda kind: (kinds.count(kind), -len(kind)))
    same = [look for look, kind in zip(looks, kinds, strict=True) if kind == usual]
    more = [look for look, kind in zip(looks, kinds, strict=True) if kind > usual]
    for look in looks:
        if not any(look is one for one in [*same, *more]):
            notes.append(f"{look.file} was left out: it has other columns than most files")
    return [*same, *more]


def _channels(looks: Sequence[LookedAt], notes: list[str]) -> tuple[GuessedChannel, ...]:
    """Channels: columns that vary in every file, with as many samples as there are times."""
    first = looks[0]
    kinds = [_unit_of(c, first.table)[3] for c in first.table.columns if not _no_channel(c, looks)]
    alone = {kind for kind in kinds if kinds.count(kind) == 1}
    found: list[GuessedChannel] = []
    for column in first.table.columns:
        reason = _no_channel(column, looks)
        if reason:
            if column != first.time and f"from {column} =" not in first.source:
                notes.append(f"column {column} was left out: {reason}")
        elif len(found) < _MOST:
            found.append(_channel(column, first.table, [one.name for one in found], alone))
        else:
            notes.append(f"column {column} was left out: there are {_MOST} channels already")
    if not found:
        raise CampaignError("no column varies", file=first.file, hint="check what was recorded")
    return tuple(found)


def _no_channel(column: str, looks: Sequence[LookedAt]) -> str:
    """Why a column is no channel; empty if it is one."""
    if column == looks[0].time:
        return "it is time"
    for look in looks:
        values = look.table.columns[column]
        if values.size != look.seconds.size:
            samples = number_of(values.size, "sample")
            return f"{samples} in {look.file}, where most have {look.seconds.size}"
        finite = values[np.isfinite(values)]
        if finite.size < 0.5 * values.size:
            return f"it is more than half empty in {look.file}"
        if np.ptp(finite) == 0:
            return f"it is constant in {look.file}"
        steps = np.diff(finite)
        if np.all(steps == 1):
            return "it counts samples"
        if np.all(steps > 0) and np.ptp(steps) < 0.02 * np.median(steps):
            return "it increases evenly, as a time does"
    return ""


def _unit_of(column: str, table: FileColumns) -> tuple[str, str, bool, str]:
    """Unit, what it follows from, whether it is known, and the quantity that it measures."""
    stated = table.units.get(column)
    unit = stated or unit_in_name(column) or ""
    why = "as the file states" if stated else f"from the column's name {column}"
    word = next((w for w in _WORDS if w[0].search(_bare_name(column))), None)
    if unit and word and word[1] == "force" and unit in _AS_FORCE:
        guess = _AS_FORCE[unit]
        why = f"{TO_FILL_IN}: {unit} is a mass; {guess} is assumed"
        return guess, why, False, "force"
    known = True
    if unit in _MEANINGS:
        unit, why, known = _of_two_meanings(unit, _bare_name(column), why)
    if unit and _parses(unit):
        return unit, why, known, _QUANTITIES.get(parse_unit(unit).si_name, "")
    why = f"{TO_FILL_IN}: the file does not say the unit of {column}"
    if word is None:
        return "1", why, False, ""
    return word[2], f"{why}; {word[2]} is assumed", False, word[1]


def _of_two_meanings(unit: str, name: str, why: str) -> tuple[str, str, bool]:
    """The unit that a column's name tells, what it follows from, and whether it is known."""
    first, names_first, second, names_second = _MEANINGS[unit]
    other = SECOND_MEANINGS[unit]
    if names_second.search(name):
        return other, f"{why}; {other} is {second}", True
    if names_first.search(name):
        return unit, why, True
    return other, f"{TO_FILL_IN}: {first} or {second}? {other}, {second}, is assumed", False


def _channel(
    column: str, table: FileColumns, taken: Sequence[str], alone: Collection[str]
) -> GuessedChannel:
    """A channel; it has the name of its quantity where it is the only one of its kind."""
    unit, why, known, quantity = _unit_of(column, table)
    name = quantity if quantity in alone and quantity else _identifier(column)
    while name in taken or not _fits(name, unit):
        name += "_signal" if name not in taken else "_2"
    return GuessedChannel(name, column, unit, why, known)


def _parses(unit: str) -> bool:
    try:
        parse_unit(unit)
    except CampaignError:
        return False
    return True


def _fits(name: str, unit: str) -> bool:
    """Whether a channel of this name may have this unit: a name that ends in force must."""
    try:
        check_kind(name, parse_unit(unit))
    except CampaignError:
        return False
    return True


def _bare_name(column: str) -> str:
    """A column's name without group, brackets and unit."""
    last = re.split(r"[/.]", column)[-1] if not re.search(r"[\[(]", column) else column
    last = re.sub(r"[\[(][^\]):]*[\])]", "", last).strip()
    unit = unit_in_name(column)
    return re.sub(rf"[ _/]{re.escape(unit)}$", "", last) if unit else last


def _identifier(column: str) -> str:
    word = re.sub(r"\W+", "_", _bare_name(column), flags=re.ASCII).strip("_")
    if not word:
        word = re.sub(r"\W+", "_", column, flags=re.ASCII).strip("_")
    return word if word and not word[0].isdigit() else f"channel_{word or 'x'}"


def _runs(
    looks: Sequence[LookedAt],
    channels: Sequence[GuessedChannel],
    callback: Callable[[str], None],
) -> tuple[GuessedRun, ...]:
    runs: list[GuessedRun] = []
    for look in looks:
        parts = _segments(look.seconds)
        for number, rows in enumerate(parts, 1):
            segment = number if len(parts) > 1 else None
            label = _label(look.file, looks) + (f" {segment}" if segment else "")
            callback(f"looking for the period of {label}")
            values = np.array([look.table.columns[c.column][rows] for c in channels])
            frequency = guess_frequency(values, look.seconds[rows])
            runs.append(GuessedRun(label, look, rows, segment, frequency, "fit"))
    if len(runs) >= 3:  # the last one, so that predictions can be compared with a run not fitted
        runs[-1] = replace(runs[-1], role="hold-out")
    return tuple(runs)


def _segments(seconds: Array) -> list[slice]:
    """Parts between restarts of time."""
    filled = np.flatnonzero(np.isfinite(seconds))
    last = int(filled[-1]) + 1 if filled.size else 0
    restarts = np.flatnonzero(np.diff(seconds[:last]) < 0) + 1
    ends = [0, *restarts.tolist(), last]
    parts = [slice(a, b) for a, b in pairwise(ends)]
    return parts if all(p.stop - p.start >= _FEWEST for p in parts) else [slice(0, last)]


def _label(file: str, looks: Sequence[LookedAt]) -> str:
    stems = [Path(look.file).with_suffix("").as_posix() for look in looks]
    stem = Path(file).with_suffix("").as_posix()
    return stem if stems.count(stem) == 1 else file


def _written(draft: _Draft, toml: Path, callback: Callable[[str], None]) -> CampaignData:
    """Write the campaign so that it loads: what cannot be used is left out, with the reason."""
    try:
        while True:
            toml.write_text(_toml(draft), encoding="utf-8")
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    loaded = load_campaign(toml.parent)
            except CampaignError as error:
                if not _left_out(draft, error):
                    raise
                continue
            callback("checking the frequencies")
            if not _frequencies_checked(draft, loaded):
                return loaded
    except BaseException:
        toml.unlink(missing_ok=True)
        raise


def _left_out(draft: _Draft, error: CampaignError) -> bool:
    """Leave out the run that cannot be loaded; whether there is one, and others are left."""
    rest = tuple(run for run in draft.runs if run.label != error.run)
    if len(rest) == len(draft.runs) or not rest:
        return False
    draft.runs = rest
    draft.notes.append(f"run {error.run} was left out: {error}")
    return True


def _frequencies_checked(draft: _Draft, loaded: CampaignData) -> bool:
    """Declare as transients the runs that do not repeat; whether there are any."""
    changed = []
    for run in draft.runs:
        if run.frequency is None:
            continue
        alone = replace(loaded, runs=(loaded.run(run.label),))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                reduce_campaign(alone)
        except CampaignError as error:
            draft.notes.append(f"run {run.label} is declared as a transient: {error.problem}")
            changed.append(run.label)
    draft.runs = tuple(
        replace(run, frequency=None) if run.label in changed else run for run in draft.runs
    )
    return bool(changed)


def _questions(draft: _Draft) -> list[str]:
    """What the files do not say."""
    found = [
        f"channels.{c.name}.unit: the unit of column {c.column}; {c.unit!r} stands there now"
        for c in draft.channels
        if not c.known
    ]
    if any(run.look.source == _EVEN for run in draft.runs):
        found.append(f"time: column {draft.runs[0].look.time} is taken for time in seconds")
    unknown = [run.label for run in draft.runs if run.look.time is None and run.look.rate is None]
    if unknown:
        found.append(f"sample_rate of run {', '.join(unknown[:4])}: 1.0 Hz stands there now")
    if len(draft.channels) > 1:
        found.append("controlled: the channel that the rig controls, which drives the model")
    return found


def _toml(draft: _Draft) -> str:
    """The campaign's text."""
    name = draft.folder.resolve().name
    lines = [
        "# Written by bayesoleo init after a look at the files. Lines with",
        f"# {TO_FILL_IN} hold what the files do not say; guesses say what they come from.",
        "format = 1",
        f"name = {_quoted(name)}",
        'description = ""',
    ]
    if len(draft.channels) > 1:
        names = ", ".join(c.name for c in draft.channels)
        lines.append(f"# {TO_FILL_IN}: the channel that the rig controls: {names}")
        lines.append(f"# controlled = {_quoted(draft.channels[0].name)}")
    for channel in draft.channels:
        lines += ["", *_channel_lines(channel, draft.runs[0])]
    for run in draft.runs:
        lines += ["", *_run_lines(run)]
    lines += ["", *(f"# {' '.join(note.split())}" for note in draft.notes)]
    return "\n".join(lines).rstrip() + "\n"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _channel_lines(channel: GuessedChannel, run: GuessedRun) -> list[str]:
    values = run.look.table.columns[channel.column][run.rows]
    low, high = np.nanmin(values), np.nanmax(values)
    return [
        f"[channels.{channel.name}]",
        f"column = {_quoted(channel.column)}",
        f"unit = {_quoted(channel.unit)}  # {channel.why}",
        f"# from {low:.4g} to {high:.4g} in run {run.label}",
    ]


def _run_lines(run: GuessedRun) -> list[str]:
    look = run.look
    lines = ["[[runs]]", f"label = {_quoted(run.label)}", f"file = {_quoted(look.file)}"]
    if run.segment is not None:
        lines.append(f"segment = {run.segment}  # time starts anew in this file")
    if look.time is not None:
        lines.append(f"time = {_quoted(look.time)}  # {look.source}")
    elif look.rate is not None:
        lines.append(f"sample_rate = {look.rate:.12g}  # {look.source}")
    else:
        lines.append(f"sample_rate = 1.0  # {TO_FILL_IN}: the sampling rate in Hz")
    if run.frequency is None:
        lines.append('kind = "transient"  # it does not repeat; a periodic run has a frequency')
    else:
        lines.append('kind = "periodic"')
        lines.append(f"frequency = {run.frequency:g}  # Hz, where the channels repeat")
    folder = Path(look.file).parent.as_posix()
    if folder != ".":
        lines.append(f"group = {_quoted(folder)}  # its folder")
    lines.append(f"role = {_quoted(run.role)}  # or {_other_role(run.role)}")
    return lines


def _other_role(role: str) -> str:
    if role == "fit":
        return '"hold-out", to be predicted and not fitted'
    return '"fit"; it is not fitted, so that predictions can be compared with it'
