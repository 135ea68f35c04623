"""The quantities of a model along its estimated motion, at any phase of any run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import sympy as sp
from scipy import stats

from bayesoleo._types import Array
from bayesoleo.effects.units import parse_unit, unit_of, unit_text
from bayesoleo.effects.unnamed import Axis, bspline_values
from bayesoleo.errors import ModelError
from bayesoleo.model import Model, Output
from bayesoleo.model.expressions import split_derivative, symbol
from bayesoleo.prediction.inputs import signal_of
from bayesoleo.prediction.run import RunPredictor
from bayesoleo.tracing.fitting.assembly import Assembly
from bayesoleo.tracing.fitting.fit import Fit

#: A quantity whose range is a smaller part of its size does not move.
MOVES = 1e-6
_PREFIX = "quantity_"


@dataclass(frozen=True)
class ModelQuantity:
    """Something of a model that varies in time.

    Parameters
    ----------
    name, unit : str
    expression : sympy.Expr
        In the names of the model in its own drive.
    """

    name: str
    expression: sp.Expr
    unit: str


def quantities_of(model: Model) -> list[ModelQuantity]:
    """Positions and velocities, states of first order, and the definitions that move.

    Parameters
    ----------
    model : Model
        In its own drive.
    """
    found: dict[str, ModelQuantity] = {}

    def add(name: str, expression: sp.Expr, unit: str) -> None:
        found.setdefault(name, ModelQuantity(name, expression, unit))

    for item in model.coordinates():
        unit = model.dofs[item.name].unit if item.name in model.dofs else model.inputs[item.name]
        add(item.name, item.position, unit)
        if item.velocity is not None:
            rate = unit_text(parse_unit(unit) / parse_unit("s"))
            add(f"velocity of {item.name}", item.velocity, rate)
    for name in model.definitions:
        own = _unit(model, name)
        if own is not None and _moves(model, name):
            add(name, symbol(name), own)
    return list(found.values())


def _moves(model: Model, definition: str) -> bool:
    free = {split_derivative(item)[0] for item in model.expand(symbol(definition)).free_symbols}
    return bool(free & {*model.dofs, *model.inputs})


def _unit(model: Model, definition: str) -> str | None:
    try:
        return unit_text(unit_of(symbol(definition), model))
    except ModelError:
        return None  # bare numbers in a definition leave it without one


class Motions:
    """Values of quantities along the estimated motion.

    Parameters
    ----------
    fit : Fit
        The present model.
    assembly : Assembly
        It, with its drive.
    quantities : sequence of ModelQuantity
    """

    def __init__(self, fit: Fit, assembly: Assembly, quantities: Sequence[ModelQuantity]):
        self.fit = fit
        self.quantities: list[ModelQuantity] = []
        self._functions = []
        for item in quantities:
            expression = _driven(assembly, item)
            if expression is not None:
                items = tuple(sorted(expression.free_symbols, key=str))
                modules = [{"bspline": bspline_values}, "numpy"]
                self._functions.append((sp.lambdify(items, expression, modules), items))
                self.quantities.append(item)

    def at(self, r: int, k: int, phase: Array) -> Array:
        """Quantity number ``k`` in run number ``r`` at phases in cycles, shape (N,)."""
        present = self.fit.predictor.constants(
            self.fit.problem.full(self.fit.point.theta[None]), r
        )[0]
        return self.along(self.fit.predictor.runs[r], present, k, phase)

    def along(self, run: RunPredictor, constants: Array, k: int, phase: Array) -> Array:
        """Quantity number ``k`` along any solved run of the model, shape (N,).

        Parameters
        ----------
        run : RunPredictor
        constants : ndarray
            The run's, in the order of its kernels.
        k : int
        phase : ndarray, shape (N,)
            In cycles.
        """
        function, items = self._functions[k]
        columns = [_row(run, constants, item, phase) for item in items]
        with np.errstate(all="ignore"):
            found: Array = np.zeros(phase.size) + np.asarray(function(*columns), dtype=float)
        return found

    def axes(self, also: Mapping[str, Axis]) -> list[tuple[int, Axis]]:
        """Quantities that move, each with its number and range, none that another one follows.

        Parameters
        ----------
        also : mapping of str to Axis
            By name: ranges to be covered besides.
        """
        found: list[tuple[int, Axis]] = []
        kept: list[Array] = []
        same = self.fit.policy.equal_ranks
        records = self.fit.records
        for k, item in enumerate(self.quantities):
            parts = [self.at(r, k, record.position) for r, record in enumerate(records)]
            values = np.concatenate(parts)
            if not np.isfinite(values).all():
                continue
            if np.ptp(values) <= MOVES * np.abs(values).max():
                continue
            if any(_rank_correlation(values, other) > same for other in kept):
                continue
            kept.append(values)
            axis = Axis.covering(item.name, item.expression, item.unit, values)
            found.append((k, axis.together(also[item.name]) if item.name in also else axis))
        return found


def ranges(fit: Fit, assembly: Assembly, model: Model) -> dict[str, Axis]:
    """By name, the ranges of a model's quantities along an estimated motion.

    Parameters
    ----------
    fit : Fit
    assembly : Assembly
        What was fitted; it may have more effects than the model.
    model : Model
        In its own drive.
    """
    return {axis.name: axis for _, axis in Motions(fit, assembly, quantities_of(model)).axes({})}


def _rank_correlation(values: Array, other: Array) -> float:
    return float(abs(stats.spearmanr(values, other).statistic))


def _driven(assembly: Assembly, item: ModelQuantity) -> sp.Expr | None:
    """A quantity in the names of the driven model: as an output, it is rewritten with the rest."""
    name = f"{_PREFIX}{item.name}".replace(" ", "_")
    native = assembly.native
    watched = replace(
        native, outputs={**native.outputs, name: Output({"itself": item.expression}, item.unit)}
    )
    try:
        driven = replace(assembly, native=watched).model()
    except ModelError:
        return None
    return driven.output(name) if name in driven.outputs else None


def _row(run: RunPredictor, present: Array, item: sp.Symbol, phase: Array) -> Array:
    """A symbol of the driven model: of a dof, an input or a constant. Not a number where it is
    none of them, as a channel fed back within an effect, or where the run has no solution."""
    name, order = split_derivative(item)
    motions = run.known_motions()
    if name in motions:
        rows: Array = motions[name](phase)
        return cast(Array, rows[order])
    if name in run.model.inputs:
        return signal_of(run.record, name, order).evaluate(phase, run.record.rate, order)
    constants = run.kernels.derived.constants
    if name in constants:
        return np.asarray(present[constants.index(name)])
    return np.full(phase.size, np.nan)
