"""The estimators' steps: each says only how the prior enters the linear equations.

In scaled unknowns (``w = 1``) every step solves ``min |J d - e|^2 + |P d - r|^2``, with whitened
sensitivities ``J`` and residuals ``e``. An estimator is the choice of the rows ``P``, of how they
are carried on, and of whether the prior pulls: ``r`` is its slope for BE and zero for the others.

References
----------
Verbeek (1993), eqs. 3.19-3.23, with Hendriks's MMVE.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from bayesoleo._types import Array
from bayesoleo.estimation.objectives.equations import WhitenedEquations


@dataclass(frozen=True)
class Step[State]:
    """What an estimator adds to the least-squares equations.

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

    #: whether it keeps steps within a length of its own
    limits_length: ClassVar[bool] = False
    #: iterations after which it is given up
    most: ClassVar[int] = 100
    #: whether it takes the residual's second derivatives into account
    second_order: ClassVar[bool] = False

    @abstractmethod
    def begin(self, root: Array) -> State:
        """State before the first iteration, for the prior's precision ``root' root``, (l, l)."""

    def prepare(self, state: State, equations: WhitenedEquations) -> State:
        """State with what the equations of this iteration ask for."""
        return state

    @abstractmethod
    def rows(self, state: State, jacobian: Array) -> Array:
        """Rows ``P``, shape (l, l) or (0, l), for whitened sensitivities of shape (k, l)."""

    def accept(self, state: State, jacobian: Array, ratio: float, taken: Array) -> State:
        """State after a step with these sensitivities, and its ratio of real to expected gain."""
        return state

    def refuse(self, state: State, step: Array) -> State | None:
        """State with which to try a shorter step, or None to halve the step instead."""
        return None


@dataclass(frozen=True)
class PriorStep(Step[Array]):
    """A step whose state is the rows that it adds: at first the prior's."""

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

    All that it adds is in its equations: see
    :func:`bayesoleo.estimation.estimators.newton.newton_equations`.
    """

    name: ClassVar[str] = "newton"
    fixed_prior: ClassVar[bool] = True
    second_order: ClassVar[bool] = True

    def rows(self, state: Array, jacobian: Array) -> Array:
        return np.zeros((0, jacobian.shape[1]))
