"""When the progress of a search is kept: not while other processes wait for this one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

from bayesoleo.discovery._round import Progress


class Kept:
    """How far a search has come, kept when it is known, or as soon as other processes work as well:
    to keep it takes as long as several scores, and they would wait.

    What is left is kept on leaving, by an exception too.

    Parameters
    ----------
    keep : callable
        Receives it.
    """

    def __init__(self, keep: Callable[[Progress], object] = lambda _: None) -> None:
        self._keep, self._left = keep, list[Progress]()

    def later(self, known: Progress) -> None:
        """Keep it at the next :meth:`now`; it holds what was left before."""
        self._left[:] = [known]

    def now(self) -> None:
        """Keep what is left."""
        while self._left:
            self._keep(self._left.pop())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.now()
