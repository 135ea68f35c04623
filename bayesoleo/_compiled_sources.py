"""The sources that the machine code of a compiled function follows from.

Numba looks at the file of a function alone. What it compiled before would therefore be used after a
function of another file, or a number that stands in one, has changed: results would not be those of
the code. Here the files of all that a function calls count, by their content, and the numbers that
it refers to.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

#: What code is compiled for the value of.
VALUES = (bool, int, float, complex, str, tuple, np.generic)


def stamp_of(function: Callable[..., Any]) -> str:
    """Digest of what the machine code of a function follows from.

    Parameters
    ----------
    function : callable
        As it is written, or as Numba compiles it. Of what it refers to, functions, classes and
        modules of its own package count with their files, and numbers with their values.
    """
    package = _top(function.__module__)
    files, values, seen, left = set[str](), set[str](), set[int](), [_written(function)]
    while left:
        one = left.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        file, values_of_one, called = _direct(one, package)
        files |= file
        values |= values_of_one
        left += called
    digest = hashlib.sha256()
    for line in (*sorted(map(_content, files)), *sorted(values)):
        digest.update(line.encode() + b"\n")
    return digest.hexdigest()


def _top(module: str) -> str:
    return module.partition(".")[0]


def _written(function: Any) -> Any:
    """A function as it is written: Numba keeps it in what it makes of it."""
    return getattr(function, "py_func", None) or getattr(function, "_defn", None) or function


@cache
def _direct(
    function: FunctionType, package: str
) -> tuple[frozenset[str], frozenset[str], tuple[FunctionType, ...]]:
    """Files, values and functions that a function refers to, with its own file."""
    files, values, called = {function.__code__.co_filename}, set[str](), list[FunctionType]()
    for name, value in _referred(function, package):
        written = _written(value)
        module = value.__name__ if isinstance(value, ModuleType) else _module_of(written)
        if _top(module) != package:
            if isinstance(value, VALUES):
                values.add(f"{name} = {value!r}")
        elif isinstance(written, FunctionType):
            called.append(written)
        else:
            files.add(
                inspect.getfile(value if isinstance(value, ModuleType | type) else type(value))
            )
    return frozenset(files), frozenset(values), tuple(called)


def _module_of(value: Any) -> str:
    """Where a function or a class was made, or the class of anything else."""
    owner = value if isinstance(value, FunctionType | type) else type(value)
    return str(owner.__module__)


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


@cache
def _content(file: str) -> str:
    """Digest of a file; of one that cannot be read, its name."""
    try:
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()
    except OSError:
        return file
