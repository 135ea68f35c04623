"""Explicit form ``ds/dt = h(s, t; p)`` of implicit equations ``g(z, u, p) = 0``, with derivatives.

The state ``s`` holds for each dof its value, and its velocity where the dof is of second order. At
given state and inputs the equations are solved for the highest derivatives by Newton's method: one
step where they are linear in them. The derivatives of ``h`` follow by the implicit function
theorem, from those of the generated kernels rather than from differences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bayesoleo._compiled import ImplicitEquations, jit
from bayesoleo._types import Array, Flags, Integers
from bayesoleo.solvers._elimination import eliminate

#: ``(times in s, shape (N,)) -> rows of inputs, shape (nu, N)``.
Inputs = Callable[[Array], Array]

MAXIMUM_ITERATIONS = 30
#: A Newton step this small, over the size of the derivative, leaves round-off only.
SMALL_STEP = 1e-12
#: Below this a derivative is zero: where all terms cancel, relative steps never get small.
SMALLEST = 1e-3


class Rates(NamedTuple):
    """Time derivatives ``(L, D, N)`` of states; ``ok (L, N)`` is false where there are none."""

    rates: Array
    ok: Flags


class LinearisedRates(NamedTuple):
    """Time derivatives of states, with theirs: ``rates (L, D, N)``, ``by_state (L, D, D, N)``,
    ``by_parameter (L, D, na, N)`` and ``ok (L, N)``, false where they are not finite or singular.
    """

    rates: Array
    by_state: Array
    by_parameter: Array
    ok: Flags


@dataclass(frozen=True)
class StateSpace:
    """A model's equations of motion as ordinary differential equations (Verbeek 1993, eq. 4.6).

    Parameters
    ----------
    equations : ImplicitEquations
        Kernels over states ``z (L, nz, N)``: for each dof its value and derivatives.
    orders : tuple of int
        Order (1 or 2) of each dof.
    inputs : callable
        Inputs and their derivatives at any times.
    active : int
        Number of parameters with derivatives.
    conditions : int
        Number of conditions on the admissible region.
    """

    equations: ImplicitEquations
    orders: tuple[int, ...]
    inputs: Inputs
    active: int
    conditions: int = 0

    @property
    def size(self) -> int:
        """Number D of state components."""
        return sum(self.orders)

    def state_rows(self) -> Integers:
        """Rows of ``z`` that are the state, shape (D,)."""
        first = np.cumsum([0, *(order + 1 for order in self.orders)])
        return np.array([first[j] + k for j, o in enumerate(self.orders) for k in range(o)], int)

    def highest_rows(self) -> Integers:
        """Rows of ``z`` that are highest derivatives, shape (d,)."""
        return np.cumsum([order + 1 for order in self.orders]).astype(int) - 1

    def complete(self, t: Array, s: Array, p: Array) -> tuple[Array, Array, Flags]:
        """Solve for the highest derivatives.

        Parameters
        ----------
        t : ndarray, shape (N,)
            Times, s.
        s : ndarray, shape (L, D, N)
            States.
        p : ndarray, shape (L, np)
            Constants of each lane.

        Returns
        -------
        z : ndarray, shape (L, nz, N)
            Values and all derivatives of the dofs.
        gz : ndarray, shape (L, d, nz, N)
            Partial derivatives of the equations there.
        ok : ndarray of bool, shape (L, N)
            False where the equations are singular in the highest derivatives, not finite, or were
            not solved.
        """
        lanes, d, points = np.arange(s.shape[0]), len(self.orders), s.shape[2]
        highest, u = self.highest_rows(), np.ascontiguousarray(self.inputs(t))
        z = np.zeros((lanes.size, self.size + d, points))
        z[:, self.state_rows()] = s
        g, gz = np.zeros((lanes.size, d, points)), np.zeros((lanes.size, d, z.shape[1], points))
        done = np.zeros((lanes.size, points), dtype=bool)
        regular = np.ones_like(done)
        for _ in range(MAXIMUM_ITERATIONS):
            with np.errstate(all="ignore"):
                self.equations.jacobian(z, u, p, lanes, g, gz)
            step, regular = _solve_at_points(gz, -g[:, :, None], highest)
            unit = _unit(z, gz, highest)
            z[:, highest] += np.where(done[:, None], 0.0, step[:, :, 0])
            # A step that is not finite is final too: there is nothing to go on from.
            done |= ~np.any(np.abs(step[:, :, 0]) > SMALL_STEP * unit, axis=1) | ~regular
            if done.all():
                break
        return z, gz, regular & done & np.isfinite(z).all(axis=1)

    def rates(self, t: Array, s: Array, p: Array) -> Rates:
        """Time derivatives of states ``s (L, D, N)`` at times ``t (N,)``; NaN where there are none.

        Takes the arguments of :meth:`complete`.
        """
        z, _, ok = self.complete(t, s, p)
        return Rates(np.where(ok[:, None], z[:, self.state_rows() + 1], np.nan), ok)

    def linearise(self, t: Array, s: Array, p: Array) -> LinearisedRates:
        """Time derivatives of states with their derivatives by states and active parameters.

        Takes the arguments of :meth:`complete`.

        References
        ----------
        Verbeek (1993), eqs. 4.10-4.11.
        """
        z, gz, ok = self.complete(t, s, p)
        lanes, D, rows = s.shape[0], self.size, self.state_rows()
        gp = np.zeros((lanes, len(self.orders), self.active, t.size))
        with np.errstate(all="ignore"):
            self.equations.parameters(
                z, np.ascontiguousarray(self.inputs(t)), p, np.arange(lanes), gp
            )
        right = -np.concatenate([gz[:, :, rows], gp], axis=2)
        answer, _ = _solve_at_points(gz, right, self.highest_rows())
        derivatives = np.zeros((lanes, D, D + self.active, t.size))
        next_state = {int(row): i for i, row in enumerate(rows)}
        for i, row in enumerate(rows + 1):
            if int(row) in next_state:
                derivatives[:, i, next_state[int(row)]] = 1.0
            else:
                derivatives[:, i] = answer[:, list(self.highest_rows()).index(row)]
        ok = ok & np.isfinite(derivatives).all(axis=(1, 2))
        rates = np.where(ok[:, None], z[:, rows + 1], np.nan)
        derivatives = np.where(ok[:, None, None], derivatives, np.nan)
        return LinearisedRates(rates, derivatives[:, :, :D], derivatives[:, :, D:], ok)

    def admissible(self, t: Array, s: Array, p: Array) -> Flags:
        """Whether states lie in the admissible region, shape (L, N).

        Takes the arguments of :meth:`complete`.
        """
        a = np.ones((s.shape[0], self.conditions, t.size))
        if self.conditions:
            z, _, _ = self.complete(t, s, p)
            u = np.ascontiguousarray(self.inputs(t))
            with np.errstate(all="ignore"):
                self.equations.admissible(z, u, p, np.arange(s.shape[0]), a)
        return np.asarray((a > 0).all(axis=1))

    # -- for an integrator of ordinary differential equations ----------------------------------

    def right_side(self, p: Array) -> Callable[[float, Array], Array]:
        """``f(t, s)`` of one lane ``p (np,)``, as :func:`scipy.integrate.solve_ivp` takes it."""
        constants = p[None]

        def f(t: float, s: Array) -> Array:
            return self.rates(np.array([t]), s[None, :, None], constants).rates[0, :, 0]

        return f

    def variational(self, p: Array) -> Callable[[float, Array], Array]:
        """The state with its derivatives as one system, of one lane ``p (np,)``.

        The unknowns are ``[s, ds/ds(0), ds/dtheta]``: ``(D, 1 + D + na)`` raveled; they start at
        :meth:`variational_start`.

        References
        ----------
        Verbeek (1993), eqs. 4.10-4.11.
        """
        constants, D = p[None], self.size

        def f(t: float, unknowns: Array) -> Array:
            table = unknowns.reshape(D, 1 + D + self.active)
            local = self.linearise(np.array([t]), table[None, :, :1], constants)
            result = np.empty_like(table)
            result[:, 0] = local.rates[0, :, 0]
            result[:, 1:] = local.by_state[0, :, :, 0] @ table[:, 1:]
            result[:, 1 + D :] += local.by_parameter[0, :, :, 0]
            return result.ravel()

        return f

    def variational_start(self, s: Array, s_theta: Array | None = None) -> Array:
        """Unknowns of :meth:`variational` at the start ``s (D,)``, with its derivatives by the
        parameters ``s_theta (D, na)``, zero by default.
        """
        by_parameter = np.zeros((self.size, self.active)) if s_theta is None else s_theta
        return np.concatenate([s[:, None], np.eye(self.size), by_parameter], axis=1).ravel()


def _unit(z: Array, gz: Array, highest: Integers) -> Array:
    """Size of the highest derivatives ``(L, d, N)`` that the equations' terms make, each alone."""
    terms = np.abs(gz * z[:, None]).sum(axis=2)
    slope = np.abs(gz[:, :, highest]).max(axis=2)
    return np.asarray(np.abs(z[:, highest]) + terms / np.where(slope > 0, slope, 1) + SMALLEST)


def _solve_at_points(gz: Array, right: Array, highest: Integers) -> tuple[Array, Flags]:
    """Solve ``gz[:, :, highest] x = right`` at every point.

    ``right`` and ``x`` are ``(L, d, k, N)``; the flags ``(L, N)`` say where it is regular.
    """
    lanes, d, k, points = right.shape
    x, ok = np.empty((lanes, points, d, k)), np.ones((lanes, points), dtype=np.bool_)
    x[:] = np.moveaxis(right, 3, 1)
    matrix = np.ascontiguousarray(np.moveaxis(gz[:, :, highest], 3, 1))
    _eliminate_points(matrix, x, ok)
    return np.moveaxis(x, 1, 3), ok


@jit
def _eliminate_points(matrix: Array, right: Array, ok: Flags) -> None:
    for lane in range(ok.shape[0]):
        for i in range(ok.shape[1]):
            # Rows are scaled to one: what is left of an exact zero is round-off below 1e-14.
            ok[lane, i] = eliminate(matrix[lane, i], right[lane, i], 1e-14)
            if not ok[lane, i]:
                right[lane, i] = np.nan
