"""Atomic writing, one writer to a folder, and a check that a folder can be written to.

A new version is written beside the old one under a hidden name, flushed to the disk and then
renamed over it, so that a reader, a full disk or a power cut never meets half a result.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from bayesoleo.errors import InputError, ResultsError


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


@contextmanager
def only_writer(folder: str | os.PathLike[str] | None) -> Iterator[None]:
    """Keep other processes from writing to a folder.

    Parameters
    ----------
    folder : path-like or None
        Made if it does not exist; with None there is nothing to keep.

    Raises
    ------
    ResultsError
        If another process writes there, or the folder cannot be made.
    """
    if folder is None:
        yield
        return
    place = Path(folder)
    with _lock_file(place) as file:
        if not _lock(file):
            raise ResultsError(
                "another process is writing here",
                file=place,
                hint="wait for it, or give another folder",
            )
        # Closing the file releases the lock, and so does the end of the process, however it comes.
        yield


def _lock_file(place: Path) -> IO[bytes]:
    try:
        place.mkdir(parents=True, exist_ok=True)
        return open(place / "lock", "a+b")
    except OSError as error:
        raise ResultsError(
            f"cannot be written to: {error.strerror or error}",
            file=place,
            hint="choose a folder that you may write to",
        ) from error


def _lock(file: IO[bytes]) -> bool:
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


HINT = "choose a folder that you may write to (--out; in Python out=)"


def path_of(path: str | os.PathLike[str], key: str = "out") -> Path:
    """A path that every library can open.

    Parameters
    ----------
    path : str or path-like
    key : str
        Name of the argument, for the error.

    Raises
    ------
    InputError
        If it is no path, is empty, holds a null character or is not UTF-8, in which netCDF and
        JSON keep names.
    """
    try:
        text = os.fsdecode(path)
    except TypeError:
        hint = "write a str or a pathlib.Path"
        raise InputError("is not a path", key=key, value=path, hint=hint) from None
    if not text or "\0" in text:
        problem = "is empty" if not text else "holds a null character"
        raise InputError(problem, key=key, value=text, hint=HINT)
    try:
        # A relative path is opened from here, and libraries may ask for all of it.
        os.path.abspath(text).encode("utf-8")
    except UnicodeEncodeError:
        shown = os.path.abspath(text).encode("utf-8", "backslashreplace").decode()
        raise InputError("is not UTF-8", key=key, value=shown, hint=HINT) from None
    return Path(text)


def check_writable(
    folder: str | os.PathLike[str], files: Iterable[str] = (), folders: Iterable[str] = ()
) -> Path:
    """Check that a folder is there, or can be made, and takes files; nothing is made yet.

    Parameters
    ----------
    folder : path-like
    files, folders : iterable of str
        Names of what will be written there.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        If not, with the reason.
    """
    place = path_of(folder)
    nearest = place.absolute()
    while not os.path.lexists(nearest):
        nearest = nearest.parent
    if not nearest.is_dir():
        raise InputError("is not a folder; nothing can be written there", file=nearest, hint=HINT)
    _check_names(place.absolute(), nearest)
    try:
        # What is allowed shows only in trying: permissions, read-only disks, quotas.
        with tempfile.TemporaryDirectory(prefix=".bayesoleo-", dir=nearest):
            pass
    except OSError as error:
        problem = f"cannot be written to: {error.strerror or error}"
        raise InputError(problem, file=place, hint=HINT) from error
    for name in files:
        if (place / name).is_dir():
            raise InputError("is a folder, not a file", file=place / name, hint=HINT)
    for name in folders:
        if os.path.lexists(place / name) and not (place / name).is_dir():
            raise InputError("is a file, not a folder", file=place / name, hint=HINT)
    return place


def _check_names(place: Path, nearest: Path) -> None:
    """Refuse names that are longer than the disk allows."""
    if not hasattr(os, "pathconf"):
        return
    most = os.pathconf(nearest, "PC_NAME_MAX")
    for part in place.relative_to(nearest).parts:
        if len(os.fsencode(part)) > most:
            problem = f"has a name longer than the {most} bytes that this disk allows"
            raise InputError(problem, file=place, value=part, hint=HINT)
