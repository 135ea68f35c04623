"""What the machine code of a compiled function follows from.

Numba looks at the file of a function alone, and at its date. What it compiled before would be used
after a function of another file, or a number that stands in one, has changed: results would not be
those of the code. Here the instructions of all functions that one calls count, as Python has read
them, and the values that they refer to. Files do not count: they may change while a process runs.
"""

from __future__ import annotations

import enum
import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core import types
from numba.core.typing.templates import Signature

#: What code is compiled for the value of.
VALUES = (
    bool, int, float, complex, str, tuple, np.generic, types.Type, Signature, type(None),
)  # fmt: skip


def stamp_of(function: Callable[..., Any]) -> str:
    """Digest of what the machine code of a function follows from.

    Parameters
    ----------
    function : callable
        As it is written, or as Numba compiles it. Functions of its own package that it refers to
        count with their instructions, and so on; other packages have versions of their own.
    """
    package = _top(function.__module__)
    lines, seen, left = list[str](), set[int](), [_written(function)]
    while left:
        one = left.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        told, called = _direct(one, package)
        lines.append(told)
        left += called
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()


def _top(module: str) -> str:
    return module.partition(".")[0]


def _written(function: Any) -> Any:
    """A function as it is written: Numba keeps it in what it makes of it."""
    return getattr(function, "py_func", None) or getattr(function, "_defn", None) or function


@cache
def _direct(function: FunctionType, package: str) -> tuple[str, tuple[FunctionType, ...]]:
    """What a function is made of and the values that it refers to, as a text; and the functions of
    its package that it refers to."""
    given = function.__defaults__, function.__kwdefaults__
    told, called = [_told(function.__code__), repr(given)], list[FunctionType]()
    for name, value in _referred(function, package):
        written = _written(value)
        if isinstance(written, FunctionType):
            if _top(written.__module__) == package:
                called.append(written)
        elif isinstance(value, np.ndarray):
            told.append(f"{name}: {value.dtype} {value.shape} {value.tobytes().hex()}")
        elif isinstance(value, type):
            told.append(f"{name}: {_told_class(value)}")
        elif isinstance(value, VALUES):
            told.append(f"{name}: {value!r}")
    return "; ".join(told), tuple(called)


def _told(code: CodeType) -> str:
    """Instructions with what they refer to by number; not where they stand in a file."""
    parts = [
        _told(one) if isinstance(one, CodeType) else f"{type(one).__name__} {one!r}"
        for one in code.co_consts
    ]
    names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    counts = code.co_argcount, code.co_kwonlyargcount, code.co_flags
    return f"{code.co_name} {code.co_code.hex()} {parts} {names} {counts}"


def _told_class(kind: type) -> str:
    """Names of a tuple's fields, or the members of an enumeration."""
    if issubclass(kind, enum.Enum):
        return f"{kind.__qualname__} {[(one.name, one.value) for one in kind]}"
    return f"{kind.__qualname__} {getattr(kind, '_fields', ())}"


def _referred(function: FunctionType, package: str) -> Iterator[tuple[str, Any]]:
    """Names that a function refers to outside itself, in modules of its package too, with what they
    stand for."""
    names = sorted(set(_names(function.__code__)))
    outside = {name: function.__globals__[name] for name in names if name in function.__globals__}
    closed = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    outside |= {name: cell.cell_contents for name, cell in closed}
    yield from outside.items()
    for module in outside.values():
        if isinstance(module, ModuleType) and _top(module.__name__) == package:
            yield from ((name, vars(module)[name]) for name in names if name in vars(module))


def _names(code: CodeType) -> Iterator[str]:
    """Names in a function and in those that are written within it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)
