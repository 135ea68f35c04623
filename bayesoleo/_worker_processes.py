"""Work of one calculation in several processes of this machine.

Scores and estimates of candidate effects spend most of their time in Python, where threads wait
for each other. The processes are kept for the next call, because to start one takes two seconds,
and end when they have had nothing to do for a while or when this process ends.

A result does not depend on where it was computed. A process that is lost, or that cannot read what
it is sent, only costs time: its work is done here.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any, Self, cast

import bayesoleo._parallel as parallel
from bayesoleo._kept_processes import (
    EARLY,
    ERROR,
    VALUE,
    LostError,
    Worker,
    content_of,
    forget,
    kept,
    kill_processes,
    process_of,
    sent,
    usable,
)
from bayesoleo._process_messages import NOTHING, Message, Without, as_it_is, dumps, loads

#: Seconds of work left, as far as can be seen, from which processes that run already are asked,
#: and from which one is started.
WORTH_ASKING, WORTH_STARTING = 0.5, 4.0
#: Items for each process that are left while one has another in hand beside that which it does:
#: with fewer, others may be through before it begins with that.
LEFT_TO_OTHERS = 4
#: Seconds between looks at whether they are worth asking.
LOOK = 0.05


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
    alone = jobs <= 1 or len(work) <= 1 or not usable()
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
    others = min(jobs, len(work)) - 1
    call = _Call(function, shared, work, known, order, others)
    helpers = [threading.Thread(target=call.help, args=(k,), daemon=True) for k in range(others)]
    for helper in helpers:
        helper.start()
    try:
        before()
        call.begin()
        call.work()
    except BaseException:
        kill_processes()  # nobody waits for what they are doing
        raise
    finally:
        call.stop()
        for helper in helpers:
            helper.join()
    return cast(list[R], call.results())


#: What the processes of a search need. What compares structures is needed at its end only, but all
#: that follows would wait there until it is loaded.
OF_A_SEARCH = (
    EARLY,
    "bayesoleo.discovery._loop",
    "bayesoleo._report.page",
    "bayesoleo._workflow.structures_beside",
)


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
    if jobs > 1 and usable():
        with suppress(LostError):
            process_of(0, modules)


class _Call:
    """The items of one call, those that are taken, and what came of them."""

    def __init__(
        self,
        function: Callable[[Any, Any], Any],
        shared: Any,
        items: list[Any],
        known: Callable[[Any], Sequence[Any]],
        order: Sequence[int],
        others: int,
    ):
        self.function, self.shared, self.items, self.known = function, shared, items, known
        self.left = deque(order)
        self.spared = LEFT_TO_OTHERS * others
        self.found: dict[int, Any] = {}
        self.failed: BaseException | None = None
        self.lock, self.over = threading.Lock(), threading.Event()
        self.begun, self.stopped = time.perf_counter(), False
        self.working, self.before = False, 0
        self._sent: Message = []

    def _take(self, last: bool, leaving: int = 0) -> int | None:
        with self.lock:
            if len(self.left) <= leaving or self.failed is not None:
                return None
            return self.left.pop() if last else self.left.popleft()

    def _give_back(self, index: int) -> None:
        with self.lock:
            if not self.stopped:  # else nobody wants it any more
                self.left.appendleft(index)

    def begin(self) -> None:
        """Say that items are done here from now on: their time is known then."""
        self.begun, self.before = time.perf_counter(), len(self.found)
        self.working = True

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
            self.stopped = True
            self.left.clear()

    def results(self) -> list[Any]:
        """What came of all items, in their order."""
        if self.failed is not None:
            raise self.failed
        return [self.found[index] for index in range(len(self.items))]

    def help(self, number: int) -> None:
        """Have another process do items, from the last on, once that is worth it.

        What it does next is taken and made a message of while it works, and sent before its answer
        is read: this process has other things to do, and a waiting one has not. No call may change
        an item of another one.
        """
        while not self._worth(number):
            if not self.left:
                return
            time.sleep(LOOK)
        now: int | None = None
        then: int | None = None
        try:
            worker = process_of(number)
            worker.ask(self._message())  # what all calls need
            objects = self.known(self.shared)
            if (now := self._take(last=True)) is not None:
                worker.send(sent((now, self.items[now]), objects))
            while now is not None:
                then = self._take(last=True, leaving=self.spared)
                following = None if then is None else sent((then, self.items[then]), objects)
                answer = worker.answer()
                if self.failed is not None:
                    break  # nobody waits for what it would do next
                if following is None and (then := self._take(last=True)) is not None:
                    following = sent((then, self.items[then]), objects)
                if following is not None:
                    worker.send(following)
                kind, value = content_of(answer, objects)
                if kind == ERROR:
                    self.failed = value
                    if then is not None:  # nor for what it does now
                        raise LostError
                else:
                    self.found[now] = value
                now, then = then, None
                self.over.set()
            worker.ask(dumps((None, None, None)))  # it needs no memory until the next call
        except LostError:
            forget(number)
            for index in (then, now):
                if index is not None:
                    self._give_back(index)
        except BaseException as error:  # it must not be lost with the thread
            self.failed = self.failed or error
        finally:
            self.over.set()

    def _worth(self, number: int) -> bool:
        """Whether the work that is left is worth another process, by the time of that done. Before
        items are done here, no process is started for them, but one that runs may begin."""
        working = self.working  # first: it says what the time is counted from
        took = time.perf_counter() - self.begun
        if not working:
            return number in kept and took > LOOK
        each = took / max(len(self.found) - self.before, 1)
        least = WORTH_ASKING if number in kept else WORTH_STARTING
        return took > LOOK and each * len(self.left) > least

    def _message(self) -> Message:
        with self.lock:
            if not self._sent:
                self._sent = sent((self.function, self.shared, self.known))
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
        self._ready: dict[int, Worker] = {}
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
        if self._begun or self._most < 1 or not usable():
            return
        if took < self.WORTH[not kept] or not _in_use.acquire(blocking=False):
            return
        self._mine = True
        for number in range(self._most):
            thread = threading.Thread(target=self._prepare, args=(number, item), daemon=True)
            thread.start()
            self._begun.append(thread)

    def _prepare(self, number: int, item: T) -> None:
        with suppress(LostError):
            worker = process_of(number)
            worker.ask(sent((self.function, self.shared, None)))
            if worker.ask(sent((0, item)))[0] != ERROR:
                self._ready[number] = worker

    def __call__(self, items: Sequence[T]) -> list[R]:
        """Results in the order of the items: the first from here, one from each other process, and
        what is left over from here."""
        asked = list(self._ready.items())[: len(items) - 1]
        found: dict[int, R] = {}
        failed: list[BaseException] = []

        def ask(number: int, worker: Worker, index: int) -> None:
            try:
                kind, value = worker.ask(sent((index, items[index])))
                if kind == ERROR:
                    failed.append(value)
                else:
                    found[index] = value
            except LostError:
                # One that is started in its place would not know what to do.
                self._ready.pop(number, None)
                forget(number)

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
            with suppress(LostError):
                worker.ask(dumps((None, None, None)))
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

    def __init__(self, function: Callable[[S], R], message: Message) -> None:
        self._function, self._message, self._more = function, message, list[Message]()
        self._found: list[tuple[str, Any]] = []
        self._items: dict[int, Any] = {}
        self._last, self._open, self._over = list[Message](), True, False
        self._lock = threading.Lock()
        self._answered, self._enough = threading.Event(), threading.Event()
        self._dropped = False
        self._freed = threading.Lock()
        self._thread = threading.Thread(target=self._ask, daemon=True)

    @classmethod
    def begun(
        cls,
        function: Callable[[S], R],
        argument: S,
        jobs: int | None = None,
        then: tuple[Callable[[Any, Any], Any], Any, Sequence[Any]] | None = None,
        without: Without = NOTHING,
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
            As of :meth:`go_on_with`.
        without : mapping of type to sequence of str
            Attributes within the argument that the call has no use for, by the class of what has
            them; they are None for it.
        """
        if not cls.may_begin(jobs) or not _in_use.acquire(blocking=False):
            return None
        try:
            made = cls(function, as_it_is(sent((0, argument), without=without)))
            if then is not None:
                made.go_on_with(*then)
        except BaseException as error:
            _in_use.release()
            if isinstance(error, LostError):
                return None
            raise
        made._start()
        return made

    def go_on_with[T](
        self, function: Callable[[Any, T], Any], shared: Any, items: Sequence[T]
    ) -> None:
        """Say what the process does after the call until :meth:`taken` is called; nothing of it
        where it has answered before this.

        Parameters
        ----------
        function, shared, items
            As of :func:`process_map`, taken as they are now.

        Raises
        ------
        LostError
            If they cannot be sent.
        """
        messages = _messages_of(function, shared, items)
        if not self.answered:
            self._more[:] = messages

    def end_with[T](self, function: Callable[[Any, T], Any], shared: Any, item: T) -> None:
        """Have the process do one more item, next, and no other after it; nothing where it has come
        to its end before this.

        Parameters
        ----------
        function, shared, item
            As of :func:`process_map`, taken as they are now.

        Raises
        ------
        LostError
            If they cannot be sent.
        """
        if not self._open:
            return
        messages = _messages_of(function, shared, [item])
        with self._lock:
            if self._open:
                self._last[:] = messages
        self._enough.set()

    @property
    def goes_on(self) -> bool:
        """Whether the process does, or begins, what comes after the call."""
        return self.answered and not self._over

    @classmethod
    def may_begin(cls, jobs: int | None = None) -> bool:
        """Whether there are processes for it, in use or not; ``jobs`` as of :func:`process_map`."""
        jobs = min(parallel.available_cores() if jobs is None else jobs, parallel.thread_limit())
        return 1 < jobs <= cls.MOST and usable()

    def _start(self) -> None:
        try:
            self._thread.start()
        except BaseException:  # an interrupt finds the thread at work, or about to be
            try:
                self.drop()
            finally:
                self._free()
            raise

    def _free(self) -> None:
        """Let others use the processes; the thread and what could not start it may both ask."""
        if self._freed.acquire(blocking=False):
            _in_use.release()

    def _ask(self) -> None:
        try:
            worker = process_of(0)
            if self._dropped:  # before there was one to be ended
                return
            worker.ask(sent((_called, self._function, None)))
            self._found.append(worker.ask(self._message))
            self._message = []
            self._answered.set()
            self._go_on(worker)
            worker.ask(dumps((None, None, None)))  # it needs no memory until the next call
        except LostError:
            forget(0)
        finally:
            self._answered.set()
            self._open, self._over = False, True
            self._free()

    def _go_on(self, worker: Worker) -> None:
        for number, message in enumerate(self._more):
            if self._enough.is_set():
                break
            self._done(worker, message, number)
        with self._lock:
            self._open, last = False, list(self._last)
        self._over = not last
        for number, message in enumerate(last, len(self._more)):
            self._done(worker, message, number)

    def _done(self, worker: Worker, message: Message, number: int) -> None:
        kind, value = worker.ask(message)
        if kind == VALUE:
            self._items[number - 1] = value  # the first message says what is to be done

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None:
            self.drop()

    def drop(self) -> None:
        """End the process unless it is done: nobody waits for what it does."""
        self._dropped = True
        if self._thread.is_alive():
            kill_processes()
            self._thread.join()

    @property
    def answered(self) -> bool:
        """Whether :meth:`result` need not wait: the call is done, or the process was lost."""
        return self._answered.is_set()

    def result(self) -> R:
        """What came of it, or the exception that it raised, when it is done."""
        self._answered.wait()
        if not self._more:
            self._thread.join()  # the processes are free again
        if not self._found:
            _, argument = loads(self._message)
            self._found.append((VALUE, self._function(argument)))
        kind, value = self._found[0]
        if kind == ERROR:
            raise value
        return cast(R, value)

    def taken(self) -> dict[int, Any]:
        """What came of the items that were done after the call, by number; no more are begun. One
        that fails is left out: whoever needs it meets the error by itself."""
        self._enough.set()
        self._thread.join()
        return dict(self._items)


def _messages_of(
    function: Callable[[Any, Any], Any], shared: Any, items: Sequence[Any]
) -> list[Message]:
    """What a process is sent to do some items: first what is to be done."""
    parts = [(function, shared, None), *((0, item) for item in items)]
    return [as_it_is(sent(one)) for one in parts]


def _called(function: Callable[[Any], Any], argument: Any) -> Any:
    return function(argument)
