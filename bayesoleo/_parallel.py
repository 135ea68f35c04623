"""Distribution of independent work over threads.

Kernels release the interpreter lock, so threads are enough inside one process.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController

_limit: int | None = None


def limit_threads(count: int | None) -> None:
    """Limit the number of threads of this process; None removes the limit.

    For a worker that shares its machine with others like it.
    """
    global _limit
    _limit = count


def available_cores() -> int:
    """Number of cores that this process may use."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # macOS and Windows have no affinity call
        cores = os.cpu_count() or 1
    return cores if _limit is None else min(cores, _limit)


@cache
def _libraries() -> ThreadpoolController:
    """Linear algebra libraries of this process; finding them takes milliseconds."""

    return ThreadpoolController()


def single_blas_thread() -> AbstractContextManager[object]:
    """Keep linear algebra to the calling thread.

    Small problems gain nothing from more, and on a busy machine wait for them.
    """
    limit: AbstractContextManager[object] = _libraries().limit(limits=1, user_api="blas")
    return limit


def thread_map[T, R](
    function: Callable[[T], R], items: Iterable[T], jobs: int | None = None
) -> list[R]:
    """Apply ``function`` to every item and keep the order.

    Parameters
    ----------
    function : callable
        Called once an item; an exception it raises is passed on.
    items : iterable
        The work.
    jobs : int, optional
        Threads; by default the cores this process may use. One means no thread at all.

    Returns
    -------
    list
        Results in the order of the items.
    """
    work = list(items)
    jobs = available_cores() if jobs is None else jobs
    jobs = jobs if _limit is None else min(jobs, _limit)
    if jobs <= 1 or len(work) <= 1:
        return [function(item) for item in work]
    # Threads of ours that each call a linear algebra library with threads of its own would crowd
    # each other out.
    with single_blas_thread():
        if getattr(_here, "pooled", False):  # its own threads: a full pool would wait for itself
            with ThreadPoolExecutor(max_workers=min(jobs, len(work))) as pool:
                return _gather(pool, function, work)
        return _gather(_pool(jobs), function, work)


#: Whether the present thread is one of a pool.
_here = threading.local()
_pools: dict[int, ThreadPoolExecutor] = {}


def _pool(jobs: int) -> ThreadPoolExecutor:
    """Threads that are kept: to start them takes as long as a good part of a small batch."""
    if jobs not in _pools:
        _pools.setdefault(jobs, ThreadPoolExecutor(jobs, initializer=_enter))
    return _pools[jobs]


def _enter() -> None:
    _here.pooled = True


if hasattr(os, "register_at_fork"):  # threads do not follow into a forked process
    os.register_at_fork(after_in_child=_pools.clear)


def _gather[T, R](pool: ThreadPoolExecutor, function: Callable[[T], R], work: list[T]) -> list[R]:
    """Results in order; after an error or an interrupt no task keeps running."""
    futures = [pool.submit(function, item) for item in work]
    try:
        return [future.result() for future in futures]
    finally:
        for future in futures:
            future.cancel()
        wait(futures)
