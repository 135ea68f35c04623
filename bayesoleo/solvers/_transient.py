"""Transient solutions from given states, for many parameter vectors at once.

A library's integrator chooses the steps, once, according to the error
(``_library_integrator.py``); collocation on those steps then gives every further solution. On a
frozen mesh a solution is a smooth function of its own parameters, with sensitivities exact to
round-off and the same bits whatever the batch; an integrator that chose its steps anew for each
vector has none of these properties. The default scheme is the integrator's own method, so that the
error it controlled is the error of the solution.

Lanes (parameter vectors) are independent, as in ``_periodic.py``.

References
----------
Verbeek (1993), section 4.2, eqs. 4.10-4.11.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.solvers import _period_arrangement as measures
from bayesoleo.solvers._collocation import Collocation, SamplePlan
from bayesoleo.solvers._mesh import Mesh
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import LAST_STEP, SMALL_STEP, Boundary, Solution, Trial

#: Newton iterations on the whole time at once, before it is walked through piece by piece.
MAXIMUM_ITERATIONS = 12
MAXIMUM_HALVINGS = 8
#: Newton iterations on one piece. A piece is solved when the next Newton step is below this part of
#: its size; that step is still taken and leaves round-off.
PIECE_ITERATIONS, SETTLED = 16, 1e-6


def solve_transient(problem: Boundary, p: Array, start: Array) -> Solution:
    """Solve the collocation equations from given first states.

    Newton's method on all steps at once; a lane that does not converge so is walked through in
    pieces, from the first step on: an initial value problem always can be.

    Parameters
    ----------
    problem : Boundary
        Equations, a collocation scheme with its mesh, inputs; its period is the duration.
    p : ndarray, shape (L, np)
        Constants of each lane.
    start : ndarray, shape (L, n, w)
        Where each lane starts. The state of its first step is the initial state, and stays.

    Returns
    -------
    Solution
    """
    solution = newton(problem, p, start)
    failed = np.flatnonzero(solution.status != Status.CONVERGED.value)
    if failed.size == 0:
        return solution
    x, status, iterations = solution.x, solution.status.copy(), solution.iterations.copy()
    for lane in failed:
        one = slice(lane, lane + 1)
        x[one], status[lane], more = _walk(problem, p[one], start[one].copy())
        iterations[lane] += more
    return Solution(x, status, iterations)


def newton(
    problem: Boundary,
    p: Array,
    start: Array,
    max_iterations: int = MAXIMUM_ITERATIONS,
    *,
    to_end: bool = False,
) -> Solution:
    """Newton's method on all steps at once, halved where a step leaves the admissible region.

    Parameters are those of :func:`solve_transient`; `to_end` asks that the state at the end of the
    time rests as well, which is where a next piece begins.
    """
    state = _State(problem, p, start.copy(), to_end)
    lanes = np.arange(start.shape[0])
    lanes = state.keep(lanes, state.trial.evaluate(lanes))
    last = np.full(start.shape[0], np.inf)
    for _ in range(max_iterations):
        if lanes.size == 0:
            break
        state.iterations[lanes] += 1
        dx, size = state.direction(lanes)
        lanes = state.keep(lanes, np.isfinite(size[lanes]), Status.SINGULAR)
        small = (size < LAST_STEP) & (size < 0.1 * last) | (size < SMALL_STEP)
        last[lanes] = size[lanes]
        lanes = state.finish(lanes, small, dx)
        lanes = state.advance(lanes, dx)
    return Solution(state.trial.x, state.status, state.iterations)


class _State:
    """State of one batched iteration."""

    def __init__(self, problem: Boundary, p: Array, x: Array, to_end: bool):
        self.trial = Trial(problem, p, x)
        self.end = _end(problem, x.shape[1]) if to_end else None
        self.status = np.full(x.shape[0], Status.NO_CONVERGENCE.value, dtype=np.int64)
        self.iterations = np.zeros(x.shape[0], dtype=np.int64)

    def keep(self, lanes: Integers, good: Flags, reason: Status | None = None) -> Integers:
        """Give up the lanes that are not good, for a reason or for what the evaluation found."""
        bad = lanes[~good]
        outside = np.where(
            self.trial.inside[bad], Status.NOT_FINITE.value, Status.INADMISSIBLE.value
        )
        self.status[bad] = outside if reason is None else reason.value
        return lanes[good]

    def direction(self, lanes: Integers) -> tuple[Array, Array]:
        """Newton's step, and its size over the states' by lane, (L,); infinite where singular."""
        trial, size = self.trial, np.full(self.status.size, np.inf)
        dx, ok = trial.newton_step(lanes, initial=True)
        # Over the largest value: a piece of a transient may hardly move.
        states, moved = trial.problem.scheme.state_size, np.empty(self.status.size)
        measures.step_size(trial.x, dx, lanes, states, moved, size)
        if self.end is not None:
            change = np.abs(end_state(trial.problem, dx[..., 0], self.end))
            largest = np.abs(trial.x[:, :, :states]).max(axis=1)
            largest = np.maximum(largest, np.abs(end_state(trial.problem, trial.x, self.end)))
            with np.errstate(invalid="ignore"):
                part = np.where(change > 0.0, change / np.maximum(largest, change), 0.0)
            size[lanes] = np.maximum(size, part.max(axis=1))[lanes]
        size[~ok] = np.inf
        return dx, size

    def finish(self, lanes: Integers, small: Flags, dx: Array) -> Integers:
        """Take the last step where it is so small that what it leaves is round-off."""
        finished = lanes[small[lanes]]
        self.trial.take_whole(finished, dx)
        self.status[finished] = Status.CONVERGED.value
        return lanes[~small[lanes]]

    def advance(self, lanes: Integers, dx: Array) -> Integers:
        """Take the steps, halved until they can be evaluated."""
        measures.keep(self.trial.x, lanes, self.trial.base)
        pending, fraction = lanes, np.ones(lanes.size)
        for _ in range(MAXIMUM_HALVINGS):
            if pending.size == 0:
                break
            self.trial.take(pending, dx, fraction)
            bad = ~self.trial.evaluate(pending)
            pending, fraction = pending[bad], 0.5 * fraction[bad]
        return self.keep(lanes, ~np.isin(lanes, pending))


def _walk(problem: Boundary, p: Array, x: Array) -> tuple[Array, int, int]:
    """Solve one lane piece by piece.

    What a step is depends on those before it alone: where a piece does not converge, its steps up
    to the first that still moves do, and the next piece begins there. Where not one does, pieces
    are made shorter, down to one step.
    """
    n, first, size, iterations = x.shape[1], 0, max(x.shape[1] // 8, 1), 0
    states = problem.scheme.state_size
    while first < n:
        piece = slice(first, min(first + size, n))
        found, count, more = _solved(problem, p, piece, x[:, piece])
        iterations += more
        if count == 0:
            found, count, more = _solved(problem, p, piece, _constant(x[:, piece], states))
            iterations += more
        if count == 0:
            if size == 1:
                return x, int(found.status[0]), iterations
            size = max(size // 4, 1)
            continue
        last = first + count
        x[:, first:last] = found.x
        if last < n:
            x[:, last, :states] = end_state(_piece(problem, first, last), found.x)
        first, size = last, 2 * size if last == piece.stop else max(count, size // 4)
    return x, Status.CONVERGED.value, iterations


def _solved(problem: Boundary, p: Array, piece: slice, start: Array) -> tuple[Solution, int, int]:
    """Solution of a piece's first steps, up to one that Newton's method still moves.

    With their number, none where they do not stand by themselves either, and all iterations.
    """
    part, lane = _piece(problem, piece.start, piece.stop), np.zeros(1, dtype=np.int64)
    found = newton(part, p, start, PIECE_ITERATIONS, to_end=True)
    if found.status[0] == Status.CONVERGED.value:
        return found, found.x.shape[1], int(found.iterations[0])
    trial = Trial(part, p, found.x.copy())
    trial.evaluate(lane)
    dx, _ = trial.newton_step(lane, initial=True)
    states = problem.scheme.state_size
    with np.errstate(all="ignore"):
        size = np.maximum.accumulate(np.abs(found.x[0, :, :states]), axis=0)
        moves = ~(np.abs(dx[0, :, :states, 0]) <= SETTLED * size).all(axis=1)
    # A step is solved where the state that it leads to rests.
    count = max(int(np.argmax(moves)) - 1, 0) if moves.any() else moves.size - 1
    if count == 0:
        return found, 0, int(found.iterations[0])
    settled = np.ascontiguousarray(found.x[:, :count])
    part = _piece(problem, piece.start, piece.start + count)
    again = newton(part, p, settled, PIECE_ITERATIONS, to_end=True)
    done = count if again.status[0] == Status.CONVERGED.value else 0
    return again, done, int(found.iterations[0] + again.iterations[0])


def _constant(x: Array, state_size: int) -> Array:
    """A start that stays where it begins: of no use but for being close in short pieces."""
    still = np.zeros(x.shape)
    still[:, :, :state_size] = x[:, :1, :state_size]
    return still


def _piece(problem: Boundary, first: int, last: int) -> Boundary:
    """The same equations over some of the steps."""
    scheme = problem.scheme
    assert isinstance(scheme, Collocation)
    assert scheme.mesh is not None
    edges, stages = scheme.mesh.edges[first : last + 1], scheme.method.stages
    length = edges[-1] - edges[0]
    inner = (edges - edges[0]) / length
    inner[-1] = 1.0
    return replace(
        problem,
        scheme=replace(scheme, mesh=Mesh(inner)),
        period=problem.period * float(length),
        inputs=np.ascontiguousarray(problem.inputs[:, first * stages : last * stages]),
    )


def end_state(problem: Boundary, x: Array, end: SamplePlan | None = None) -> Array:
    """States at the end of the time, shape (L, D), from unknowns ``(L, n, w)``."""
    scheme, n = problem.scheme, x.shape[1]
    assert isinstance(scheme, Collocation)
    rows = scheme.sample(x[..., None], end or _end(problem, n), problem.step(n))
    return rows[:, state_rows(scheme.orders), 0, 0]


def _end(problem: Boundary, n: int) -> SamplePlan:
    """The place of the end of the time."""
    assert isinstance(problem.scheme, Collocation)
    return problem.scheme.plan(np.ones(1), n, initial=True)


def state_rows(orders: tuple[int, ...]) -> Integers:
    """Rows of values and derivatives that are the state, shape (D,)."""
    first = np.cumsum([0, *(order + 1 for order in orders)])
    rows = [first[j] + k for j, order in enumerate(orders) for k in range(order)]
    return np.array(rows, dtype=np.int64)


def transient_sensitivities(
    problem: Boundary, p: Array, solution: Solution, start_p: Array
) -> tuple[Solution, Array, Array]:
    """Derivatives of converged transients with respect to the active parameters.

    Parameters
    ----------
    problem : Boundary
        As solved.
    p : ndarray, shape (L, np)
        Constants.
    solution : Solution
        Of :func:`solve_transient`.
    start_p : ndarray, shape (L, D, na)
        Derivatives of the initial states.

    Returns
    -------
    solution : Solution
        With the status ``SINGULAR`` where the linear problem has no solution.
    x_theta : ndarray, shape (L, n, w, na)
        The discretised ``ds_theta/dt = h_s s_theta + h_theta`` from ``ds(0)/dtheta``
        (Verbeek 1993, eqs. 4.10-4.11).
    transition : ndarray, shape (L, D, D)
        Derivatives of the last state by the first.
    """
    lanes = np.flatnonzero(solution.status == Status.CONVERGED.value)
    count, n, _ = solution.x.shape
    scheme, step = problem.scheme, problem.step(n)
    d, points = len(scheme.orders), problem.inputs.shape[1]
    nz = scheme.state_size + d
    z = np.zeros((count, nz, points))
    g, gz = np.zeros((count, d, points)), np.zeros((count, d, nz, points))
    right = np.zeros((count, d, problem.active, points))
    scheme.rows(solution.x, lanes, step, z)
    problem.equations.jacobian(z, problem.inputs, p, lanes, g, gz)
    problem.equations.parameters(z, problem.inputs, p, lanes, right)
    x_theta, transition, ok = moved_from_start(problem, n, gz, right, start_p, lanes)
    status = solution.status.copy()
    status[lanes[~ok[lanes]]] = Status.SINGULAR.value
    return replace(solution, status=status), x_theta, transition


def moved_from_start(
    problem: Boundary, n: int, gz: Array, right: Array, start_p: Array, lanes: Integers
) -> tuple[Array, Array, Flags]:
    """Changes of a motion by changes of its initial state and of its equations.

    Parameters
    ----------
    problem : Boundary
        As solved.
    n : int
        Steps.
    gz : ndarray, shape (L, d, nz, N)
        Partial derivatives of the equations at the points.
    right : ndarray, shape (L, d, k, N)
        Changes of the equations; overwritten.
    start_p : ndarray, shape (L, D, k)
        Of the initial state.
    lanes : ndarray of int
        Which of the L to solve.

    Returns
    -------
    x : ndarray, shape (L, n, w, k)
    transition : ndarray, shape (L, D, D)
        Derivatives of the last state by the first.
    ok : ndarray of bool, shape (L,)
    """
    # A motion that carries the initial derivative on without a force is known; what is left to
    # solve for starts at zero.
    base = _free_motion(problem, n, start_p)
    rows = _free_rows(problem, n, start_p)
    for k in range(gz.shape[2]):
        right += gz[:, :, k, None, :] * rows[:, None, k]
    step = problem.step(n)
    x, transition, ok = problem.scheme.linear(gz, right, None, lanes, step, initial=True)
    return x + base, transition, ok


def _free_motion(problem: Boundary, n: int, start_p: Array) -> Array:
    """Unknowns ``(L, n, w, na)`` of a motion whose highest derivatives are zero."""
    scheme = problem.scheme
    assert isinstance(scheme, Collocation)
    rows = _carried(scheme.orders, problem.period * scheme.nodes(n), start_p)
    x = np.zeros((start_p.shape[0], n, scheme.width, start_p.shape[2]))
    x[:, :, : scheme.state_size] = np.moveaxis(rows[:, state_rows(scheme.orders)], 3, 1)
    return x


def _free_rows(problem: Boundary, n: int, start_p: Array) -> Array:
    """Values and derivatives ``(L, nz, na, N)`` of that motion at the points."""
    return _carried(problem.scheme.orders, problem.period * problem.scheme.phases(n), start_p)


def _carried(orders: tuple[int, ...], time: Array, start_p: Array) -> Array:
    rows, state = [], 0
    for order in orders:
        value = np.repeat(start_p[:, state, :, None], time.size, axis=2)
        if order == 2:
            rate = np.repeat(start_p[:, state + 1, :, None], time.size, axis=2)
            rows += [value + rate * time, rate]
        else:
            rows.append(value)
        rows.append(np.zeros_like(value))
        state += order
    return np.stack(rows, axis=1)
