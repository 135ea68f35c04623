"""The linear equations of one iteration, with the variances held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from bayesoleo._types import Array, Float
from bayesoleo.error_models.linearise import RANK, inverse_gram
from bayesoleo.estimation.objectives.bounded import bounded_step, on_limit


@dataclass(frozen=True)
class WhitenedEquations:
    """Whitened least squares in scaled unknowns (the prior's standard deviation is one).

    Of an unknown with a log-normal prior it is the logarithm that is scaled.

    Parameters
    ----------
    jacobian : ndarray, shape (k, l)
        Rows ``J`` with ``A = J'J``.
    residual : ndarray, shape (k,)
        Rows ``e`` with ``b = -J'e``.
    slope : ndarray, shape (l,)
        Derivative of the log prior where the prior is fixed at its centre, zero otherwise.
    room : tuple of ndarray, each shape (l,)
        Distances to the limits of the support, or to how far a logarithm may go in one step.
    root : ndarray, shape (l, l) or (0, l)
        Rows ``P`` with ``P'P`` the prior's precision; upper triangular. Newton's method has none:
        its matrix contains the prior.
    place : ndarray, shape (l,)
        Scaled unknowns where this is, by which a first step is judged.
    noise : float
        Standard deviation by which rows were whitened, the outputs' geometric mean.
    """

    jacobian: Float[Array, "rows unknowns"]
    residual: Float[Array, " rows"]
    slope: Float[Array, " unknowns"]
    room: tuple[Float[Array, " unknowns"], Float[Array, " unknowns"]]
    root: Float[Array, "_rows unknowns"]
    place: Float[Array, " unknowns"]
    noise: float = 1.0

    @property
    def gradient(self) -> Array:
        """Slope of the merit function, shape (l,)."""
        return self.jacobian.T @ self.residual + self.slope

    @property
    def held(self) -> NDArray[np.bool_]:
        """Which unknowns lie on a limit and would leave, shape (l,)."""
        down, up = self.room
        return on_limit(
            (np.where(self.gradient < 0, down, np.inf), np.where(self.gradient > 0, up, np.inf))
        )

    def solve(self, rows: Array) -> Array:
        """Step, shape (l,), with the weight ``rows' rows`` added to ``A``."""
        # only the fixed prior pulls, and it does so along its own rows: P'r is its slope
        pulls = len(rows) == len(self.slope) and self.slope.any()
        pull = solve_triangular(rows, self.slope, trans="T") if pulls else np.zeros(len(rows))
        target = np.concatenate((self.residual, pull))
        # without a weight, what the data leave open must not follow the derivatives' rounding
        rank = None if len(rows) else RANK
        return bounded_step(np.vstack((self.jacobian, rows)), target, self.room, rank)

    def expected_gain(self, step: Array) -> float:
        """Rise of the merit function that the linearisation promises for a step, shape (l,)."""
        change = self.jacobian @ step
        return float(step @ self.gradient - 0.5 * (change @ change))

    def distance(self) -> float:
        """Newton decrement: the way to the fixed point in linearised standard deviations."""
        step = self.solve(self.root)
        return float(np.sqrt(max(0.0, float(step @ self.gradient))))

    def sd(self) -> Array:
        """LinearisedResidual standard deviations ``[A + P'P]^-1/2``, shape (l,)."""
        weighted = np.vstack((self.jacobian, self.root))
        return np.sqrt(np.diag(inverse_gram(weighted)))
