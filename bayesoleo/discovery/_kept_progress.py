"""When the progress of a search is kept: not while other processes wait for this one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

from bayesoleo.discovery._round import Progress


class Kept:
    """Keeps how far a search has come as the work that follows begins. Where other processes take
    part in that, they need not wait: to keep it takes as long as several scores.

    What has not been kept is kept on leaving, by an exception too.

    Parameters
    ----------
    keep : callable
        Receives the progress.
    """

    def __init__(self, keep: Callable[[Progress], object] = lambda _: None) -> None:
        self._keep, self._left = keep, list[Progress]()

    def later(self, known: Progress) -> None:
        """Keep this progress at the next :meth:`now`, in place of an earlier one."""
        self._left[:] = [known]

    def now(self) -> None:
        """Keep what has not been kept."""
        while self._left:
            self._keep(self._left.pop())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.now()
