"""When the progress of a search is kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

from bayesoleo.discovery._round import Progress


class Kept:
    """Keeps how far a search has come, at once or as the work that follows begins.

    To keep it takes as long as several scores, for which other processes would wait. What has not
    been kept is kept on leaving, by an exception too.

    Parameters
    ----------
    keep : callable
        Receives the progress.
    at_once : bool
        Whether :meth:`later` is :meth:`now`.
    """

    def __init__(
        self, keep: Callable[[Progress], object] = lambda _: None, *, at_once: bool = False
    ) -> None:
        self._keep, self._at_once, self._left = keep, at_once, list[Progress]()

    def later(self, known: Progress) -> None:
        """Keep this progress at the next :meth:`now`, in place of an earlier one."""
        self._left[:] = [known]
        if self._at_once:
            self.now()

    def now(self) -> None:
        """Keep what has not been kept."""
        while self._left:
            self._keep(self._left.pop())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.now()
