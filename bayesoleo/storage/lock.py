"""One writer to a folder at a time."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from bayesoleo.errors import ResultsError


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
