"""Least squares over the states of a trajectory, under the constraint that it is continuous.

The states ``s_m`` at the nodes and the parameters ``theta`` minimise a quadratic form under
``s_{m+1} = F_m s_m + C_m theta + d_m``. States and Lagrange multipliers in the order of time make
the optimality conditions a band of half width ``2 D - 1`` with a border as wide as the parameters;
one factorisation of the band, of a cost that grows with the number of nodes, leaves the small
information matrix of the parameters alone. Nothing is multiplied along the trajectory, so that the
exponential growth of disturbances in a chaotic system does no harm: the condensing recursion of
the literature, which forms the products ``F_m ... F_1``, has no digits left after some thirty
Lyapunov times (``exp(36) = 1e16``).

References
----------
Bock, H. G. (1987). Randwertproblemmethoden zur Parameteridentifizierung in Systemen nichtlinearer
Differentialgleichungen. Bonner Mathematische Schriften 183.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs

from bayesoleo._types import Array

_gbtrf, _gbtrs = get_lapack_funcs(("gbtrf", "gbtrs"), (np.zeros(1),))


@dataclass(frozen=True)
class ContinuousLeastSquares:
    """The factorised conditions of one trajectory.

    Parameters
    ----------
    band, pivots : ndarray
        LAPACK's factors of the band matrix.
    coupling : ndarray, shape (n, D, l)
        Second derivatives of the quadratic form by states and parameters.
    by_parameter : ndarray, shape (n - 1, D, l)
        ``C_m``.
    states, multipliers : ndarray, shapes (n, D, l) and (n - 1, D, l)
        Derivatives of the solution by the parameters.
    regular : bool
        Whether the data determine the states at given parameters.
    """

    band: Array
    pivots: NDArray[np.int32]
    coupling: Array
    by_parameter: Array
    states: Array
    multipliers: Array
    regular: bool

    @classmethod
    def of(
        cls,
        hessian: Array,
        coupling: Array,
        transition: Array,
        by_parameter: Array,
        slack: Array,
    ) -> ContinuousLeastSquares:
        """Factorise.

        Parameters
        ----------
        hessian : ndarray, shape (n, D, D)
            Second derivatives of the quadratic form by the state of each node.
        coupling : ndarray, shape (n, D, l)
        transition : ndarray, shape (n - 1, D, D)
            ``F_m``.
        by_parameter : ndarray, shape (n - 1, D, l)
        slack : ndarray, shape (n - 1, D)
            Variance that each gap is allowed: a gap costs half its square over that; zero for
            continuity.
        """
        band, pivots, info = _gbtrf(_band(hessian, transition, slack), *_widths(hessian.shape[1]))
        empty = np.zeros((0, 0))
        plain = cls(band, pivots, coupling, by_parameter, empty, empty, info == 0)
        states, multipliers = plain._substitute(-coupling, by_parameter)
        finite = bool(np.isfinite(states).all() and np.isfinite(multipliers).all())
        return cls(
            band, pivots, coupling, by_parameter, states, multipliers, plain.regular and finite
        )

    def solve(self, gradient: Array, gap: Array) -> tuple[Array, Array]:
        """States ``(n, D)`` and multipliers ``(n - 1, D)`` at parameters that stay as they are.

        Parameters
        ----------
        gradient : ndarray, shape (n, D)
            Descent direction of the quadratic form at zero.
        gap : ndarray, shape (n - 1, D)
            ``d_m``.
        """
        states, multipliers = self._substitute(gradient[..., None], gap[..., None])
        return states[..., 0], multipliers[..., 0]

    def information(self, hessian: Array) -> Array:
        """Information matrix of the parameters, ``(l, l)``, states eliminated.

        ``hessian (l, l)`` holds the second derivatives by the parameters.
        """
        total = hessian + np.einsum("nab,nac->bc", self.coupling, self.states)
        total -= np.einsum("nab,nac->bc", self.by_parameter, self.multipliers)
        return cast(Array, 0.5 * (total + total.T))

    def descent(self, gradient: Array, states: Array, multipliers: Array) -> Array:
        """Descent direction by the parameters, ``(l,)``, states eliminated.

        ``gradient (l,)`` is that at fixed states; the others are the answer of :meth:`solve`.
        """
        total = gradient - np.einsum("nab,na->b", self.coupling, states)
        return np.asarray(total + np.einsum("nab,na->b", self.by_parameter, multipliers))

    def initial_covariance(self) -> Array:
        """Covariance ``(D, D)`` of the first state at given parameters."""
        n, D, _ = self.states.shape
        units = np.zeros((n, D, D))
        units[0] = np.eye(D)
        return cast(Array, self._substitute(units, np.zeros((n - 1, D, D)))[0][0])

    def _substitute(self, gradient: Array, gap: Array) -> tuple[Array, Array]:
        n, D, columns = gradient.shape
        first, second = _places(n, D)
        right = np.zeros((D * (2 * n - 1), columns))
        right[first], right[second] = gradient, gap
        if not self.regular:
            right[:] = np.nan
            return right[first], right[second]
        answer, _ = _gbtrs(self.band, *_widths(D), right, self.pivots)
        return answer[first], answer[second]


def _widths(D: int) -> tuple[int, int]:
    return 2 * D - 1, 2 * D - 1


def _places(n: int, D: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the states (n, D) and of the multipliers (n - 1, D)."""
    first = 2 * D * np.arange(n)[:, None] + np.arange(D)
    return first, first[:-1] + D


def _band(hessian: Array, transition: Array, slack: Array) -> Array:
    """The symmetric, indefinite matrix in LAPACK's band storage."""
    n, D, _ = hessian.shape
    width = 2 * D - 1
    band = np.zeros((3 * width + 1, D * (2 * n - 1)))
    states, multipliers = _places(n, D)

    def put(rows: NDArray[np.int64], columns: NDArray[np.int64], values: Array | float) -> None:
        band[2 * width + rows - columns, columns] = values

    put(states[:, :, None], states[:, None, :], hessian)
    put(multipliers[:, :, None], states[:-1, None, :], -transition)
    put(states[:-1, None, :], multipliers[:, :, None], -transition)
    put(multipliers, multipliers, -slack)
    put(multipliers, states[1:], 1.0)
    put(states[1:], multipliers, 1.0)
    return band
