"""Atomic writing of one file or of several together, one writer to a folder, and folders on trial.

A new version is written beside the old one under a hidden name, flushed to the disk and then
renamed over it, so that a reader, a full disk or a power cut never meets half a result. Several
files are written to a hidden folder; renaming that folder decides that they are the new ones.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shutil
import tempfile
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import IO

from bayesoleo._file_locks import try_lock
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
        flush(draft)
        _rename(draft, target)
        flush_directory(target.parent)
    except OSError as error:
        raise not_written(target, error) from error
    finally:
        remove(draft)


def not_written(path: Path, error: OSError) -> ResultsError:
    """What is told where a file or folder could not be written."""
    hint = "choose a folder that you may write to and that has space left"
    return ResultsError(f"cannot be written: {error.strerror or error}", file=path, hint=hint)


def write_bytes_atomic(path: str | os.PathLike[str], content: bytes) -> None:
    """Write bytes in place of a file, as :func:`write_text_atomic` writes text."""
    with replacing(path) as draft:
        draft.write_bytes(content)


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


def flush(path: Path) -> None:
    """Force a file, or every file of a directory, to the disk."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    for file in files:
        with file.open("rb+") as stream:
            os.fsync(stream.fileno())


def flush_directory(path: Path) -> None:
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
    remove(aside)


def remove(path: Path) -> None:
    """Remove what is left of a draft; failing at that must not hide why it was left."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


LOCK = ".lock"


SUMS = "SHA256SUMS"
#: Folders of files that are being written, and of those that only have to be moved to their places.
_DRAFT, _DECIDED = ".draft", ".decided"
_PLAN = ".plan"


@contextmanager
def together(
    folder: Path, names: Sequence[str], *, aside: str | None = None, keep: bool = False
) -> Iterator[Path]:
    """Give a folder to write files to; on leaving they take the place of older ones together.

    A process that is killed leaves the older files, or leaves the new ones to :func:`settle`. In
    no order of events do files of two results stand side by side.

    Parameters
    ----------
    folder : Path
        Of which this process is the only writer.
    names : sequence of str
        Files of a result, the most important first. Those that are not written are removed.
    aside : str, optional
        Folder in ``folder`` to which the older files are moved instead of being removed.
    keep : bool
        Whether files that are not written stay.

    Raises
    ------
    ResultsError
        If the place cannot be written to; the older files are untouched.
    """
    draft = folder / _DRAFT
    try:
        remove(draft)
        draft.mkdir(parents=True)
        yield draft
        new = [name for name in names if (draft / name).is_file()]
        sums = {name: sha256(draft / name) for name in new}
        if keep:
            sums = {**read_sums(folder), **sums}
        lines = "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
        (draft / SUMS).write_text(lines, encoding="utf-8", newline="")
        plan = {"new": new, "old": new if keep else list(names), "aside": aside}
        (draft / _PLAN).write_text(json.dumps(plan), encoding="utf-8")
        flush(draft)
        flush_directory(draft)
        os.rename(draft, folder / _DECIDED)
        flush_directory(folder)
        settle(folder)
    except OSError as error:
        raise not_written(folder, error) from error
    finally:
        remove(draft)


def settle(folder: Path) -> None:
    """Move files whose writing was complete to their places, wherever that was interrupted.

    Parameters
    ----------
    folder : Path
        Of which this process is the only writer.
    """
    decided = folder / _DECIDED
    if not decided.is_dir():
        return
    try:
        plan = json.loads((decided / _PLAN).read_text(encoding="utf-8"))
    except FileNotFoundError:  # all but the folder itself was done
        remove(decided)
        return
    new = [*plan["new"], SUMS]
    # First what goes, then what comes: files that stand side by side belong to one result.
    for name in (SUMS, *reversed(plan["old"])):
        if name not in new or (decided / name).exists():
            _take_away(folder / name, plan["aside"])
    for name in new:
        if (decided / name).exists():
            os.replace(decided / name, folder / name)
    flush_directory(folder)
    remove(decided / _PLAN)
    remove(decided)


def _take_away(path: Path, aside: str | None) -> None:
    if not path.is_file():
        return
    if aside is None:
        path.unlink()
    else:
        os.replace(path, path.parent / aside / path.name)


def current(path: Path) -> Path:
    """Where the newest version of a file is, while files are being moved to their places."""
    decided = path.parent / _DECIDED / path.name
    return decided if decided.is_file() else path


def sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_sums(folder: Path) -> dict[str, str]:
    """SHA-256 by file as :func:`together` noted it; nothing where it did not, or not legibly."""
    try:
        text = current(folder / SUMS).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return {}
    pairs = (line.split("  ", 1) for line in text.splitlines() if "  " in line)
    return {name: digest for digest, name in pairs}


def changed_files(folder: Path) -> list[str]:
    """Files of a result that are not as they were written; those that are gone are not counted."""
    return [
        name
        for name, digest in read_sums(folder).items()
        if (path := current(folder / name)).is_file() and sha256(path) != digest
    ]


def sweep(folder: Path, names: Iterable[str]) -> None:
    """Remove what processes that were killed have left half written.

    Parameters
    ----------
    folder : Path
        Of which this process is the only writer.
    names : iterable of str
        Files and folders whose drafts go. Whatever else is hidden there is somebody else's.
    """
    remove(folder / _DRAFT)
    stems = "|".join(re.escape(Path(name).stem) for name in names)
    ours = re.compile(rf"\.({stems})\.[0-9a-f]{{32}}(\.\w+)?")
    for path in folder.glob(".*"):
        if ours.fullmatch(path.name):
            remove(path)
        elif path.name.startswith(_TRIAL):
            with suppress(OSError):  # of a folder that was tried; it is empty
                path.rmdir()


@contextmanager
def only_writer(folder: str | os.PathLike[str] | None) -> Iterator[None]:
    """Keep other processes from writing to a folder.

    Parameters
    ----------
    folder : path-like or None
        Made if it does not exist, and removed again if nothing was written; with None there is
        nothing to keep.

    Raises
    ------
    ResultsError
        If another process writes there, or the folder cannot be made.
    """
    if folder is None:
        yield
        return
    place = Path(folder)
    found_there = place.is_dir()
    file = _locked_file(place)
    try:
        yield
    finally:
        # The system releases the lock at the end of the process too, however it comes.
        if os.name == "posix":  # while it is held: afterwards the file may be another's
            remove(place / LOCK)
        file.close()
        if os.name != "posix":  # Windows removes no file that somebody has open
            remove(place / LOCK)
        if not found_there:
            with suppress(OSError):
                place.rmdir()


def check_free(folder: str | os.PathLike[str]) -> None:
    """Raise a ResultsError if another process writes to a folder; nothing is made."""
    with suppress(OSError), (Path(folder) / LOCK).open("r+b") as file:
        if not try_lock(file):
            raise _busy(Path(folder), file)


def _locked_file(place: Path) -> IO[bytes]:
    """The lock of a folder, held; it says who holds it."""
    try:
        place.mkdir(parents=True, exist_ok=True)
        while True:
            file = (place / LOCK).open("a+b")
            if not try_lock(file):
                with file:
                    raise _busy(place, file)
            # Whoever held it before may have removed the file between these two steps.
            if _is_same(file, place / LOCK):
                break
            file.close()
        file.truncate(0)
        started = datetime.now().astimezone().isoformat(timespec="seconds")
        file.write(f"process {os.getpid()} on {platform.node()} since {started}\n".encode())
        file.flush()
    except OSError as error:
        raise ResultsError(
            f"cannot be written to: {error.strerror or error}",
            file=place,
            hint="choose a folder that you may write to",
        ) from error
    return file


def _is_same(file: IO[bytes], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


def _busy(place: Path, file: IO[bytes]) -> ResultsError:
    """What is told where another process holds the lock."""
    holder = ""
    with suppress(OSError):
        file.seek(0)
        holder = file.read(500).decode("utf-8", "replace").strip()
    return ResultsError(
        "another process is writing here" + (f" ({holder})" if holder else ""),
        file=place,
        hint="wait for it, or give another folder",
    )


_TRIAL = ".bayesoleo-"
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
        with tempfile.TemporaryDirectory(prefix=_TRIAL, dir=nearest):
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
