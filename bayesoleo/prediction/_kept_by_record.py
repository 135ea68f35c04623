"""Arrays that follow from a run, or from a model of it, and are asked for again and again."""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import partial

from bayesoleo._types import Array
from bayesoleo.prediction._records import Record


class KeptByRecord:
    """Arrays of runs, those asked for last. They go with the run.

    Parameters
    ----------
    most : float
        Bytes.
    """

    def __init__(self, most: float):
        # A run may go while this one holds it: then its thread asks again.
        self.most, self.lock = most, threading.RLock()
        self.kept: OrderedDict[tuple[int, Hashable], Array] = OrderedDict()
        self.runs: dict[int, weakref.ref[Record]] = {}
        self._bytes = 0

    def of(self, record: Record, key: Hashable, make: Callable[[], Array]) -> Array:
        """What is kept of a run under a key, or is made of it now; not to be written to. Nothing
        without a number is kept: no limit would end that."""
        full = id(record), key
        with self.lock:
            if full in self.kept:
                self.kept.move_to_end(full)
                return self.kept[full]
        found = make()
        found.flags.writeable = False
        if not found.size:
            return found
        with self.lock:
            if full[0] not in self.runs:
                self.runs[full[0]] = weakref.ref(record, partial(self._forget, full[0]))
            self._drop(full)  # another thread may have made it too
            self.kept[full] = found
            self._bytes += found.nbytes
            while len(self.kept) > 1 and self._bytes > self.most:
                self._drop(next(iter(self.kept)))
        return found

    def _drop(self, full: tuple[int, Hashable]) -> None:
        gone = self.kept.pop(full, None)
        self._bytes -= 0 if gone is None else gone.nbytes

    def _forget(self, number: int, _: object) -> None:
        """Of a run that is no more, before another one has its number."""
        with self.lock:
            self.runs.pop(number, None)
            for full in [full for full in self.kept if full[0] == number]:
                self._drop(full)
