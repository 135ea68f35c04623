"""The estimators BE, MVE, MMVE and MBE, and the Levenberg-Marquardt step, by name.

An estimator decides how the prior enters the linear equations of a step. In scaled unknowns
(``w = 1``) every step solves ``min |J d - e|^2 + |P d - r|^2``, with whitened sensitivities ``J``
and residuals ``e``. The estimator chooses the rows ``P``, how these change from step to step, and
the right-hand side ``r``: the slope of the prior for BE, zero for the others.

Levenberg-Marquardt also adds a weight to ``J'J``. The weight follows the success of the last steps
instead of the prior, so that the method also converges where a prior is too wide to scale anything.
It is written as a trust region: the weight keeps the step within a given length.

References
----------
Verbeek (1993), eqs. 3.19-3.23, with Hendriks's MMVE.

Levenberg (1944); Marquardt (1963); Moré (1978), "The Levenberg-Marquardt algorithm: implementation
and theory", for the lengths, the secular equation and the update of the radius.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation._damping import GOOD, HALF, POOR, SHRINK, weight_within
from bayesoleo.estimation._least_squares import WhitenedEquations

# Accepted spellings of the names.
_SHORT = {"lm": "levenberg-marquardt", "gn": "gauss-newton"}


@dataclass(frozen=True)
class Step[State]:
    """Step of an estimator: the rows that it adds to the least-squares equations.

    The state is carried from one iteration to the next.

    Parameters
    ----------
    damped : bool
        Whether a step that halving does not help is damped, see ``_damping.py``. A search that
        compares many models wants their optima by few evaluations; the estimators as published only
        halve.
    """

    damped: bool = False

    #: name of the estimator
    name: ClassVar[str] = ""
    #: whether the prior keeps its declared centre, and so belongs to the merit function
    fixed_prior: ClassVar[bool] = False
    #: whether steps may shrink before the optimum is reached
    locks: ClassVar[bool] = False

    #: whether the prior's weight is the same in every iteration, so that many data sets can be
    #: fitted together
    steady: ClassVar[bool] = False
    #: whether the prior enters at all
    weighted: ClassVar[bool] = True

    #: whether it bounds the length of steps itself
    limits_length: ClassVar[bool] = False
    #: largest number of iterations
    most: ClassVar[int] = 100
    #: whether it takes the residual's second derivatives into account
    second_order: ClassVar[bool] = False

    @abstractmethod
    def begin(self, root: Array) -> State:
        """State before the first iteration, for the prior's precision ``root' root``, (l, l)."""

    def prepare(self, state: State, equations: WhitenedEquations) -> State:
        """State updated for the equations of this iteration."""
        return state

    @abstractmethod
    def rows(self, state: State, jacobian: Array) -> Array:
        """Rows ``P``, shape (l, l) or (0, l), for whitened sensitivities of shape (k, l)."""

    def accept(self, state: State, jacobian: Array, ratio: float, taken: Array) -> State:
        """State after a step with these sensitivities and this ratio of actual to expected gain."""
        return state

    def refuse(self, state: State, step: Array) -> State | None:
        """State for a shorter step, or None to halve the step instead."""
        return None


@dataclass(frozen=True)
class PriorStep(Step[Array]):
    """A step whose state is the rows that it adds, initially those of the prior."""

    def begin(self, root: Array) -> Array:
        return root

    def rows(self, state: Array, jacobian: Array) -> Array:
        return state


@dataclass(frozen=True)
class BayesianStep(PriorStep):
    """Bayesian estimator, BE: the prior stays at its centre (Verbeek 1993, eq. 3.19)."""

    name: ClassVar[str] = "be"
    steady: ClassVar[bool] = True
    fixed_prior: ClassVar[bool] = True


@dataclass(frozen=True)
class ModifiedBayesianStep(PriorStep):
    """Modified Bayesian estimator, MBE: the prior is re-centred on the current estimate.

    It acts as a trust region; the fixed point is the maximum-likelihood point whatever the prior's
    width (Verbeek 1993, eq. 3.23).
    """

    name: ClassVar[str] = "mbe"
    steady: ClassVar[bool] = True


@dataclass(frozen=True)
class MinimumVarianceStep(PriorStep):
    """Minimum-variance estimator, MVE: the weight grows by ``A`` in every iteration.

    ``V <- (A + V^-1)^-1`` from ``V = diag(w)`` shrinks like 1/i, and so do the steps: the estimator
    locks up (Verbeek 1993, eqs. 3.20-3.22).
    """

    name: ClassVar[str] = "mve"
    locks: ClassVar[bool] = True

    def accept(self, state: Array, jacobian: Array, ratio: float, taken: Array) -> Array:
        return np.linalg.qr(np.vstack((jacobian, state)), mode="r")


@dataclass(frozen=True)
class ModifiedMinimumVarianceStep(PriorStep):
    """Modified MVE: the prior variance is added again in every iteration, so nothing locks up.

    The state is ``V``, zero at the start, above ``diag(w)``; the weight is ``(V + diag(w))^-1``
    (Verbeek 1993, eq. 3.22, after Hendriks).
    """

    name: ClassVar[str] = "mmve"

    def begin(self, root: Array) -> Array:
        inverse = solve_triangular(root, np.eye(len(root)))
        return np.stack((np.zeros_like(root), inverse @ inverse.T))

    def rows(self, state: Array, jacobian: Array) -> Array:
        # S = L L' gives S^-1 = P'P with P = L^-1
        identity = np.eye(state.shape[1])
        return cast(
            Array, solve_triangular(cholesky(state[0] + state[1], lower=True), identity, lower=True)
        )

    def accept(self, state: Array, jacobian: Array, ratio: float, taken: Array) -> Array:
        triangle = np.linalg.qr(np.vstack((jacobian, self.rows(state, jacobian))), mode="r")
        root = solve_triangular(triangle, np.eye(state.shape[1]))
        return np.stack((root @ root.T, state[1]))


@dataclass(frozen=True)
class GaussNewtonStep(PriorStep):
    """Gauss-Newton with a pseudo-inverse: the prior does not enter at all."""

    name: ClassVar[str] = "gauss-newton"
    steady: ClassVar[bool] = True
    weighted: ClassVar[bool] = False

    def rows(self, state: Array, jacobian: Array) -> Array:
        return np.zeros((0, jacobian.shape[1]))


@dataclass(frozen=True)
class NewtonStep(PriorStep):
    """Newton's method on the objective with ``v`` eliminated (Verbeek 1993, Appendix A).

    It adds no rows; its equations differ, see
    :func:`bayesoleo.estimation._objectives.newton_equations`.
    """

    name: ClassVar[str] = "newton"
    fixed_prior: ClassVar[bool] = True
    second_order: ClassVar[bool] = True

    def rows(self, state: Array, jacobian: Array) -> Array:
        return np.zeros((0, jacobian.shape[1]))


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
        Factor on the lengths in the rows that keep the present step within the radius.
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
        # The staged variance shrinks by decades in the iteration; lengths must not follow it.
        jacobian = equations.noise * equations.jacobian
        length = np.maximum(state.length, np.linalg.norm(jacobian, axis=0))
        length = np.where(length > 0, length, 1.0)
        radius = state.radius
        if np.isnan(radius):  # the first step is at most as long as the start vector
            radius = float(np.linalg.norm(length * equations.place)) or 1.0
        free = ~equations.held
        weight = weight_within(
            (jacobian / length)[:, free], equations.noise * equations.residual, radius
        )
        return TrustRegion(radius, length, np.sqrt(weight) / equations.noise)

    def rows(self, state: TrustRegion, jacobian: Array) -> Array:
        if state.weight == 0:
            return np.zeros((0, state.length.size))
        return state.weight * np.diag(state.length)

    def accept(
        self, state: TrustRegion, jacobian: Array, ratio: float, taken: Array
    ) -> TrustRegion:
        size = float(np.linalg.norm(state.length * taken))
        if ratio < POOR:
            return replace(state, radius=HALF * size)
        if ratio >= GOOD or state.weight == 0:
            return replace(state, radius=max(state.radius, 2 * size))
        return state

    def refuse(self, state: TrustRegion, step: Array) -> TrustRegion:
        size = float(np.linalg.norm(state.length * step))
        return replace(state, radius=SHRINK * min(size, state.radius))


METHODS: dict[str, Step[Any]] = {
    step.name: step
    for step in (
        BayesianStep(),
        MinimumVarianceStep(),
        ModifiedMinimumVarianceStep(),
        ModifiedBayesianStep(),
        GaussNewtonStep(),
        LevenbergMarquardtStep(),
        NewtonStep(),
    )
}


def method(name: str | Step[Any]) -> Step[Any]:
    """Estimator of this name, or the step itself.

    Raises
    ------
    InputError
        If there is no estimator of that name.
    """
    if isinstance(name, Step):
        return name
    name = _SHORT.get(name, name)
    if name not in METHODS:
        raise InputError(
            "there is no such estimator",
            key="method",
            value=name,
            hint=f"use {', '.join(METHODS)}, or scipy: and one of SciPy's optimisers",
        )
    return METHODS[name]
