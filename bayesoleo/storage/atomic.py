"""Replace a file as a whole or not at all.

A new version is written beside the old one under a hidden name, flushed to the disk and then
renamed over it, so that a reader, a full disk or a power cut never meets half a result.
"""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bayesoleo.errors import ResultsError


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a path to write to; what was written there takes the place of ``path`` on leaving.

    Parameters
    ----------
    path : path-like
        File or directory to replace; missing parents are made.

    Yields
    ------
    Path
        Does not exist yet; write a file or a directory there.

    Raises
    ------
    ResultsError
        The place cannot be written to. ``path`` is as it was then.
    """
    target = Path(path)
    # The suffix stays: writers choose a format by it.
    draft = target.with_name(f".{target.stem}.{uuid.uuid4().hex}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield draft
        _flush(draft)
        _rename(draft, target)
        _flush_directory(target.parent)
    except OSError as error:
        reason = error.strerror or str(error)
        hint = "choose a folder that you may write to and that has space left"
        raise ResultsError(f"cannot be written: {reason}", file=target, hint=hint) from error
    finally:
        _remove(draft)


def write_text_atomic(path: str | os.PathLike[str], text: str) -> None:
    """Write UTF-8 text in place of a file, as a whole or not at all.

    Parameters
    ----------
    path : path-like
        File to write; missing parents are made.
    text : str
        Its new content; line ends are written as given.

    Raises
    ------
    ResultsError
        The place cannot be written to.
    """
    with replacing(path) as draft:
        draft.write_text(text, encoding="utf-8", newline="")


def _flush(path: Path) -> None:
    """Force a file, or every file of a directory, to the disk."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    for file in files:
        with file.open("rb+") as stream:
            os.fsync(stream.fileno())


def _flush_directory(path: Path) -> None:
    """Force a rename to the disk, where the system can do that (Windows cannot)."""
    if os.name == "posix":
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _rename(draft: Path, target: Path) -> None:
    """Put the draft in place; a directory cannot be renamed over, so it is moved aside."""
    if not target.is_dir():
        os.replace(draft, target)
        return
    if draft.is_file():
        raise IsADirectoryError(21, "it is a directory")
    aside = target.with_name(f".{target.name}.{uuid.uuid4().hex}.old")
    os.replace(target, aside)
    try:
        os.replace(draft, target)
    except OSError:
        os.replace(aside, target)
        raise
    _remove(aside)


def _remove(path: Path) -> None:
    """Remove what is left of a draft; failing at that must not hide why it was left."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()
