"""Independent work on threads, on processes of this machine, or on many machines by Dask.

Kernels release the interpreter lock, so threads are enough for work that is mostly in kernels; work
in Python goes to :mod:`bayesoleo._worker_processes`. A calculation that is to outlive others'
crashes gets a process of its own. Workers on other machines return results
and write nothing; the caller stores them. If a worker is lost, others repeat the tasks with which
it was busy.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, as_completed, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from threadpoolctl import ThreadpoolController

from bayesoleo.errors import InputError, ResultsError, import_extra

if TYPE_CHECKING:
    from distributed import Client

_limit: int | None = None
_COUNTING = threading.Lock()
#: The limit of linear algebra, once for each that is inside of :func:`single_blas_thread`.
_inside: list[Any] = []

#: What keeps libraries of linear algebra to one thread where they are loaded.
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")


def limit_threads(count: int | None) -> None:
    """Limit the number of threads of this process; None removes the limit.

    For a worker that shares its machine with others like it.
    """
    global _limit
    _limit = count


def thread_limit() -> int:
    """Number of threads to which this process is limited; very many without a limit."""
    return sys.maxsize if _limit is None else _limit


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


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Keep linear algebra to the calling thread.

    Small problems gain nothing from more, and on a busy machine wait for them: filters of inputs
    took twenty times as long. The limit is the whole process's; the first of several threads that
    are inside sets it, and the last one gives back what there was.
    """
    with _COUNTING:
        if not _inside:
            _inside.append(_libraries().limit(limits=1, user_api="blas"))
        else:
            _inside.append(_inside[0])
    try:
        yield
    finally:
        with _COUNTING:
            limit = _inside.pop()
            if not _inside:
                limit.restore_original_limits()


def session_blas_threads() -> AbstractContextManager[None]:
    """One thread of linear algebra, unless the environment says how many there are to be."""
    asked = any(name in os.environ for name in ONE_THREAD)
    return nullcontext() if asked else single_blas_thread()


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


def shared_size(count: int, most: int, jobs: int) -> int:
    """Items of a task, so many at most, of which there are at least two for each thread: some take
    a hundred times as long as others."""
    return max(1, min(most, -(-count // (2 * jobs))))


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


#: Name of workers on this machine; a number behind a colon sets how many.
LOCAL = "local"
#: Rounds in which workers are lost and not one task is done before it is given up.
ROUNDS = 3
#: Seconds to wait for a scheduler.
PATIENCE = 10
#: Seconds to wait for a worker where a cluster has none: those that were killed begin again.
WAIT = 300
#: What calls of a client raise while its scheduler is being lost; the last kind once its pool of
#: connections is closed.
UNCONNECTED = (OSError, CancelledError, RuntimeError)

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
        with suppress(*UNCONNECTED):  # the scheduler is being lost, as the next task will tell
            return int(max(sum(self.client.nthreads().values()), 1))
        return 1

    def each(self, items: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Results of the function for items, as :func:`each_done`.

        Raises
        ------
        ResultsError
            If workers are lost again and again before any finishes a task, if none comes, or if the
            scheduler is lost.
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
                        self._check_scheduler()
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
        self._check_scheduler()
        self._share()
        try:
            return {
                self.client.submit(_call, self._token, self._shared, item, pure=False): index
                for index, item in missing.items()
            }
        except Exception:  # Dask's own kind, where a client closes meanwhile
            self._check_scheduler()
            raise

    def _share(self) -> None:
        """Send the function to all workers, as soon as there is one."""
        deadline = time.monotonic() + WAIT
        while self._shared is None:
            try:
                self._shared = self.client.scatter([self._payload], broadcast=True, hash=False)[0]
            # There is no worker, or the last one is lost while it is sent to: Dask then finds an
            # unknown address or nothing to copy to. A client that is closed has no scheduler.
            except (*UNCONNECTED, KeyError, ValueError, AttributeError) as error:
                self._check_scheduler()
                if time.monotonic() > deadline:
                    raise ResultsError(
                        f"the scheduler has had no workers for {WAIT} seconds",
                        hint="start some with 'dask worker <its address>', or see in their logs why"
                        f" they ended ({type(error).__name__}: {error})",
                    ) from error
                time.sleep(LOOK)

    def _check_scheduler(self) -> None:
        """Say so where it is the scheduler that is lost."""
        if self.client.status not in ("running", "connecting"):
            raise ResultsError(
                "the scheduler was lost",
                hint="start it and its workers, and then the same command, which goes on where its"
                " results are stored",
            )


def _is_loss(error: BaseException) -> bool:
    """Whether a task failed because its worker was lost, not by its own error."""
    from distributed import KilledWorker
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError

    kinds = (KilledWorker, CancelledError, FutureCancelledError, CommClosedError)
    return isinstance(error, kinds)


def _call(token: str, payload: bytes, item: Any) -> Any:
    """On a worker: one task, in one thread; a worker gets as many at a time as it has threads."""
    import cloudpickle

    limit_threads(1)
    if not token:
        return cloudpickle.loads(payload)(item)
    if token not in _kept:
        _kept.clear()
        _kept[token] = cloudpickle.loads(payload)
    return _kept[token](item)


#: Seconds between two looks at a process, and how often it is seen whether it is to stop.
LOOK = 0.1
_CALL, _VALUE, _PATHS, _SAID = "call.pickle", "value.pickle", "paths.json", "said.txt"
#: It finds modules where its parent finds them. Unlike ``multiprocessing`` it does not run the
#: script of the user again, which then needs no guard.
_CHILD = (
    "import json, sys; sys.path[:] = json.load(open(sys.argv[1] + '/paths.json'));"
    " from bayesoleo._parallel import answer; answer(sys.argv[1])"
)


class LostError(Exception):
    """The process or the worker of a task ended before the task did.

    Parameters
    ----------
    reason : str
        What is known of it.
    times : int
        How many of them did; none where it is the scheduler that was lost.
    """

    def __init__(self, reason: str, times: int = 1) -> None:
        self.reason, self.times = reason, times
        super().__init__(reason)


def in_own_process[R](
    function: Callable[[Path], R],
    stopped: Callable[[], bool] = lambda: False,
    *,
    within: str | os.PathLike[str] | None = None,
) -> R:
    """Call a function in a new process, with one thread of linear algebra.

    The process ends with this one, however this one ends.

    Parameters
    ----------
    function : callable
        Sent by value. Its argument is a folder that is removed afterwards.
    stopped : callable
        Asked again and again whether to give up.
    within : path-like, optional
        Where that folder is made; by default where temporary files are.

    Returns
    -------
    object
        What the function returns.

    Raises
    ------
    LostError
        If the process ends without a result.
    CancelledError
        If it was stopped.
    """
    import cloudpickle

    with tempfile.TemporaryDirectory(
        prefix="bayesoleo-", dir=within, ignore_cleanup_errors=True
    ) as made:
        folder = Path(made)
        (folder / _CALL).write_bytes(cloudpickle.dumps(function))
        (folder / _PATHS).write_text(json.dumps(sys.path), encoding="utf-8")
        _await_process(folder, stopped)
        value: R = cloudpickle.loads((folder / _VALUE).read_bytes())
        return value


def _await_process(folder: Path, stopped: Callable[[], bool]) -> None:
    """Run the call that a folder holds to its end."""
    environment = os.environ | dict.fromkeys(ONE_THREAD, "1")
    command = [sys.executable, "-c", _CHILD, str(folder)]
    with (
        (folder / _SAID).open("wb") as said,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=said, stderr=said, env=environment
        ) as child,
    ):
        try:
            while child.poll() is None:
                if stopped():
                    raise CancelledError
                with suppress(subprocess.TimeoutExpired):
                    child.wait(LOOK)
        finally:
            child.kill()
    if not (folder / _VALUE).is_file():  # it is whole where it is there, however the process ended
        raise LostError(_last_words(child.returncode, folder / _SAID))


def _last_words(code: int, said: Path) -> str:
    """How a process ended, and the last line that it wrote."""
    how = f"signal {-code}" if code < 0 else f"exit status {code}"
    lines = said.read_text(encoding="utf-8", errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f"its process ended with {how}" + (f": {last[-300:]}" if last else "")


def answer(place: str) -> None:
    """In the new process: call the function and leave its result in the folder."""
    import cloudpickle

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    limit_threads(1)
    folder = Path(place)
    value = cloudpickle.loads((folder / _CALL).read_bytes())(folder)
    draft = folder / f".{_VALUE}"
    draft.write_bytes(cloudpickle.dumps(value))
    os.replace(draft, folder / _VALUE)


def _end_with_parent() -> None:
    """End this process when the other end of its input is closed."""
    # Not by sys.stdin: Python would abort at its end where a thread waits in a buffered read.
    while os.read(0, 1):
        pass
    os._exit(1)


class Pending(Protocol):
    """A result that is yet to come: a future of Python or of Dask."""

    def result(self) -> Any:
        """The result, or what was raised."""

    def add_done_callback(self, fn: Callable[[Any], Any]) -> Any:
        """Call a function with this once it is done."""


class TaskPool(Protocol):
    """Where calls are made, each in a process of its own."""

    @property
    def size(self) -> int:
        """Calls that are made at a time; none for now where it is zero."""

    @property
    def lost(self) -> str:
        """Why no calls are taken any more; empty while they are."""

    def submit(self, function: Callable[[Path], Any]) -> Pending:
        """Begin a call."""


class OwnProcesses:
    """Processes of this machine.

    Parameters
    ----------
    jobs : int
        How many at a time.
    """

    lost = ""

    def __init__(self, jobs: int) -> None:
        self.size, self._stop = jobs, threading.Event()
        self._threads = ThreadPoolExecutor(jobs)

    def submit(self, function: Callable[[Path], Any]) -> Future[Any]:
        """Begin a call as soon as one of the processes is free."""
        return self._threads.submit(in_own_process, function, self._stop.is_set)

    def close(self) -> None:
        """End all processes."""
        self._stop.set()
        self._threads.shutdown(cancel_futures=True)


class Machines:
    """Processes of the workers of a cluster.

    Parameters
    ----------
    client : distributed.Client
        Connection to them.
    """

    #: Seconds for which a count of the workers' threads holds.
    COUNTED = 2.0

    def __init__(self, client: Client) -> None:
        self.client = client
        self._size, self._counted = 1, -math.inf
        self._empty_since: float | None = None
        self._begun: weakref.WeakSet[Any] = weakref.WeakSet()

    @property
    def lost(self) -> str:
        """Says so where the scheduler does not answer and will not again, or where no look has
        found a worker for long, as when all were lost and none began again."""
        if self.client.status not in ("running", "connecting"):
            return "the scheduler was lost"
        # After a look now: to prepare and send many tasks may have taken long.
        if self.size and self._empty_since and time.monotonic() - self._empty_since > WAIT:
            return f"the scheduler has had no workers for {WAIT} seconds"
        return ""

    @property
    def size(self) -> int:
        """Threads of all workers, at least one; none while the scheduler does not answer."""
        if self.client.status != "running":
            return 0
        now = time.monotonic()
        if now - self._counted > self.COUNTED:
            with suppress(*UNCONNECTED):  # the scheduler is being lost
                threads = sum(self.client.nthreads().values())
                self._size = max(threads, 1)
                self._empty_since = None if threads else self._empty_since or now
            self._counted = now
        return self._size

    def submit(self, function: Callable[[Path], Any]) -> Any:
        """Send a call; it is done by whichever worker has a thread free."""
        import cloudpickle

        found = self.client.submit(_on_worker, cloudpickle.dumps(function), pure=False)
        self._begun.add(found)
        return found

    def close(self) -> None:
        """Cancel what is not done; its processes end."""
        if self.client.status == "running":
            with suppress(*UNCONNECTED):
                self.client.cancel([one for one in self._begun if not one.done()])


def _on_worker(payload: bytes) -> Any:
    """On a worker: make a call in a process of its own, unless it is cancelled."""
    import cloudpickle
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def stopped() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state in ("cancelled", "released", "forgotten")

    return in_own_process(cloudpickle.loads(payload), stopped, within=worker.local_directory)


@contextmanager
def task_pool(scheduler: str | None, jobs: int | None) -> Iterator[TaskPool]:
    """Processes of this machine, or of the workers of a scheduler.

    Parameters
    ----------
    scheduler : str or None
        See :func:`connected`; None for this machine.
    jobs : int or None
        Processes at a time of this machine; by default the cores it may use.
    """
    with connected(scheduler) as client:
        pool = OwnProcesses(jobs or available_cores()) if client is None else Machines(client)
        try:
            yield pool
        finally:
            pool.close()


def loss_of(error: BaseException) -> LostError | None:
    """How a task's process or worker was lost, where that is why it failed."""
    if isinstance(error, LostError):
        return error
    if "distributed" not in sys.modules:
        return LostError("it was stopped") if isinstance(error, CancelledError) else None
    if not _is_loss(error):
        return None
    if getattr(error, "reason", "") == "scheduler-connection-lost":
        return LostError("the scheduler was lost", 0)
    deaths = getattr(error, "allowed_failures", 0) + 1
    return LostError(f"{deaths} workers that ran it died" if deaths > 1 else str(error), deaths)
