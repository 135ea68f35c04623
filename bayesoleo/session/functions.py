"""A user's function and a table of data as a problem that can be estimated."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cloudpickle
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem
from bayesoleo.model import Parameter
from bayesoleo.model.priors import Prior

Function = Callable[..., ArrayLike]


class Call:
    """A function of columns and parameters, called as ``call(inputs, theta)``.

    Parameters
    ----------
    function : callable
        The user's.
    arguments : sequence of (str, object)
        For each argument of the function ``("column", name)``, ``("unknown", index)``,
        ``("constant", value)``, ``("vector", None)`` or ``("table", None)``.
    """

    def __init__(self, function: Function, arguments: Sequence[tuple[str, Any]]) -> None:
        self.function, self.arguments = function, tuple(arguments)

    def __call__(self, inputs: Mapping[str, Array], theta: Array) -> ArrayLike:
        values: dict[str, Callable[[Any], Any]] = {
            "column": lambda name: inputs[name],
            "unknown": lambda index: theta[index],
            "constant": lambda value: value,
            "vector": lambda _: theta,
            "table": lambda _: inputs,
        }
        return self.function(*(values[kind](which) for kind, which in self.arguments))

    def __getstate__(self) -> bytes:
        return bytes(cloudpickle.dumps(self.__dict__))  # a lambda has no name to be found by

    def __setstate__(self, state: bytes) -> None:
        self.__dict__.update(cloudpickle.loads(state))


@dataclass(frozen=True)
class Sum:
    """A function with added terms, each of its own part of the unknowns.

    Parameters
    ----------
    base : callable
        ``base(inputs, theta)`` of the first ``size`` unknowns.
    size : int
    terms : tuple of (callable, int)
        Functions of the next unknowns, and how many of them each has.
    """

    base: Callable[[Any, Array], ArrayLike]
    size: int
    terms: tuple[tuple[Callable[[Any, Array], ArrayLike], int], ...]

    def __call__(self, inputs: Mapping[str, Array], theta: Array) -> ArrayLike:
        total, first = np.asarray(self.base(inputs, theta[: self.size])), self.size
        for term, count in self.terms:
            total = total + np.asarray(term(inputs, theta[first : first + count]))
            first += count
        return total


def read_table(data: Any) -> dict[str, Array]:
    """Columns of a dictionary, a pandas table or an xarray Dataset, by name.

    Raises
    ------
    InputError
        If it is none of these, or a column is not one of numbers.
    """
    if not hasattr(data, "keys"):
        raise InputError(
            "data must be a campaign or a table", key="data", value=type(data).__name__,
            hint='write bo.load_campaign(folder), {"x": x, "y": y} or a pandas table',
        )  # fmt: skip
    table = {}
    for name in data.variables if isinstance(data, xr.Dataset) else data:
        try:
            column = np.asarray(data[name], dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError(
                "is not a column of numbers", key=f"data[{name!r}]", value=str(error),
                hint="give numbers, or leave the column out",
            ) from error  # fmt: skip
        if column.ndim == 1:
            table[str(name)] = column
    return table


def output_of(table: Mapping[str, Array], wanted: str | None, used: Sequence[str]) -> str:
    """The measured column: the one asked for, ``y``, or the only one that is no argument."""
    if wanted is not None:
        if wanted not in table:
            raise InputError(
                "there is no such column", key="output", value=wanted,
                hint=f"use {', '.join(table)}",
            )  # fmt: skip
        return wanted
    left = [name for name in table if name not in used]
    if "y" in left:
        return "y"
    if len(left) != 1:
        raise InputError(
            "it is not clear which column was measured", key="output", value=list(table),
            hint='name it: output="…"',
        )  # fmt: skip
    return left[0]


def parameters_of(given: Mapping[str, Any] | None) -> dict[str, Parameter]:
    """Parameters by name; a prior stands for one that starts at its mean.

    Raises
    ------
    InputError
        If one is neither, or is estimated without a prior.
    """
    found = {}
    for name, item in (given or {}).items():
        key = f"parameters[{name!r}]"
        if not isinstance(item, Parameter) and isinstance(item, Prior):
            item = Parameter(item.mean, prior=item)
        if not isinstance(item, Parameter):
            raise InputError(
                "is neither a Parameter nor a prior", key=key, value=item,
                hint="write bo.Parameter(1.0, sd=…), or bo.Parameter(1.0, fixed=True)",
            )  # fmt: skip
        if item.prior is None and not item.fixed:
            raise InputError(
                "has no prior", key=key, value=item.value,
                hint=f"write bo.Parameter({item.value:g}, sd=…) or bounds=(…, …), or fixed=True",
            )  # fmt: skip
        if item.by_run:
            raise InputError("a function has no runs", key=key, hint="leave by_run out")
        found[name] = item
    if not any(item.prior is not None for item in found.values()):
        raise InputError(
            "no parameter to estimate", key="parameters", value=list(found),
            hint='write parameters={"a": bo.Parameter(1.0, sd=…)}',
        )  # fmt: skip
    return found


def unknowns_of(parameters: Mapping[str, Parameter]) -> list[str]:
    """Names of the parameters that are estimated."""
    return [name for name, item in parameters.items() if item.prior is not None]


def call_of(
    function: Function, columns: Sequence[str], parameters: Mapping[str, Parameter]
) -> Call:
    """How a function is called, decided by the names of its arguments.

    An argument with the name of a column gets that column, one with the name of a parameter its
    value. The first argument may have any name: it gets the only input column, or all as a
    dictionary. The last may be a vector of all estimated parameters, in the order in which they
    were given.

    Raises
    ------
    InputError
        If an argument is none of these, or a parameter is no argument.
    """
    names = [
        item.name
        for item in inspect.signature(function).parameters.values()
        if item.default is item.empty and item.kind in (item.POSITIONAL_ONLY, _BOTH)
    ]
    unknowns = unknowns_of(parameters)
    found: list[tuple[str, Any]] = []
    vector = len(names) > 1 and names[-1] not in {*columns, *parameters}
    for place, name in enumerate(names):
        if name in columns:
            found.append(("column", name))
        elif name in unknowns:
            found.append(("unknown", unknowns.index(name)))
        elif name in parameters:
            found.append(("constant", parameters[name].value))
        elif place == 0:
            found.append(("column", columns[0]) if len(columns) == 1 else ("table", None))
        elif vector and place == len(names) - 1 and not set(names) & set(parameters):
            found.append(("vector", None))
        else:
            raise InputError(
                "is neither a column of the data nor a parameter", key=f"argument {name}",
                value=_name(function),
                hint=f'write parameters={{"{name}": bo.Parameter(1.0, sd=…), …}}',
            )  # fmt: skip
    if ("vector", None) not in found:
        for name in parameters:
            if name not in names:
                raise InputError(
                    f"function {_name(function)} has no such argument", key="parameters",
                    value=name, hint=f"its arguments are {', '.join(names)}",
                )  # fmt: skip
    return Call(function, found)


_BOTH = inspect.Parameter.POSITIONAL_OR_KEYWORD


def _name(function: Function) -> str:
    return getattr(function, "__name__", type(function).__name__)


def arguments_of(function: Function) -> list[str]:
    """Names of a function's arguments."""
    return list(inspect.signature(function).parameters)


def function_problem(
    function: Callable[[Any, Array], ArrayLike],
    inputs: Mapping[str, Array],
    y: Array,
    parameters: Mapping[str, Parameter],
    output: str,
) -> FunctionProblem:
    """The problem of estimating a function's parameters.

    Parameters
    ----------
    function : callable
        ``function(inputs, theta)``.
    inputs : mapping of str to ndarray, shape (n,)
    y : ndarray, shape (n,)
    parameters : mapping of str to Parameter
    output : str
    """
    chosen = {name: parameters[name] for name in unknowns_of(parameters)}
    return FunctionProblem(
        function,
        inputs,
        y,
        [item.prior for item in chosen.values() if item.prior is not None],
        names=list(chosen),
        start=[item.value for item in chosen.values()],
        output=output,
        nuisances=[name for name, item in chosen.items() if item.measured],
    )
