"""Transient solutions from given states, for many parameter vectors at once.

An integrator chooses the steps, once, according to the error; collocation on those steps then gives
every further solution. On a frozen mesh a solution is a smooth function of its own parameters, with
sensitivities exact to round-off and the same bits whatever the batch; an integrator that chose its
steps anew for each vector has none of these properties. The default scheme is the integrator's own
method, so that the error it controlled is the error of the solution.

Lanes (parameter vectors) are independent, as in ``_periodic.py``.

References
----------
Verbeek (1993), section 4.2, eqs. 4.10-4.11.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._compiled import BlockKernel, inner, jit
from bayesoleo._types import Array, Flags, Integers
from bayesoleo.solvers import _period_arrangement as measures
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._elimination import eliminate
from bayesoleo.solvers._initial_value import Dynamics, solve_initial_value
from bayesoleo.solvers._mesh import Mesh, graded
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import (
    LAST_STEP,
    SMALL_STEP,
    Boundary,
    Solution,
    Trial,
    solve_from_state,
)
from bayesoleo.solvers._radau_step import (
    ROUND_OFF,
    Method,
    Workspace,
    assemble,
    copy_to,
    evaluate_kernel,
    rows_of_stages,
    stretch,
    workspace,
)

#: Local error of the integrator over the size of each state: what its steps leave in a solution is
#: of this order, far below what a channel resolves.
TOLERANCE = 1e-6
#: Local error of the first look, which tells how large the states get, and their least size there.
LOOK, LEAST_SIZE = 1e-3, 1e-6
#: Steps at least, of an integrator that must not stride over the inputs, and at most.
FEWEST_STEPS, MOST_STEPS = 64, 65_536
#: Newton iterations on the whole time at once, before it is solved step by step: compiled code
#: takes as long for four of them as for all steps, arrays much longer for the steps.
MAXIMUM_ITERATIONS, ITERATIONS_OF_ARRAYS = 6, 12
#: The same of straight-line code, a tenth as long each.
ITERATIONS_OF_SWEEPS = 12
MAXIMUM_HALVINGS = 8
#: Newton iterations on one step.
STEP_ITERATIONS = 16
#: Steps from which on calls back into Python, some ten microseconds each, take longer than to
#: compile the kernels that are called, where a model is estimated.
WORTH_COMPILING = 250


@dataclass(frozen=True)
class Integration:
    """One integrated transient.

    Parameters
    ----------
    status : Status
        Unless it is ``CONVERGED`` there is nothing else.
    mesh : Mesh or None
        Steps in parts of the duration.
    rows : callable or None
        Values and derivatives ``(nz, N)`` at times ``(N,)`` in s since the start.
    """

    status: Status
    mesh: Mesh | None = None
    rows: Callable[[Array], Array] | None = None


def integrate(
    dynamics: Dynamics, p: Array, start: Array, duration: float, tolerance: float = TOLERANCE
) -> Integration:
    """Integrate one transient in steps chosen by their error, and keep the steps.

    Parameters
    ----------
    dynamics : Dynamics
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
    size = np.maximum(np.abs(start), LEAST_SIZE)
    for relative in (LOOK, tolerance):
        found = solve_initial_value(
            dynamics, p, start, np.array([0.0, duration]), tolerance=relative, scale=size,
            longest_step=duration / FEWEST_STEPS, most_steps=MOST_STEPS, exact=False,
        )  # fmt: skip
        if not found.status.ok:
            # Without rates at the start, equations have no explicit form.
            rateless = found.status is Status.NOT_FINITE and found.times.size == 1
            return Integration(Status.SINGULAR if rateless else found.status)
        largest = np.abs(found.states).max(axis=0)
        size = np.where(largest > 0, largest, 1.0)
    edges = found.times / duration
    edges[0], edges[-1] = 0.0, 1.0
    return Integration(Status.CONVERGED, graded(Mesh(edges)), found.sample)


def solve_transient(problem: Boundary, p: Array, start: Array) -> Solution:
    """Solve the collocation equations from given first states.

    Newton's method on all steps at once; a lane that does not converge so is solved step by step,
    from the first one on: an initial value problem always can be.

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
    solution = solve_from_state(problem, p, start, ITERATIONS_OF_SWEEPS)
    if solution is None:
        compiled = isinstance(problem.equations.jacobian, BlockKernel)
        most = MAXIMUM_ITERATIONS if compiled else ITERATIONS_OF_ARRAYS
        solution = newton(problem, p, start, most)
    failed = np.flatnonzero(solution.status != Status.CONVERGED.value)
    if failed.size == 0:
        return solution
    x, status, iterations = solution.x, solution.status.copy(), solution.iterations.copy()
    for lane in failed:
        x[lane], status[lane], more = _march(problem, p[lane], start[lane])
        iterations[lane] += more
    return Solution(x, status, iterations)


def newton(
    problem: Boundary,
    p: Array,
    start: Array,
    max_iterations: int = ITERATIONS_OF_ARRAYS,
) -> Solution:
    """Newton's method on all steps at once, halved where a step leaves the admissible region.

    Parameters are those of :func:`solve_transient`.
    """
    state = _State(problem, p, start.copy())
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

    def __init__(self, problem: Boundary, p: Array, x: Array):
        self.trial = Trial(problem, p, x)
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
        # Over the largest value: a transient may hardly move.
        states, moved = trial.problem.scheme.state_size, np.empty(self.status.size)
        measures.step_size(trial.x, dx, lanes, states, moved, size)
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


def _march(problem: Boundary, p: Array, start: Array) -> tuple[Array, int, int]:
    """Solve one lane step by step: unknowns ``(n, w)``, status and number of iterations."""
    scheme, equations = problem.scheme, problem.equations
    assert isinstance(scheme, Collocation)
    x, n, table = start.copy(), start.shape[0], scheme.method
    orders = np.array(scheme.orders, dtype=np.int64)
    method = Method(
        table.c, table.a, table.a @ table.a, table.polynomials, np.zeros(table.stages), 0.0
    )
    work = workspace(table.stages, scheme.orders, problem.inputs.shape[0], 0, problem.conditions, 0)
    jacobian, admissible = equations.jacobian, equations.admissible
    if n >= WORTH_COMPILING:
        jacobian, admissible = jacobian.compiled, admissible.compiled
    conditions = admissible.address if problem.conditions else 0
    done, iterations, outside = _steps(
        jacobian.address, conditions, problem.conditions, x, problem.inputs,
        scheme.lengths(n, problem.step(n)), p, method, table.b, table.b @ table.a, orders, work,
    )  # fmt: skip
    if done == n:
        return x, Status.CONVERGED.value, iterations
    status = Status.INADMISSIBLE if outside else Status.NO_CONVERGENCE
    return start, status.value, iterations


@jit
def _steps(
    jacobian: int, admissible: int, conditions: int, x: Array, inputs: Array, lengths: Array,
    p: Array, method: Method, b: Array, ba: Array, orders: Integers, work: Workspace,
) -> tuple[int, int, bool]:  # fmt: skip
    """Solve the steps of ``x (n, w)`` in place.

    Returns how many are solved, all iterations, and whether the one that is not leaves the
    admissible region.
    """
    n, d, s = lengths.size, orders.size, b.size
    D = x.shape[1] - s * d
    top, last, scale = np.zeros((s, d)), np.zeros((s, d)), np.zeros(D)
    kept, total = x[:, D:].copy(), 0
    for m in range(n):
        for k in range(inputs.shape[0]):
            for i in range(s):
                work.u[k, i] = inputs[k, m * s + i]
        for k in range(D):
            scale[k] = max(scale[k], abs(x[m, k]))
        solved = left = False
        # Where the last step leads, what was guessed, and no acceleration at all.
        for attempt in range(3):
            if attempt == 0 and m == 0:
                continue
            if attempt == 0:
                stretch(last, lengths[m] / lengths[m - 1], method, top)
            else:
                for i in range(s):
                    for j in range(d):
                        top[i, j] = kept[m, i * d + j] if attempt == 1 else 0.0
            solved, outside, count = _step(
                jacobian, admissible, conditions, x[m, :D], top, lengths[m], scale, method, orders,
                p, work,
            )  # fmt: skip
            total, left = total + count, left or outside
            if solved:
                break
        if not solved:
            return m, total, left
        for i in range(s):
            for j in range(d):
                last[i, j] = x[m, D + i * d + j] = top[i, j]
        if m + 1 < n:
            _end_of(x[m], lengths[m], b, ba, orders, x[m + 1])
    return n, total, False


@inner
def _step(
    jacobian: int, admissible: int, conditions: int, state: Array, top: Array, h: float,
    scale: Array, method: Method, orders: Integers, p: Array, work: Workspace,
) -> tuple[bool, bool, int]:  # fmt: skip
    """Newton's method for one step's stages ``top (s, d)``, halved where a step leaves the
    admissible region; whether it is solved, whether it left the region, iterations."""
    d, s = orders.size, method.c.size
    base, before, left = top.copy(), np.inf, False
    finite, inside = _evaluated(
        jacobian, admissible, conditions, state, top, h, method, orders, p, work
    )
    for iteration in range(STEP_ITERATIONS):
        left = left or not inside
        if not (finite and inside):
            return False, left, iteration
        assemble(work.g, h, method, orders, work.matrix)
        for i in range(s):
            for e in range(d):
                work.right[i * d + e, 0] = -work.g[e, i]
        if not eliminate(work.matrix, work.right, 1e-300):
            return False, left, iteration
        size, row = 0.0, -1
        for j in range(d):
            row += orders[j]
            for i in range(s):
                change = abs(h * work.right[i * d + j, 0])
                size = max(size, change / max(scale[row], abs(h * top[i, j]), change, 1e-300))
        if not np.isfinite(size):
            return False, left, iteration
        # What a step of this size leaves is round-off: quadratic, at a kink, or no better any more.
        done = size < SMALL_STEP or (size < LAST_STEP and size < 0.1 * before)
        done = done or (size < ROUND_OFF and size > 0.1 * before)
        copy_to(top, base)
        fraction = 1.0
        for _ in range(MAXIMUM_HALVINGS):
            for i in range(s):
                for j in range(d):
                    top[i, j] = base[i, j] + fraction * work.right[i * d + j, 0]
            if done:
                return True, left, iteration + 1
            finite, inside = _evaluated(
                jacobian, admissible, conditions, state, top, h, method, orders, p, work
            )
            left = left or not inside
            if finite and inside:
                break
            fraction *= 0.5
        before = size
    return False, left, STEP_ITERATIONS


@inner
def _evaluated(
    jacobian: int, admissible: int, conditions: int, state: Array, top: Array, h: float,
    method: Method, orders: Integers, p: Array, work: Workspace,
) -> tuple[bool, bool]:  # fmt: skip
    """Equations and derivatives at the stages: whether they are finite, and admissible."""
    d, s = orders.size, method.c.size
    rows_of_stages(state, top, h, method, orders, work.z)
    evaluate_kernel(jacobian, work.z, work.u, p, work.g, s)
    if conditions > 0:
        evaluate_kernel(admissible, work.z, work.u, p, work.a, s)
    finite, inside = True, True
    for k in range(d + d * (d + state.size)):
        for i in range(s):
            finite = finite and np.isfinite(work.g[k, i])
    for k in range(conditions):
        for i in range(s):
            inside = inside and work.a[k, i] > 0.0
    return finite, inside


@inner
def _end_of(x: Array, h: float, b: Array, ba: Array, orders: Integers, following: Array) -> None:
    """State at the end of a step with unknowns ``x (w,)``, where the following one begins."""
    d, D, first = orders.size, orders.sum(), 0
    for j in range(d):
        last = first + orders[j] - 1
        once = twice = 0.0
        for i in range(b.size):
            once += b[i] * x[D + i * d + j]
            twice += ba[i] * x[D + i * d + j]
        following[last] = x[last] + h * once
        if orders[j] == 2:
            following[first] = x[first] + h * (x[last] + h * twice)
        first += orders[j]


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
    scheme, step = problem.scheme, problem.step(n)
    moves = right.any(axis=(0, 1, 3)) | start_p.any(axis=(0, 1))
    moves[:1] |= not moves.any()  # the transition and the status are asked for in any case
    every = bool(moves.all())
    few = right if every else np.compress(moves, right, axis=2)
    moved = start_p[:, :, moves]
    # A motion that carries the initial derivative on without a force is known; what is left to
    # solve for starts at zero.
    if moved.any():
        few += moved.mT[:, None] @ _pull_of_states(problem, n, gz)
    x, transition, ok = scheme.linear(gz, few, None, lanes, step, initial=True)
    if moved.any():
        _carry_on(problem, n, moved, x)
    if every:
        return x, transition, ok
    whole = np.zeros((*x.shape[:3], right.shape[2]))
    whole[..., moves] = x
    return whole, transition, ok


def _pull_of_states(problem: Boundary, n: int, gz: Array) -> Array:
    """Change of the equations by each state at time zero, shape (L, d, D, N), where the motion goes
    on with its initial derivative and no force."""
    orders, rows = problem.scheme.orders, state_rows(problem.scheme.orders)
    found: Array = np.take(gz, rows, axis=2)
    time, state = problem.period * problem.scheme.phases(n), 0
    for order in orders:
        if order == 2:
            found[:, :, state + 1] += time * found[:, :, state]
        state += order
    return found


def _carry_on(problem: Boundary, n: int, start_p: Array, x: Array) -> None:
    """Add that motion by changes ``(L, D, k)`` of the first state to ``x (L, n, w, k)``."""
    scheme = problem.scheme
    assert isinstance(scheme, Collocation)
    time, state = problem.period * scheme.nodes(n), 0
    for order in scheme.orders:
        for k in range(state, state + order):
            x[:, :, k] += start_p[:, None, k]
        if order == 2:
            x[:, :, state] += time[:, None] * start_p[:, None, state + 1]
        state += order
