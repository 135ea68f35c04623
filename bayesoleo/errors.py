"""Exceptions and warnings that carry their data.

Three kinds of failure are kept apart: bad input raises an :class:`InputError` whose one-line
message says where, what value and what to write instead; a numerical failure is a
:class:`~bayesoleo.solvers.Status`, never an exception; inside a log density a failure
becomes minus infinity and is counted by reason.
"""

from __future__ import annotations

from importlib import import_module
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
