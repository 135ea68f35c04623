"""What a session computes for a function and a table of data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy import stats

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem, PointEstimate, estimate, polish, to_dataset
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.estimation.shown import LabelledResult, columns
from bayesoleo.model import Parameter
from bayesoleo.posterior import LogDensity, compare, to_datasets
from bayesoleo.session.functions import (
    Call,
    Sum,
    function_problem,
    read_table,
    unknowns_of,
)
from bayesoleo.storage import provenance
from bayesoleo.storage.digest import digest
from bayesoleo.workflow.sampling import draw_from
from bayesoleo.workflow.settings import Settings

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
        """What would be fitted."""
        number = self.table[self.output].size
        terms = "".join(f" + {name}" for name in self.added)
        lines = [f"{self.output} = {self.name}({', '.join(self.inputs)}, …){terms}"]
        lines.append(f"{number} samples of {', '.join(self.table)}")
        rows = []
        for name in unknowns_of(self.parameters):
            item = self.parameters[name]
            sd = "" if item.prior is None else f"{item.prior.sd:.3g}"
            rows.append([name, f"{item.value:.6g}", sd, item.unit or "1"])
        return "\n".join([*lines, columns(["parameter", "start", "sd of prior", "unit"], rows)])

    def check(self) -> dict[str, Any]:
        """What the data and the start are."""
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
        callback(f"{method.upper()}, {len(problem.names)} unknowns")
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
            schema.OBSERVED_DATA: dataset({**self.inputs, self.output: y}),
            schema.POINT: to_dataset(fit.point, mbe=fit.mbe, units=units),
            schema.PREDICTION: dataset({name: predicted}),
            schema.RESIDUAL: dataset({name: y - predicted}),
        }
        tree = xr.DataTree.from_dict({**groups, **more})
        model = " + ".join([self.name, *self.added])
        tree.attrs.update(provenance(self.settings.seed, **{schema.MODEL: model}))
        return tree

    def problem(self, fit: FunctionFit) -> Problem:
        """The problem that was estimated."""
        return fit.problem

    def sample(
        self, fit: FunctionFit, tree: xr.DataTree, out: Path | None, progress: float
    ) -> xr.DataTree:
        """The tree with the posterior."""
        settings, problem = self.settings, fit.problem
        density = LogDensity(problem, settings.jobs, errors=settings.error_model)
        of = ["" if out is None else digest((self.table, self.call, self.parameters))]
        samples = draw_from(
            density, fit.point.theta, settings, of=of, checkpoints=out, progress=progress
        )
        units = {name: self.parameters[name].unit or "1" for name in problem.names}
        found = to_datasets(
            samples, problem.priors, units=units, seed=settings.seed, density=density
        )
        groups = {name: tree[name].to_dataset() for name in tree.children} | found
        groups[schema.COMPARISON] = compare(groups)
        drawn = xr.DataTree.from_dict(groups)
        drawn.attrs.update({**tree.attrs, schema.SEED: settings.seed})
        return drawn

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
        mean, half = -found.residual[0], stats.norm.isf(0.5 * (1 - level)) * np.sqrt(variance)
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
            return {next(iter(self.inputs)): np.atleast_1d(np.asarray(data, dtype=float))}
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
