"""Processes that are kept for work, what they do, and a process that nobody waits for.

They are started by a command: they do not run the user's script again. A process that nobody asks
for a while ends, and so do all when the one that started them does.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import importlib
import json
import os
import select
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, BinaryIO, cast

import bayesoleo._parallel as parallel
from bayesoleo._process_messages import NOTHING, Message, Without, dumps, loads, receive, send

#: Seconds without work after which a process ends.
IDLE = 120.0
#: Seconds to wait for the end of one that was killed.
ENDING = 5.0
#: Where optional libraries are missing, this one looks for its callers in all modules that are
#: loaded: the later it comes, the longer that takes.
EARLY = "arviz_base"
#: Thresholds of the search for garbage in a process of this package's own: new objects before a
#: search of these, and searches before one of older objects and before one of all. Expressions and
#: records live on in hundred thousands, and little of them is garbage: at Python's 2000, 10 and 10
#: the searches take four hundredths of a command's time.
SELDOM = 200_000, 10, 10
#: Settings of the GNU C library and their values in such a process: bytes from which an array has
#: pages of its own, and bytes free at the end of the heap from which they go back to the system.
#: At its own values arrays of a megabyte get new pages, which are filled with zeros, again and
#: again.
MMAP_THRESHOLD, TRIM_THRESHOLD = (-3, 2**25), (-1, 2**28)
#: Bytes that a pipe is to hold: messages have megabytes. All pipes of a user may hold 64 MiB.
PIPE = 2**18
#: Seconds without work after which a process gives back the memory that it keeps.
RESTING = 5.0
#: It finds modules where its parent finds them, and does not run the user's script again.
_CHILD = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]);"
    " from bayesoleo._kept_processes import serve; serve(sys.argv[2:])"
)
READY, VALUE, ERROR, UNREADABLE = "ready", "value", "error", "unreadable"


class LostError(Exception):
    """A process ended, or cannot read what it was sent."""


def usable() -> bool:
    """Whether processes may be started: not by a worker, nor where the user forbids it."""
    asked = os.environ.get("BAYESOLEO_PROCESSES", "")
    return asked != "0" and bool(sys.executable)


kept: dict[int, Worker] = {}
#: Held while a process is looked for and started: two threads that ask for one number get one
#: process.
_starting = threading.RLock()


class Worker:
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
        _widen(self.process.stdin, self.process.stdout)

    def ask(self, message: Message, known: Sequence[Any] = ()) -> tuple[str, Any]:
        """Send a message and wait for the answer: its kind and its content."""
        self.send(message)
        return content_of(self.answer(), known)

    def send(self, message: Message) -> None:
        """Send a message; whoever sends the next one has received the answer to this."""
        assert self.process.stdin is not None
        try:
            send(cast(BinaryIO, self.process.stdin), message)
        except (OSError, ValueError) as error:
            raise LostError from error

    def answer(self) -> Message:
        """Wait for an answer, and receive it as it is."""
        assert self.process.stdout is not None
        try:
            answer = receive(cast(BinaryIO, self.process.stdout))
        except (OSError, ValueError) as error:
            raise LostError from error
        if answer is None:
            raise LostError
        return answer

    def end(self) -> None:
        """End the process, and close the pipes to it."""
        self.process.kill()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        self.process.wait()


def _widen(*pipes: Any) -> None:
    """Let pipes hold more, where the system does that and has not given too much to others."""
    with suppress(ImportError, AttributeError, OSError):
        import fcntl

        for pipe in pipes:
            fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, PIPE)


def content_of(answer: Message, known: Sequence[Any] = ()) -> tuple[str, Any]:
    """The kind and the content of an answer."""
    try:
        kind, value = loads(answer, known)
    except Exception as error:
        raise LostError from error
    if kind == UNREADABLE:
        raise LostError
    return kind, value


def _paths() -> str:
    """Where modules are found; an import passes over what is no text."""
    return json.dumps([one for one in sys.path if isinstance(one, str)])


def process_of(number: int, modules: Sequence[str] = ()) -> Worker:
    """The process of a number, started where there is none or it has ended."""
    with _starting:
        known = kept.get(number)
        if known is not None and known.process.poll() is not None:
            forget(number)
            known = None
        if known is None:
            try:
                known = kept[number] = Worker(modules)
            except OSError as error:  # no memory, or too many processes
                raise LostError from error
        return known


def forget(number: int) -> None:
    worker = kept.pop(number, None)
    if worker is not None:
        worker.end()


def kill_processes() -> None:
    """Kill all processes that are kept; whoever waits for one finds it lost."""
    killed = [worker.process for worker in list(kept.values())]
    for process in killed:
        process.kill()
    for process in killed:  # one that is still ending would be taken for one that can be asked
        with suppress(subprocess.TimeoutExpired):
            process.wait(ENDING)


@atexit.register
def end_processes() -> None:
    """End all processes that are kept."""
    for number in list(kept):
        forget(number)


def _begin_as_child() -> None:
    """Forget processes and lock in a forked copy of this process.

    The pipes belong to its parent, and so does the thread that may hold the lock.
    """
    global _starting
    kept.clear()
    _starting = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_as_child)


def begin_elsewhere(module: str, function: str) -> bool:
    """Call a function without arguments in a process that nobody waits for; whether one was begun.

    It is killed where this process ends before it does.
    """
    if not usable():
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


def sent(value: Any, known: Sequence[Any] = (), without: Without = NOTHING) -> Message:
    """A message for a process; what cannot be sent is done by whoever asks."""
    try:
        return dumps(value, known, without)
    except Exception as error:
        raise LostError from error


def load(modules: Sequence[str]) -> None:
    """Load modules in a process of this package's own, which needs them until it ends.

    There is no garbage in them: half a million objects are kept out of all searches for it, which
    become seldom.

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
        search_seldom()
        keep_memory()
        if was_on:
            gc.enable()


def search_seldom() -> None:
    """Search for garbage less often than Python does, where it does at all."""
    if 0 < gc.get_threshold()[0] < SELDOM[0]:
        gc.set_threshold(*SELDOM)


def keep_memory() -> None:
    """Keep memory that arrays have left for the next ones, where the C library can be told so."""
    with suppress(OSError, AttributeError, TypeError):
        set_option = ctypes.CDLL(None).mallopt
        # Either alone ends the library's own choice of both.
        _ = set_option(*MMAP_THRESHOLD) and set_option(*TRIM_THRESHOLD)


def give_back_memory() -> None:
    """Give all memory that nothing is in back to the system, where the C library can do that."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


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
    search_seldom()
    keep_memory()
    source, target = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what is printed must not get among the messages
    load(modules)
    function, shared, objects = cast(Any, None), None, cast(Sequence[Any], ())
    while _waits(source):
        message = receive(source)
        if message is None:
            return
        try:
            content = loads(message, objects)
        except Exception as error:  # a module that only the parent has
            send(target, dumps((UNREADABLE, str(error))))
            continue
        if len(content) == 3:
            function, shared, known = content
            objects = () if known is None else known(shared)
            send(target, dumps((READY, None)))
            continue
        _, item = content
        try:
            answer = _answer(function(shared, item), objects)
        except MemoryError as error:  # there is more where this one's memory is not needed
            answer = dumps((UNREADABLE, str(error)))
        except Exception as error:
            answer = _of_error(error)
        send(target, answer)


def _answer(value: Any, known: Sequence[Any]) -> Message:
    """A result for the parent; where it cannot be sent, the parent computes it."""
    try:
        return dumps((VALUE, value), known)
    except Exception as error:
        return dumps((UNREADABLE, str(error)))


def _waits(source: BinaryIO) -> bool:
    """Whether something comes before it has been idle for too long."""
    if sys.platform == "win32":
        return True  # pipes cannot be waited for
    if select.select([source], [], [], RESTING)[0]:
        return True
    give_back_memory()
    return bool(select.select([source], [], [], IDLE - RESTING)[0])


def _of_error(error: Exception) -> Message:
    """An error for the parent; where it cannot be sent, the parent meets it by itself."""
    try:
        content = dumps((ERROR, error))
        loads(content)
    except Exception:
        return dumps((UNREADABLE, str(error)))
    return content
