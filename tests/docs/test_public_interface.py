"""What is public needs nothing private: types in signatures, and paths in docstrings."""

from __future__ import annotations

import ast
import inspect
import re
import sys
import types
import typing
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

import bayesoleo

DOCS = Path(__file__).resolve().parents[2] / "docs"
FACES = ("bayesoleo", *(f"bayesoleo.{name}" for name in bayesoleo._SUBPACKAGES))
#: Protocols of generated kernels, which ``model`` and ``solvers`` share; nobody writes one by hand.
KERNELS = "bayesoleo._compiled"
#: Results of a session are made by its verbs, never by hand.
MADE_BY_VERBS = (bayesoleo.Fit, bayesoleo.Posterior, bayesoleo.Explanation)
PRIVATE = re.compile(r"bayesoleo(?:\.\w+)*\._\w[\w.]*")


def exported(face: str) -> dict[str, object]:
    module = import_module(face)
    return {name: getattr(module, name) for name in module.__all__ if not name.startswith("__")}


@cache
def public() -> frozenset[int]:
    return frozenset(id(item) for face in FACES for item in exported(face).values())


def test_every_type_in_a_public_signature_is_public() -> None:
    private = set()
    for face in FACES:
        for name, item in exported(face).items():
            for namespace, annotation in _annotations(item):
                for word in _words(annotation):
                    for hidden in _private_types(_resolved(namespace, word), set()):
                        private.add(f"{hidden.__module__}.{hidden.__name__} in {face}.{name}")
    assert sorted(private) == []


def test_no_private_path_in_a_public_docstring() -> None:
    found = []
    for face in FACES:
        found += [f"{face}: {path}" for path in PRIVATE.findall(import_module(face).__doc__ or "")]
        for name, item in exported(face).items():
            texts = [inspect.getdoc(item)] if callable(item) else []
            if isinstance(item, type):
                own = (getattr(item, key) for key in dir(item) if not key.startswith("_"))
                texts += [inspect.getdoc(one) for one in own]
            found += [f"{face}.{name}: {p}" for text in texts for p in PRIVATE.findall(text or "")]
    assert found == []


def test_every_public_constant_is_on_the_page_of_the_interface() -> None:
    page = (DOCS / "api.rst").read_text(encoding="utf-8")
    constants = [f"{f}.{n}" for f in FACES for n, item in exported(f).items() if not callable(item)]
    assert constants
    assert [name for name in constants if f"py:data:: {name}\n" not in page] == []


@pytest.mark.parametrize("face", FACES[1:])
def test_every_face_is_on_the_page_of_the_interface(face: str) -> None:
    assert f"   {face}\n" in (DOCS / "api.rst").read_text(encoding="utf-8")


def _annotations(item: object) -> Iterator[tuple[dict[str, typing.Any], str]]:
    """Annotations with the names that they are read among."""
    if isinstance(item, type):
        for owner in item.__mro__:
            if owner.__module__.startswith("bayesoleo"):
                yield from _of_class(owner, item)
    elif isinstance(item, types.FunctionType):
        function = inspect.unwrap(item)
        for name, text in function.__annotations__.items():
            if isinstance(text, str) and not name.startswith("_"):
                yield function.__globals__, text


def _of_class(owner: type, item: type) -> Iterator[tuple[dict[str, typing.Any], str]]:
    namespace = vars(sys.modules[owner.__module__])
    for name, text in inspect.get_annotations(owner).items():
        if isinstance(text, str) and not name.startswith("_"):
            yield namespace, text
    for name, value in owner.__dict__.items():
        public_name = not name.startswith("_") or name in ("__init__", "__call__")
        if public_name and not (name == "__init__" and issubclass(item, MADE_BY_VERBS)):
            if isinstance(value, property):
                value = value.fget
            value = getattr(value, "__func__", getattr(value, "func", value))
            if isinstance(value, types.FunctionType):
                yield from _annotations(value)


def _words(annotation: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(annotation, mode="eval")):
        if isinstance(node, ast.Name):
            yield node.id


def _resolved(namespace: dict[str, typing.Any], name: str) -> object:
    """What a name stands for, also where it is imported for type checkers only."""
    if name in namespace:
        return namespace[name]
    module, original = _imports(namespace["__name__"]).get(name, ("", ""))
    return getattr(import_module(module), original, None) if module else None


@cache
def _imports(module: str) -> dict[str, tuple[str, str]]:
    """Module and name there of each name that a module imports, for type checkers too."""
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {
        alias.asname or alias.name: (str(node.module), alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def _private_types(value: object, seen: set[int]) -> Iterator[type]:
    if id(value) in public() or id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, typing.TypeAliasType):
        yield from _private_types(value.__value__, seen)
    elif isinstance(value, type) and not isinstance(value, types.GenericAlias):
        if value.__module__.startswith("bayesoleo") and value.__module__ != KERNELS:
            yield value
    else:
        parts = value if isinstance(value, list | tuple) else typing.get_args(value)
        for part in parts:
            yield from _private_types(part, seen)
