"""What the linearisation at one point says about parameters and states: the way to the solution.

The normal equations of every record, its states eliminated, add up to those of the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.estimation.objectives.bounded import bounded_step
from bayesoleo.estimation.problems.problem import measured_of
from bayesoleo.estimation.problems.scaling import PriorScale
from bayesoleo.estimation.trajectories.problem import ShootingProblem
from bayesoleo.prediction.normal_equations import SegmentedNormalEquations
from bayesoleo.prediction.segmented import LinearRun

#: What the prior does: it is centred anew on every iterate and thus only limits the steps; it stays
#: where it is and pulls; nothing.
PRIORS = ("mbe", "be", "gauss-newton")


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
    def pulled(self) -> NDArray[np.bool_]:
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
