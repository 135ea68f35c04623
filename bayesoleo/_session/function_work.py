"""The computations of a session for a user's function and a table of data."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import LabelledResult, columns
from bayesoleo._storage.result_files import provenance
from bayesoleo._storage.resume import digest
from bayesoleo._types import Array, Integers
from bayesoleo._workflow.estimating import draw_from
from bayesoleo._workflow.settings import Settings
from bayesoleo.discovery._inference import effective_at, function_errors
from bayesoleo.error_models._correlated import PowerErrors
from bayesoleo.errors import InputError, number_of
from bayesoleo.estimation._estimate import estimate, polish
from bayesoleo.estimation._function_problem import FunctionProblem
from bayesoleo.estimation._point_estimate import PointEstimate, to_dataset
from bayesoleo.estimation._problem import EstimationProblem
from bayesoleo.model._parameters import Parameter, check_start
from bayesoleo.model._priors import Prior
from bayesoleo.posterior._comparison import compare
from bayesoleo.posterior._datatree import block_groups, each_sample, to_datasets
from bayesoleo.posterior._log_density import LogDensity

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
        column = _numbers(data[name], f"data[{name!r}]")
        if column.ndim == 1:
            table[str(name)] = column
    return table


def _numbers(values: Any, key: str) -> Array:
    """Values as floats; text is refused even where it reads as a number."""
    found = np.asarray(values)
    items = found.flat if found.dtype.kind in "OSU" else ()
    text = next((item for item in items if isinstance(item, str | bytes)), None)
    hint = "give numbers, or leave the column out; text is converted by numpy.asarray(…, float)"
    if text is not None:
        raise InputError("holds text, not numbers", key=key, value=str(text), hint=hint)
    try:
        return np.asarray(found, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError("does not hold numbers", key=key, value=str(error), hint=hint) from error


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
        If one is neither, is estimated without a prior, or starts where that has no density.
    """
    if given is not None and not isinstance(given, Mapping):
        raise InputError(
            "is not a dictionary", key="parameters", value=given,
            hint='write parameters={"a": bo.Parameter(1.0, sd=…)}',
        )  # fmt: skip
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
        check_start(name, item)
        found[name] = item
    if not any(item.prior is not None for item in found.values()):
        raise InputError(
            "no parameter to estimate", key="parameters", value=list(found),
            hint='write parameters={"a": bo.Parameter(1.0, sd=…)}',
        )  # fmt: skip
    return found


def check_call(call: Call, inputs: Mapping[str, Array], problem: FunctionProblem) -> None:
    """Call a function once where the estimate starts, so that it fails here or not at all.

    Raises
    ------
    InputError
        If it raises something, or returns another number of values than were measured.
    """
    size = problem.data[0].size
    for name, column in inputs.items():
        if column.size != size and ("column", name) in call.arguments:
            raise InputError(
                f"has {number_of(column.size, 'row')}, the measured column has {size}",
                key=f"data[{name!r}]",
                hint="give columns of one length",
            )  # fmt: skip
    try:
        problem.predict(problem.start)
    except InputError:
        raise
    except Exception as error:  # the function is the user's: it may raise anything
        hint = "correct the function, or the names of its arguments"
        if ("table", None) in call.arguments:
            hint = (
                "its first argument is no column, so that it received all columns as a dictionary; "
                f"name its arguments after columns: {', '.join(inputs)}"
            )
        raise InputError(
            f"function fails at the start values: {type(error).__name__}: {error}",
            key="model", value=_name(call.function), hint=hint,
        ) from error  # fmt: skip


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
                f"of {_name(function)} is neither a column of the data ({', '.join(columns)}) nor "
                "a parameter", key=f"argument {name}",
                hint="rename it after a column, or declare it: "
                f'parameters={{"{name}": bo.Parameter(1.0, sd=…), …}}',
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


Say = Callable[[str], None]
#: The one run of a function's data.
RUN = "1"


@dataclass(frozen=True)
class FunctionFit:
    """A function's estimate.

    Parameters
    ----------
    problem : FunctionProblem
    mbe, point : PointEstimate
        By the method asked for, and the posterior's mode reached from it.
    """

    problem: FunctionProblem
    mbe: PointEstimate
    point: PointEstimate


@dataclass(frozen=True)
class FunctionWork:
    """A function, its parameters and the data.

    Parameters
    ----------
    name : str
        Of the function.
    call : callable
        ``call(inputs, theta)``.
    table : mapping of str to ndarray, shape (n,)
        All columns.
    output : str
        The measured one.
    parameters : mapping of str to Parameter
    settings : Settings
    added : tuple of str
        Names of the terms that were added.
    """

    name: str
    call: Call | Sum
    table: Mapping[str, Array]
    output: str
    parameters: Mapping[str, Parameter]
    settings: Settings
    added: tuple[str, ...] = field(default=())

    @property
    def inputs(self) -> dict[str, Array]:
        """Columns that are not measured output."""
        return {name: column for name, column in self.table.items() if name != self.output}

    @property
    def statement(self) -> FunctionProblem:
        """The problem of estimating the parameters."""
        y = self.table[self.output]
        return function_problem(self.call, self.inputs, y, self.parameters, self.output)

    def with_settings(self, settings: Settings) -> FunctionWork:
        """The same with other settings of later steps."""
        return replace(self, settings=settings)

    def text(self) -> str:
        """Function, data and parameters, as text."""
        number = self.table[self.output].size
        terms = "".join(f" + {name}" for name in self.added)
        lines = [f"{self.output} = {self.name}({', '.join(self.inputs)}, …){terms}"]
        lines.append(f"{number_of(number, 'sample')} of {', '.join(self.table)}")
        rows = []
        for name in unknowns_of(self.parameters):
            item = self.parameters[name]
            sd = "" if item.prior is None else f"{item.prior.sd:.3g}"
            rows.append([name, f"{item.value:.6g}", sd, item.unit or "1"])
        return "\n".join([*lines, columns(["parameter", "start", "sd of prior", "unit"], rows)])

    def check(self) -> dict[str, Any]:
        """Facts about the data and the start."""
        problem = self.statement
        left = problem.evaluate(problem.start).residual[0]
        y = self.table[self.output]
        return {
            "model": self.name,
            "outputs": [self.output],
            "inputs": list(self.inputs),
            "samples": y.size,
            "unknowns": list(problem.names),
            "rms of residual at the start": float(np.sqrt(np.mean(left**2))),
            "rms of measured": float(np.sqrt(np.mean(y**2))),
        }

    def fit(self, method: str, callback: Say) -> tuple[FunctionFit, xr.DataTree]:
        """The estimate, and its tree."""
        problem = self.statement
        callback(f"{method.upper()}, {number_of(len(problem.names), 'unknown')}")
        mbe = estimate(problem, method)
        fit = FunctionFit(problem, mbe, polish(problem, mbe))
        return fit, self.tree(fit, {})

    def tree(self, fit: FunctionFit, more: Mapping[str, xr.Dataset]) -> xr.DataTree:
        """The groups of the data, of the estimate and of what it leaves."""
        (y,), rows = fit.problem.data, (schema.RUN, schema.SAMPLE)
        predicted = fit.problem.predict(fit.point.theta)
        units = [self.parameters[name].unit for name in fit.problem.names]
        name, coords = schema.before(self.output), {schema.RUN: [RUN]}
        about = {schema.UNITS: "1"}

        def dataset(columns: Mapping[str, Array]) -> xr.Dataset:
            data = {
                key: (rows, np.asarray(column, dtype=float)[None], {**about, schema.LONG_NAME: key})
                for key, column in columns.items()
                if np.shape(column) == y.shape
            }
            return xr.Dataset(data, coords=coords)

        groups = {
            schema.RECORDS: dataset({**self.inputs, self.output: y}),
            schema.POINT: to_dataset(fit.point, mbe=fit.mbe, units=units),
            schema.PREDICTION: dataset({name: predicted}),
            schema.RESIDUAL: dataset({name: y - predicted}),
        }
        tree = xr.DataTree.from_dict({**groups, **more})
        model = " + ".join([self.name, *self.added])
        tree.attrs.update(provenance(self.settings.seed, **{schema.MODEL: model}))
        return tree

    def problem(self, fit: FunctionFit) -> EstimationProblem:
        """The problem that was estimated."""
        return fit.problem

    def sample(
        self, fit: FunctionFit, tree: xr.DataTree, out: Path | None, progress: float
    ) -> xr.DataTree:
        """The tree with the posterior."""
        settings, problem = self.settings, fit.problem
        word, reason = function_errors(problem, fit.point.theta, settings.error_model)
        if word == PowerErrors.word:
            problem.effective = effective_at(problem, fit.point.theta)
        density = LogDensity(problem, settings.jobs, errors=word)
        of = ["" if out is None else digest((self.table, self.call, self.parameters))]
        samples = draw_from(
            density, fit.point.theta, settings, of=of, checkpoints=out, progress=progress
        )
        units = {name: self.parameters[name].unit or "1" for name in problem.names}
        found = to_datasets(
            samples, problem.priors, units=units, seed=settings.seed, density=density
        )
        found |= block_groups(
            samples, density, self._shown, seed=settings.seed, blocks=each_sample(density)
        )
        groups = {name: tree[name].to_dataset() for name in tree.children} | found
        groups[schema.COMPARISON] = compare(groups)
        if reason:
            groups[schema.POSTERIOR].attrs["error_model_reason"] = reason
        drawn = xr.DataTree.from_dict(groups)
        drawn.attrs.update({**tree.attrs, schema.SEED: settings.seed})
        return drawn

    def _shown(self, _: int, shown: Integers) -> dict[str, Array]:
        size = self.table[self.output].size
        return {name: x[shown] for name, x in self.inputs.items() if np.shape(x) == (size,)}

    def predict(
        self, tree: xr.DataTree, data: Any, *, level: float = 0.95, noise: bool = True
    ) -> LabelledResult:
        """The function with its interval at other inputs."""
        table = self.inputs if data is None else self._inputs_of(data)
        size = next(iter(table.values())).size
        problem = function_problem(self.call, table, np.zeros(size), self.parameters, self.output)
        point = tree[schema.POINT].to_dataset()
        found = problem.evaluate(point[schema.ESTIMATE].values)
        if not found.status.ok:
            raise InputError(
                f"function cannot be evaluated: {found.status.message}", key="data",
                hint="give inputs at which it is finite",
            )  # fmt: skip
        slope = found.sensitivity[0]
        variance = np.einsum("nk,kl,nl->n", slope, point[schema.COVARIANCE].values, slope)
        variance = variance + (float(point[schema.VARIANCE].values[0]) if noise else 0.0)
        mean, half = (
            -found.residual[0],
            distributions.norm.isf(0.5 * (1 - level)) * np.sqrt(variance),
        )
        columns_ = {"mean": mean, "sd": np.sqrt(variance), "low": mean - half, "high": mean + half}
        place = next(iter(table))
        data_set = xr.Dataset(
            {key: (schema.SAMPLE, column) for key, column in {**table, **columns_}.items()},
            attrs={"place": place, "output": self.output, "level": level, "noise": int(noise)},
        )
        return LabelledResult(data_set, _prediction_text(data_set, place))

    def _inputs_of(self, data: Any) -> dict[str, Array]:
        if not hasattr(data, "keys"):
            if len(self.inputs) != 1:
                raise InputError(
                    "a function of several columns needs a table", key="data",
                    hint=f"give a dictionary with {', '.join(self.inputs)}",
                )  # fmt: skip
            return {next(iter(self.inputs)): np.atleast_1d(_numbers(data, "data"))}
        table = read_table(data)
        missing = [name for name in self.inputs if name not in table]
        if missing:
            raise InputError(
                "lacks a column that the function reads", key="data", value=missing,
                hint=f"give {', '.join(self.inputs)}",
            )  # fmt: skip
        return {name: table[name] for name in self.inputs}


def _prediction_text(data: xr.Dataset, place: str, most: int = 12) -> str:
    keys = (place, "mean", "sd", "low", "high")
    chosen = np.unique(np.linspace(0, data.sizes[schema.SAMPLE] - 1, most).round().astype(int))
    rows = [[f"{float(data[key][k]):.5g}" for key in keys] for k in chosen]
    level = f"{100 * float(data.attrs['level']):.3g} %"
    table = columns([place, "mean", "sd", f"low {level}", "high"], rows)
    number = data.sizes[schema.SAMPLE]
    return table if number == len(rows) else f"{table}\n{len(rows)} of {number} samples"
