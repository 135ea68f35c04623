"""Output folder and stages of a long calculation.

A folder is checked before anything is computed and written as soon as something is known. A stage
that fails takes nothing with it that was known before.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._storage.files import check_writable, only_writer, write_text_atomic
from bayesoleo._storage.result_files import read_attributes, write_tree
from bayesoleo._storage.resume import digest, keep_state, kept_state, package_digest
from bayesoleo._types import ProgressCallback
from bayesoleo._workflow.task import Task, silent
from bayesoleo.discovery._round import Progress
from bayesoleo.errors import InputError, UnfinishedError

RESULTS, REPORT, SUMMARY = "results.nc", "report.html", "summary.json"
FILES = (RESULTS, REPORT, SUMMARY)
CHECKPOINTS, SEARCH, OLDER = "checkpoints", "search.pickle", "older"
#: By this file a folder of an older result is known as one that was made here, and may go.
PUT_ASIDE = ".put-aside"


@dataclass
class ResultFolder:
    """The folder of a result.

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
        """Folder from which a calculation that was stopped goes on."""
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
    # How much is drawn from the posterior has no say in what is missing, and probabilities of
    # structures are computed once the search has ended.
    same = {"quick": False, "effective_size": 0, "command": "", "structure_prior": None}
    settings = {f.name: getattr(task.settings, f.name) for f in fields(task.settings)} | same
    return {
        "campaign": digest((task.campaign.sha256, task.reduced.records)),
        "model": digest(task.assembly),
        "setting": digest(settings),
        "version": package_digest(),
    }


#: In the order in which they are done; those of the schema of the summary.
SEARCH_STAGE, PROPOSALS_STAGE, POSTERIOR_STAGE, PREDICTIONS_STAGE, REPORT_STAGE = (
    "search",
    "proposals",
    "posterior",
    "predictions",
    "report",
)
_PACKAGE = Path(__file__).parents[1]


@dataclass
class Stages:
    """Stages that have failed so far.

    Parameters
    ----------
    callback : callable
        Told of each failure as it happens.
    """

    callback: ProgressCallback = silent
    failed: list[dict[str, str]] = field(default_factory=list)
    first: Exception | None = None

    def attempt[Value](
        self, stage: str, work: Callable[[], Value], default: Callable[[], Value]
    ) -> Value:
        """The result of a stage, or a default where it fails; a stop by the user goes through."""
        try:
            return work()
        except Exception as error:
            self.fail(stage, reason_of(error), error)
            return default()

    def fail(self, stage: str, reason: str, error: Exception | None = None) -> None:
        """Note that a stage did not finish."""
        self.callback(f"{stage} failed: {reason}")
        self.failed.append({"stage": stage, "reason": reason})
        self.first = self.first or error

    def finish(self, tree: xr.DataTree, folder: Path | None) -> xr.DataTree:
        """The result if all stages finished.

        Raises
        ------
        UnfinishedError
            If one failed; it carries the result without it.
        """
        if self.failed:
            raise UnfinishedError(self.failed, tree, folder) from self.first
        return tree


def reason_of(error: Exception) -> str:
    """An exception in a line: what it says, and where it came from if it was not foreseen."""
    if isinstance(error, InputError):
        return str(error)
    text = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(": ")
    own = [
        (Path(frame.filename), frame.lineno)
        for frame in traceback.extract_tb(error.__traceback__)
        if Path(frame.filename).is_relative_to(_PACKAGE)
    ]
    if not own:
        return text
    file, line = own[-1]
    return f"{text} ({file.relative_to(_PACKAGE.parent).as_posix()}, line {line})"
