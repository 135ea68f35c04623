"""A digest of what a calculation depends on: equal where it says the same, in any process."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Mapping, Set
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, MethodType
from typing import Any

import numpy as np

from bayesoleo.model import Model
from bayesoleo.storage.provenance import PACKAGES, package_version

_PLAIN = (str, bytes, bool, int, float, complex, type(None))


def digest(value: Any) -> str:
    """SHA-256 of a value: numbers, text, arrays, containers, dataclasses, models, functions.

    A function is known by its code, its defaults, what it encloses, and those constants and
    functions of its own module that it mentions.

    Parameters
    ----------
    value : object
    """
    total = hashlib.sha256()
    _feed(total, value, [])
    return total.hexdigest()


@cache
def package_digest() -> str:
    """Digest of the package's own code, and of the versions of what can change a number."""
    root = Path(__file__).parents[1]
    sources = {str(file.relative_to(root)): file.read_bytes() for file in root.rglob("*.py")}
    versions = {name: package_version(name) for name in PACKAGES}
    return digest((dict(sorted(sources.items())), versions, platform.python_version()))


def _feed(total: Any, value: Any, inside: list[int]) -> None:
    """Add a value; one that holds itself is entered once."""
    total.update(f"<{type(value).__qualname__}>".encode())
    if isinstance(value, _PLAIN):
        total.update(repr(value).encode("utf-8", "surrogatepass"))
        return
    if id(value) in inside:
        return
    inside.append(id(value))
    if isinstance(value, np.ndarray):
        total.update(f"{value.dtype} {value.shape}".encode())
        total.update(np.ascontiguousarray(value).tobytes())
    else:
        for part in _parts(value):
            _feed(total, part, inside)
    inside.pop()


def _parts(value: Any) -> list[Any]:
    """What a value is made of."""
    if isinstance(value, Model):
        return [value.digest()]
    if isinstance(value, Mapping):
        return [part for item in value.items() for part in item]
    if isinstance(value, Set):
        return sorted(map(digest, value))
    if isinstance(value, list | tuple):
        return list(value)
    if isinstance(value, FunctionType):
        return _of_function(value)
    if isinstance(value, CodeType):
        return [value.co_code, value.co_names, value.co_consts]
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, functools.partial):
        return [value.func, value.args, value.keywords]
    if is_dataclass(value) and not isinstance(value, type):
        return [(item.name, getattr(value, item.name)) for item in fields(value)]
    if isinstance(value, type):
        return [value.__module__, value.__qualname__]
    own = getattr(value, "__dict__", None)
    return [own] if own else [str(value)]


def _of_function(function: FunctionType) -> list[Any]:
    cells = [cell.cell_contents for cell in function.__closure__ or () if _filled(cell)]
    mentioned = {
        name: item
        for name in function.__code__.co_names
        if _is_own(item := function.__globals__.get(name), function)
    }
    own = [function.__module__, function.__qualname__, function.__code__, function.__defaults__]
    return [*own, function.__kwdefaults__, cells, mentioned]


def _is_own(item: Any, function: FunctionType) -> bool:
    """Whether something that a function mentions is a constant, or a function of its module."""
    if isinstance(item, FunctionType):
        return item.__module__ == function.__module__
    return item is not None and isinstance(item, (*_PLAIN, tuple, np.ndarray))


def _filled(cell: Any) -> bool:
    try:
        cell.cell_contents  # noqa: B018 - an empty cell raises
    except ValueError:
        return False
    return True
