"""Work of one calculation in several processes of this machine.

Scores and estimates of candidate effects spend most of their time in Python, where threads wait
for each other. The processes are kept for the next call, because to start one takes two seconds,
and end when they have had nothing to do for a while or when this process ends.

A result does not depend on where it was computed. A process that is lost, or that cannot read what
it is sent, only costs time: its work is done here.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import io
import json
import os
import pickle
import select
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any, BinaryIO, Self, cast

import bayesoleo._parallel as parallel

#: Seconds of work left, as far as can be seen, from which processes that run already are asked,
#: and from which one is started.
WORTH_ASKING, WORTH_STARTING = 0.5, 4.0
#: Seconds between looks at whether they are worth asking.
LOOK = 0.05
#: Seconds without work after which a process ends.
IDLE = 120.0

#: A message: a pickle, and the memory of its large arrays, which is not copied into it.
type Message = list[memoryview | bytes | bytearray]
_HEADER = struct.Struct("<Q")
#: Bytes from which an array is sent beside the pickle: arrays take a copy less on either side.
LARGE = 2**16
#: It finds modules where its parent finds them, and does not run the user's script again.
_CHILD = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]);"
    " from bayesoleo._worker_processes import serve; serve(sys.argv[2:])"
)
_READY, _VALUE, _ERROR, _UNREADABLE = "ready", "value", "error", "unreadable"


class _LostError(Exception):
    """A process ended, or cannot read what it was sent."""


def process_map[S, T, R](
    function: Callable[[S, T], R],
    shared: S,
    items: Iterable[T],
    jobs: int | None = None,
    *,
    known: Callable[[S], Sequence[Any]] = lambda _: (),
    before: Callable[[], object] = lambda: None,
    cost: Callable[[T], float] = lambda _: 0.0,
) -> list[R]:
    """Apply ``function(shared, item)`` to every item, in this process and others; keep the order.

    This process begins with the first item of the highest cost. Others take items from the other
    end as soon as the work that is left seems worth it, so that short work is done without them.

    Parameters
    ----------
    function : callable
        Of a module, so that other processes find it.
    shared : object
        What all calls need; sent once to each process.
    items : iterable
        The work.
    jobs : int, optional
        Processes, this one included; by default the cores that it may use.
    known : callable
        Objects within ``shared`` that results refer to rather than copy.
    before : callable
        What this process does before its first item, while others do theirs.
    cost : callable
        About how long an item takes, in any unit: one that takes long must not be the last.

    Returns
    -------
    list
        Results in the order of the items. An exception that a call raises is passed on.
    """
    work = list(items)
    jobs = min(parallel.available_cores() if jobs is None else jobs, parallel.thread_limit())
    alone = jobs <= 1 or len(work) <= 1 or not _usable()
    if alone or not _in_use.acquire(blocking=False):
        before()
        return [function(shared, item) for item in work]
    try:
        order = sorted(range(len(work)), key=lambda k: -cost(work[k]))
        return _shared(function, shared, work, jobs, known, before, order)
    finally:
        _in_use.release()


#: Held while a call uses the processes: another one at that time does its work by itself.
_in_use = threading.Lock()


def _shared[S, T, R](
    function: Callable[[S, T], R],
    shared: S,
    work: list[T],
    jobs: int,
    known: Callable[[S], Sequence[Any]],
    before: Callable[[], object],
    order: Sequence[int],
) -> list[R]:
    """Results of :func:`process_map` by this process and others."""
    call = _Call(function, shared, work, known, order)
    helpers = [
        threading.Thread(target=call.help, args=(k,), daemon=True)
        for k in range(min(jobs, len(work)) - 1)
    ]
    for helper in helpers:
        helper.start()
    try:
        before()
        call.work()
    except BaseException:
        kill_processes()  # nobody waits for what they are doing
        raise
    finally:
        call.stop()
        for helper in helpers:
            helper.join()
    return cast(list[R], call.results())


#: What the processes of a search need to begin with.
OF_A_SEARCH = ("bayesoleo.discovery._loop", "bayesoleo._report.page")


def start_ahead(modules: Sequence[str] = OF_A_SEARCH, jobs: int | None = None) -> None:
    """Start a process now for work that comes later: it takes seconds to load libraries.

    Parameters
    ----------
    modules : sequence of str
        What the work needs.
    jobs : int, optional
        As of :func:`process_map`; with one there is nothing to start.
    """
    jobs = min(parallel.available_cores() if jobs is None else jobs, parallel.thread_limit())
    if jobs > 1 and _usable():
        with suppress(_LostError):
            _worker(0, modules)


def load(modules: Sequence[str]) -> None:
    """Load modules in a process of this package's own, which needs them until it ends.

    There is no garbage in them: half a million objects are kept out of all searches for it.

    Parameters
    ----------
    modules : sequence of str
        Where all are loaded, nothing is done.
    """
    if all(name in sys.modules for name in modules):
        return
    was_on = gc.isenabled()
    gc.disable()
    try:
        for name in modules:
            importlib.import_module(name)
    finally:
        gc.freeze()
        if was_on:
            gc.enable()


def _usable() -> bool:
    """Whether processes may be started: not by a worker, nor where the user forbids it."""
    asked = os.environ.get("BAYESOLEO_PROCESSES", "")
    return asked != "0" and bool(sys.executable)


class _Call:
    """The items of one call, those that are taken, and what came of them."""

    def __init__(
        self,
        function: Callable[[Any, Any], Any],
        shared: Any,
        items: list[Any],
        known: Callable[[Any], Sequence[Any]],
        order: Sequence[int],
    ):
        self.function, self.shared, self.items, self.known = function, shared, items, known
        self.left = deque(order)
        self.found: dict[int, Any] = {}
        self.failed: BaseException | None = None
        self.lock, self.over = threading.Lock(), threading.Event()
        self.begun = time.perf_counter()
        self._sent: Message = []

    def _take(self, last: bool) -> int | None:
        with self.lock:
            if not self.left or self.failed is not None:
                return None
            return self.left.pop() if last else self.left.popleft()

    def _give_back(self, index: int) -> None:
        with self.lock:
            self.left.appendleft(index)

    def work(self) -> None:
        """Do items here until none is left and those of other processes have come."""
        while True:
            index = self._take(last=False)
            if index is not None:
                self.found[index] = self.function(self.shared, self.items[index])
            elif self.failed is not None or len(self.found) == len(self.items):
                return
            else:
                self.over.wait(LOOK)  # what a lost process had is given back
                self.over.clear()

    def stop(self) -> None:
        """Take no further items."""
        with self.lock:
            self.left.clear()

    def results(self) -> list[Any]:
        """What came of all items, in their order."""
        if self.failed is not None:
            raise self.failed
        return [self.found[index] for index in range(len(self.items))]

    def help(self, number: int) -> None:
        """Have another process do items, from the last on, once that is worth it."""
        while not self._worth(number):
            if not self.left:
                return
            time.sleep(LOOK)
        index: int | None = None
        try:
            worker = _worker(number)
            worker.ask(self._message())  # what all calls need
            objects = self.known(self.shared)
            while (index := self._take(last=True)) is not None:
                kind, value = worker.ask(_sent((index, self.items[index]), objects), objects)
                if kind == _ERROR:
                    self.failed = value
                else:
                    self.found[index] = value
                index = None
                self.over.set()
            worker.ask(_dumps((None, None, None)))  # it needs no memory until the next call
        except _LostError:
            _forget(number)
            if index is not None:
                self._give_back(index)
        except BaseException as error:  # it must not be lost with the thread
            self.failed = self.failed or error
        finally:
            self.over.set()

    def _worth(self, number: int) -> bool:
        """Whether the work that is left is worth another process, by the time of that done."""
        took = time.perf_counter() - self.begun
        each = took / max(len(self.found), 1)
        least = WORTH_ASKING if number in _workers else WORTH_STARTING
        return took > LOOK and each * len(self.left) > least

    def _message(self) -> Message:
        with self.lock:
            if not self._sent:
                self._sent = _sent((self.function, self.shared, self.known))
            return self._sent


class StandingCall[S, T, R]:
    """One function of what stays the same and an item, called many times with few items.

    What stays the same is sent once. Other processes take part from the moment when they have it;
    until then, and where one is lost, all is done here.

    Parameters
    ----------
    function : callable
        Of a module, so that other processes find it.
    shared : object
        What all calls need.
    jobs : int, optional
        Processes, this one included; by default the cores that it may use.
    """

    #: Seconds of such work here from which on processes that run are asked, and one is started.
    WORTH = (1.0, WORTH_STARTING)

    def __init__(self, function: Callable[[S, T], R], shared: S, jobs: int | None = None) -> None:
        jobs = min(parallel.available_cores() if jobs is None else jobs, parallel.thread_limit())
        self.function, self.shared, self._most = function, shared, jobs - 1
        self._ready: dict[int, _Worker] = {}
        self._begun, self._mine = list[threading.Thread](), False

    @property
    def others(self) -> int:
        """Number of other processes that can be asked."""
        return len(self._ready)

    def begin(self, took: float, item: T) -> None:
        """Have other processes made ready in the meantime, where that is worth it.

        Parameters
        ----------
        took : float
            Seconds that such work has taken here: what comes is likely to take as long.
        item : object
            Done by each of them first, for which it loads what it needs.
        """
        if self._begun or self._most < 1 or not _usable():
            return
        if took < self.WORTH[not _workers] or not _in_use.acquire(blocking=False):
            return
        self._mine = True
        for number in range(self._most):
            thread = threading.Thread(target=self._prepare, args=(number, item), daemon=True)
            thread.start()
            self._begun.append(thread)

    def _prepare(self, number: int, item: T) -> None:
        with suppress(_LostError):
            worker = _worker(number)
            worker.ask(_sent((self.function, self.shared, None)))
            if worker.ask(_sent((0, item)))[0] != _ERROR:
                self._ready[number] = worker

    def __call__(self, items: Sequence[T]) -> list[R]:
        """Results in the order of the items: the first from here, one from each other process, and
        what is left over from here."""
        asked = list(self._ready.items())[: len(items) - 1]
        found: dict[int, R] = {}
        failed: list[BaseException] = []

        def ask(number: int, worker: _Worker, index: int) -> None:
            try:
                kind, value = worker.ask(_sent((index, items[index])))
                if kind == _ERROR:
                    failed.append(value)
                else:
                    found[index] = value
            except _LostError:
                # One that is started in its place would not know what to do.
                self._ready.pop(number, None)
                _forget(number)

        threads = [
            threading.Thread(target=ask, args=(*one, 1 + k), daemon=True)
            for k, one in enumerate(asked)
        ]
        try:
            for thread in threads:
                thread.start()
            for index in (0, *range(1 + len(asked), len(items))):
                found[index] = self.function(self.shared, items[index])
            for thread in threads:
                thread.join()
        except BaseException:
            kill_processes()  # nobody waits for what they are doing
            self._ready.clear()
            raise
        if failed:
            raise failed[0]
        for index in range(len(items)):
            if index not in found:
                found[index] = self.function(self.shared, items[index])
        return [found[index] for index in range(len(items))]

    def end(self) -> None:
        """The processes need no memory of this any more."""
        if not self._mine:
            return
        for thread in self._begun:
            thread.join()
        for worker in self._ready.values():
            with suppress(_LostError):
                worker.ask(_dumps((None, None, None)))
        self._ready, self._mine = {}, False
        _in_use.release()


class Beside[S, R]:
    """One long call that another process does while this one goes on.

    The argument is taken as it is now: what this process changes of it meanwhile makes no
    difference, even where the process is lost and the call is done here. Left by an exception, the
    process is ended: nobody waits for what it does.
    """

    #: Jobs beyond which it is not begun: all of them do this call sooner than one process does.
    MOST = 3

    def __init__(
        self, function: Callable[[S], R], message: Message, more: Sequence[Message] = ()
    ) -> None:
        self._function, self._message, self._more = function, message, more
        self._found: list[tuple[str, Any]] = []
        self._items: dict[int, Any] = {}
        self._answered, self._enough = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._ask, daemon=True)
        self._thread.start()

    @classmethod
    def begun(
        cls,
        function: Callable[[S], R],
        argument: S,
        jobs: int | None = None,
        then: tuple[Callable[[Any, Any], Any], Any, Sequence[Any]] | None = None,
    ) -> Beside[S, R] | None:
        """The call, begun; None where this process is alone, has others enough for all, where they
        are in use, or the argument cannot be sent.

        Parameters
        ----------
        function : callable
            Of a module, so that another process finds it.
        argument : object
            Its only argument.
        jobs : int, optional
            As of :func:`process_map`.
        then : tuple of (callable, object, sequence), optional
            Function, what all its calls need, and items of work as of :func:`process_map`, which
            the process goes on with until :meth:`taken` is called.
        """
        jobs = min(parallel.available_cores() if jobs is None else jobs, parallel.thread_limit())
        if not 1 < jobs <= cls.MOST or not _usable() or not _in_use.acquire(blocking=False):
            return None
        try:
            more = [] if then is None else [(*then[:2], None), *((0, item) for item in then[2])]
            taken = [_as_it_is(_sent(one)) for one in ((0, argument), *more)]
            return cls(function, taken[0], taken[1:])
        except BaseException as error:
            _in_use.release()
            if isinstance(error, _LostError):
                return None
            raise

    def _ask(self) -> None:
        try:
            worker = _worker(0)
            worker.ask(_sent((_called, self._function, None)))
            self._found.append(worker.ask(self._message))
            self._message = []
            self._answered.set()
            self._go_on(worker)
            worker.ask(_dumps((None, None, None)))  # it needs no memory until the next call
        except _LostError:
            _forget(0)
        finally:
            self._answered.set()
            _in_use.release()

    def _go_on(self, worker: _Worker) -> None:
        for number, message in enumerate(self._more):
            if self._enough.is_set():
                return
            kind, value = worker.ask(message)
            if kind == _VALUE:
                self._items[number - 1] = value  # the first message says what is to be done

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None:
            kill_processes()
            self._thread.join()

    def result(self) -> R:
        """What came of it, or the exception that it raised, when it is done."""
        self._answered.wait()
        if not self._more:
            self._thread.join()  # the processes are free again
        if not self._found:
            _, argument = _loads(self._message)
            self._found.append((_VALUE, self._function(argument)))
        kind, value = self._found[0]
        if kind == _ERROR:
            raise value
        return cast(R, value)

    def taken(self) -> dict[int, Any]:
        """What came of the items that were done after the call, by number; no more are begun. One
        that fails is left out: whoever needs it meets the error by itself."""
        self._enough.set()
        self._thread.join()
        return dict(self._items)


def _called(function: Callable[[Any], Any], argument: Any) -> Any:
    return function(argument)


# -- processes ------------------------------------------------------------------------------------

_workers: dict[int, _Worker] = {}


class _Worker:
    """A process that waits for work, and the pipes to it."""

    def __init__(self, modules: Sequence[str] = ()) -> None:
        environment = os.environ | dict.fromkeys(parallel.ONE_THREAD, "1")
        command = [sys.executable, "-P", "-c", _CHILD, _paths(), *modules]
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )

    def ask(self, message: Message, known: Sequence[Any] = ()) -> tuple[str, Any]:
        """Send a message and wait for the answer: its kind and its content."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            _send(cast(BinaryIO, self.process.stdin), message)
            answer = _receive(cast(BinaryIO, self.process.stdout))
        except (OSError, ValueError) as error:
            raise _LostError from error
        if answer is None:
            raise _LostError
        try:
            kind, value = _loads(answer, known)
        except Exception as error:
            raise _LostError from error
        if kind == _UNREADABLE:
            raise _LostError
        return kind, value

    def end(self) -> None:
        """End the process, and close the pipes to it."""
        self.process.kill()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        self.process.wait()


def _paths() -> str:
    """Where modules are found; an import passes over what is no text."""
    return json.dumps([one for one in sys.path if isinstance(one, str)])


def _worker(number: int, modules: Sequence[str] = ()) -> _Worker:
    """The process of a number, started where there is none or it has ended."""
    known = _workers.get(number)
    if known is not None and known.process.poll() is not None:
        _forget(number)
        known = None
    if known is None:
        try:
            known = _workers[number] = _Worker(modules)
        except OSError as error:  # no memory, or too many processes
            raise _LostError from error
    return known


def _forget(number: int) -> None:
    worker = _workers.pop(number, None)
    if worker is not None:
        worker.end()


def kill_processes() -> None:
    """Kill all processes that are kept; whoever waits for one finds it lost."""
    for worker in list(_workers.values()):
        worker.process.kill()


@atexit.register
def end_processes() -> None:
    """End all processes that are kept."""
    for number in list(_workers):
        _forget(number)


if hasattr(os, "register_at_fork"):  # pipes belong to the process that made them
    os.register_at_fork(after_in_child=_workers.clear)


def begin_elsewhere(module: str, function: str) -> bool:
    """Call a function without arguments in a process that nobody waits for; whether one was begun.

    It is killed where this process ends before it does.
    """
    if not _usable():
        return False
    code = f"import json, sys; sys.path[:] = json.loads(sys.argv[1]); import {module} as m"
    with suppress(OSError):
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", f"{code}; m.{function}()", _paths()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        atexit.register(_end, process)
        return True
    return False


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


# -- messages -------------------------------------------------------------------------------------


def _dumps(value: Any, known: Sequence[Any] = ()) -> Message:
    """A pickle by value of what no module holds; known objects are referred to by number."""
    import cloudpickle

    number = {id(one): k for k, one in enumerate(known)}
    extremes = _extremes()

    class Pickler(cloudpickle.Pickler):  # type: ignore[misc]
        def persistent_id(self, one: Any) -> int | None:
            return number.get(id(one))

        def reducer_override(self, one: Any) -> Any:
            if isinstance(one, extremes):
                return _as_it_was, (type(one), one.args)
            return super().reducer_override(one)

    stream, large = io.BytesIO(), list[memoryview]()

    def is_small(buffer: pickle.PickleBuffer) -> bool:
        memory = buffer.raw()
        if memory.nbytes >= LARGE:
            large.append(memory)
        return memory.nbytes < LARGE

    Pickler(stream, protocol=pickle.HIGHEST_PROTOCOL, buffer_callback=is_small).dump(value)
    return [stream.getvalue(), *large]


def _as_it_is(message: Message) -> Message:
    """A copy of a message, which does not follow what becomes of its arrays; where it is read
    here, they may be written to."""
    return [bytearray(part) for part in message]


def _extremes() -> tuple[Any, ...]:
    """SymPy's largest and smallest of several, if anything may hold one."""
    module = sys.modules.get("sympy")
    return () if module is None else (module.Max, module.Min)


def _as_it_was(kind: Any, arguments: tuple[Any, ...]) -> Any:
    """One of them again. To make it anew compares all arguments with each other, which takes as
    long as to estimate a candidate."""
    return kind(*arguments, evaluate=False)


def _sent(value: Any, known: Sequence[Any] = ()) -> Message:
    """The same for a process; what cannot be sent is done here."""
    try:
        return _dumps(value, known)
    except Exception as error:
        raise _LostError from error


def _loads(message: Message, known: Sequence[Any] = ()) -> Any:
    class Unpickler(pickle.Unpickler):
        def persistent_load(self, number: Any) -> Any:
            return known[number]

    content, *large = message
    return Unpickler(io.BytesIO(content), buffers=large).load()


def _send(pipe: BinaryIO, message: Message) -> None:
    sizes = [len(message), *(len(part) for part in message)]
    pipe.write(b"".join(map(_HEADER.pack, sizes)))
    for part in message:
        pipe.write(part)
    pipe.flush()


def _receive(pipe: BinaryIO) -> Message | None:
    """A message; None at the end of the pipe."""
    count = _number(pipe)
    if count is None:
        return None
    sizes = [_number(pipe) for _ in range(count)]
    parts: Message = []
    for size in sizes:
        part = None if size is None else _filled(pipe, size)
        if part is None:
            return None
        parts.append(part)
    return parts


def _number(pipe: BinaryIO) -> int | None:
    head = pipe.read(_HEADER.size)
    return _HEADER.unpack(head)[0] if len(head) == _HEADER.size else None


def _filled(pipe: BinaryIO, size: int) -> bytearray | None:
    """So many bytes, which an array may take for its own memory; None where the pipe ends."""
    part, at = bytearray(size), 0
    while at < size:
        got = pipe.readinto(memoryview(part)[at:])  # type: ignore[attr-defined]
        if not got:
            return None
        at += got
    return part


def serve(modules: Sequence[str]) -> None:
    """In another process: do what comes, until nothing comes any more.

    Parameters
    ----------
    modules : sequence of str
        To be loaded before anything comes.
    """
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    parallel.limit_threads(1)
    source, target = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what is printed must not get among the messages
    load(modules)
    function, shared, objects = cast(Any, None), None, cast(Sequence[Any], ())
    while _waits(source):
        message = _receive(source)
        if message is None:
            return
        try:
            content = _loads(message, objects)
        except Exception as error:  # a module that only the parent has
            _send(target, _dumps((_UNREADABLE, str(error))))
            continue
        if len(content) == 3:
            function, shared, known = content
            objects = () if known is None else known(shared)
            _send(target, _dumps((_READY, None)))
            continue
        _, item = content
        try:
            answer = _answer(function(shared, item), objects)
        except MemoryError as error:  # there is more where this one's memory is not needed
            answer = _dumps((_UNREADABLE, str(error)))
        except Exception as error:
            answer = _of_error(error)
        _send(target, answer)


def _answer(value: Any, known: Sequence[Any]) -> Message:
    """A result for the parent; where it cannot be sent, the parent computes it."""
    try:
        return _dumps((_VALUE, value), known)
    except Exception as error:
        return _dumps((_UNREADABLE, str(error)))


def _waits(source: BinaryIO) -> bool:
    """Whether something comes before it has been idle for too long."""
    if sys.platform == "win32":
        return True  # pipes cannot be waited for
    return bool(select.select([source], [], [], IDLE)[0])


def _of_error(error: Exception) -> Message:
    """An error for the parent; where it cannot be sent, the parent meets it by itself."""
    try:
        content = _dumps((_ERROR, error))
        _loads(content)
    except Exception:
        return _dumps((_UNREADABLE, str(error)))
    return content
