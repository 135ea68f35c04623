"""Least squares of one record under continuity, in the states of its nodes and the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.prediction.segmented import LinearRun, SegmentedRun
from bayesoleo.solvers.segments.constrained import ContinuousLeastSquares


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
        """Of the active parameters, ``(na, na)``, states eliminated."""
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
