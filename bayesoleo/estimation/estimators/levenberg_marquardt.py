"""Levenberg-Marquardt as a trust region: the weight is what keeps a step within a known length.

Like MBE it adds a weight to ``A``, but the weight follows success instead of the prior, so that it
finds its way where a prior is far too wide to scale anything.

References
----------
Levenberg (1944); Marquardt (1963); Moré (1978), "The Levenberg-Marquardt algorithm: implementation
and theory", for the lengths, the secular equation and the update of the radius.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models.linearise import RANK
from bayesoleo.estimation.estimators.steps import Step
from bayesoleo.estimation.objectives.equations import WhitenedEquations

# A step may miss the radius by this part of it, which saves iterations of the secular equation.
_SLACK = 0.1
_MAX_SECULAR = 20
# A radius that fell below this moves nothing.
_SMALLEST = 1e-100
# Ratios of real to promised gain below which the radius shrinks, and from which it grows.
_POOR, _GOOD = 0.25, 0.75
# What a refused step leaves of the radius, and one that gained little.
_SHRINK, _HALF = 0.25, 0.5


@dataclass(frozen=True)
class TrustRegion:
    """State of the step.

    Parameters
    ----------
    radius : float
        Longest step, in units of ``length``; NaN before the first one.
    length : ndarray, shape (l,)
        Longest columns of the sensitivities so far.
    weight : float
        What multiplies the lengths in the rows that keep the present step within the radius.
    """

    radius: float
    length: Array
    weight: float = 0.0


@dataclass(frozen=True)
class LevenbergMarquardtStep(Step[TrustRegion]):
    """Levenberg-Marquardt with Moré's trust region."""

    name: ClassVar[str] = "levenberg-marquardt"
    weighted: ClassVar[bool] = False
    limits_length: ClassVar[bool] = True
    most: ClassVar[int] = 1000

    def begin(self, root: Array) -> TrustRegion:
        return TrustRegion(np.nan, np.zeros(len(root)))

    def prepare(self, state: TrustRegion, equations: WhitenedEquations) -> TrustRegion:
        # The staged variance shrinks by decades on the way; lengths must not change with it.
        jacobian = equations.noise * equations.jacobian
        length = np.maximum(state.length, np.linalg.norm(jacobian, axis=0))
        length = np.where(length > 0, length, 1.0)
        radius = state.radius
        if np.isnan(radius):  # the first step is at most as long as the start is large
            radius = float(np.linalg.norm(length * equations.place)) or 1.0
        free = ~equations.held
        weight = _weight((jacobian / length)[:, free], equations.noise * equations.residual, radius)
        return TrustRegion(radius, length, np.sqrt(weight) / equations.noise)

    def rows(self, state: TrustRegion, jacobian: Array) -> Array:
        if state.weight == 0:
            return np.zeros((0, state.length.size))
        return state.weight * np.diag(state.length)

    def accept(
        self, state: TrustRegion, jacobian: Array, ratio: float, taken: Array
    ) -> TrustRegion:
        size = float(np.linalg.norm(state.length * taken))
        if ratio < _POOR:
            return replace(state, radius=_HALF * size)
        if ratio >= _GOOD or state.weight == 0:
            return replace(state, radius=max(state.radius, 2 * size))
        return state

    def refuse(self, state: TrustRegion, step: Array) -> TrustRegion:
        size = float(np.linalg.norm(state.length * step))
        return replace(state, radius=_SHRINK * min(size, state.radius))


def _weight(jacobian: Array, residual: Array, radius: float) -> float:
    """Weight ``m`` for which ``|(J'J + m)^-1 J'e|`` is the radius; zero if none is needed."""
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
