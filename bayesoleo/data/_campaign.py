"""Campaigns: a folder with ``campaign.toml`` and files of runs, loaded in SI and checked."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bayesoleo.data._campaign_folders import dataset_folder
from bayesoleo.data._campaign_toml import (
    FILE,
    Channel,
    Declaration,
    RunDeclaration,
    read_declaration,
)
from bayesoleo.data._files import read_file
from bayesoleo.data._run_samples import LoadedRun, Run, columns_of, load_run
from bayesoleo.data._text_layout import FileColumns
from bayesoleo.errors import CampaignError, check_path, choose


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
    given = Path(path)
    toml = given if given.suffix == ".toml" else given / FILE
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
