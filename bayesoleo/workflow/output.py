"""The folder that a result is written to: checked first, written as soon as something is known."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import xarray as xr

from bayesoleo import schema
from bayesoleo._types import ProgressCallback
from bayesoleo.errors import InputError
from bayesoleo.storage import check_writable, read_attributes, write_text_atomic, write_tree
from bayesoleo.storage.digest import digest, package_digest
from bayesoleo.storage.kept import keep_state, kept_state
from bayesoleo.storage.lock import only_writer
from bayesoleo.tracing.deciding.progress import Progress
from bayesoleo.workflow.task import Task

RESULTS, REPORT, SUMMARY = "results.nc", "report.html", "summary.json"
FILES = (RESULTS, REPORT, SUMMARY)
CHECKPOINTS, SEARCH, OLDER = "checkpoints", "search.pickle", "older"
#: By this file a folder of an older result is known as one that was made here, and may go.
PUT_ASIDE = ".put-aside"


@dataclass
class ResultFolder:
    """Where a result goes.

    Parameters
    ----------
    folder : Path or None
        None writes nothing.
    """

    folder: Path | None
    _begun: bool = False

    @classmethod
    def checked(cls, out: str | os.PathLike[str] | None) -> ResultFolder:
        """A folder that was found to take files; nothing is made yet.

        Raises
        ------
        InputError
            If it is no path, or files cannot be written there without writing over others.
        """
        if out is None:
            return cls(None)
        folder = check_writable(out, FILES, (CHECKPOINTS, OLDER))
        aside = folder / OLDER
        if not (aside / PUT_ASIDE).is_file() and any((aside / name).exists() for name in FILES):
            raise InputError(
                "holds a result that was not put aside here, which would be written over",
                file=aside,
                hint="rename or move it, or choose another folder",
            )
        return cls(folder)

    @property
    def checkpoints(self) -> Path | None:
        """Where a calculation that was stopped goes on from."""
        return None if self.folder is None else self.folder / CHECKPOINTS

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other processes from writing here.

        Raises
        ------
        ResultsError
            If one does already.
        """
        with only_writer(self.checkpoints):
            yield

    # -- results ------------------------------------------------------------------------

    def write(self, tree: xr.DataTree, summary: dict[str, Any] | None = None) -> None:
        """Write a result; an older one that was finished is put aside until this one is."""
        if self.folder is None:
            return
        if not self._begun:
            self._put_aside()
        self._begun = True
        write_tree(tree, self.folder / RESULTS)
        if summary is not None:
            write_text_atomic(self.folder / SUMMARY, schema.summary_json(summary))

    def _put_aside(self) -> None:
        """Move an older, finished result to a folder of its own."""
        assert self.folder is not None
        if not is_finished(self.folder / RESULTS):
            return
        aside = self.folder / OLDER
        _drop(aside)
        aside.mkdir(parents=True, exist_ok=True)
        (aside / PUT_ASIDE).touch()
        for name in FILES:
            if (self.folder / name).exists():
                os.replace(self.folder / name, aside / name)

    def finish(self) -> None:
        """Drop the older result, and what the search would go on from: the new one is complete."""
        if self.folder is not None and self.checkpoints is not None:
            _drop(self.folder / OLDER)
            # Fits of many candidates take tens of megabytes.
            (self.checkpoints / SEARCH).unlink(missing_ok=True)

    # -- how far a search has come ------------------------------------------------------

    def keep(self, task: Task, progress: Progress) -> None:
        """Keep what the search needs to go on."""
        if self.checkpoints is not None:
            keep_state(self.checkpoints / SEARCH, search_key(task), progress)

    def kept(self, task: Task, callback: ProgressCallback) -> Progress | None:
        """How far the same search came before."""
        if self.checkpoints is None:
            return None
        path = self.checkpoints / SEARCH
        found, reason = kept_state(path, search_key(task))
        if reason:
            callback(f"start anew: {path} cannot be gone on from, {reason}")
        if not isinstance(found, Progress):
            return None
        callback(f"go on after round {len(found.rounds)}, which {path} holds")
        return found


def _drop(aside: Path) -> None:
    """Remove a result that was put aside; whatever else is in its folder stays."""
    if not (aside / PUT_ASIDE).is_file():
        return
    for name in (*FILES, PUT_ASIDE):
        (aside / name).unlink(missing_ok=True)
    with suppress(OSError):  # a user's own files are in it
        aside.rmdir()


def is_finished(results: Path) -> bool:
    """Whether a file holds a result of which nothing is missing; one that cannot be read may."""
    return results.is_file() and schema.UNFINISHED not in read_attributes(results)


def search_key(task: Task) -> dict[str, str]:
    """Digests of all that a search depends on."""
    # How much is drawn from the posterior has no say in what is missing.
    settings = replace(task.settings, quick=False, effective_size=0, command="")
    return {
        "campaign": digest((task.campaign.sha256, task.reduced.records)),
        "model": digest(task.assembly),
        "setting": digest(settings),
        "version": package_digest(),
    }
