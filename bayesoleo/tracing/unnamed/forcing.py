"""How outputs answer to a small term of any course in a balance.

A score asks for the derivative of the outputs by each coefficient of a spline. The coefficient
multiplies a function of the *present* motion, which is known: so the term is given as a further
input, and one model serves for all functions of all quantities.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import Any, cast

import numpy as np
import sympy as sp

from bayesoleo._types import Array
from bayesoleo.effects.unnamed import balance_places
from bayesoleo.model import Model, Parameter
from bayesoleo.model.expressions import symbol
from bayesoleo.model.kernels import Kernels, kernels
from bayesoleo.prediction.records import Record
from bayesoleo.prediction.run import RunPredictor
from bayesoleo.prediction.transient import TransientRun
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.fitting.assembly import Assembly
from bayesoleo.tracing.fitting.fit import Fit

#: Courses of a term in one run: at phases ``(N,)`` an array ``(K, N)``.
Courses = Callable[[Array], Array]

#: Terms that one model takes at a time.
TOGETHER = 36
#: Step in phase for derivatives of a course.
NEARBY = 1e-6
_AMPLITUDE, _INPUT = "nonparametric_amplitude_", "nonparametric_course_"


class _Course:
    """One of several courses as an input signal."""

    def __init__(self, courses: _Remembered, k: int, rate: float):
        self.courses, self.k, self.rate = courses, k, rate

    def evaluate(self, phase: Array, frequency: float, derivative: int = 0) -> Array:
        """As a signal's; derivatives by differences."""
        if derivative:
            later = self.evaluate(phase + NEARBY, frequency, derivative - 1)
            before = self.evaluate(phase - NEARBY, frequency, derivative - 1)
            return (later - before) * frequency / (2 * NEARBY)
        rows = self.courses(phase)
        return rows[self.k] if self.k < len(rows) else np.zeros(phase.size)

    def for_derivative(self, highest: int) -> _Course:
        """The same: it is computed, not measured."""
        return self

    def at_once(self, time: float, derivative: int = 0) -> float:
        """At one time of a transient, s."""
        return float(self.evaluate(np.array([time * self.rate]), self.rate, derivative)[0])


class _Remembered:
    """Courses that are computed once for each set of phases."""

    def __init__(self, courses: Courses):
        self._courses, self._known = courses, dict[bytes, Array]()

    def __call__(self, phase: Array) -> Array:
        key = phase.tobytes()
        if key not in self._known:
            self._known[key] = self._courses(phase)
        return self._known[key]


class Forced:
    """A fitted model with small terms added to one of its balances.

    Parameters
    ----------
    fit : Fit
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

    def __init__(self, fit: Fit, assembly: Assembly, target: str):
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
    model: Model, compiled: Kernels, record: Record, fit: Fit, present: RunPredictor
) -> RunPredictor:
    """A run of the forced model on the mesh of the present one."""
    rows = dict(present.known_rows)  # its own: the courses are others in every block
    scheme = fit.numerics.scheme
    if isinstance(present, TransientRun):
        like = copy(present)
        like.known_rows = rows
        return TransientRun(model, compiled, record, fit.steps, scheme, like)
    return RunPredictor(model, compiled, record, fit.steps, scheme, rows)
