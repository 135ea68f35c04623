"""Campaigns: a folder with ``campaign.toml`` and files of runs, loaded in SI, checked and written.

A registered data set is a folder of the user's, or a verified download. Campaigns are written in
the raw format, so that simulated data are read like measured data.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bayesoleo._parallel import single_blas_thread
from bayesoleo._types import Array, Float
from bayesoleo._units import parse_unit
from bayesoleo.data._campaign_toml import (
    FILE,
    FORMAT,
    Channel,
    Declaration,
    RunDeclaration,
    read_declaration,
)
from bayesoleo.data._files import read_file
from bayesoleo.data._run_samples import LoadedRun, Run, columns_of, load_run
from bayesoleo.data._text_layout import FileColumns
from bayesoleo.errors import CampaignError, check_path, choose, import_extra


@dataclass(frozen=True)
class CampaignData:
    """A loaded campaign.

    Parameters
    ----------
    name, description : str
        As declared.
    controlled : str or None
        The channel that the rig controls.
    path : Path
        Folder of ``campaign.toml``.
    channels : mapping of str to Channel
        Declared channels by name.
    runs : tuple of Run
        In the order declared.
    sha256 : str
        Of ``campaign.toml`` and all run files, in the order of the runs.
    rig : mapping of str to (float, float)
        Limits of the rig in a further run, SI, infinite where there is none.
    """

    name: str
    description: str
    controlled: str | None
    path: Path
    channels: Mapping[str, Channel]
    runs: tuple[Run, ...]
    sha256: str
    rig: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def units(self) -> dict[str, str]:
        """SI unit of each channel."""
        return {name: channel.si_unit for name, channel in self.channels.items()}

    def run(self, label: str) -> Run:
        """The run with this label.

        Parameters
        ----------
        label : str
            As declared.

        Raises
        ------
        CampaignError
            If no run has this label; the message lists the labels.
        """
        for run in self.runs:
            if run.label == label:
                return run
        raise CampaignError(
            "no such run", run=label, hint=choose(label, [run.label for run in self.runs])
        )


@single_blas_thread()  # more threads add in another order, and the checksum of times would differ
def load_campaign(path: str | os.PathLike[str], *, progress: bool = False) -> CampaignData:
    """Load a campaign and check it.

    Parameters
    ----------
    path : path-like
        The campaign's folder, or its ``campaign.toml``.
    progress : bool, optional
        Whether to show a bar for a file that takes more than two seconds.

    Returns
    -------
    CampaignData
        All runs, in SI.

    Raises
    ------
    CampaignError
        If the campaign is invalid; one line that says where and why, and how to correct it.

    Warns
    -----
    DataWarning
        If samples are unevenly spaced and were interpolated, or a file states another unit.
    """
    check_path(path, "path", hint='write load_campaign("folder")')
    toml = declared_in(path)
    declaration = read_declaration(toml)
    folder = _data_folder(declaration, toml.parent)
    files = _RunFiles(declaration, folder, progress)
    loaded = [load_run(run, declaration.channels, files.read) for run in declaration.runs]
    _check_shared(loaded)
    return CampaignData(
        name=declaration.name,
        description=declaration.description,
        controlled=declaration.controlled,
        path=toml.parent,
        channels=dict(declaration.channels),
        runs=tuple(one.run for one in loaded),
        sha256=_checksum(toml, [folder / run.file for run in declaration.runs]),
        rig=declaration.rig,
    )


def declared_in(path: str | os.PathLike[str]) -> Path:
    """The ``campaign.toml`` of a campaign that is given by its folder or by that file."""
    given = Path(path)
    return given if given.suffix == ".toml" else given / FILE


@dataclass(frozen=True)
class CampaignFiles:
    """The files of a campaign, unread.

    Parameters
    ----------
    toml : Path
        Its declaration.
    files : mapping of str to Path
        Run files, by the names that the declaration gives them.
    inside : bool
        Whether all are named from the folder of the declaration down, which is then a campaign
        wherever it is copied to.
    """

    toml: Path
    files: Mapping[str, Path]
    inside: bool

    @property
    def sha256(self) -> str:
        """As of :class:`CampaignData`."""
        return _checksum(self.toml, list(self.files.values()))


def campaign_files(path: str | os.PathLike[str]) -> CampaignFiles:
    """Find the files of a campaign and check its declaration.

    Parameters
    ----------
    path : path-like
        As of :func:`load_campaign`.

    Raises
    ------
    CampaignError
        If the declaration cannot be used, or a file is not there.
    """
    toml = declared_in(path)
    declaration = read_declaration(toml)
    folder = _data_folder(declaration, toml.parent)
    files = {run.file: folder / run.file for run in declaration.runs}
    for name, file in files.items():
        if not file.is_file():
            raise CampaignError("no such file", file=name, hint=f"it should be {file}")
    names = [Path(name) for name in files]
    inside = not any(name.is_absolute() or ".." in name.parts for name in names)
    return CampaignFiles(toml, files, inside and declaration.dataset is None)


def _check_shared(loaded: Sequence[LoadedRun]) -> None:
    """Raise where two runs are the same stretch of a file: it would count twice, or be fitted and
    held out at once."""
    for later, one in enumerate(loaded):
        for other in loaded[:later]:
            common = min(one.last, other.last) - max(one.first, other.first)
            shorter = min(one.last - one.first, other.last - other.first)
            same = one.run.file == other.run.file and set(one.columns) & set(other.columns)
            if same and common > 0.5 * shorter:
                raise CampaignError(
                    f"holds the same samples as run {other.run.label}",
                    file=one.run.file,
                    run=one.run.label,
                    key="file",
                    hint="name its own file, columns, rows or segment, or cut both with start and "
                    "stop",
                )


class _RunFiles:
    """The files of a campaign; one that several runs share is read once.

    Parameters
    ----------
    declaration : Declaration
    folder : Path
        Of the files.
    progress : bool
        Whether to show bars.
    """

    def __init__(self, declaration: Declaration, folder: Path, progress: bool) -> None:
        self.declaration, self.folder, self.progress = declaration, folder, progress
        self._read: dict[tuple[Any, ...], FileColumns] = {}

    def read(self, run: RunDeclaration) -> FileColumns:
        """Columns of a run's file."""
        key = _file_key(run)
        if key not in self._read:
            together = [other for other in self.declaration.runs if _file_key(other) == key]
            wanted = {name for other in together for name in self._wanted(other)}
            self._read = {  # the last file only: files may be large
                key: read_file(
                    self._path(run),
                    run.delimiter,
                    run.header_delimiter,
                    wanted,
                    run.encoding,
                    self.progress,
                )
            }
        return self._read[key]

    def _wanted(self, run: RunDeclaration) -> set[str]:
        wanted = set(columns_of(run, self.declaration.channels).values())
        wanted |= {run.time} if run.time else set()
        return wanted | ({run.segment[0]} if isinstance(run.segment, tuple) else set())

    def _path(self, run: RunDeclaration) -> Path:
        path = self.folder / run.file
        inside = os.path.abspath(path).startswith(os.path.abspath(self.folder) + os.sep)
        if not inside and not self.declaration.outside_files:
            raise CampaignError(
                "lies outside the folder of the campaign",
                key="file",
                value=run.file,
                hint=f"copy it there, or write outside_files = true at the top of {FILE}",
            )
        return path


def _file_key(run: RunDeclaration) -> tuple[Any, ...]:
    return run.file, run.delimiter, run.header_delimiter, run.encoding


def _data_folder(declaration: Declaration, folder: Path) -> Path:
    if declaration.dataset is None:
        return folder
    files = tuple(dict.fromkeys(run.file for run in declaration.runs))
    return dataset_folder(declaration.dataset, files)


def _checksum(toml: Path, files: list[Path]) -> str:
    total = hashlib.sha256(toml.read_bytes())
    for file in dict.fromkeys(files):
        total.update(hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


#: Environment variable with a folder laid out as ``measured/<name>``, ``campaigns/<name>``,
#: ``nist``.
VARIABLE = "BAYESOLEO_DATA"


@dataclass(frozen=True)
class RegisteredSet:
    """A measured set that can be fetched.

    Parameters
    ----------
    url : str
        Upstream folder, pinned to a commit.
    hashes : dict of str to str
        SHA-256 of each file.
    """

    url: str
    hashes: dict[str, str]


_CONTINUOUS = (
    "https://raw.githubusercontent.com/forgi86/sysid-neural-continuous/"
    "956aa7ecd73061b0321c6f6098d74c9e4a7ce67a/examples/"
)
REGISTERED = {
    "silverbox": RegisteredSet(
        "https://raw.githubusercontent.com/antonior92/sysid-neuralnet/"
        "8da23c9810f738aececa6058a53e40e9a621e5bc/data/SilverboxFiles/",
        {
            "Schroeder80mV.mat": "ec5a9740a4789aa20b9d84f387424c0218e843844807b30b367c218778339fb6",
            "SNLS80mV.mat": "5c7413a52255af0cb4e2f93fb6903beb92b08965ba1e6ad0a6ffedfed8477ed4",
        },
    ),
    "mr_damper": RegisteredSet(
        "https://raw.githubusercontent.com/labcontrol-data/mr-damper/"
        "e42439f08b227bb08e9923ee2736bedf2f4fe59a/data/",
        {
            "ensaio1.1.mat": "b7e1a8303ac125f147857db1d020c52bd9c471e7866ab5344b62d91191eddcf2",
            "ensaio3.1.mat": "fa929378aea5f85655eb5746fe230556f592f6abc28b152b03c2b807c17a85c8",
            "ensaio5.1.mat": "7c610cd351fd2e3f684d0f8ff34c32e507d657ae9f695e9c34ac691212f4ee3b",
            "ensaio7.1.mat": "e5519b81cd7df238a20a0cb61f7d860828eddf23a4a315ff9b727508062033fa",
        },
    ),
    "mbari_gas_spring": RegisteredSet(
        "https://raw.githubusercontent.com/osrf/mbari_wec_gz/"
        "71fe25a249e74a220e1448354f979f42a7ae9208/buoy_tests/test_inputdata/",
        {
            "2022.01.28T16.46.31.exp": (
                "f18f9ee7f744d79baf2474cbdb01afdf2287e0e3979da8e8f3442d2d7453cd2d"
            ),
            "2022.12.21T15.44.24_VentedSpring.exp": (
                "925dcd71cdef0c4d48a07a18989428fbead86d3d53d04cce9518bfbb20941269"
            ),
        },
    ),
    "emps": RegisteredSet(
        f"{_CONTINUOUS}EMPS/data/",
        {
            "DATA_EMPS.mat": "6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e",
            "DATA_EMPS_PULSES.mat": (
                "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704"
            ),
        },
    ),
    "cascaded_tanks": RegisteredSet(
        f"{_CONTINUOUS}CTS/data/",
        {
            "dataBenchmark.csv": "ef2388ed822f3aef4aa80d6b0f2b466dd80b361786b3eafc7a2957c31ea323a7",
        },
    ),
    "brfd": RegisteredSet(
        "https://raw.githubusercontent.com/ARTS-Laboratory/Dataset-Friction-Damper-with-Backlash/"
        "0e09aa9d950760277e31c08cd93fd01f39a5af09/data/dataset-2/",
        {
            "dataset-2_0.5Hz30lbtension1amplitude.json": (
                "3d58d0f71296a6221974c14454352fa29a27d536295fd5cb05e6d946a7cf30db"
            ),
            "dataset-2_1Hz30lbtension0.5amplitude.json": (
                "8d8c46dcbed3889ae8dbe6ff3698d67e6453349ab728a8915b22680453c4d277"
            ),
            "dataset-2_1Hz30lbtension1.5amplitude.json": (
                "1a894d5857486ee56f363343c3216d2fb300c2fc8777439cca8ee2d02a7dd35c"
            ),
            "dataset-2_1Hz30lbtension1amplitude.json": (
                "ed02a98a96369937851bed92b4e5e92e34d98ceebd4db81d5bd65d5b77c4bc91"
            ),
        },
    ),
    "single_pendulum": RegisteredSet(
        "https://raw.githubusercontent.com/dynamicslab/MultiArm-Pendulum/"
        "e99a7e13fe2adc8fc647321a156b6cb59a48a698/ParameterEstimation/SinglePendulum/",
        {
            "SinglePendulumDataForParameterEstimation.mat": (
                "f3b8cdda4a6e86405ec37ff32b98be76fd37806a609cba7870628c1e40377a98"
            ),
        },
    ),
}


def dataset_folder(name: str, files: Sequence[str] = ()) -> Path:
    """Folder that holds the files of a data set.

    Looked up in the folder that ``BAYESOLEO_DATA`` names; else, for measured sets, fetched once
    into the user's cache. Files with a registered SHA-256 are verified either way.

    Parameters
    ----------
    name : str
        A measured set such as ``silverbox`` or ``emps``, ``nist``, or a campaign such as
        ``shaker-plain``.
    files : sequence of str
        Files wanted; by default all registered ones.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    CampaignError
        If the set is unknown or not there, or a file is not the registered one.
    MissingExtraError
        If the set has to be fetched and pooch is not installed.
    """
    known = REGISTERED.get(name)
    wanted = tuple(files) or (tuple(known.hashes) if known else ())
    local = _local_folder(name)
    if local is not None and all((local / file).is_file() for file in wanted):
        for file in wanted:
            _verify(local / file, known.hashes.get(file) if known else None)
        return local
    if known is None:
        raise CampaignError(
            "data set is not here and cannot be fetched",
            key="dataset",
            value=name,
            hint=f"set {VARIABLE} to a folder with campaigns/<name> or nist, "
            f"or name one of {', '.join(REGISTERED)}",
        )
    return _fetch(name, known, wanted)


def _local_folder(name: str) -> Path | None:
    root = os.environ.get(VARIABLE)
    if not root or Path(name).name != name:
        return None
    candidates = (
        Path(root) / "measured" / name,
        Path(root) / "campaigns" / name,
        Path(root) / name,
    )
    return next((folder for folder in candidates if folder.is_dir()), None)


def _verify(path: Path, expected: str | None) -> None:
    if expected is None:
        return
    state = path.stat()
    found = _digest(path, state.st_mtime_ns, state.st_size)
    if found != expected:
        raise CampaignError(
            "file is not the registered one (SHA-256 differs)",
            file=path.name,
            value=found[:12],
            hint=f"expected {expected[:12]}; remove it, and it is fetched again",
        )


@cache
def _digest(path: Path, modified: int, size: int) -> str:
    """SHA-256 of a file; modification time and size make a changed file a new entry."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _fetch(name: str, known: RegisteredSet, wanted: Sequence[str]) -> Path:
    pooch = import_extra("pooch", "data")
    unknown = [file for file in wanted if file not in known.hashes]
    if unknown:
        raise CampaignError(
            f"{name} has no such registered file",
            file=unknown[0],
            hint=f"it has {', '.join(known.hashes)}",
        )
    folder = Path(pooch.os_cache("bayesoleo")) / name
    try:
        fetcher = pooch.create(path=folder, base_url=known.url, registry=known.hashes)
        for file in wanted:
            fetcher.fetch(file)
    except (
        Exception
    ) as error:  # network libraries raise many types; all mean that the file is not here
        with suppress(OSError):  # an empty folder would look like data that are here
            folder.rmdir()
        raise CampaignError(
            f"cannot fetch {name}: {str(error)[:120]}",
            key="dataset",
            value=name,
            hint=f"put the files into measured/{name} under a folder and set {VARIABLE} to it",
        ) from error
    return folder


TIME_COLUMN = "time_s"
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
#: Names of files on every system: no others, not too long, and none that Windows keeps for devices.
_PLAIN_FILE = re.compile(
    r"(?!(con|prn|aux|nul|com\d|lpt\d)$)[a-z0-9][a-z0-9_-]{,99}", re.IGNORECASE | re.ASCII
)


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
    if not is_vacant(folder) and not overwrite:
        raise CampaignError(
            "folder is not empty", file=folder, hint="choose another, or pass overwrite=True"
        )
    own = [text for run in runs for text in (run.label, run.group, *run.conditions)]
    for text in (name, description, *channels, *own):
        if "\0" in text:
            raise CampaignError("text holds a null character", value=text, hint="leave it out")
    _check_columns(channels)
    files = _file_names([run.label for run in runs])
    text = _head(name, description, controlled, channels)
    text += "".join(_run_table(run, file) for run, file in zip(runs, files, strict=True))
    with _moved_into(folder) as draft:
        for run, file in zip(runs, files, strict=True):
            _write_samples(draft / file, run, channels)
        (draft / FILE).write_text(text, encoding="utf-8", newline="\n")
    return folder


#: Folder of files that are being written, the list of those that are being moved, and the file by
#: which a process keeps others out.
_DRAFT, _MOVED, _LOCK = ".campaign-draft", ".campaign-files", ".lock"
#: Beginning of the names of folders by which ``_storage`` tries whether a folder takes files.
_TRIAL = ".bayesoleo-"


def is_vacant(folder: Path) -> bool:
    """Whether a new campaign can be written to a folder without touching other files.

    Files that a process was moving there when it was killed are no other files. It moves
    ``campaign.toml`` last: where that stands, the campaign is whole.
    """
    if not folder.exists():
        return True
    if not folder.is_dir():
        return False
    ours = {_DRAFT, _MOVED, _LOCK, *_half_moved(folder)}
    return all(item.name in ours or item.name.startswith(_TRIAL) for item in folder.iterdir())


def _half_moved(folder: Path) -> list[str]:
    """Files that a process was moving to a folder when it was killed, some of them there."""
    moved = folder / _MOVED
    if (folder / FILE).exists() or not moved.is_file():
        return []
    return moved.read_text(encoding="utf-8", errors="replace").splitlines()


@contextmanager
def _moved_into(folder: Path) -> Iterator[Path]:
    """Give a folder to write files to, which are moved on leaving: a full disk leaves no half."""
    draft, made = folder / _DRAFT, not folder.exists()
    try:
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
        yield draft
        # Last, so that a campaign.toml never stands for runs that are not there yet.
        files = sorted(draft.iterdir(), key=lambda path: path.name == FILE)
        names = [file.name for file in files]
        older = set(_half_moved(folder)) - set(names)
        (draft / _MOVED).write_text("\n".join([*names, *sorted(older)]), encoding="utf-8")
        os.replace(draft / _MOVED, folder / _MOVED)
        (folder / FILE).unlink(missing_ok=True)  # of what is overwritten, before its runs go
        for name in older:
            (folder / name).unlink(missing_ok=True)
        for file in files:
            os.replace(file, folder / file.name)
        draft.rmdir()
        (folder / _MOVED).unlink()
    except OSError as error:
        hint = "choose a folder that you may write to and that has space left"
        problem = f"cannot be written: {error.strerror or error}"
        raise CampaignError(problem, file=folder, hint=hint) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        if made and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


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
