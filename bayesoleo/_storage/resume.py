"""Calculations that resume: a digest of their inputs, their state and their pieces on disk.

Equal digests mean equal inputs, in any process. A state is pickled: a file is only read where its
first line carries the key of the calculation that asks for it and its content is whole. Pickles are
code; resume only from folders of your own.

A piece is whole or absent, and only missing ones are computed. Where a piece depends on its own
number alone (:meth:`Slots.fill`), a calculation that was stopped reaches the same result in any
order and with any number of workers. Where each depends on the one before it (:meth:`Slots.chain`),
it resumes from the last whole one.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import platform
import zlib
from collections.abc import Callable, Mapping, Set
from dataclasses import fields, is_dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from types import CodeType, FunctionType, MethodType
from typing import IO, Any
from zipfile import BadZipFile

import cloudpickle
import numpy as np
from numpy.typing import NDArray

from bayesoleo._parallel import connected, each_done
from bayesoleo._storage.files import only_writer, replacing
from bayesoleo._storage.result_files import PACKAGES, package_version
from bayesoleo.errors import ResultsError
from bayesoleo.model._model import Model

_PLAIN = (str, bytes, bool, int, float, complex, type(None))


def digest(value: Any) -> str:
    """SHA-256 of a value: numbers, text, arrays, containers, dataclasses, models, functions.

    A function is known by its code, its defaults, what it encloses, and those constants and
    functions of its own module that it mentions.

    Parameters
    ----------
    value : object
    """
    total = hashlib.sha256()
    _feed(total, value, [])
    return total.hexdigest()


@cache
def package_digest() -> str:
    """Digest of the package's own code, and of the versions of what can change a number."""
    root = Path(__file__).parents[1]
    sources = {str(file.relative_to(root)): file.read_bytes() for file in root.rglob("*.py")}
    versions = {name: package_version(name) for name in PACKAGES}
    return digest((dict(sorted(sources.items())), versions, platform.python_version()))


def _feed(total: Any, value: Any, inside: list[int]) -> None:
    """Add a value; one that holds itself is entered once."""
    total.update(f"<{type(value).__qualname__}>".encode())
    if isinstance(value, _PLAIN):
        total.update(repr(value).encode("utf-8", "surrogatepass"))
        return
    if id(value) in inside:
        return
    inside.append(id(value))
    if isinstance(value, np.ndarray):
        total.update(f"{value.dtype} {value.shape}".encode())
        total.update(np.ascontiguousarray(value).tobytes())
    else:
        for part in _parts(value):
            _feed(total, part, inside)
    inside.pop()


def _parts(value: Any) -> list[Any]:
    """What a value is made of."""
    if isinstance(value, Model):
        return [value.digest()]
    if isinstance(value, Mapping):
        return [part for item in value.items() for part in item]
    if isinstance(value, Set):
        return sorted(map(digest, value))
    if isinstance(value, list | tuple):
        return list(value)
    if isinstance(value, FunctionType):
        return _of_function(value)
    if isinstance(value, CodeType):
        return [value.co_code, value.co_names, value.co_consts]
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, functools.partial):
        return [value.func, value.args, value.keywords]
    if is_dataclass(value) and not isinstance(value, type):
        return [(item.name, getattr(value, item.name)) for item in fields(value)]
    if isinstance(value, type):
        return [value.__module__, value.__qualname__]
    own = getattr(value, "__dict__", None)
    return [own] if own else [str(value)]


def _of_function(function: FunctionType) -> list[Any]:
    cells = [cell.cell_contents for cell in function.__closure__ or () if _filled(cell)]
    mentioned = {
        name: item
        for name in function.__code__.co_names
        if _is_own(item := function.__globals__.get(name), function)
    }
    own = [function.__module__, function.__qualname__, function.__code__, function.__defaults__]
    return [*own, function.__kwdefaults__, cells, mentioned]


def _is_own(item: Any, function: FunctionType) -> bool:
    """Whether something that a function mentions is a constant, or a function of its module."""
    if isinstance(item, FunctionType):
        return item.__module__ == function.__module__
    return item is not None and isinstance(item, (*_PLAIN, tuple, np.ndarray))


def _filled(cell: Any) -> bool:
    try:
        cell.cell_contents  # noqa: B018 - an empty cell raises
    except ValueError:
        return False
    return True


Key = Mapping[str, str]
_FORMAT = "bayesoleo state 1"


def keep_state(path: str | os.PathLike[str], key: Key, state: Any) -> None:
    """Write a state in place of an older one, as a whole or not at all.

    Parameters
    ----------
    path : path-like
        File.
    key : mapping of str to str
        What the calculation depends on, each with a digest of it.
    state : object
        Anything that can be pickled.

    Raises
    ------
    ResultsError
        If the place cannot be written to.
    """
    with replacing(path) as draft, draft.open("wb") as stream:
        # The sum comes first in the file, and is known last: room is left for it.
        stream.write(_head(key, hashlib.sha256()))
        content = _Summed(stream)
        cloudpickle.dump(state, content)
        stream.seek(0)
        stream.write(_head(key, content.sum))


def _head(key: Key, content: Any) -> bytes:
    """First line of a state, of the same length for every sum of its content."""
    head = {"format": _FORMAT, "key": dict(key), "sha256": content.hexdigest()}
    return json.dumps(head).encode() + b"\n"


class _Summed:
    """A stream whose content is summed as it is written: a state of hundreds of megabytes is not
    held a second time."""

    def __init__(self, stream: IO[bytes]) -> None:
        self.stream, self.sum = stream, hashlib.sha256()

    def write(self, data: Any) -> int:
        self.sum.update(data)
        return self.stream.write(data)


def kept_state(path: str | os.PathLike[str], key: Key) -> tuple[Any, str]:
    """The state of a calculation, and why there is none.

    Parameters
    ----------
    path : path-like
        File of :func:`keep_state`.
    key : mapping of str to str
        As it must have been when the state was kept.

    Returns
    -------
    state : object
        None if there is none that can be used.
    reason : str
        In that case; empty where there is no file.
    """
    try:
        head_line, _, content = Path(path).read_bytes().partition(b"\n")
        head = json.loads(head_line)
        stored, checksum, kind = head["key"], head["sha256"], head["format"]
    except FileNotFoundError:
        return None, ""
    except (OSError, ValueError, KeyError, TypeError):
        return None, "it cannot be read"
    if kind != _FORMAT or hashlib.sha256(content).hexdigest() != checksum:
        return None, "it is damaged"
    names = [*key, *(stored.keys() - key.keys())]
    other = [name for name in names if stored.get(name) != key.get(name)]
    if other:
        return None, f"it belongs to {' and '.join(f'another {name}' for name in other)}"
    try:
        return cloudpickle.loads(content), ""
    # A pickle can fail in any way, for example where a file of the user has moved.
    except Exception as error:
        return None, f"it cannot be read ({type(error).__name__}: {error})"


Arrays = dict[str, NDArray[Any]]
_FINGERPRINT, _CHECKSUM = "fingerprint", "checksum"
#: What reading a truncated or altered archive can raise.
_DAMAGE = (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error)


class Slots:
    """A folder with one file a piece.

    Parameters
    ----------
    folder : path-like or None
        Made with the first piece; with None pieces are kept in memory.
    fingerprint : str
        Says what the pieces belong to; pieces of something else are refused.
    name : str
        What files are called.
    foreign : str
        What is said of pieces of something else.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str] | None,
        fingerprint: str,
        *,
        name: str = "slot",
        foreign: str = "belongs to another calculation",
    ) -> None:
        self.folder = None if folder is None else Path(folder)
        self.fingerprint, self.name, self.foreign = fingerprint, name, foreign
        self._memory: dict[int, Arrays] = {}

    def path(self, number: int) -> Path | None:
        """File of a piece; None where pieces are kept in memory."""
        return None if self.folder is None else self.folder / f"{self.name}-{number:06d}.npz"

    def read(self, number: int) -> Arrays | None:
        """Arrays of a piece, or None if it has not been made.

        Raises
        ------
        ResultsError
            If the file is damaged or belongs to another calculation.
        """
        path = self.path(number)
        if path is None:
            return self._memory.get(number)
        if not path.is_file():
            return None
        try:
            with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            checksum, found = arrays.pop(_CHECKSUM), str(arrays[_FINGERPRINT])
            if not np.array_equal(checksum, _checksum(arrays, number)):
                raise ValueError("another checksum")
            del arrays[_FINGERPRINT]
        except _DAMAGE as error:
            raise ResultsError(
                "is damaged", file=path, hint="remove it; only this piece is then made again"
            ) from error
        if found != self.fingerprint:
            raise ResultsError(
                self.foreign,
                file=path,
                hint="choose another folder, or remove this one",
            )
        return arrays

    def write(self, number: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep a piece, as a whole or not at all.

        Raises
        ------
        ResultsError
            If the folder cannot be written to.
        """
        path = self.path(number)
        if path is None:
            self._memory[number] = dict(arrays)
            return
        named: Arrays = {**arrays, _FINGERPRINT: np.array(self.fingerprint)}
        named[_CHECKSUM] = _checksum(named, number)
        with replacing(path) as draft:
            np.savez(draft, **named)  # type: ignore[arg-type]

    def remove_drafts(self) -> None:
        """Remove what a process that was killed has left half written."""
        if self.folder is not None:
            for draft in self.folder.glob(f".{self.name}-*"):
                draft.unlink()

    def chain(self) -> list[Arrays]:
        """Pieces up to the first that is missing or damaged; what comes after it is set aside.

        Raises
        ------
        ResultsError
            If the folder holds pieces of another calculation.
        """
        if self.folder is None:
            return [self._memory[number] for number in range(len(self._memory))]
        self.remove_drafts()
        found: list[Arrays] = []
        for number in range(len(list(self.folder.glob(f"{self.name}-*.npz")))):
            try:
                piece = self.read(number)
            except ResultsError as error:
                if error.__cause__ is None:  # whole, but of another calculation
                    raise
                break
            if piece is None:
                break
            found.append(piece)
        for path in sorted(self.folder.glob(f"{self.name}-*.npz")):
            if int(path.stem.split("-")[-1]) >= len(found):
                _set_aside(path)
        return found

    def fill(
        self,
        make: Callable[[int], Arrays],
        count: int,
        *,
        whole: Callable[[int, Arrays], bool] = lambda _number, _arrays: True,
        scheduler: str | None = None,
        jobs: int | None = None,
        done: Callable[[int], None] = lambda _number: None,
    ) -> list[Arrays]:
        """Make the pieces that are missing, and return all.

        Workers only make them; this process alone writes, each piece as soon as it is there.

        Parameters
        ----------
        make : callable
            Piece by number; a function of the number alone. With a scheduler it is sent to others.
        count : int
            Pieces ``0 … count - 1`` are wanted.
        whole : callable, optional
            Whether a stored piece is all of what is wanted.
        scheduler : str, optional
            See :func:`bayesoleo._parallel.connected`.
        jobs : int, optional
            Threads, where there is no scheduler.
        done : callable, optional
            Told the number of each piece that is there.

        Returns
        -------
        list of dict
            By number.

        Raises
        ------
        ResultsError
            If another process writes to the folder, or a stored piece is damaged.
        """
        with only_writer(self.folder):
            self.remove_drafts()
            pieces: dict[int, Arrays] = {}
            for number in range(count):
                stored = self.read(number)
                if stored is not None and whole(number, stored):
                    pieces[number] = stored
                    done(number)
            missing = [number for number in range(count) if number not in pieces]
            if missing:
                with connected(scheduler) as client:
                    for index, arrays in each_done(make, missing, client=client, jobs=jobs):
                        number = missing[index]
                        self.write(number, arrays)
                        pieces[number] = arrays
                        done(number)
        return [pieces[number] for number in range(count)]


def _checksum(arrays: Mapping[str, NDArray[Any]], number: int) -> NDArray[np.uint8]:
    """Digest of a piece and its number: a file must be whole, and not another's."""
    digest = hashlib.sha256(str(number).encode())
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        digest.update(f"{key}{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return np.frombuffer(digest.digest(), dtype=np.uint8)


def _set_aside(path: Path) -> None:
    """Rename a file so that it is neither read nor overwritten."""
    number = 0
    while (aside := path.with_suffix(f".broken-{number}")).exists():
        number += 1
    path.rename(aside)
