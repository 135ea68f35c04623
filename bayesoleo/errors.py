"""Exceptions and warnings that carry their data.

Three kinds of failure are kept apart: bad input raises an :class:`InputError` whose one-line
message says where, what value and what to write instead; a numerical failure is a
:class:`~bayesoleo.solvers.Status`, never an exception; inside a log density a failure
becomes minus infinity and is counted by reason.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from importlib import import_module
from os import PathLike
from typing import Any

__all__ = [
    "BayesoleoError",
    "CampaignError",
    "DataWarning",
    "InputError",
    "MissingExtraError",
    "ModelError",
    "ModelWarning",
    "ResultsError",
    "UnfinishedError",
]


#: Words that a message lists at most, and beside the one that was probably meant.
LISTED, FEW = 30, 12


class BayesoleoError(Exception):
    """Base of every exception that bayesoleo raises on purpose."""


class InputError(BayesoleoError, ValueError):
    """Something a user gave cannot be used.

    Parameters
    ----------
    problem : str
        What is wrong, as a short clause.
    file, run, column, key : str, optional
        Where it is wrong; those given are shown in this order.
    value : object, optional
        The offending value.
    hint : str, optional
        What to write instead.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: object = None,
        run: str | None = None,
        column: str | None = None,
        key: str | None = None,
        value: Any = None,
        hint: str | None = None,
    ) -> None:
        self.problem, self.file, self.run = problem, file, run
        self.column, self.key, self.value, self.hint = column, key, value, hint
        super().__init__(self._message())

    def _message(self) -> str:
        places = (
            ("file", self.file),
            ("run", self.run),
            ("column", self.column),
            ("key", self.key),
        )
        where = ", ".join(f"{name} {place!s}" for name, place in places if place is not None)
        text = f"{where}: {self.problem}" if where else self.problem
        if self.value is not None:
            text += f" (got {self.value!r})"
        if self.hint is not None:
            text += f"; {self.hint}"
        return " ".join(text.split())


class CampaignError(InputError):
    """A campaign folder, its ``campaign.toml`` or one of its run files cannot be used."""


class ModelError(InputError):
    """A model declaration, or a model asked to do what it cannot, is inconsistent."""


class ResultsError(InputError):
    """A stored result is missing, broken or of another kind than expected."""


class MissingExtraError(BayesoleoError, ImportError):
    """A package is not installed that only some users need.

    Parameters
    ----------
    module : str
        Name of the package.
    extra : str
        The optional dependency of bayesoleo that installs it.
    """

    def __init__(self, module: str, extra: str) -> None:
        self.extra = extra
        text = f"this needs the package {module}; pip install 'bayesoleo[{extra}]' installs it"
        super().__init__(text, name=module)


def choose(wrong: object, allowed: Iterable[object], most: int = 1) -> str:
    """What to write instead of a word: the closest of those allowed, and all where they are few."""
    names = [str(name) for name in allowed]
    close = difflib.get_close_matches(str(wrong), names, most)
    listed = f"one of: {', '.join(names[:LISTED])}" + (", …" if len(names) > LISTED else "")
    if not close:
        return listed
    return f"did you mean {' or '.join(close)}?" + (f" {listed}" if len(names) <= FEW else "")


def number_of(count: int, one: str, many: str = "") -> str:
    """A count with its noun, in the number that it asks for: ``1 run``, ``2 runs``.

    Parameters
    ----------
    count : int
    one : str
        The noun for one.
    many : str, optional
        For none and several, where that is not the same with an s.
    """
    return f"{count} {one if count == 1 else many or one + 's'}"


def memory_text(error: MemoryError) -> str:
    """What is told where memory runs out, in one line."""
    asked = " ".join(str(error).split())
    text = "not enough memory" + (f": {asked[0].lower()}{asked[1:]}" if asked else "")
    return f"{text}; close other programs, or use fewer --jobs, runs or draws"


def check_number(
    value: object, key: str, *, hint: str, kind: type[InputError] = InputError
) -> None:
    """Raise unless a value is one number; text is none, whatever it holds.

    Parameters
    ----------
    value : object
    key, hint : str
        As :class:`InputError` takes them.
    kind : type
        Of the error.
    """
    try:
        number = not isinstance(value, str | bytes) and float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = False
    if number is False:
        raise kind("is not a number", key=key, value=value, hint=hint)


def check_level(level: float) -> None:
    """Raise unless a probability lies between 0 and 1."""
    check_number(level, "level", hint="write level=0.95")
    if not 0 < level < 1:
        raise InputError(
            "must lie between 0 and 1", key="level", value=level, hint="write level=0.95"
        )


def check_names(names: Sequence[str], known: Sequence[str], key: str, *, example: str) -> None:
    """Raise unless each of several names is known; ``example`` is the whole argument."""
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise InputError("is not a sequence of names", key=key, value=names, hint=example)
    for name in names:
        if name not in known:
            raise InputError(
                "there is no such unknown", key=key, value=name, hint=choose(name, known)
            )


def check_path(value: object, key: str, *, hint: str) -> None:
    """Raise unless a value is text or a path; parameters are those of :func:`check_number`."""
    if not isinstance(value, str | PathLike):
        raise InputError("is not a path", key=key, value=value, hint=hint)


def import_extra(module: str, extra: str) -> Any:
    """Import a package that is an optional dependency.

    Parameters
    ----------
    module, extra : str
        As :class:`MissingExtraError` takes them.

    Returns
    -------
    module

    Raises
    ------
    MissingExtraError
        If the package is not installed.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtraError(module, extra) from error


class UnfinishedError(BayesoleoError):
    """A late stage failed; what was known before it is kept.

    Parameters
    ----------
    stages : sequence of mapping
        Each with ``stage`` and ``reason``, as in the summary's ``unfinished``.
    tree : xarray.DataTree
        What is known, with its summary.
    folder : path-like, optional
        Where it was written.

    Attributes
    ----------
    stages, tree, folder
        The same.
    """

    def __init__(self, stages: Any, tree: Any, folder: Any = None) -> None:
        self.stages, self.tree, self.folder = tuple(stages), tree, folder
        failed = "; ".join(f"{item['stage']}: {item['reason']}" for item in self.stages)
        where = "" if folder is None else f"; what is known without it is in {folder}"
        super().__init__(f"unfinished: {failed}{where}")


class DataWarning(UserWarning):
    """A record is usable but deserves a look."""


class ModelWarning(UserWarning):
    """A model is usable but deserves a look."""
