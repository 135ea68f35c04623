"""Quantities along the motion, and the response of outputs to a small force.

Quantities of the model are evaluated along its estimated motion, at any phase of any run.

A score needs the derivative of the outputs by each coefficient of a spline. The coefficient
multiplies a function of the *present* motion, which is known. The term is therefore a further
input, and one model serves all functions of all quantities.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import sympy as sp

from bayesoleo._types import Array
from bayesoleo.discovery._assembly import Assembly
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.effects._forces import FRICTION_SLOPE
from bayesoleo.effects._nonparametric import Axis, balance_places, bspline_values
from bayesoleo.effects._places import parse_unit, unit_of, unit_text
from bayesoleo.errors import ModelError
from bayesoleo.model._expressions import split_derivative, symbol
from bayesoleo.model._kernels import Kernels, kernels
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Output, Parameter
from bayesoleo.prediction._inputs import signal_of
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._transient_run import TransientRun
from bayesoleo.solvers._orbit import Status

#: A quantity whose range is a smaller part of its size does not move.
MOVES = 1e-6
_PREFIX = "quantity_"

#: Courses of a term in one run: at phases ``(N,)`` an array ``(K, N)``.
Courses = Callable[[Array], Array]
#: Terms that one model takes at a time: the splines of two fine curves.
TOGETHER = 38
#: Velocity at which a direction has half its size, over the largest one.
TRANSITION = 1 / 200
#: Step in phase for derivatives of a course.
NEARBY = 1e-6
_AMPLITUDE, _INPUT = "nonparametric_amplitude_", "nonparametric_course_"


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
    """Positions and velocities, other states of first order, and the definitions that move.

    Parameters
    ----------
    model : Model
        In its own drive.
    """
    found: dict[str, ModelQuantity] = {}

    def add(name: str, expression: sp.Expr, unit: str) -> None:
        found.setdefault(name, ModelQuantity(name, expression, unit))

    for item in model.coordinates():
        names = (item.position_name, item.name) if item.position is not None else (item.name,)
        for name in names:
            unit = model.dofs[name].unit if name in model.dofs else model.inputs[name]
            add(name, symbol(name), unit)
        if item.velocity is not None and item.order > 0:
            rate = unit_text(parse_unit(unit) / parse_unit("s"))
            add(f"velocity of {item.name}", item.velocity, rate)
    for name, dof in model.dofs.items():
        add(name, symbol(name), dof.unit)
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
    fit : ModelFit
        The present model.
    assembly : Assembly
        It, with its drive.
    quantities : sequence of ModelQuantity
    """

    def __init__(self, fit: ModelFit, assembly: Assembly, quantities: Sequence[ModelQuantity]):
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


def ranges(fit: ModelFit, assembly: Assembly, model: Model) -> dict[str, Axis]:
    """By name, the ranges of a model's quantities along an estimated motion.

    Parameters
    ----------
    fit : ModelFit
    assembly : Assembly
        What was fitted; it may have more effects than the model.
    model : Model
        In its own drive.
    """
    return {axis.name: axis for _, axis in Motions(fit, assembly, quantities_of(model)).axes({})}


def direction_at(fit: ModelFit, assembly: Assembly, target: str) -> ModelQuantity | None:
    r"""A smooth sign of the velocity at a place, :math:`\frac{2}{\pi}\arctan(v/v_0)`; None where
    the place has no velocity.

    The transition is the model's own where it declares a ``friction_slope``, else a part of the
    largest velocity.
    """
    model = assembly.native
    velocity = balance_places(model)[target].velocity
    if velocity is None:
        return None
    if FRICTION_SLOPE in model.parameters:
        slope: sp.Expr = symbol(FRICTION_SLOPE)
    else:
        motions = Motions(fit, assembly, [ModelQuantity("velocity", velocity, "")])
        if not motions.quantities:
            return None
        along = [motions.at(r, 0, record.position) for r, record in enumerate(fit.records)]
        largest = float(np.abs(np.concatenate(along)).max())
        if not np.isfinite(largest) or largest == 0.0:
            return None
        slope = sp.Float(float(f"{1.0 / (TRANSITION * largest):.6g}"))
    return ModelQuantity(f"direction at {target}", 2 / sp.pi * sp.atan(slope * velocity), "")


def times_direction(turns: Motions | None, r: int, phase: Array, values: Array) -> Array:
    """Courses ``(K, N)`` of run number ``r``, times the direction if there is one."""
    return values if turns is None else values * turns.at(r, 0, phase)


def _rank_correlation(values: Array, other: Array) -> float:
    """Size of Spearman's rank correlation."""
    return float(abs(np.corrcoef(_ranks(values), _ranks(other))[0, 1]))


def _ranks(values: Array) -> Array:
    """Ranks from one, equal values with the average of theirs."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2)[place])


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


class _Course:
    """One of several courses as an input signal."""

    def __init__(self, courses: _Remembered, k: int, rate: float):
        self.courses, self.k, self.rate = courses, k, rate

    def evaluate(self, phase: Array, frequency: float, derivative: int = 0) -> Array:
        """As a signal's; derivatives by differences."""
        rows = self.courses.derivative(phase, derivative)
        if self.k >= len(rows):
            return np.zeros(phase.size)
        return np.asarray(rows[self.k] * frequency**derivative)

    def for_derivative(self, highest: int) -> _Course:
        """The same: it is computed, not measured."""
        return self


class _Remembered:
    """Courses that are computed once for each set of phases."""

    def __init__(self, courses: Courses):
        self._courses, self._known = courses, dict[bytes, Array]()
        self._last = dict[int, tuple[Array, Array]]()

    def __call__(self, phase: Array) -> Array:
        key = phase.tobytes()
        if key not in self._known:
            self._known[key] = self._courses(phase)
        return self._known[key]

    def derivative(self, phase: Array, order: int) -> Array:
        """Derivative of all courses by the phase, from differences. The result for the last array
        of phases is kept: every course is asked for with the same one."""
        last = self._last.get(order)
        if last is None or last[0] is not phase:
            last = self._last[order] = phase, self._differences(phase, order)
        return last[1]

    def _differences(self, phase: Array, order: int) -> Array:
        if order == 0:
            return self(phase)
        later = self._differences(phase + NEARBY, order - 1)
        before = self._differences(phase - NEARBY, order - 1)
        return (later - before) / (2 * NEARBY)


class Forced:
    """A fitted model with small terms added to one of its balances.

    Parameters
    ----------
    fit : ModelFit
        The present model.
    assembly : Assembly
        It, with its drive.
    target : str
        Where the terms act.

    Raises
    ------
    ModelError
        If no drive is left with them.
    """

    def __init__(self, fit: ModelFit, assembly: Assembly, target: str):
        self.fit = fit
        native = _with_terms(assembly.native, target)
        model = replace(assembly, native=native).model()
        own = {f"{_AMPLITUDE}{k}" for k in range(TOGETHER)}
        self.model = model.fixing(*(name for name in model.estimated() if name not in own))
        self.kernels = kernels(self.model, self.model.estimated(), "numpy")

    def responses(self, r: int, courses: Courses) -> Array | Status:
        """Change of the outputs of run number ``r`` by each course, shape (ny, K, N)."""
        remembered = _Remembered(courses)
        record = self.fit.records[r]
        count = len(remembered(record.position))
        parts = []
        for first in range(0, count, TOGETHER):
            block = _shifted(remembered, first)
            found = self._block(r, _with_courses(record, block))
            if isinstance(found, Status):
                return found
            parts.append(found)
        return np.concatenate(parts, axis=1)[:, :count]

    def _block(self, r: int, record: Record) -> Array | Status:
        present = self.fit.predictor.runs[r]
        run = _run(self.model, self.kernels, record, self.fit, present)
        p = run.base_constants()
        theta = self.fit.problem.full(self.fit.point.theta[None])
        known = self.fit.predictor.constants(theta, r)[0]
        place = {name: k for k, name in enumerate(self.kernels.derived.constants)}
        for name, value in zip(present.kernels.derived.constants, known, strict=True):
            if name in place:
                p[place[name]] = value
        run.motions = present.known_motions()
        samples = run.evaluate(p)
        if samples.status[0] != Status.CONVERGED.value or samples.y_p is None:
            return Status(int(samples.status[0]))
        return cast(Array, samples.y_p[0])


def _with_terms(native: Model, target: str) -> Model:
    place = balance_places(native)[target]
    inputs = {f"{_INPUT}{k}": "" for k in range(TOGETHER)}
    amplitudes = {f"{_AMPLITUDE}{k}": Parameter(0.0, sd=1.0) for k in range(TOGETHER)}
    total = sp.Add(*(symbol(a) * symbol(u) for a, u in zip(amplitudes, inputs, strict=True)))
    extended = replace(native, inputs={**native.inputs, **inputs}).with_parameters(**amplitudes)
    return extended.with_term(place.kind, place.target, "nonparametric_courses", place.sign * total)


def _shifted(courses: _Remembered, first: int) -> _Remembered:
    return _Remembered(lambda phase: courses(phase)[first : first + TOGETHER])


def _with_courses(record: Record, courses: _Remembered) -> Record:
    names = [f"{_INPUT}{k}" for k in range(TOGETHER)]
    signals: dict[str, Any] = {
        name: _Course(courses, k, record.rate) for k, name in enumerate(names)
    }
    # A record is asked whether it has a channel by its samples.
    samples = {**record.samples, **dict.fromkeys(names, np.zeros(0))}
    if record.periodic:
        return replace(record, samples=samples, harmonics={**record.harmonics, **signals})
    return replace(record, samples=samples, smoothed={**record.smoothed, **signals})


def _run(
    model: Model, compiled: Kernels, record: Record, fit: ModelFit, present: RunPredictor
) -> RunPredictor:
    """A run of the forced model on the mesh of the present one."""
    rows = dict(present.known_rows)  # its own: the courses are others in every block
    scheme = fit.numerics.scheme
    if isinstance(present, TransientRun):
        like = copy(present)
        like.known_rows = rows
        return TransientRun(model, compiled, record, fit.fineness, scheme, like)
    return RunPredictor(model, compiled, record, fit.steps, scheme, rows)
