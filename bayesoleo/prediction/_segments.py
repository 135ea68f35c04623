"""One record cut into shooting steps, with its least-squares equations.

The equations are in the states of the nodes and the parameters, under continuity. They are the
contribution of a model and a record to a fit by multiple shooting.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
import sympy as sp

from bayesoleo._types import Array
from bayesoleo.errors import CampaignError
from bayesoleo.model._expressions import parse, symbol
from bayesoleo.model._kernels import Kernels
from bayesoleo.model._model import Model
from bayesoleo.prediction._inputs import input_rows
from bayesoleo.prediction._records import FEWEST_SAMPLES, Record, Signal
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._multiple_shooting import ContinuousLeastSquares, LinearSteps, Segments
from bayesoleo.solvers._schemes import scheme

#: A smoother that follows the samples leaves next to nothing; noise is not taken for less than this
#: part of a channel's spread.
LEAST_NOISE = 1e-3

_LANE = np.zeros(1, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class LinearRun:
    """A record's predictions linearised in the states of its nodes and in the parameters.

    Parameters
    ----------
    steps : LinearSteps
    ends : ndarray, shape (n - 1, D, 1 + na + D)
        Changes of the state at the end of each step but the last.
    gap : ndarray, shape (n - 1, D)
        Jumps to the next node once each step solves its equations.
    y : ndarray, shape (ny, N)
        Predictions once each step solves its equations.
    yz : ndarray, shape (ny, nz, N)
        Partial derivatives of the outputs by values and derivatives of the dofs.
    columns : ndarray, shape (ny, na + D, N)
        Derivatives of the predictions by parameters and by the first state of each sample's step.
    """

    steps: LinearSteps
    ends: Array
    gap: Array
    y: Array
    yz: Array
    columns: Array


class SegmentedRun:
    """A model over one record, with the states at all nodes of a mesh as unknowns.

    Parameters
    ----------
    model : Model
    kernels : Kernels
        Of that model.
    record : Record
        With samples of at least one of the model's outputs.
    steps : int
        Of the mesh.
    scheme_name : str
        A collocation scheme.

    Raises
    ------
    CampaignError
        If the record lacks an input, a condition or all outputs, or has too few samples.
    """

    def __init__(
        self, model: Model, kernels: Kernels, record: Record, steps: int, scheme_name: str
    ):
        self.model, self.kernels, self.record = model, kernels, record
        derived = kernels.derived
        self.outputs = tuple(name for name in derived.outputs if name in record.samples)
        _check(model, record, self.outputs)
        method = scheme(scheme_name, derived.orders)
        if not isinstance(method, Collocation):
            raise CampaignError(
                "multiple shooting needs a one-step scheme",
                value=scheme_name,
                hint="use radau3, for instance",
            )
        self.time = record.time - record.time[0]
        duration = float(self.time[-1])
        self._rows = [derived.outputs.index(name) for name in self.outputs]
        self.segments = Segments(
            equations=kernels,
            scheme=method,
            duration=duration,
            steps=steps,
            inputs=input_rows(record, derived.inputs, self._phase(method.phases(steps))),
            conditions=len(derived.admissible),
            active=len(derived.active),
        )
        self.plan = self.segments.plan(self.time)
        self.sample_inputs = input_rows(record, derived.inputs, record.position)
        self.measured = np.stack([record.samples[name] for name in self.outputs])

    @property
    def state_size(self) -> int:
        """Number D of state components."""
        return self.segments.scheme.state_size

    def _phase(self, part: Array) -> Array:
        """The record's phase at parts of its duration; a periodic record may last many periods."""
        return part * float(self.record.position[-1])

    def noise(self) -> Array:
        """First guess of each output's standard deviation, shape (ny,)."""
        known = [self.record.signal_noise.get(name, 0.0) for name in self.outputs]
        least = LEAST_NOISE * np.std(self.measured, axis=1)
        # Of an output whose noise is unknown, not a number, the least stands.
        return np.maximum(np.fmax(known, least), np.finfo(float).tiny)

    def base_constants(self) -> Array:
        """Nominal parameters and this run's conditions, shape (np,)."""
        model, values = self.model, []
        for name in self.kernels.derived.constants:
            if name in model.parameters:
                values.append(model.parameters[name].value)
            else:
                default = model.conditions[name].default
                stated = np.nan if default is None else default
                values.append(self.record.conditions.get(name, stated))
        return np.array(values)

    def start(self, p: Array) -> Array:
        """Unknowns ``(n, w)`` along the smoothed samples of dofs that are measured, and at their
        declared guess for the others.
        """
        method, steps = self.segments.scheme, self.segments.steps
        times = (np.arange(steps) / steps, method.phases(steps))
        nodes, points = (self._guess(self._phase(part), p) for part in times)
        return cast(Array, method.from_motion(nodes[None], points[None])[0])

    def _guess(self, phase: Array, p: Array) -> Array:
        derived, rows = self.kernels.derived, []
        constants = dict(zip(derived.constants, p, strict=True))
        for dof, order in zip(derived.dofs, derived.orders, strict=True):
            measured = self._measured(dof, constants)
            if measured is not None:
                curve, offset = measured
                rows += [curve.evaluate(phase, self.record.rate, k) for k in range(order + 1)]
                rows[-order - 1] = rows[-order - 1] - offset
            else:
                rows.append(np.full(phase.size, _declared(self.model, dof, constants)))
                rows += [np.zeros(phase.size)] * order
        return np.stack(rows)

    def _measured(self, dof: str, constants: Mapping[str, float]) -> tuple[Signal, float] | None:
        """The curve behind the samples of a dof, if it is measured itself, and its offset."""
        for name in self.outputs:
            offset = self.model.output(name) - symbol(dof)
            value = offset.subs({symbol(key): item for key, item in constants.items()})
            if value.is_number and name in self.record.signals:
                return self.record.signals[name], float(value)
        return None

    def moved_to(self, other: SegmentedRun, x: Array) -> Array:
        """The motion ``x (n, w)`` as unknowns on another run's mesh of the same duration."""
        method, steps = other.segments.scheme, other.segments.steps
        times = (np.arange(steps) / steps, method.phases(steps))
        nodes, points = (
            self.segments.sample(x[..., None], self.segments.plan(phase * self.segments.duration))
            for phase in times
        )
        return cast(Array, method.from_motion(nodes[None, :, 0], points[None, :, 0])[0])

    # -- prediction ---------------------------------------------------------------------------

    def predict(self, x: Array, p: Array) -> Array:
        """Outputs ``(ny, N)`` at the samples."""
        return self._output(self.segments.sample(x[..., None], self.plan)[:, 0], p)

    def _output(self, z: Array, p: Array) -> Array:
        everything = np.full((1, len(self.kernels.derived.outputs), self.time.size), np.nan)
        rows = np.ascontiguousarray(z[None])
        with np.errstate(all="ignore"):
            self.kernels.output(rows, self.sample_inputs, p[None], _LANE, everything)
        return everything[0, self._rows]

    def linearise(self, x: Array, p: Array) -> LinearRun | None:
        """Linearise about unknowns ``x (n, w)``; None where the equations are not finite."""
        steps = self.segments.linearise(x, p)
        if not steps.regular:
            return None
        derived, D = self.kernels.derived, self.state_size
        every = np.concatenate([x[..., None], steps.columns], axis=2)
        z = self.segments.sample(every, self.plan)
        ny, na = len(derived.outputs), len(derived.active)
        yz, yp = np.zeros((1, ny, z.shape[0], z.shape[2])), np.zeros((1, ny, na, z.shape[2]))
        rows = np.ascontiguousarray(z[None, :, 0])
        with np.errstate(all="ignore"):
            self.kernels.output_jacobian(rows, self.sample_inputs, p[None], _LANE, yz, yp)
            changes = np.einsum("yzn,zkn->ykn", yz[0], z[:, 1:])
            changes[:, 1 : 1 + na] += yp[0]
            y = self._output(z[:, 0], p)
        ends = self.segments.ends(every)[:-1]
        gap = ends[..., 0] + ends[..., 1] - x[1:, :D]
        chosen = changes[self._rows]
        run = LinearRun(
            steps, ends[..., 1:], gap, y + chosen[:, 0], yz[0, self._rows], chosen[:, 1:]
        )
        return run if np.isfinite(run.y).all() and np.isfinite(run.columns).all() else None

    def corrected(self, x: Array, p: Array, linear: LinearRun) -> tuple[Array, Array] | None:
        """Gaps ``(n - 1, D)`` and predictions ``(ny, N)`` at other unknowns, each step solved by an
        old linearisation; None where these are not finite or not admissible.
        """
        change, ok = self.segments.correction(x, p, linear.steps)
        if not ok:
            return None
        z = self.segments.sample(np.stack([x, change], axis=2), self.plan)
        y = self._output(z[:, 0], p) + np.einsum("yzn,zn->yn", linear.yz, z[:, 1])
        ends = self.segments.ends(np.stack([x, change], axis=2))[:-1]
        gap = ends.sum(axis=2) - x[1:, : self.state_size]
        return (gap, y) if np.isfinite(y).all() and np.isfinite(gap).all() else None


def _check(model: Model, record: Record, outputs: tuple[str, ...]) -> None:
    if not model.dofs:
        raise CampaignError(f"model {model.name!r} has no dof, so nothing to shoot")
    if not outputs:
        raise CampaignError(
            f"no output of model {model.name!r} was measured",
            run=record.label,
            hint=f"outputs: {', '.join(model.outputs)}; channels: {', '.join(record.samples)}",
        )
    if record.time.size < FEWEST_SAMPLES:
        raise CampaignError(
            f"a transient needs {FEWEST_SAMPLES} samples", run=record.label, value=record.time.size
        )
    for name, condition in model.conditions.items():
        if name not in record.conditions and condition.default is None:
            raise CampaignError(f"model {model.name!r} needs condition {name!r}", run=record.label)


def _declared(model: Model, dof: str, constants: Mapping[str, float]) -> float:
    """A dof's declared guess; of inputs in it, zero."""
    known = {name: symbol(name) for name in (*model.parameters, *model.conditions, *model.inputs)}
    expression = parse(
        model.dofs[dof].guess, known, model.inputs, f"model {model.name!r}, guess of {dof!r}"
    )
    values: dict[sp.Symbol, float] = {symbol(name): value for name, value in constants.items()}
    free = expression.subs(values)
    return float(free.subs(dict.fromkeys(free.free_symbols, 0.0)))


@dataclass(frozen=True, eq=False)
class SegmentedNormalEquations:
    """Weighted least squares of one record under continuity, in states of a common scale.

    Parameters
    ----------
    system : ContinuousLeastSquares
    hessian : ndarray, shape (na, na)
        By the parameters, at fixed states.
    weights : ndarray, shape (ny,)
        One over the variances.
    scale : ndarray, shape (D,)
        Units of the states in ``system``.
    """

    run: SegmentedRun
    linear: LinearRun
    system: ContinuousLeastSquares
    hessian: Array
    weights: Array
    scale: Array

    @classmethod
    def of(
        cls, run: SegmentedRun, linear: LinearRun, weights: Array, scale: Array, slack: Array
    ) -> SegmentedNormalEquations:
        """Form and factorise; ``slack (n - 1, D)`` is the variance that each gap is allowed."""
        na, n = run.segments.active, run.segments.steps
        by_parameter = linear.columns[:, :na]
        by_state = linear.columns[:, na:] * scale[:, None]
        D, index = scale.size, run.plan.index
        hessian, coupling = np.zeros((n, D, D)), np.zeros((n, D, na))
        weighted = by_state * weights[:, None, None]
        np.add.at(hessian, index, np.einsum("ysn,ytn->nst", weighted, by_state))
        np.add.at(coupling, index, np.einsum("ysn,ytn->nst", weighted, by_parameter))
        transition = linear.ends[..., 1 + na :] * scale / scale[:, None]
        system = ContinuousLeastSquares.of(
            hessian,
            coupling,
            transition,
            linear.ends[..., 1 : 1 + na] / scale[:, None],
            slack / scale**2,
        )
        own = np.einsum("ysn,ytn,y->st", by_parameter, by_parameter, weights)
        return cls(run, linear, system, own, weights, scale)

    @property
    def information(self) -> Array:
        """Matrix of the active parameters, ``(na, na)``, states eliminated."""
        return self.system.information(self.hessian)

    def answer(self, gap: Array, y: Array) -> tuple[Array, Array]:
        """Descent direction by the parameters ``(na,)``, and changes of the states ``(n, D)`` at
        fixed parameters, for gaps and predictions of :class:`LinearRun`.
        """
        na, residual = self.run.segments.active, self.run.measured - y
        weighted = np.einsum("yn,y,ykn->kn", residual, self.weights, self.linear.columns)
        gradient = np.zeros((self.run.segments.steps, self.scale.size))
        np.add.at(gradient, self.run.plan.index, (weighted[na:] * self.scale[:, None]).T)
        states, multipliers = self.system.solve(gradient, gap / self.scale)
        return self.system.descent(weighted[:na].sum(axis=1), states, multipliers), states

    def states(self, at_fixed: Array, change: Array) -> Array:
        """Changes of the states ``(n, D)``, scaled, with a change of the parameters ``(na,)``."""
        return np.asarray(at_fixed + self.system.states @ change)

    def expand(self, states: Array, change: Array) -> Array:
        """Changes of all unknowns ``(n, w)`` from those of states (scaled) and parameters."""
        columns, na = self.linear.steps.columns, self.run.segments.active
        total = columns[..., 0] + columns[..., 1 : 1 + na] @ change
        return cast(
            Array, total + np.einsum("nwd,nd->nw", columns[..., 1 + na :], states * self.scale)
        )

    def initial_sd(self, covariance: Array) -> Array:
        """Standard deviations ``(D,)`` of the first state, given those of the parameters."""
        by_parameter = self.system.states[0]
        total = self.system.initial_covariance() + by_parameter @ covariance @ by_parameter.T
        return self.scale * np.sqrt(np.maximum(np.diag(total), 0.0))
