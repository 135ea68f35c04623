"""Branches of a model's periodic answers.

What a single solve does not show: that there are other answers to the same motion, where two of
them meet and vanish, and which of them a rig can be on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.model import Model
from bayesoleo.model.kernels import Kernels, kernels
from bayesoleo.prediction.records import Harmonics
from bayesoleo.prediction.simulate import RunPlan
from bayesoleo.solvers.branches.follow import Branch, BranchPoint, follow
from bayesoleo.solvers.periodic.continuation import solve_from_guess
from bayesoleo.solvers.periodic.solve import Boundary
from bayesoleo.solvers.schemes.choose import DEFAULT_SCHEME, scheme
from bayesoleo.solvers.schemes.collocation import Collocation
from bayesoleo.solvers.status import Status

#: What a branch can be followed along besides a parameter.
FREQUENCY, AMPLITUDE = "frequency", "amplitude"
UNITS = {FREQUENCY: "Hz", AMPLITUDE: ""}
#: Steps of the longest kind after which a branch that does not leave its span is given up.
MOST = 40


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
    answers: _Answers
    units: Mapping[str, str]

    @property
    def values(self) -> Array:
        """Shape (K,)."""
        return self.branch.values

    @property
    def unstable(self) -> NDArray[np.int64]:
        """Number of multipliers outside the unit circle at each value, shape (K,)."""
        return np.array([point.unstable for point in self.branch.points], dtype=np.int64)

    def swing(self, output: str) -> Array:
        """Half the difference between largest and least value of an output, shape (K,)."""
        return np.array([self.swing_of(point, output) for point in self.branch.points])

    def swing_of(self, point: BranchPoint, output: str) -> float:
        """The same at one orbit."""
        return 0.5 * float(np.ptp(self.answers.output(point, output)))

    def output(self, point: BranchPoint, output: str) -> Array:
        """An output over the points of one period, shape (N,); SI."""
        return self.answers.output(point, output)

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
        """Problem and constants, as a :data:`~bayesoleo.solvers.branches.bordered.Family` has."""
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
