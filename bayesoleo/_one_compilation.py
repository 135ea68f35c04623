"""Compilation of a function in one process at a time: others wait, and read what it has made."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import IO

from bayesoleo._cache_folder import user_cache
from bayesoleo._file_locks import FAR, try_lock

#: Seconds that a process waits for another one that compiles the same function, and between looks.
PATIENCE, LOOK = 120.0, 0.02
#: A file with a byte for each function.
LOCKS = "compiling.lock"


@contextmanager
def in_one_process(name: str, waiting: Callable[[], object]) -> Iterator[None]:
    """Wait while another process compiles a function of that name.

    Parameters
    ----------
    name : str
    waiting : callable
        Called at each look, while another process compiles it.
    """
    file = _lock_of(name, waiting)
    try:
        yield
    finally:
        if file is not None:  # the lock ends with it
            file.close()


def is_elsewhere(name: str) -> bool:
    """Whether another process compiles a function of that name now. Not to be asked while this one
    compiles: its locks end where the file is closed."""
    with suppress(OSError), (user_cache() / LOCKS).open("ab") as file:
        return not try_lock(file, _byte(name))
    return False


def _byte(name: str) -> int:
    return zlib.crc32(name.encode()) % FAR


def _lock_of(name: str, waiting: Callable[[], object]) -> IO[bytes] | None:
    """A file that is locked for a function, unless another process holds it for too long.

    None on a disk that has no locks: two processes may then compile the same.
    """
    with suppress(OSError):
        folder = user_cache()
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCKS).open("ab")
        end, byte = time.monotonic() + PATIENCE, _byte(name)
        try:
            while not try_lock(file, byte) and time.monotonic() < end:
                waiting()
                time.sleep(LOOK)
        except BaseException:
            file.close()
            raise
        return file
    return None
