"""Independent tasks on this machine's threads, on processes of it, or on many machines, by Dask.

Workers return results and write nothing; the caller stores them. If a worker is lost, others repeat
the tasks with which it was busy.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from bayesoleo._parallel import available_cores, limit_threads, single_blas_thread
from bayesoleo.errors import InputError, ResultsError, import_extra

if TYPE_CHECKING:
    from distributed import Client


#: Name of workers on this machine; a number behind a colon sets how many.
LOCAL = "local"
#: Rounds in which workers are lost and not one task is done before it is given up.
ROUNDS = 3
#: Seconds to wait for a scheduler.
PATIENCE = 10

#: State of one worker pool on a worker: its token and its function.
_kept: dict[str, Callable[[Any], Any]] = {}


@contextmanager
def connected(scheduler: str | None) -> Iterator[Client | None]:
    """Connect to the machines that are to work.

    Parameters
    ----------
    scheduler : str or None
        Address of a Dask scheduler, for example ``tcp://10.0.0.1:8786``; ``local`` or ``local:4``
        for processes on this machine, of one thread each; None for threads of this process.

    Yields
    ------
    distributed.Client or None

    Raises
    ------
    InputError
        If the scheduler does not answer, or the number of processes is none.
    MissingExtraError
        If Dask is not installed.
    """
    if scheduler is None:
        yield None
        return
    distributed = import_extra("distributed", "dask")
    if scheduler.partition(":")[0] == LOCAL:
        with (
            distributed.LocalCluster(
                n_workers=_processes(scheduler),
                threads_per_worker=1,
                processes=True,
                # Not None: even without a dashboard there is a port, and 8787 may be taken.
                dashboard_address="localhost:0",
                silence_logs="CRITICAL",
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = distributed.Client(scheduler, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise InputError(
            "the scheduler does not answer",
            key="scheduler",
            value=scheduler,
            hint="start one with 'dask scheduler' and workers with 'dask worker <its address>',"
            " or write local:N",
        ) from error
    with client:
        yield client


def _processes(scheduler: str) -> int:
    number = scheduler.partition(":")[2] or str(available_cores())
    if not number.isdigit() or int(number) < 1:
        raise InputError(
            "the number of processes must be a whole number above zero",
            key="scheduler",
            value=scheduler,
            hint=f"write {LOCAL}, or {LOCAL}:4",
        )
    return int(number)


def each_done[T, R](
    function: Callable[[T], R],
    items: Sequence[T],
    *,
    client: Client | None = None,
    jobs: int | None = None,
) -> Iterator[tuple[int, R]]:
    """Do tasks in any order.

    Parameters
    ----------
    function : callable
        Called once an item. On other machines every task begins with a fresh copy of it.
    items : sequence
        The tasks.
    client : distributed.Client, optional
        Whose workers do them; by default threads of this process.
    jobs : int, optional
        Threads; by default the cores this process may use.

    Yields
    ------
    index, result
        As soon as it is there. What the function raises is raised.
    """
    if client is not None:
        yield from WorkerPool(client, function).each(items)
        return
    jobs = available_cores() if jobs is None else jobs
    if jobs <= 1 or len(items) <= 1:
        for index, item in enumerate(items):
            yield index, function(item)
        return
    with single_blas_thread(), ThreadPoolExecutor(min(jobs, len(items))) as pool:
        futures = {pool.submit(function, item): index for index, item in enumerate(items)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(cancel_futures=True)


class WorkerPool:
    """The workers of a cluster, all given one function.

    Parameters
    ----------
    client : distributed.Client
        Connection to them.
    function : callable
        Sent once to each worker.
    keep : bool
        Whether workers keep the function between calls, because it does not change by being
        called; by default every task begins with a fresh copy.
    """

    def __init__(
        self, client: Client, function: Callable[[Any], Any], *, keep: bool = False
    ) -> None:
        import cloudpickle

        self.client = client
        self._payload = cloudpickle.dumps(function)
        self._token = uuid.uuid4().hex if keep else ""
        self._shared: Any = None

    @property
    def size(self) -> int:
        """Threads of all workers together, at least one."""
        return int(max(sum(self.client.nthreads().values()), 1))

    def each(self, items: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Results of the function for items, as :func:`each_done`.

        Raises
        ------
        ResultsError
            If workers are lost again and again before any finishes a task.
        """
        from distributed import as_completed as completed

        missing, idle = dict(enumerate(items)), 0
        while missing:
            futures = self._submit(missing)
            before = len(missing)
            for future in completed(list(futures)):
                index = futures[future]
                try:
                    result = future.result()
                except Exception as error:
                    if _is_loss(error):
                        continue
                    self.client.cancel(list(futures))
                    raise
                del missing[index]
                future.release()
                yield index, result
            idle = idle + 1 if len(missing) == before else 0
            if missing:
                self._shared = None  # data sent may be lost with the workers that held it
            if idle == ROUNDS:
                raise ResultsError(
                    f"workers were lost {ROUNDS} times before one task was done",
                    hint="see why in the workers' logs: often they run out of memory",
                )

    def _submit(self, missing: dict[int, Any]) -> dict[Any, int]:
        if self._shared is None:
            self._shared = self.client.scatter([self._payload], broadcast=True, hash=False)[0]
        return {
            self.client.submit(_call, self._token, self._shared, item, pure=False): index
            for index, item in missing.items()
        }


def _is_loss(error: BaseException) -> bool:
    """Whether a task failed because its worker was lost, not by its own error."""
    from distributed import KilledWorker
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError

    kinds = (KilledWorker, CancelledError, FutureCancelledError, CommClosedError)
    return isinstance(error, kinds)


def _call(token: str, payload: bytes, item: Any) -> Any:
    """On a worker: one task, with as many threads as the worker has."""
    import cloudpickle
    from distributed import get_worker

    limit_threads(get_worker().state.nthreads)
    if not token:
        return cloudpickle.loads(payload)(item)
    if token not in _kept:
        _kept.clear()
        _kept[token] = cloudpickle.loads(payload)
    return _kept[token](item)
