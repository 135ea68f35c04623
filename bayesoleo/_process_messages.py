"""Messages between processes: pickles by value, with large arrays beside them."""

from __future__ import annotations

import io
import pickle
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from types import FunctionType
from typing import TYPE_CHECKING, Any, BinaryIO

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: A message: a pickle, and the memory of its large arrays, which is not copied into it.
type Message = list[memoryview | bytes | bytearray | NDArray[np.uint8]]
#: Attributes that are left out of a message, by the class of what has them.
type Without = Mapping[type, Sequence[str]]
NOTHING: Without = {}
_HEADER = struct.Struct("<Q")
#: Bytes from which an array is sent beside the pickle: arrays take a copy less on either side.
LARGE = 2**16


def dumps(value: Any, known: Sequence[Any] = (), without: Without = NOTHING) -> Message:
    """A pickle by value of what no module holds; known objects are referred to by number, and some
    attributes are left out."""
    stream, large = io.BytesIO(), list[memoryview]()

    def is_small(buffer: pickle.PickleBuffer) -> bool:
        memory = buffer.raw()
        if memory.nbytes >= LARGE:
            large.append(memory)
        return memory.nbytes < LARGE

    plain, referring = _picklers()
    pickler = (referring if known else plain)(
        stream, protocol=pickle.HIGHEST_PROTOCOL, buffer_callback=is_small
    )
    pickler.number = {id(one): k for k, one in enumerate(known)}
    pickler.reducers = dict.fromkeys(_extremes(), _extreme)
    pickler.reducers |= {kind: partial(_less, names=names) for kind, names in without.items()}
    pickler.dump(value)
    return [stream.getvalue(), *large]


@cache
def _picklers() -> tuple[Any, Any]:
    """The class of what makes pickles, and that for objects of which some are known, which asks
    of every number and text whether it is one of these."""
    import cloudpickle  # a command first starts a process, and loads libraries then

    class Plain(cloudpickle.Pickler):  # type: ignore[misc]
        reducers: dict[type, Callable[[Any], Any]]

        def reducer_override(self, one: Any) -> Any:
            kind = type(one)
            if kind in self.reducers:
                return self.reducers[kind](one)
            if issubclass(kind, (type, FunctionType)):
                return super().reducer_override(one)
            return NotImplemented  # it says so of all others, of which there are thousands

    class Referring(Plain):
        number: dict[int, int]

        def persistent_id(self, one: Any) -> int | None:
            return self.number.get(id(one))

    return Plain, Referring


def _less(one: Any, names: Sequence[str]) -> tuple[Any, ...]:
    """How an object comes without some of its attributes: they are None, with which nothing can be
    computed by mistake."""
    make, arguments, state, *rest = one.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
    return make, arguments, state | dict.fromkeys(names), *rest


def as_it_is(message: Message) -> Message:
    """A copy of a message, which does not follow what becomes of its arrays; where it is read
    here, they may be written to."""
    return [bytearray(part) for part in message]


def _extremes() -> tuple[Any, ...]:
    """SymPy's largest and smallest of several, if anything may hold one."""
    module = sys.modules.get("sympy")
    # Another thread may be loading it.
    return tuple(getattr(module, name) for name in ("Max", "Min") if hasattr(module, name))


def _extreme(one: Any) -> tuple[Any, ...]:
    return _as_it_was, (type(one), one.args)


def _as_it_was(kind: Any, arguments: tuple[Any, ...]) -> Any:
    """One of them again. To make it anew compares all arguments with each other, which takes as
    long as to estimate a candidate."""
    return kind(*arguments, evaluate=False)


def loads(message: Message, known: Sequence[Any] = ()) -> Any:
    class Unpickler(pickle.Unpickler):
        def persistent_load(self, number: Any) -> Any:
            return known[number]

    content, *large = message
    return Unpickler(io.BytesIO(content), buffers=large).load()


def send(pipe: BinaryIO, message: Message) -> None:
    sizes = [len(message), *(len(part) for part in message)]
    pipe.write(b"".join(map(_HEADER.pack, sizes)))
    for part in message:
        pipe.write(part)
    pipe.flush()


def receive(pipe: BinaryIO) -> Message | None:
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


def _filled(pipe: BinaryIO, size: int) -> NDArray[np.uint8] | None:
    """So many bytes, which an array may take for its own memory; None where the pipe ends."""
    import numpy as np  # a command first starts a process, and loads libraries then

    part, at = np.empty(size, np.uint8), 0  # bytes of Python's would be filled with zeros first
    while at < size:
        got = pipe.readinto(memoryview(part)[at:])  # type: ignore[attr-defined]
        if not got:
            return None
        at += got
    return part
