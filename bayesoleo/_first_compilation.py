"""Compilation in a process of its own, begun with a command on a machine where nothing is compiled
yet.

Whether that is so is known for certain only once the numerical libraries are loaded, which takes
seconds; a mark in the cache tells at once. Where the mark is missing and what takes longest is
compiled, the process ends soon.
"""

from __future__ import annotations

import hashlib
import os
import sys
from contextlib import suppress
from pathlib import Path

from bayesoleo._cache_folder import user_cache
from bayesoleo._kept_processes import begin_elsewhere
from bayesoleo._parallel import available_cores, thread_limit

#: What the process does: a module, and a function without arguments.
ELSEWHERE = ("bayesoleo.discovery._compile_ahead", "compile_ahead")
#: Whether another process was begun by this one: once is enough.
_begun: list[bool] = []


def begin_early(jobs: int | None) -> bool:
    """Begin with what has to be compiled, unless the mark says that nothing has.

    Parameters
    ----------
    jobs : int, optional
        How many may work at once; alone nothing is begun.

    Returns
    -------
    bool
        Whether another process compiles.
    """
    return not is_marked() and begin(jobs)


def is_marked() -> bool:
    """Whether what takes longest has been compiled before."""
    return _mark().exists()


def begin(jobs: int | None) -> bool:
    """Begin, if that was not done; whether another process compiles."""
    if not has_others(jobs):
        return False
    if not _begun:
        _begun.append(begin_elsewhere(*ELSEWHERE))
    return _begun[0]


def has_others(jobs: int | None) -> bool:
    """Whether another process may work beside this one."""
    return min(thread_limit(), jobs or available_cores()) > 1


def leave_mark() -> None:
    """Say that what takes longest is compiled."""
    with suppress(OSError):  # the next command looks once more
        mark = _mark()
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()


def _mark() -> Path:
    """Of this installation, this Python and the folder in which Numba keeps what it compiled."""
    own = Path(__file__)
    of = [str(own), str(own.stat().st_mtime_ns), sys.version, os.environ.get("NUMBA_CACHE_DIR", "")]
    return user_cache() / f"compiled-{hashlib.sha256(repr(of).encode()).hexdigest()[:16]}"
