"""Numbered pieces of a long calculation on disk: each whole or absent, only missing ones redone.

Where a piece depends on its own number alone (:meth:`Slots.fill`), a calculation that was stopped
goes on to the same result in any order and with any number of workers. Where each goes on from the
one before it (:meth:`Slots.chain`), it goes on from the last that is whole.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from bayesoleo.errors import ResultsError
from bayesoleo.machines import connected, each_done
from bayesoleo.storage.atomic import replacing
from bayesoleo.storage.lock import only_writer

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
            See :func:`bayesoleo.machines.connected`.
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
