"""Numbered pieces of a long calculation on disk: each whole or absent, only missing ones redone.

A piece depends on its own number alone, never on which pieces were made before it, so a calculation
that was stopped goes on to the same result in any order and with any number of workers.
"""

from __future__ import annotations

import os
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
_FINGERPRINT = "fingerprint"


class Slots:
    """A folder with one file a piece.

    Parameters
    ----------
    folder : path-like or None
        Made with the first piece; with None pieces are kept in memory.
    fingerprint : str
        Says what the pieces belong to; pieces of something else are refused.
    """

    def __init__(self, folder: str | os.PathLike[str] | None, fingerprint: str) -> None:
        self.folder = None if folder is None else Path(folder)
        self.fingerprint = fingerprint
        self._memory: dict[int, Arrays] = {}

    def path(self, number: int) -> Path | None:
        """File of a piece; None where pieces are kept in memory."""
        return None if self.folder is None else self.folder / f"slot-{number:06d}.npz"

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
            found = str(arrays.pop(_FINGERPRINT))
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise ResultsError(
                "is damaged", file=path, hint="remove it; only this piece is then made again"
            ) from error
        if found != self.fingerprint:
            raise ResultsError(
                "belongs to another calculation",
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
        with replacing(path) as draft:
            np.savez(draft, **named)  # type: ignore[arg-type]

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
            if self.folder is not None:  # what a process that was killed left half written
                for draft in self.folder.glob(".slot-*"):
                    draft.unlink()
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
