"""Integration by SciPy: time steps of transients, and shooting for comparison.

The steps of a transient are chosen by SciPy's integrator according to the error.

Shooting integrates the variational equations with LSODA or Radau (Verbeek 1993, eqs. 4.10-4.11 and
4.36-4.41), and Newton's method closes the period. It is slow and has no switches. It is an
independent check of the package's own solvers, and a last resort where these fail.

References
----------
Hairer, E. and Wanner, G. (1996). Solving Ordinary Differential Equations II, 2nd ed., section IV.8:
the method, as SciPy carries it out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.integrate import solve_ivp

from bayesoleo._types import Array, Integers
from bayesoleo.errors import InputError
from bayesoleo.solvers._mesh import Mesh, Tableau
from bayesoleo.solvers._orbit import Orbit, Status
from bayesoleo.solvers._state_space import StateSpace

#: Local error of the integrator over the size of each state: what its steps leave in a solution is
#: of this order, far below what a channel resolves.
TOLERANCE = 1e-6
#: Local error of the first look, which tells how large the states get.
LOOK = 1e-3
#: Neighbouring steps differ by this factor at most. If other parameters move a kink (a velocity
#: that changes sign under dry friction) away from its fine steps, the step that it reaches is no
#: longer than a fixed part of the distance moved.
GRADING = 1.5
#: Steps at least: an integrator sees inputs at its own steps only, and must not stride over them.
FEWEST_STEPS = 64
#: Evaluations of the right-hand side after which an integration has failed.
MOST_EVALUATIONS = 200_000
#: A Newton step this small, over the derivative's size, leaves round-off only.
SMALL_STEP = 1e-12
#: Part of an input's range by which a step may miss it between the points where it is seen.
INPUT_TOLERANCE = 1e-3
INTEGRATORS = ("LSODA", "Radau", "BDF", "DOP853")
#: Periods that the motion settles first: a stable one attracts from further than Newton's method.
SETTLING = 10
#: Local error while it does.
LOOSE = 1e-6
MAXIMUM_PASSES = 12
#: A correction is final when it is below this many tolerances, over the sizes of the states.
FINAL = 30.0


@dataclass(frozen=True)
class Integration:
    """One integrated transient.

    Parameters
    ----------
    status : Status
        Unless it is ``CONVERGED`` there is nothing else.
    mesh : Mesh or None
        Steps in parts of the duration.
    states : callable or None
        States ``(D, N)`` at times ``(N,)`` in s since the start.
    """

    status: Status
    mesh: Mesh | None = None
    states: Callable[[Array], Array] | None = None


class TooLongError(Exception):
    """The integrator asks for too many evaluations."""


def integrate(
    space: StateSpace, p: Array, start: Array, duration: float, tolerance: float = TOLERANCE
) -> Integration:
    """Integrate one transient by SciPy's Radau, and keep its steps.

    Parameters
    ----------
    space : StateSpace
        Equations and inputs.
    p : ndarray, shape (np,)
        Constants.
    start : ndarray, shape (D,)
        State at time zero.
    duration : float
        Seconds.
    tolerance : float
        Local error over each state's size.

    Returns
    -------
    Integration
    """
    if not np.isfinite(space.rates(np.zeros(1), start[None, :, None], p[None]).rates).all():
        return Integration(_inside(space, p, np.zeros(1), start[:, None], Status.SINGULAR))
    size = np.full(start.size, 1e-9 / LOOK)
    found = None
    for relative in (LOOK, tolerance):
        found = _radau(space, p, start, duration, relative, relative * size)
        if found is None or not np.isfinite(found.y).all():
            return Integration(Status.NO_CONVERGENCE)
        if found.status != 0:
            return Integration(_inside(space, p, found.t, found.y, Status.NO_CONVERGENCE))
        largest = np.abs(found.y).max(axis=1)
        size = np.where(largest > 0, largest, 1.0)
    assert found is not None
    status = _inside(space, p, found.t, found.y, Status.CONVERGED)
    if not status.ok:
        return Integration(status)
    return Integration(status, graded(Mesh(_edges(found.t, duration))), found.sol)


def _radau(
    space: StateSpace, p: Array, start: Array, duration: float, rtol: float, atol: Array
) -> Any:
    rates, left = _right_side(space, p), MOST_EVALUATIONS

    def counted(t: float, s: Array) -> Array:
        nonlocal left
        left -= 1
        if left < 0:
            raise TooLongError
        return rates(t, s)

    longest = duration / FEWEST_STEPS
    try:
        with np.errstate(all="ignore"):
            return solve_ivp(
                counted, (0.0, duration), start, "Radau", rtol=rtol, atol=atol, max_step=longest,
                jac=space.state_jacobian(p), dense_output=True,
            )  # fmt: skip
    except (
        TooLongError,
        ValueError,
        np.linalg.LinAlgError,
    ):  # SciPy raises where a Jacobian is NaN
        return None


def _right_side(space: StateSpace, p: Array) -> Callable[[float, Array], Array]:
    """``f(t, s)`` of one lane, as :meth:`StateSpace.right_side`, with arrays allocated once.

    An integrator asks for one point at a time, thousands of times.
    """
    d, rows, highest = len(space.orders), space.state_rows(), space.highest_rows()
    lanes, constants = np.zeros(1, dtype=np.int64), p[None]
    z, g = np.zeros((1, space.size + d, 1)), np.zeros((1, d, 1))
    gz, now = np.zeros((1, d, space.size + d, 1)), np.zeros(1)

    def f(t: float, s: Array) -> Array:
        now[0] = t
        u = space.inputs(now)
        z[0, rows, 0], z[0, highest, 0] = s, 0.0
        for _ in range(30):
            space.equations.jacobian(z, u, constants, lanes, g, gz)
            try:
                step = _solve(gz[0, :, highest, 0].T, -g[0, :, 0])
            except np.linalg.LinAlgError:
                break
            z[0, highest, 0] += step
            if space.affine or _is_last(step, z[0, :, 0], gz[0, :, :, 0], highest):
                return cast(Array, z[0, rows + 1, 0].copy())
        return np.full(s.size, np.nan)

    return f


def _solve(matrix: Array, right: Array) -> Array:
    """Solution of a few equations; of one without what a library does before it divides."""
    if right.size > 1:
        return np.linalg.solve(matrix, right)
    if matrix[0, 0] == 0.0:
        raise np.linalg.LinAlgError
    return cast(Array, right / matrix[0])


def _is_last(step: Array, z: Array, gz: Array, highest: Integers) -> bool:
    """Whether a Newton step for the highest derivatives leaves round-off only."""
    # Terms that cancel to a derivative of zero leave the round-off of their own size.
    terms = np.abs(gz * z).sum(axis=1)
    slope = np.abs(gz[:, highest]).max(axis=1)
    size = np.abs(z[highest]).max() + (terms / slope).max()
    return not np.abs(step).max() > SMALL_STEP * size


def _inside(space: StateSpace, p: Array, t: Array, s: Array, otherwise: Status) -> Status:
    """``INADMISSIBLE`` where a state has left the admissible region."""
    inside = space.admissible(t, s[None], p[None])
    return otherwise if inside.all() else Status.INADMISSIBLE


def _edges(times: Array, duration: float) -> Array:
    edges = times / duration
    edges[0], edges[-1] = 0.0, 1.0
    return edges


def graded(mesh: Mesh, ratio: float = GRADING) -> Mesh:
    """Cut steps until neighbours differ by a factor at most.

    Parameters
    ----------
    mesh : Mesh
    ratio : float
        The factor, above one.
    """
    lengths = np.diff(mesh.edges)
    allowed = lengths.copy()
    # A step may be longer than its neighbour by what one cut of that factor leaves.
    for n in range(1, lengths.size):
        allowed[n] = min(allowed[n], ratio * allowed[n - 1])
    for n in range(lengths.size - 2, -1, -1):
        allowed[n] = min(allowed[n], ratio * allowed[n + 1])
    edges = [0.0]
    for n, length in enumerate(lengths):
        edges += _cut(mesh.edges[n], length, allowed, n, ratio)
    edges[-1] = 1.0
    return Mesh(np.array(edges))


def _cut(left: float, length: float, allowed: Array, n: int, ratio: float) -> list[float]:
    """Right edges of the pieces of one step, that grow from both of its neighbours."""
    before = allowed[n - 1] if n > 0 else length
    after = allowed[n + 1] if n + 1 < allowed.size else length
    first, last = min(length, ratio * before), min(length, ratio * after)
    if length <= min(first, last) * (1 + 1e-12):
        return [left + length]
    position, pieces = 0.0, []
    while position < length * (1 - 1e-12):
        # No piece longer than the geometric growth from either end allows at its place.
        ahead = length - position
        piece = min(first + (ratio - 1) * position, (last + (ratio - 1) * ahead) / ratio)
        pieces.append(min(piece, ahead))
        position += pieces[-1]
    if len(pieces) > 1 and pieces[-1] < 0.5 * pieces[-2]:
        merged = 0.5 * (pieces[-1] + pieces[-2])
        pieces[-2:] = [merged, merged]
    return [*(left + np.cumsum(pieces[:-1])), left + length]


def halved(mesh: Mesh, times: int = 1) -> Mesh:
    """Cut every step into two, so many times."""
    edges = mesh.edges
    for _ in range(times):
        middle = 0.5 * (edges[:-1] + edges[1:])
        edges = np.sort(np.concatenate([edges, middle]))
    return Mesh(edges)


def resolving(
    mesh: Mesh,
    inputs: Callable[[Array], Array],
    method: Tableau,
    shortest: float,
    tolerance: float = INPUT_TOLERANCE,
) -> Mesh:
    """Halve the steps in which the inputs are no polynomial through what the method sees of them.

    Parameters
    ----------
    mesh : Mesh
    inputs : callable
        Rows of inputs ``(nu, N)`` at parts of the time ``(N,)``.
    method : Tableau
        Its stages are where inputs are seen.
    shortest : float
        Steps below twice this part of the time are not cut.
    tolerance : float
        Largest distance between them, over each row's range.
    """
    between = np.linspace(0.0, 1.0, 2 * method.stages + 1)
    weights = method.weights(between)[0]
    for _ in range(64):
        edges, count = mesh.edges, mesh.steps
        seen = inputs(mesh.points(method.c))
        if seen.shape[0] == 0:
            return mesh
        true = inputs(mesh.points(between))
        span = np.ptp(true, axis=1)[:, None, None]
        follows = seen.reshape(-1, count, method.stages) @ weights.T
        missed = np.abs(true.reshape(-1, count, between.size) - follows).max(axis=2)
        cut = (missed > tolerance * span[:, :, 0]).any(axis=0) & (np.diff(edges) >= 2 * shortest)
        if not cut.any():
            return mesh
        middle = 0.5 * (edges[:-1] + edges[1:])[cut]
        mesh = Mesh(np.sort(np.concatenate([edges, middle])))
    return mesh


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
