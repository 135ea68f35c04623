"""Shooting by SciPy, for comparison.

Shooting integrates the variational equations with LSODA or Radau (Verbeek 1993, eqs. 4.10-4.11 and
4.36-4.41), and Newton's method closes the period. It is slow and has no switches. It is an
independent check of the package's own solvers, and a last resort where these fail.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.integrate import solve_ivp

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.solvers._orbit import Orbit, Status
from bayesoleo.solvers._state_space import StateSpace

#: Steps at least: an integrator sees inputs at its own steps only, and must not stride over them.
FEWEST_STEPS = 64
#: Evaluations of the right-hand side after which an integration has failed.
MOST_EVALUATIONS = 200_000
INTEGRATORS = ("LSODA", "Radau", "BDF", "DOP853")
#: Periods that the motion settles first: a stable one attracts from further than Newton's method.
SETTLING = 10
#: Local error while it does.
LOOSE = 1e-6
MAXIMUM_PASSES = 12
#: A correction is final when it is below this many tolerances, over the sizes of the states.
FINAL = 30.0


class TooLongError(Exception):
    """The integrator asks for too many evaluations."""


@dataclass(frozen=True, eq=False)
class LibraryShot:
    """A periodic motion found with a library's integrator.

    Parameters
    ----------
    space : StateSpace
        Equations and inputs.
    p : ndarray, shape (np,)
        Constants.
    orbit : Orbit
        States at the integrator's steps, status, multipliers, cost.
    table : callable or None
        State, its derivatives by the first state and by parameters, ``(D (1 + D + na), N)`` at
        times in s; None where there is no orbit.
    start_theta : ndarray, shape (D, na)
        Derivatives of the first state by the active parameters.
    """

    space: StateSpace
    p: Array
    orbit: Orbit
    table: Any
    start_theta: Array

    def sample(self, phases: Array) -> Array:
        """Values and derivatives ``(nz, N)`` of all dofs at phases in cycles."""
        times, table = self._at(phases)
        return cast(Array, self.space.complete(times, table[None, :, 0], self.p[None])[0][0])

    def sample_theta(self, phases: Array) -> Array:
        """Derivatives ``(nz, na, N)`` of these by the active parameters."""
        times, table = self._at(phases)
        D, rows = self.space.size, self.space.state_rows()
        by = np.einsum("idn,da->ian", table[:, 1 : 1 + D], self.start_theta) + table[:, 1 + D :]
        local = self.space.linearise(times, table[None, :, 0], self.p[None])
        rates = np.einsum("ijn,jan->ian", local.by_state[0], by) + local.by_parameter[0]
        found = np.empty((D + len(self.space.orders), by.shape[1], times.size))
        found[rows + 1], found[rows] = rates, by
        return found

    def _at(self, phases: Array) -> tuple[Array, Array]:
        times = (phases % 1.0) * self.orbit.period
        return times, self.table(times).reshape(self.space.size, -1, times.size)


def shoot_by_library(
    space: StateSpace,
    p: Array,
    period: float,
    start: Array,
    *,
    integrator: str = "LSODA",
    tolerance: float = 1e-9,
    fewest_steps: int = FEWEST_STEPS,
) -> LibraryShot:
    """Find the state that returns to itself after a period, with SciPy's integrators.

    Parameters
    ----------
    space : StateSpace
        Equations and inputs.
    p : ndarray, shape (np,)
        Constants.
    period : float
        Seconds.
    start : ndarray, shape (D,)
        Where to begin.
    integrator : {"LSODA", "Radau", "BDF", "DOP853"}
        Of SciPy.
    tolerance : float
        Local error over each state's size.
    fewest_steps : int
        In a period, at least: an integrator must not stride over the inputs.

    Returns
    -------
    LibraryShot
        Whatever came of it; see ``orbit.status``.

    Raises
    ------
    InputError
        If there is no such integrator.
    """
    if integrator not in INTEGRATORS:
        hint = f"use {', '.join(INTEGRATORS)}"
        raise InputError("no such integrator", key="integrator", value=integrator, hint=hint)
    return _Library(space, p, period, integrator, tolerance, fewest_steps).run(start)


class _Library:
    """One search; evaluations are counted from pass to pass."""

    def __init__(
        self, space: StateSpace, p: Array, period: float, integrator: str, tolerance: float,
        fewest_steps: int,
    ):  # fmt: skip
        self.space, self.p, self.period, self.fewest = space, p, period, fewest_steps
        self.integrator, self.tolerance, self.evaluations = integrator, tolerance, 0

    def run(self, start: Array) -> LibraryShot:
        """Settle, then Newton's method until its correction is the integrator's error."""
        D = self.space.size
        settled = self.integrate(self.space.right_side(self.p), start, SETTLING, LOOSE, 1e-9)
        if settled is None:
            return self.failed(start, self.reason(start))
        state, size = settled.y[:, -1], np.abs(settled.y).max(axis=1) + 1e-300
        rates = self.space.variational(self.p)
        for _ in range(MAXIMUM_PASSES):
            first = self.space.variational_start(state)
            # Derivatives are known to the same part of their size: of a state over that of another.
            absolute = np.full((D, first.size // D), self.tolerance) * size[:, None]
            path = self.integrate(rates, first, 1, self.tolerance, absolute.ravel())
            if path is None:
                return self.failed(state, self.reason(state))
            end = path.y[:, -1].reshape(D, -1)
            closure = np.eye(D) - end[:, 1 : 1 + D]
            scaled = closure * size / size[:, None]
            if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e12:
                return self.failed(state, Status.SINGULAR)
            step = np.linalg.solve(closure, end[:, 0] - state)
            if np.max(np.abs(step) / size) < FINAL * self.tolerance:
                return self.found(path, end)
            state = state + step
        return self.failed(state, Status.NO_CONVERGENCE)

    def integrate(
        self, rates: Any, start: Array, periods: int, rtol: float, atol: float | Array
    ) -> Any:
        """SciPy's answer over some periods; None where there is none."""
        left = MOST_EVALUATIONS

        def counted(t: float, s: Array) -> Array:
            nonlocal left
            left -= 1
            if left < 0:
                raise TooLongError
            return np.asarray(rates(t, s))

        try:
            with np.errstate(all="ignore"):
                path = solve_ivp(
                    counted, (0.0, periods * self.period), start, self.integrator, rtol=rtol,
                    atol=atol, max_step=self.period / self.fewest, dense_output=True,
                )  # fmt: skip
        # SciPy raises where a Jacobian or a first step is not a number.
        except (TooLongError, ValueError, np.linalg.LinAlgError):
            return None
        finally:
            self.evaluations += MOST_EVALUATIONS - left
        return path if path.status == 0 and np.isfinite(path.y).all() else None

    def reason(self, state: Array) -> Status:
        """Why a motion from a state does not exist."""
        at, lane = np.zeros(1), state[None, :, None]
        if not self.space.admissible(at, lane, self.p[None])[0, 0]:
            return Status.INADMISSIBLE
        found = self.space.rates(at, lane, self.p[None]).ok[0, 0]
        return Status.NO_CONVERGENCE if found else Status.NOT_FINITE

    def found(self, path: Any, end: Array) -> LibraryShot:
        D = self.space.size
        inside = self.space.admissible(path.t, path.y[None, :: end.shape[1]], self.p[None])
        # By itself it estimates no error of what it found.
        status = Status.NO_ERROR_ESTIMATE if inside.all() else Status.INADMISSIBLE
        monodromy = end[:, 1 : 1 + D]
        start_theta = np.linalg.solve(np.eye(D) - monodromy, end[:, 1 + D :])
        states = path.y[:: end.shape[1], :-1].T
        orbit = Orbit(
            path.t[:-1] / self.period, states, self.period, monodromy, status, np.nan,
            self.evaluations,
        )  # fmt: skip
        return LibraryShot(self.space, self.p, orbit, path.sol, start_theta)

    def failed(self, state: Array, status: Status) -> LibraryShot:
        D = self.space.size
        nothing = np.full((D, D), np.nan)
        orbit = Orbit(
            np.zeros(1), state[None], self.period, nothing, status, np.nan, self.evaluations
        )
        return LibraryShot(self.space, self.p, orbit, None, np.full((D, self.space.active), np.nan))
