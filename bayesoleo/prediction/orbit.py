"""A model's periodic answer to a planned motion, to a tolerance instead of on a given mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.model import Model
from bayesoleo.model.kernels import Kernels, kernels
from bayesoleo.model.switching import analytic_pieces
from bayesoleo.prediction.guess import guess_rows
from bayesoleo.prediction.inputs import input_rows
from bayesoleo.prediction.records import Record
from bayesoleo.prediction.simulate import RunPlan, record_of
from bayesoleo.solvers.adaptive.refine import AdaptiveSolution, Start, solve_adaptive
from bayesoleo.solvers.adaptive.stiffening import solve_stiffening
from bayesoleo.solvers.adaptive.switched import Motion, PeriodicProblem, Switches
from bayesoleo.solvers.orbit import Orbit


@dataclass(frozen=True, eq=False)
class PeriodicAnswer:
    """A periodic motion of a model and the outputs along it.

    Parameters
    ----------
    solution : AdaptiveSolution
        The motion on its mesh.
    kernels : Kernels
        Of the model.
    record : Record
        Its inputs.
    p : ndarray, shape (np,)
        Constants of the model.
    """

    solution: AdaptiveSolution
    kernels: Kernels
    record: Record
    p: Array

    @property
    def orbit(self) -> Orbit:
        """States at the nodes, status, estimated error, multipliers, cost."""
        return self.solution.orbit

    def dof(self, name: str, phase: Array, derivative: int = 0) -> Array:
        """A dof or its time derivative at phases in cycles, shape (N,); SI.

        Raises
        ------
        InputError
            If there is no such dof.
        """
        derived = self.kernels.derived
        if name not in derived.dofs:
            raise InputError("no such dof", key=name, hint=f"there are {', '.join(derived.dofs)}")
        k = derived.dofs.index(name)
        first = sum(order + 1 for order in derived.orders[:k])
        return cast(Array, self.solution.motion(phase)[first + derivative])

    def outputs(self, phase: Array) -> dict[str, Array]:
        """All outputs at phases in cycles, each of shape (N,); SI."""
        derived = self.kernels.derived
        y = np.empty((1, len(derived.outputs), phase.size))
        u = input_rows(self.record, derived.inputs, phase)
        z = self.solution.motion(phase)
        self.kernels.output(z[None], u, self.p[None], np.array([0]), y)
        return dict(zip(derived.outputs, y[0], strict=True))


def periodic_answer(
    model: Model,
    plan: RunPlan,
    values: Mapping[str, float] | None = None,
    *,
    tolerance: float = 1e-6,
    method: str = "radau3",
    stiffness: str | None = None,
    near: PeriodicAnswer | None = None,
    max_steps: int = 20_000,
    backend: str = "numpy",
) -> PeriodicAnswer:
    """Solve a model for the periodic answer to a planned motion, on a mesh of its own.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    plan : RunPlan
        Motion of the inputs and conditions.
    values : mapping of str to float, optional
        Parameters that are not at their nominal value.
    tolerance : float
        Estimated largest error of a state, over that state's largest size.
    method : {"radau2", "radau3", "gauss2", "gauss3"}
        Collocation method.
    stiffness : str, optional
        A parameter along which to walk up from a value small enough, where a direct solution fails:
        of a contact, or the slope of a friction.
    near : PeriodicAnswer, optional
        A similar motion of the same model, to start from.
    max_steps : int
        Of the last mesh.
    backend : {"numpy", "numba"}
        Kernels; NumPy's need no compilation.

    Returns
    -------
    PeriodicAnswer
        Look at ``orbit.status`` first: a failure is a value, not an exception.

    Raises
    ------
    InputError
        If a name is unknown, or an input or a condition is missing.
    """
    record, problem, compiled = adaptive_problem(model, plan, backend)
    derived = compiled.derived
    p = _constants(model, plan, values or {}, derived.constants)
    start: Motion | Start = _guess(model, compiled, record, p)
    if near is not None:
        start = near.solution.start()
    solve = partial(solve_adaptive, tolerance=tolerance, method=method, max_steps=max_steps)
    if stiffness is not None:
        if stiffness not in model.parameters:
            hint = f"parameters there are: {', '.join(model.parameters)}"
            raise InputError("no such parameter", key="stiffness", value=stiffness, hint=hint)
        index = derived.constants.index(stiffness)
        solve = partial(
            solve_stiffening,
            index=index,
            tolerance=tolerance,
            method=method,
            max_steps=max_steps,
        )
    return PeriodicAnswer(solve(problem, p, start), compiled, record, p)


def adaptive_problem(
    model: Model, plan: RunPlan, backend: str = "numpy"
) -> tuple[Record, PeriodicProblem, Kernels]:
    """A planned motion as the adaptive solver takes it, in analytic pieces."""
    for name in model.inputs:
        if name not in plan.inputs:
            hint = f"give inputs={{{name!r}: motion(…)}}"
            raise InputError(f"model {model.name!r} needs the input {name!r}", hint=hint)
    record = record_of(model, plan)
    compiled = kernels(model, model.estimated(), backend)
    pieces, switches = _in_pieces(model, compiled, backend)
    rows = pieces.derived.inputs

    def inputs_at(phase: Array) -> Array:
        table = np.zeros((len(rows), phase.size))
        known = [k for k, (name, _) in enumerate(rows) if name in record.harmonics]
        table[known] = input_rows(record, tuple(rows[k] for k in known), phase)
        return table

    problem = PeriodicProblem(
        equations=pieces,
        orders=compiled.derived.orders,
        period=1.0 / plan.frequency,
        inputs_at=inputs_at,
        conditions=len(compiled.derived.admissible),
        active=len(compiled.derived.active),
        switches=switches,
    )
    return record, problem, compiled


def _in_pieces(model: Model, compiled: Kernels, backend: str) -> tuple[Kernels, Switches | None]:
    """Kernels whose modes are inputs, and what decides on the modes."""
    pieces = analytic_pieces(model)
    if pieces.switches == 0:
        return compiled, None
    modes = [name for name in pieces.model.conditions if name not in model.conditions]
    moving = replace(
        pieces.model,
        conditions=model.conditions,
        inputs={**model.inputs, **dict.fromkeys(modes, "")},
    )
    chosen = kernels(moving, model.estimated(), backend)
    derived, lane = chosen.derived, np.array([0])
    if derived.orders != compiled.derived.orders:
        # An output asks for a higher derivative of a dof than the equations determine.
        return compiled, None

    def values(z: Array, u: Array, p: Array) -> Array:
        y = np.empty((1, len(derived.outputs), z.shape[1]))
        with np.errstate(all="ignore"):
            chosen.output(z[None], u, p[None], lane, y)
        return cast(Array, y[0])

    def slopes(z: Array, u: Array, p: Array) -> Array:
        count = len(derived.outputs)
        yz = np.empty((1, count, *z.shape))
        yp = np.empty((1, count, len(derived.active), z.shape[1]))
        with np.errstate(all="ignore"):
            chosen.output_jacobian(z[None], u, p[None], lane, yz, yp)
        return cast(Array, yz[0])

    return chosen, Switches(values, slopes, tuple(derived.inputs.index((m, 0)) for m in modes))


def _constants(
    model: Model, plan: RunPlan, values: Mapping[str, float], names: tuple[str, ...]
) -> Array:
    """Nominal parameters and conditions with those given put in, shape (np,)."""
    for name in values:
        if name not in model.parameters:
            hint = f"parameters there are: {', '.join(model.parameters)}"
            raise InputError("no such parameter", run=plan.label, key=name, hint=hint)
    known = {str(item): value for item, value in model.nominal().items()}
    known |= dict(plan.conditions) | dict(values)
    for name in names:
        if name not in known:
            hint = f"give conditions={{{name!r}: …}}"
            raise InputError(f"no condition {name!r}", run=plan.label, hint=hint)
    return np.array([known[name] for name in names])


def _guess(model: Model, compiled: Kernels, record: Record, p: Array) -> Motion:
    constants = dict(zip(compiled.derived.constants, p, strict=True))
    nothing = {name: h for name, h in record.harmonics.items() if name not in model.outputs}
    inputs = replace(record, harmonics=nothing)

    def motion(phase: Array) -> Array:
        return guess_rows(model, compiled.derived, inputs, constants, phase)

    return motion
