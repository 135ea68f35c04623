"""Damping of an estimator's steps where halving them does not help.

A step of BE or MBE is as long as the prior's width allows. In a curved valley its direction is good
for a tiny part of that length only, and halving keeps the direction: amplitude and exponent of a
law that make up for each other, or the phase of a free motion after many swings. A weight on the
unknowns turns the step towards the steepest ascent while it shortens it. The weight has no
right-hand side, so that no fixed point moves, and it is zero where halving suffices.

References
----------
Levenberg (1944); Marquardt (1963); Moré (1978), "The Levenberg-Marquardt algorithm: implementation
and theory", for the lengths, the secular equation and the update of the radius.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models._fitting import RANK
from bayesoleo.estimation._least_squares import WhitenedEquations

# Relative tolerance on the radius, which saves iterations of the secular equation.
_SLACK = 0.1
_MAX_SECULAR = 20
# Least radius: a shorter step changes nothing.
_SMALLEST = 1e-100
#: Ratios of actual to predicted gain below which the radius shrinks, and from which it grows.
POOR, GOOD = 0.25, 0.75
#: Factors on the radius after a refused step, and after one with little gain.
SHRINK, HALF = 0.25, 0.5


@dataclass(frozen=True)
class Damping:
    """Longest step of an iteration.

    Parameters
    ----------
    length : ndarray, shape (l,)
        Units of the unknowns: the longest columns of the equations so far.
    radius : float
        Longest step in these units; infinite while none was refused.
    """

    length: Array
    radius: float = np.inf

    def at(self, equations: WhitenedEquations, rows: Array) -> Damping:
        """The same with the lengths of new equations and the prior's rows ``(l, l)``."""
        # The staged variance shrinks by decades in the iteration; lengths must not follow it.
        columns = np.linalg.norm(np.vstack((equations.jacobian, rows)), axis=0)
        return replace(self, length=np.maximum(self.length, equations.noise * columns))

    def shortened(self, step: Array, equations: WhitenedEquations, rows: Array) -> Array:
        """A step, or the damped one where it is longer than the radius."""
        if self._size(step) <= self.radius:
            return step
        unit = np.where(self.length > 0, self.length, 1.0) / equations.noise
        free = ~equations.held
        target = np.concatenate((equations.residual, equations.pull(rows)))
        scaled = np.vstack((equations.jacobian, rows)) / unit
        triangle = np.linalg.qr(np.column_stack((scaled[:, free], target)), mode="r")
        # Lengths are in units of the noise, as is what is whitened.
        weight = weight_within(triangle[:, :-1], triangle[:, -1], self.radius / equations.noise)
        return equations.solve(rows, np.sqrt(weight) * np.diag(unit))

    def refused(self, step: Array) -> Damping:
        """After a step that did not help."""
        return replace(self, radius=SHRINK * min(self._size(step), self.radius))

    def accepted(self, step: Array, ratio: float) -> Damping:
        """After a step with this ratio of actual to expected gain."""
        if not np.isfinite(self.radius):
            return self
        size = self._size(step)
        if ratio < POOR:
            return replace(self, radius=HALF * size)
        return replace(self, radius=max(self.radius, 2 * size)) if ratio >= GOOD else self

    def _size(self, step: Array) -> float:
        return float(np.linalg.norm(self.length * step))


def weight_within(jacobian: Array, residual: Array, radius: float) -> float:
    """Weight ``m`` for which ``|(J'J + m)^-1 J'e|`` is the radius; zero if none is needed.

    Parameters
    ----------
    jacobian : ndarray, shape (k, l)
    residual : ndarray, shape (k,)
    radius : float
    """
    if jacobian.shape[1] == 0:
        return 0.0
    left, singular, _ = np.linalg.svd(jacobian, full_matrices=False)
    turned = singular * (left.T @ residual)
    squares = singular**2
    kept = singular > RANK * singular[0]

    def length(weight: float) -> tuple[float, float]:
        """Length of the step and its derivative with respect to the weight."""
        parts = turned[kept] / (squares[kept] + weight)
        size = float(np.linalg.norm(parts))
        slope = -float(np.sum(parts**2 / (squares[kept] + weight)))
        return size, slope / size if size > 0 else 0.0

    size, slope = length(0.0)
    if size <= (1 + _SLACK) * radius:
        return 0.0
    radius = max(radius, _SMALLEST)
    low, high = (size - radius) / -slope, float(np.linalg.norm(turned)) / radius
    weight = max(low, 1e-3 * high)
    for _ in range(_MAX_SECULAR):
        size, slope = length(weight)
        if abs(size - radius) <= _SLACK * radius:
            break
        low, high = (weight, high) if size > radius else (low, weight)
        # Newton's method on 1/size, which is nearly linear in the weight
        weight = weight - (size - radius) / radius * size / slope
        if not low <= weight <= high:
            weight = max(1e-3 * high, float(np.sqrt(low * high)))
    return weight
