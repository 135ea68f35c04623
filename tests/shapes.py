"""Check the arrays of a result against the shapes that its class declares."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import UnionType
from typing import Any, Union, get_args, get_origin

from jaxtyping import AbstractArray, jaxtyped


@cache
def declared(kind: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields that declare shapes, and of its base classes'."""
    homes = [sys.modules[base.__module__].__dict__ for base in kind.__mro__]
    names = {name: value for home in reversed(homes) for name, value in home.items()}
    texts = {field.name: field.type for field in fields(kind) if isinstance(field.type, str)}
    return {name: eval(text, names) for name, text in texts.items() if "'" in text}


def agrees(value: Any, kind: Any) -> bool:
    """Tell whether a value has the shape and the numbers that a type declares."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(agrees(value, one) for one in inner)
    if origin is tuple and inner[-1] is ...:
        return all(agrees(item, inner[0]) for item in value)
    if origin is tuple:
        return all(agrees(item, one) for item, one in zip(value, inner, strict=True))
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return all(agrees(item, inner[1]) for item in value.values())
    if inspect.isclass(kind) and issubclass(kind, AbstractArray):
        return isinstance(value, kind)
    return value is None if kind is type(None) else isinstance(value, kind)


def check_shapes(*values: Any) -> int:
    """Hold dataclasses against their declarations; a dimension has one size within each.

    Returns the number of fields that were checked.
    """
    number = 0
    for value in values:
        assert is_dataclass(value)
        with jaxtyped("context"):
            for name, kind in declared(type(value)).items():
                item = getattr(value, name)
                found = f"{type(value).__name__}.{name} is {getattr(item, 'shape', item)}"
                assert agrees(item, kind), f"{found}, not {kind}"
                number += 1
    return number
