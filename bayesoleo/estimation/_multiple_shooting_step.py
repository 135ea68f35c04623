"""One step of a multiple-shooting estimate: its problem and the linearisation.

The problem holds a model over transient records: runs, unknowns and variances. At each point the
states of every record are eliminated from its normal equations; the sum over records gives the
equations of the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.estimation._least_squares import PriorScale, bounded_step
from bayesoleo.estimation._problem import measured_of
from bayesoleo.model._kernels import kernels
from bayesoleo.model._model import Model
from bayesoleo.model._priors import Prior
from bayesoleo.prediction._predictor import Layout
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._segments import LinearRun, SegmentedNormalEquations, SegmentedRun

#: What the prior does: it is centred anew on every iterate and thus only limits the steps; it stays
#: where it is and pulls; nothing.
PRIORS = ("mbe", "be", "gauss-newton")


@dataclass(frozen=True, eq=False)
class ShootingProblem:
    """A model over transient records, each with a mesh of its own.

    Parameters
    ----------
    runs : tuple of SegmentedRun
    layout : Layout
        Of the unknowns over the runs.
    priors : tuple of Prior
    outputs : tuple of str
        Those that any record has.
    steps_per_interval : tuple of int
        How many steps of each run's mesh lie between shooting nodes.
    """

    runs: tuple[SegmentedRun, ...]
    layout: Layout
    priors: tuple[Prior, ...]
    outputs: tuple[str, ...]
    steps_per_interval: tuple[int, ...]

    @classmethod
    def of(
        cls,
        model: Model,
        records: Sequence[Record],
        steps: Sequence[int],
        interval: float,
        scheme: str,
        backend: str,
    ) -> ShootingProblem:
        """Cut records into steps, and these into intervals of at least a length in seconds."""
        layout = Layout.of(model, [record.label for record in records])
        compiled = kernels(model, model.estimated(), backend)
        runs = tuple(
            SegmentedRun(model, compiled, record, n, scheme)
            for record, n in zip(records, steps, strict=True)
        )
        measured = {name for run in runs for name in run.outputs}
        lengths = [interval / run.segments.length for run in runs]
        return cls(
            runs,
            layout,
            layout.priors(model),
            tuple(name for name in compiled.derived.outputs if name in measured),
            tuple(
                int(np.clip(np.ceil(length - 1e-9), 1, n))
                for length, n in zip(lengths, steps, strict=True)
            ),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns."""
        return self.layout.names

    @property
    def nuisances(self) -> frozenset[str]:
        """Unknowns whose prior is a measurement."""
        parameters = self.runs[0].model.parameters
        owners = zip(self.layout.names, self.layout.parameters, strict=True)
        return frozenset(name for name, owner in owners if parameters[owner].measured)

    @property
    def counts(self) -> Integers:
        """Number of samples of each output, shape (s,)."""
        return np.array(
            [
                sum(run.time.size for run in self.runs if name in run.outputs)
                for name in self.outputs
            ]
        )

    @property
    def unknowns(self) -> int:
        """Number of parameters and initial states."""
        return len(self.names) + sum(run.state_size for run in self.runs)

    def constants(self, theta: Array, r: int) -> Array:
        """Constants of a run, shape (np,)."""
        run = self.runs[r]
        p = run.base_constants()
        places = [run.kernels.derived.constants.index(name) for name in self.layout.active[r]]
        p[places] = theta[self.layout.columns[r]]
        return p

    def places(self, run: SegmentedRun) -> list[int]:
        """Which outputs a run has."""
        return [self.outputs.index(name) for name in run.outputs]

    def between_intervals(self, r: int) -> Flags:
        """Which of a run's inner nodes are shooting nodes, shape (n - 1,)."""
        return cast(
            Flags,
            np.arange(1, self.runs[r].segments.steps) % self.steps_per_interval[r] == 0,
        )

    def sums(self, theta: Array, x: Sequence[Array]) -> Array:
        """Sums of squared residuals of each output, shape (s,)."""
        total = np.zeros(len(self.outputs))
        for r, run in enumerate(self.runs):
            residual = run.measured - run.predict(x[r], self.constants(theta, r))
            total[self.places(run)] += np.sum(residual**2, axis=1)
        return total

    def staged(self, sums: Array) -> Array:
        """Variances, shape (s,), with the unknowns' share of the samples taken off (Verbeek 1993,
        eq. 3.18, the initial states counted).
        """
        degrees = self.counts - self.unknowns / len(self.outputs)
        return np.asarray(np.maximum(sums, np.finfo(float).tiny) / np.maximum(degrees, 1.0))

    def first_variance(self) -> Array:
        """Variances, shape (s,), that the records suggest before any fit."""
        found: dict[str, list[float]] = {name: [] for name in self.outputs}
        for run in self.runs:
            for name, sd in zip(run.outputs, run.noise(), strict=True):
                found[name].append(sd**2)
        return np.array([np.mean(found[name]) for name in self.outputs])


@dataclass(frozen=True, eq=False)
class Change:
    """A change of all unknowns: scaled parameters ``(l,)``, and states ``(n, D)`` of each run."""

    scaled: Array
    states: tuple[Array, ...]

    def size(self, spread: Array) -> float:
        """Root of the mean square of states over their spread and of scaled parameters."""
        states = np.concatenate(self.states) / spread
        own = float(np.mean(self.scaled**2)) if self.scaled.size else 0.0
        return float(np.sqrt(np.mean(states**2) + own))

    def minus(self, other: Change, part: float) -> Change:
        """This change less a part of another."""
        pairs = zip(self.states, other.states, strict=True)
        return Change(self.scaled - part * other.scaled, tuple(a - part * b for a, b in pairs))


@dataclass(frozen=True, eq=False)
class Local:
    """Everything that the linearisation at one point says.

    Parameters
    ----------
    problem : ShootingProblem
    scale : PriorScale
    theta, variance : ndarray, shapes (l,) and (s,)
    normal : tuple of SegmentedNormalEquations
        Of each run.
    jacobian : ndarray, shape (l, l)
        Whitened rows of the condensed least squares in scaled parameters.
    prior : str
        What the prior does, of :data:`PRIORS`.
    """

    problem: ShootingProblem
    scale: PriorScale
    theta: Array
    variance: Array
    normal: tuple[SegmentedNormalEquations, ...]
    jacobian: Array
    prior: str

    @classmethod
    def of(
        cls,
        problem: ShootingProblem,
        scale: PriorScale,
        prior: str,
        theta: Array,
        linear: Sequence[LinearRun],
        variance: Array,
        units: Array,
        slack: Array,
    ) -> Local | None:
        """Form and factorise all equations; None where they are singular.

        ``units (D,)`` are those of the states inside, ``slack (D,)`` the variances that gaps
        between intervals are allowed.
        """
        normal = tuple(
            SegmentedNormalEquations.of(
                run,
                item,
                1.0 / variance[problem.places(run)],
                units,
                np.where(problem.between_intervals(r)[:, None], slack, 0.0),
            )
            for r, (run, item) in enumerate(zip(problem.runs, linear, strict=True))
        )
        if not all(item.system.regular for item in normal):
            return None
        unit = scale.unit(theta)
        information = np.zeros((theta.size, theta.size))
        for columns, item in zip(problem.layout.columns, normal, strict=True):
            information[np.ix_(columns, columns)] += item.information
        information *= np.outer(unit, unit)
        if not np.isfinite(information).all():
            return None
        return cls(problem, scale, theta, variance, normal, _root(information), prior)

    @property
    def weight(self) -> Array:
        """The prior's rows in the step, shape (l, l) or fewer rows."""
        if self.prior != "gauss-newton":
            return self.scale.root
        return self.scale.root[measured_of(self.problem)]

    @property
    def pulled(self) -> Flags:
        """Unknowns that the prior pulls: all for the Bayesian estimator, for the others those whose
        prior is a measurement, shape (l,)."""
        return measured_of(self.problem) | (self.prior == "be")

    @property
    def unit(self) -> Array:
        """Derivatives of the parameters by the scaled ones, shape (l,)."""
        return self.scale.unit(self.theta)

    def change(
        self, answers: Sequence[tuple[Array, Array]], slope: Array, room: tuple[Array, Array]
    ) -> Change:
        """The linearised problem's answer to gaps and predictions ``(gap, y)`` of every run."""
        descent, fixed = np.zeros(self.theta.size), []
        for columns, item, (gap, y) in zip(
            self.problem.layout.columns, self.normal, answers, strict=True
        ):
            by_parameter, states = item.answer(gap, y)
            descent[columns] += by_parameter
            fixed.append(states)
        residual = np.linalg.lstsq(self.jacobian.T, self.unit * descent, rcond=None)[0]
        pull = np.linalg.lstsq(self.weight.T, slope, rcond=None)[0]
        scaled = bounded_step(
            np.vstack((self.jacobian, self.weight)), np.concatenate((residual, pull)), room
        )
        moved = [
            item.states(at_fixed, (self.unit * scaled)[columns]) * item.scale
            for columns, item, at_fixed in zip(
                self.problem.layout.columns, self.normal, fixed, strict=True
            )
        ]
        return Change(scaled, tuple(moved))

    def step(self) -> Change:
        """From the present point to the linearised solution."""
        slope = np.where(self.pulled, self.scale.slope(self.theta), 0.0)
        answers = [(item.linear.gap, item.linear.y) for item in self.normal]
        return self.change(answers, slope, self.scale.room(self.theta))

    def onward(self, theta: Array, x: Sequence[Array], taken: Array) -> Change | None:
        """From another point to the solution by this linearisation, ``taken (l,)`` the step that
        led there; None where the equations are not finite or not admissible.
        """
        answers = []
        for r, item in enumerate(self.normal):
            answer = item.run.corrected(x[r], self.problem.constants(theta, r), item.linear)
            if answer is None:
                return None
            answers.append(answer)
        # A prior that only scales the steps is centred where this one began.
        slope = -self.weight.T @ (self.weight @ taken)
        slope = np.where(self.pulled, self.scale.slope(theta), slope)
        anywhere = np.full(taken.size, np.inf)
        return self.change(answers, slope, (anywhere, anywhere))

    def moved(self, x: Sequence[Array], change: Change, part: float) -> tuple[Array, ...]:
        """Unknowns of all steps after a part of a change."""
        moved = []
        for r, item in enumerate(self.normal):
            parameters = (self.unit * change.scaled)[self.problem.layout.columns[r]]
            moved.append(x[r] + part * item.expand(change.states[r] / item.scale, parameters))
        return tuple(moved)


def _root(information: Array) -> Array:
    """Rows ``J`` with ``J'J`` a symmetric matrix; what round-off made negative is zero."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
