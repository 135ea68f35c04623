"""Stages of a long calculation: one that fails takes nothing with it that was known before."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import xarray as xr

from bayesoleo._types import ProgressCallback
from bayesoleo.errors import InputError, UnfinishedError
from bayesoleo.workflow.task import silent

#: In the order in which they are done; those of the schema of the summary.
SEARCH, PROPOSALS, POSTERIOR, PREDICTIONS, REPORT = (
    "search",
    "proposals",
    "posterior",
    "predictions",
    "report",
)
_PACKAGE = Path(__file__).parents[1]


@dataclass
class Stages:
    """What failed so far.

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
