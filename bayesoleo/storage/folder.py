"""Whether results can be written to a folder, found out before anything is computed."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from bayesoleo.errors import InputError

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
