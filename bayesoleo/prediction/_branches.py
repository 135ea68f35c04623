"""Branches of periodic responses of a model, and limit cycles of a model without input.

A single solve does not show other responses to the same input, the folds where two of them meet and
vanish, and which of them are stable. Branches do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.integrate import solve_ivp

from bayesoleo._types import Array, Integers
from bayesoleo.errors import InputError
from bayesoleo.model._kernels import Kernels, kernels
from bayesoleo.model._model import Model
from bayesoleo.prediction._records import Harmonics
from bayesoleo.prediction._simulate import RunPlan
from bayesoleo.solvers._branches import (
    Branch,
    BranchPoint,
    LimitCycle,
    follow,
    solve_limit_cycle,
    with_error,
)
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary, solve_from_guess
from bayesoleo.solvers._schemes import DEFAULT_SCHEME, scheme
from bayesoleo.solvers._state_space import StateSpace

#: Quantities, besides a parameter, along which a branch can be followed.
FREQUENCY, AMPLITUDE = "frequency", "amplitude"
UNITS = {FREQUENCY: "Hz", AMPLITUDE: ""}
#: Steps of the longest kind after which a branch that does not leave its span is given up.
MOST = 40
#: Of the motion towards a limit cycle, which only has to start Newton's method.
RELATIVE_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False)
class AnswerBranch:
    """Periodic answers of a model along one value.

    Parameters
    ----------
    along : str
        ``frequency`` (Hz), ``amplitude`` (parts of the planned one) or a parameter.
    branch : Branch
        The orbits, the special ones among them, and how the branch ended.
    answers : Answers
        Turns an orbit into outputs.
    units : mapping of str to str
        SI units of what is followed and of the outputs.
    """

    along: str
    branch: Branch
    _answers: _Answers
    units: Mapping[str, str]

    @property
    def values(self) -> Array:
        """Shape (K,)."""
        return self.branch.values

    @property
    def unstable(self) -> Integers:
        """Number of multipliers outside the unit circle at each value, shape (K,)."""
        return np.array([point.unstable for point in self.branch.points], dtype=np.int64)

    def swing(self, output: str) -> Array:
        """Half the difference between largest and least value of an output, shape (K,)."""
        return np.array([self.swing_of(point, output) for point in self.branch.points])

    def swing_of(self, point: BranchPoint, output: str) -> float:
        """The same at one orbit."""
        return 0.5 * float(np.ptp(self._answers.output(point, output)))

    def output(self, point: BranchPoint, output: str) -> Array:
        """An output over the points of one period, shape (N,); SI."""
        return self._answers.output(point, output)

    def __repr__(self) -> str:
        unit = self.units[self.along]
        return f"along {self.along}{f' [{unit}]' if unit else ''}: {self.branch!r}"


def follow_branch(
    model: Model,
    plan: RunPlan,
    along: str,
    span: tuple[float, float],
    values: Mapping[str, float] | None = None,
    *,
    downward: bool = False,
    longest: float = 0.1,
    steps: int = 128,
    scheme_name: str = DEFAULT_SCHEME,
    backend: str = "numpy",
) -> AnswerBranch:
    """Follow periodic answers from one end of a span, through folds, until they leave it.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    plan : RunPlan
        Motion of the inputs and conditions.
    along : str
        ``frequency`` in Hz, ``amplitude`` (a factor on what moves in the inputs), or a parameter.
    span : tuple of float
        Least and largest value.
    values : mapping of str to float, optional
        Parameters that are not at their nominal value.
    downward : bool
        Whether to set out from the span's upper end.
    longest : float
        Longest step from orbit to orbit, in parts of the span and of the largest motion.
    steps : int
        Of the mesh.
    scheme_name : str
        A collocation scheme.
    backend : {"numpy", "numba"}

    Returns
    -------
    AnswerBranch
        Without orbits, and with the reason as its branch's status, where there is none to set out
        from.

    Raises
    ------
    InputError
        If there is nothing of that name to follow, or the span is empty.
    """
    if along not in (FREQUENCY, AMPLITUDE, *model.parameters):
        hint = f"use {FREQUENCY}, {AMPLITUDE} or one of {', '.join(model.parameters)}"
        raise InputError("no branch along this", key="along", value=along, hint=hint)
    if not span[0] < span[1]:
        raise InputError("a span goes from less to more", key="span", value=span)
    answers = _Answers.of(model, plan, along, values or {}, steps, scheme_name, backend)
    first = span[1] if downward else span[0]
    problem, p = answers.at(first)
    start = np.zeros((1, steps, problem.scheme.width))
    start[:, :, : problem.scheme.state_size] = answers.rest
    found = solve_from_guess(problem, p[None], start)
    branch = Branch((), (), Status(int(found.status[0])))
    if branch.status.ok:
        branch = follow(
            answers.at,
            found.x[0],
            first,
            span,
            forward=not downward,
            longest=longest,
            most=int(MOST / longest),
        )
    units = {name: output.unit for name, output in model.outputs.items()}
    units[along] = model.parameters[along].unit if along in model.parameters else UNITS[along]
    return AnswerBranch(along, branch, answers, units)


@dataclass(frozen=True, eq=False)
class _Answers:
    """The discretised problem of a plan at any value."""

    kernels: Kernels
    scheme: Collocation
    plan: RunPlan
    along: str
    constants: Array
    rest: Array
    steps: int

    @classmethod
    def of(
        cls,
        model: Model,
        plan: RunPlan,
        along: str,
        values: Mapping[str, float],
        steps: int,
        scheme_name: str,
        backend: str,
    ) -> _Answers:
        compiled = kernels(model, model.estimated(), backend)
        derived = compiled.derived
        known = {str(item): value for item, value in model.nominal().items()}
        known |= dict(plan.conditions) | dict(values)
        for name in (*derived.constants, *model.inputs):
            if name not in known and name not in plan.inputs:
                raise InputError(f"model {model.name!r} needs {name!r}", run=plan.label)
        rest = np.concatenate(
            [
                np.eye(1, order)[0] * _guess(model, dof, known)
                for dof, order in zip(derived.dofs, derived.orders, strict=True)
            ]
        )
        return cls(
            compiled,
            collocation_scheme(scheme_name, derived.orders),
            plan,
            along,
            np.array([known[name] for name in derived.constants]),
            rest,
            steps,
        )

    def at(self, value: float) -> tuple[Boundary, Array]:
        """Problem and constants, as a :data:`~bayesoleo.solvers._branches.Family` has."""
        derived, p = self.kernels.derived, self.constants.copy()
        frequency = value if self.along == FREQUENCY else self.plan.frequency
        if self.along in derived.constants:
            p[derived.constants.index(self.along)] = value
        amount = value if self.along == AMPLITUDE else 1.0
        phases = self.scheme.phases(self.steps)
        rows = np.zeros((len(derived.inputs), phases.size))
        for k, (channel, order) in enumerate(derived.inputs):
            if channel != "time":
                item = _scaled(self.plan.inputs[channel], amount)
                rows[k] = item.evaluate(phases, frequency, order)
        boundary = Boundary(
            equations=self.kernels,
            scheme=self.scheme,
            period=1.0 / frequency,
            inputs=rows,
            conditions=len(derived.admissible),
            active=len(derived.active),
        )
        return boundary, p

    def output(self, point: BranchPoint, name: str) -> Array:
        """An output at the points of the mesh, shape (N,)."""
        derived = self.kernels.derived
        if name not in derived.outputs:
            raise InputError(
                "no such output", key=name, hint=f"there are {', '.join(derived.outputs)}"
            )
        problem, p = self.at(point.value)
        lane, points = np.zeros(1, dtype=np.int64), problem.inputs.shape[1]
        z = np.zeros((1, self.scheme.state_size + len(self.scheme.orders), points))
        y = np.zeros((1, len(derived.outputs), points))
        self.scheme.rows(point.x[None], lane, problem.step(self.steps), z)
        self.kernels.output(z, problem.inputs, p[None], lane, y)
        return cast(Array, y[0, derived.outputs.index(name)])


def collocation_scheme(name: str, orders: tuple[int, ...]) -> Collocation:
    """A scheme by its name, if it is one of one step.

    Raises
    ------
    InputError
        If it is not.
    """
    method = scheme(name, orders)
    if not isinstance(method, Collocation):
        raise InputError(
            "branches need a one-step scheme", key="scheme", value=name, hint="use radau3, say"
        )
    return method


def _guess(model: Model, dof: str, known: Mapping[str, float]) -> float:
    """A dof's declared static value, where it is a number."""
    try:
        return float(model.dofs[dof].guess)
    except (TypeError, ValueError):
        return 0.0


def _scaled(item: Harmonics, amount: float) -> Harmonics:
    """A motion about the same mean, its harmonics scaled."""
    factor = np.where(item.orders == 0, 1.0, amount)
    return replace(item, coefficients=item.coefficients * factor)


def limit_cycle(
    model: Model,
    start: Mapping[str, float],
    settle: float,
    values: Mapping[str, float] | None = None,
    *,
    period: float | None = None,
    steps: int = 512,
    scheme_name: str = DEFAULT_SCHEME,
    backend: str = "numpy",
) -> LimitCycle:
    """The limit cycle to which a motion settles, or near which it starts, with inputs at zero.

    Parameters
    ----------
    model : Model
    start : mapping of str to float
        Where dofs start; those not given at zero. ``dot(x)`` is the velocity of a second-order dof.
    settle : float
        Time after which the motion is near the cycle, s; at least a few periods.
    values : mapping of str to float, optional
        Parameters that are not at their nominal value.
    period : float, optional
        Of an unstable cycle, about, s: nothing settles to it. The motion over that time from where
        it is after ``settle`` then begins the iteration.
    steps : int
        Of the mesh.
    scheme_name : str
        A collocation scheme.
    backend : {"numpy", "numba"}

    Returns
    -------
    LimitCycle
        With its period, multipliers, and the period's derivatives by the estimated parameters; its
        ``orbit.error`` is what halving the steps changes.

    Raises
    ------
    InputError
        If a dof is unknown, or the motion does not come back after the settling time.
    """
    compiled = kernels(model, model.estimated(), backend)
    derived = compiled.derived
    known = {str(item): value for item, value in model.nominal().items()} | dict(values or {})
    p = np.array([known[name] for name in derived.constants])
    method, nu = collocation_scheme(scheme_name, derived.orders), len(derived.inputs)
    space = StateSpace(
        compiled, derived.orders, lambda t: np.zeros((nu, t.size)), len(derived.active)
    )
    names = [
        dof if k == 0 else f"dot({dof})"
        for dof, order in zip(derived.dofs, derived.orders, strict=True)
        for k in range(order)
    ]
    for name in start:
        if name not in names:
            raise InputError("no such dof", key=name, hint=f"there are {', '.join(names)}")
    state = np.array([start.get(name, 0.0) for name in names])

    def problem(count: int) -> Boundary:
        still = np.zeros((nu, method.phases(count).size))
        return Boundary(compiled, method, 1.0, still, 0, len(derived.active))

    way = _motion(space, p, state, settle, period, model.name)
    begin, length = (settle, period) if period else _last_turn(way, settle, model.name)

    def rows(phase: Array) -> Array:
        times = begin + length * phase
        return space.complete(times, way(times)[None], p[None])[0]

    nodes, points = np.arange(steps) / steps, method.phases(steps)
    x = method.from_motion(rows(nodes), rows(points))[0]
    cycle = solve_limit_cycle(problem(steps), p, x, length)
    if not cycle.solution.status.ok:
        return cycle

    def again(phase: Array) -> Array:
        step, plan = cycle.solution.value / steps, method.plan(phase, steps)
        return np.asarray(method.sample(cycle.solution.x[None, :, :, None], plan, step)[:, :, 0])

    nodes, points = np.arange(2 * steps) / (2 * steps), method.phases(2 * steps)
    x = method.from_motion(again(nodes), again(points))[0]
    finer = solve_limit_cycle(problem(2 * steps), p, x, cycle.solution.value)
    return with_error(cycle, problem(steps), finer)


def _motion(
    space: StateSpace, p: Array, s: Array, settle: float, period: float | None, name: str
) -> Callable[[Array], Array]:
    """States ``(D, N)`` at times up to a period after settling, or twice as long."""
    end = settle + period if period else 2 * settle
    options = {"rtol": RELATIVE_TOLERANCE, "atol": RELATIVE_TOLERANCE * (1.0 + np.abs(s).max())}
    way = solve_ivp(
        space.right_side(p), (0.0, end), s, method="LSODA", dense_output=True, **options
    )
    if not way.success:
        raise InputError(f"model {name!r}: the motion cannot be computed", value=way.message)
    motion: Callable[[Array], Array] = way.sol
    return motion


def _last_turn(way: Callable[[Array], Array], settle: float, name: str) -> tuple[float, float]:
    """Beginning and length of the last turn of a motion."""
    fine = np.linspace(settle, 2 * settle, 4000)
    first = way(fine)[0]
    above = first - 0.5 * (first.max() + first.min())
    rising = np.flatnonzero((above[:-1] < 0) & (above[1:] >= 0))
    if np.ptp(first) <= 1e-6 * (1.0 + np.abs(first).max()) or rising.size < 2:
        raise InputError(
            f"model {name!r}: the motion does not come back",
            key="settle",
            value=settle,
            hint="give a longer time, or another start",
        )
    return float(fine[rising[-2]]), float(fine[rising[-1]] - fine[rising[-2]])
