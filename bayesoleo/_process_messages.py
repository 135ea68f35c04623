"""Messages between processes: pickles by value, with large arrays beside them."""

from __future__ import annotations

import io
import pickle
import struct
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, BinaryIO

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: A message: a pickle, and the memory of its large arrays, which is not copied into it.
type Message = list[memoryview | bytes | bytearray | NDArray[np.uint8]]
_HEADER = struct.Struct("<Q")
#: Bytes from which an array is sent beside the pickle: arrays take a copy less on either side.
LARGE = 2**16


def dumps(value: Any, known: Sequence[Any] = ()) -> Message:
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


def as_it_is(message: Message) -> Message:
    """A copy of a message, which does not follow what becomes of its arrays; where it is read
    here, they may be written to."""
    return [bytearray(part) for part in message]


def _extremes() -> tuple[Any, ...]:
    """SymPy's largest and smallest of several, if anything may hold one."""
    module = sys.modules.get("sympy")
    # Another thread may be loading it.
    return tuple(getattr(module, name) for name in ("Max", "Min") if hasattr(module, name))


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
