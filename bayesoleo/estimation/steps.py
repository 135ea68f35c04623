"""The estimators' steps: each says only how the prior enters the linear equations.

In scaled unknowns (``w = 1``) every step solves ``min |J d - e|^2 + |P d - r|^2``, with whitened
sensitivities ``J`` and residuals ``e``. An estimator is the choice of the rows ``P``, of how they
are carried on, and of whether the prior pulls: ``r`` is its slope for BE and zero for the others.

References
----------
Verbeek (1993), eqs. 3.19-3.23, with Hendriks's MMVE; Marquardt (1963), Moré (1978) and Nielsen
(1999, IMM-REP-1999-05) for the damping.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from bayesoleo.errors import InputError
from bayesoleo.estimation.problem import Array


@dataclass(frozen=True)
class Step:
    """What an estimator adds to the least-squares equations; the base adds the prior's weight.

    The state is whatever a step carries from one iteration to the next.
    """

    #: how a user asks for it
    name: ClassVar[str] = ""
    #: whether the prior stays where it was declared, and so belongs to the merit function
    fixed_prior: ClassVar[bool] = False
    #: whether steps may shrink before the optimum is reached
    locks: ClassVar[bool] = False

    #: whether the prior's weight is the same in every iteration, so that many data sets can be
    #: fitted together
    steady: ClassVar[bool] = False
    #: whether the prior enters at all
    weighted: ClassVar[bool] = True

    def begin(self, root: Array) -> Array:
        """State before the first iteration, for the prior's precision ``root' root``, (l, l)."""
        return root

    def rows(self, state: Array, jacobian: Array) -> Array:
        """Rows ``P``, shape (l, l), for whitened sensitivities of shape (k, l)."""
        return state

    def accept(self, state: Array, jacobian: Array, ratio: float) -> Array:
        """State after a step with these sensitivities, and its ratio of real to expected gain."""
        return state

    def refuse(self, state: Array) -> Array | None:
        """State with which to try a shorter step, or None to halve the step instead."""
        return None


@dataclass(frozen=True)
class BayesianStep(Step):
    """Bayesian estimator, BE: the prior stays at its centre (Verbeek 1993, eq. 3.19)."""

    name: ClassVar[str] = "be"
    steady: ClassVar[bool] = True
    fixed_prior: ClassVar[bool] = True


@dataclass(frozen=True)
class ModifiedBayesianStep(Step):
    """Modified Bayesian estimator, MBE: the prior is re-centred on the current estimate.

    It acts as a trust region; the fixed point is the maximum-likelihood point whatever the prior's
    width (Verbeek 1993, eq. 3.23).
    """

    name: ClassVar[str] = "mbe"
    steady: ClassVar[bool] = True


@dataclass(frozen=True)
class MinimumVarianceStep(Step):
    """Minimum-variance estimator, MVE: the weight grows by ``A`` in every iteration.

    ``V <- (A + V^-1)^-1`` from ``V = diag(w)`` shrinks like 1/i, and so do the steps: the estimator
    locks up (Verbeek 1993, eqs. 3.20-3.22).
    """

    name: ClassVar[str] = "mve"
    locks: ClassVar[bool] = True

    def accept(self, state: Array, jacobian: Array, ratio: float) -> Array:
        return np.linalg.qr(np.vstack((jacobian, state)), mode="r")


@dataclass(frozen=True)
class ModifiedMinimumVarianceStep(Step):
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
        return solve_triangular(cholesky(state[0] + state[1], lower=True), identity, lower=True)

    def accept(self, state: Array, jacobian: Array, ratio: float) -> Array:
        triangle = np.linalg.qr(np.vstack((jacobian, self.rows(state, jacobian))), mode="r")
        root = solve_triangular(triangle, np.eye(state.shape[1]))
        return np.stack((root @ root.T, state[1]))


@dataclass(frozen=True)
class GaussNewtonStep(Step):
    """Gauss-Newton with a pseudo-inverse: the prior does not enter at all."""

    name: ClassVar[str] = "gauss-newton"
    steady: ClassVar[bool] = True
    weighted: ClassVar[bool] = False

    def rows(self, state: Array, jacobian: Array) -> Array:
        return np.zeros((0, jacobian.shape[1]))


@dataclass(frozen=True)
class LevenbergMarquardtStep(Step):
    """Levenberg-Marquardt: like MBE, but the weight follows success instead of the prior.

    The state is the damping, the factor by which it grows when a step fails, and the longest
    columns of the sensitivities so far, shape (2 + l,).
    """

    name: ClassVar[str] = "levenberg-marquardt"
    smallest: ClassVar[float] = 1e-14

    def begin(self, root: Array) -> Array:
        return np.concatenate(([1e-3, 2.0], np.zeros(len(root))))

    def rows(self, state: Array, jacobian: Array) -> Array:
        return np.sqrt(state[0]) * np.diag(self._length(state, jacobian))

    def accept(self, state: Array, jacobian: Array, ratio: float) -> Array:
        # a step as good as promised divides the damping by three, a useless one doubles it
        factor = max(1 / 3, 1 - (2 * min(max(ratio, 0.0), 1.0) - 1) ** 3)
        damping = max(state[0] * factor, self.smallest)
        return np.concatenate(([damping, 2.0], self._length(state, jacobian)))

    def refuse(self, state: Array) -> Array | None:
        return np.concatenate(([state[0] * state[1], 2 * state[1]], state[2:]))

    @staticmethod
    def _length(state: Array, jacobian: Array) -> Array:
        return np.maximum(state[2:], np.linalg.norm(jacobian, axis=0))


METHODS: dict[str, Step] = {
    step.name: step
    for step in (
        BayesianStep(),
        MinimumVarianceStep(),
        ModifiedMinimumVarianceStep(),
        ModifiedBayesianStep(),
        GaussNewtonStep(),
        LevenbergMarquardtStep(),
    )
}


def method(name: str | Step) -> Step:
    """Estimator of this name, or the step itself.

    Raises
    ------
    InputError
        If there is no estimator of that name.
    """
    if isinstance(name, Step):
        return name
    if name not in METHODS:
        raise InputError(
            "there is no such estimator", key="method", value=name, hint=f"use {', '.join(METHODS)}"
        )
    return METHODS[name]
