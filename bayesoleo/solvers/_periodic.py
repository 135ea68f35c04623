"""Periodic solutions on a given mesh by Newton's method, for many parameter vectors at once.

Newton's method acts on all unknowns of a period at once. Lanes (parameter vectors) are independent:
each has its own step length, its own end and its own status, so that a solution depends on its own
parameters and start alone, bit for bit. Where Newton's method fails from a static guess, the
solution is reached by raising the forcing in steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayesoleo._compiled import BlockKernel, ImplicitEquations, record
from bayesoleo._types import Array, Flags, Float, Int, Integers
from bayesoleo.solvers import (
    _period_arrangement as arrangement,
    _periodic_newton as newton,
)
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic_newton import NEEDS_EXCHANGE, ROUND_OFF, Extrapolation
from bayesoleo.solvers._schemes import Scheme

#: Newton's error after a step is about the step squared: a relative step of 1e-7 that is still
#: contracting leaves 1e-14.
LAST_STEP = 1e-7
#: Without quadratic contraction (at a kink) a step this small is taken as converged.
SMALL_STEP = 1e-11
MAXIMUM_HALVINGS = 12
#: Residual over the size of its terms below which a known motion solves other equations too: one
#: that was found leaves round-off, or at a kink a step of :data:`SMALL_STEP`.
KNOWN_MERIT = 1e-10
FIRST_STEP = 0.25
SMALLEST_STEP = 1.0 / 512


class Trial:
    """Unknowns, and the equations with their derivatives at these; arrays are allocated once.

    Parameters
    ----------
    problem : Boundary
    p : ndarray, shape (L, np)
        Constants of each lane.
    x : ndarray, shape (L, n, w)
        Unknowns; whoever moves them evaluates again.

    Attributes
    ----------
    base : ndarray, shape (L, n, w)
        Room for the unknowns that a step starts from.
    z, g, gz : ndarray
        Values at the points, shape (L, nz, N); residual, (L, d, N); derivatives, (L, d, nz, N).
    squares, terms : ndarray, shape (L, d)
        Squared residual, and squared terms it is judged by.
    inside, defined : ndarray of bool, shape (L,)
        Whether the unknowns lie in the admissible region, and whether that could be asked.
    """

    def __init__(self, problem: Boundary, p: Array, x: Array):
        self.problem, self.p, self.x = problem, p, x
        lanes, n, _ = x.shape
        scheme = problem.scheme
        d, points = len(scheme.orders), problem.inputs.shape[1]
        nz = scheme.state_size + d
        self.step, self.base = problem.step(n), np.empty_like(x)
        self.z = np.empty((lanes, nz, points))
        self.g = np.empty((lanes, d, points))
        self.gz = np.empty((lanes, d, nz, points))
        self.a = np.empty((lanes, problem.conditions, points))
        self.squares, self.terms = np.empty((lanes, d)), np.empty((lanes, d))
        self.inside, self.defined = np.ones(lanes, dtype=np.bool_), np.ones(lanes, dtype=np.bool_)

    def evaluate(self, lanes: Integers) -> Flags:
        """Equations at the present unknowns; true where they are finite and admissible, (L,)."""
        equations, u = self.problem.equations, self.problem.inputs
        self.problem.scheme.rows(self.x, lanes, self.step, self.z)
        with np.errstate(all="ignore"):
            equations.jacobian(self.z, u, self.p, lanes, self.g, self.gz)
            if self.problem.conditions:
                equations.admissible(self.z, u, self.p, lanes, self.a)
        arrangement.positive(self.a, lanes, self.inside, self.defined)
        arrangement.measure(self.z, self.g, self.gz, lanes, self.squares, self.terms)
        finite = self.defined[lanes] & np.isfinite(self.terms[lanes]).all(axis=1)
        return self.inside[lanes] & finite

    def newton_step(self, lanes: Integers, *, initial: bool = False) -> tuple[Array, Flags]:
        """Newton's step, shape (L, n, w), and where the linear problem has a solution, (L,)."""
        dx, _, ok = self.problem.scheme.linear(
            self.gz, self.g[:, :, None], self.x, lanes, self.step, initial=initial
        )
        return dx, ok

    def take(self, lanes: Integers, dx: Array, fraction: Array) -> None:
        """Move the unknowns to a fraction, shape (lanes,), of a step from where it starts."""
        arrangement.take(self.base, dx, lanes, fraction, self.x)

    def take_whole(self, lanes: Integers, dx: Array) -> None:
        """Move the unknowns by a whole step from where they are."""
        arrangement.keep(self.x, lanes, self.base)
        self.take(lanes, dx, np.ones(lanes.size))


@dataclass(frozen=True)
class Boundary:
    """A discretised periodic boundary-value problem.

    Parameters
    ----------
    equations : ImplicitEquations
        Residuals and partial derivatives.
    scheme : Scheme
        Discretisation.
    period : float
        Seconds.
    inputs : ndarray, shape (nu, N)
        Inputs and their derivatives at the scheme's points.
    conditions : int
        Number of conditions on the admissible region.
    active : int
        Number of parameters with derivatives.
    """

    equations: ImplicitEquations
    scheme: Scheme
    period: float
    inputs: Float[Array, "inputs points"]
    conditions: int
    active: int

    def step(self, n: int) -> float:
        """Length of one of ``n`` steps, s."""
        return self.period / n

    @cached_property
    def arranged(self) -> arrangement.Arranged | None:
        """Inputs as the compiled iteration sweeps them; None where it has no code for the scheme,
        or the equations are not compiled."""
        compiled = isinstance(self.equations.jacobian, BlockKernel)
        program = self.scheme.program if compiled else None
        if program is None:
            return None
        n = self.inputs.shape[1] // program.stages
        if not arrangement.can_sweep(program, n):
            return None
        return arrangement.Arranged.of(program, self.inputs, self.scheme.lengths(n, self.step(n)))


@dataclass(frozen=True)
class Solution:
    """Periodic solutions of ``L`` parameter vectors.

    Parameters
    ----------
    x : ndarray, shape (L, n, w)
        The scheme's unknowns.
    status : ndarray of int, shape (L,)
        Values of :class:`~bayesoleo.solvers.Status`.
    iterations : ndarray of int, shape (L,)
        Newton iterations.
    """

    x: Float[Array, "vectors steps width"]
    status: Int[Integers, " vectors"]
    iterations: Int[Integers, " vectors"]


def solve_periodic(
    problem: Boundary,
    p: Float[Array, "vectors constants"],
    start: Float[Array, "vectors steps width"],
    *,
    max_iterations: int = 40,
    monotone: bool = True,
    overwrite: bool = False,
    exchange: bool = True,
) -> Solution:
    """Solve the discretised periodic problem by Newton's method with step halving.

    Parameters
    ----------
    problem : Boundary
        Equations, scheme, inputs.
    p : ndarray, shape (L, np)
        Constants of each lane.
    start : ndarray, shape (L, n, w)
        Where each lane starts.
    max_iterations : int
        After which a lane's status is ``NO_CONVERGENCE``.
    monotone : bool
        Halve steps until the residual falls. Otherwise only until it is finite and admissible:
        plain Newton wanders, but out of the hollows of the residual's norm in which the monotone
        iteration gets stuck.
    overwrite : bool
        Let the solution take the place of ``start``: a fresh copy costs a twentieth of the time.
    exchange : bool
        Go on with lanes whose elimination has to exchange rows, which on thousands of steps takes
        a thousand times as long; else they have not converged.

    Returns
    -------
    Solution

    References
    ----------
    Verbeek (1993), section 4.3.1.
    """
    x = start if overwrite else start.copy()
    if problem.arranged is None:
        return _Newton(problem, p, x, max_iterations, monotone).run()
    solution = _compiled(problem, problem.arranged, p, x, max_iterations, monotone)
    # Those left over are still where they started.
    starts = x.__getitem__
    return _exchanging(problem, p, solution, starts, max_iterations, monotone, exchange)


def solve_extrapolated(
    problem: Boundary,
    p: Array,
    extrapolation: Extrapolation,
    change: Array,
    *,
    max_iterations: int = 40,
    exchange: bool = True,
) -> Solution:
    """The same from ``extrapolation.starts(change)``, ``change (L, na)``, without making them."""
    arranged, most = problem.arranged, max_iterations
    if arranged is None:
        start = extrapolation.starts(change)
        return solve_periodic(problem, p, start, max_iterations=most, overwrite=True)
    x = np.empty((p.shape[0], *extrapolation.x.shape))
    moved = np.ascontiguousarray(change[:, extrapolation.moving])
    base, slopes = extrapolation.swept(arranged.layout)
    places = base.ctypes.data, slopes.ctypes.data, moved.ctypes.data
    line = arrangement.LinearStart(*places, moved.shape[1])
    solution = _compiled(problem, arranged, p, x, most, True, line)

    def starts(lanes: Integers) -> Array:
        return extrapolation.starts(change[lanes])

    return _exchanging(problem, p, solution, starts, most, True, exchange)


def solve_from_state(problem: Boundary, p: Array, start: Array, most: int) -> Solution | None:
    """Solve an initial value problem on all steps at once, in one compiled call.

    Parameters
    ----------
    problem : Boundary
        Its period is the duration.
    p : ndarray, shape (L, np)
        Constants of each lane.
    start : ndarray, shape (L, n, w)
        Where each lane starts; the state of its first step stays.
    most : int
        Newton iterations, halved only where they cannot be evaluated: a step in the wrong
        direction at late times is soon put right by the early ones.

    Returns
    -------
    Solution or None
        None where there is no compiled code; a lane that did not converge has no solution, and
        may have one by other means. Its status may be -1, for an elimination that would have to
        exchange rows.
    """
    if problem.arranged is None:
        return None
    return _compiled(problem, problem.arranged, p, start.copy(), most, False, initial=True)


def _exchanging(
    problem: Boundary,
    p: Array,
    solution: Solution,
    starts: Callable[[Integers], Array],
    max_iterations: int,
    monotone: bool,
    exchange: bool,
) -> Solution:
    """Solve by the general iteration what the compiled one cannot eliminate, if that is wanted."""
    again = np.flatnonzero(solution.status == NEEDS_EXCHANGE)
    if not exchange:
        solution.status[again] = Status.NO_CONVERGENCE.value
    elif again.size:
        other = _Newton(problem, p[again], starts(again), max_iterations, monotone).run()
        solution.x[again] = other.x
        solution.status[again], solution.iterations[again] = other.status, other.iterations
    return solution


def _compiled(
    problem: Boundary,
    arranged: arrangement.Arranged,
    p: Array,
    x: Array,
    max_iterations: int,
    monotone: bool,
    line: arrangement.LinearStart = arrangement.NO_LINE,
    initial: bool = False,
) -> Solution:
    """The same iteration, lane by lane, in one compiled call, in place; ``initial`` holds the first
    state instead of closing the period."""
    equations, program = problem.equations, arranged.program
    status = np.empty(x.shape[0], dtype=np.int64)
    iterations = np.zeros(x.shape[0], dtype=np.int64)
    sizes = arranged.sizes(p.shape[1], problem.conditions)
    kernels = equations.residual, equations.jacobian, equations.admissible
    pieces = arrangement.scheme_kernels(program, tuple(kernel.address for kernel in kernels))
    work = arrangement.work_space(sizes, program.order)
    newton.solve_lanes(
        record(pieces), record(sizes), record(arranged.sweep), record(work),
        arrangement.Options(max_iterations, monotone, initial), p, x, line, status, iterations,
    )  # fmt: skip
    return Solution(x, status, iterations)


def solve_in_batch(problem: Boundary, p: Array, start: Array, most: int = 40) -> Solution:
    """The same by kernels of whole arrays, in place, as for equations that are not compiled."""
    return _Newton(problem, p, start, most, True).run()


class _Newton:
    """State of one batched iteration."""

    def __init__(self, problem: Boundary, p: Array, x: Array, max_iterations: int, monotone: bool):
        self.trial = Trial(problem, p, x)
        self.max_iterations, self.monotone = max_iterations, monotone
        lanes = x.shape[0]
        self.status = np.full(lanes, Status.NO_CONVERGENCE.value, dtype=np.int64)
        self.iterations = np.zeros(lanes, dtype=np.int64)
        self.merit = np.full(lanes, np.inf)
        self.last = np.full(lanes, np.inf)

    def run(self) -> Solution:
        trial, lanes = self.trial, np.arange(self.status.size)
        good = trial.evaluate(lanes)
        outside = np.where(trial.inside, Status.NOT_FINITE.value, Status.INADMISSIBLE.value)
        lanes = self._drop(lanes, good, outside)
        size, least = np.empty(self.status.size), np.empty(self.status.size)
        for _ in range(self.max_iterations):
            if lanes.size == 0:
                break
            self.iterations[lanes] += 1
            dx, ok = trial.newton_step(lanes)
            arrangement.step_size(trial.x, dx, lanes, trial.problem.scheme.state_size, size, least)
            lanes = self._drop(lanes, ok[lanes] & np.isfinite(size[lanes]), Status.SINGULAR.value)
            lanes = self._finish(lanes, dx, size, least)
            lanes = self._advance(lanes, dx, size)
        return Solution(trial.x, self.status, self.iterations)

    def _drop(self, lanes: Integers, good: Flags, reason: int | Integers) -> Integers:
        bad = lanes[~good]
        self.status[bad] = reason if isinstance(reason, int) else reason[bad]
        return lanes[good]

    def _reduces(self, lanes: Integers, squares: Array, terms: Array) -> Flags:
        """Whether the residual fell, or is round-off, in units of the equations' terms: the larger
        of those before and after.

        Terms before alone would be nothing for an equation that a start at rest fulfils, and forbid
        to leave it.
        """
        unit = np.maximum(terms, self.trial.terms[lanes]) + 1e-300
        with np.errstate(all="ignore"):
            before = np.sqrt(np.sum(squares / unit, axis=1))
            after = np.sqrt(np.sum(self.trial.squares[lanes] / unit, axis=1))
            own = self.trial.squares[lanes] / (self.trial.terms[lanes] + 1e-300)
        # An iteration that comes back from far away has a small residual against what it left.
        self.merit[lanes] = np.sqrt(np.sum(own, axis=1))
        return (after < before) | (after < ROUND_OFF)

    def _finish(self, lanes: Integers, dx: Array, size: Array, least: Array) -> Integers:
        """Take the last step where it is small enough that what it leaves is round-off."""
        sizes = size[lanes]
        falling = (sizes < LAST_STEP) & (sizes < 0.1 * self.last[lanes])
        done = falling | (least[lanes] < SMALL_STEP)
        finished = lanes[done]
        self.trial.take_whole(finished, dx)
        self.status[finished] = Status.CONVERGED.value
        self.last[lanes] = sizes
        return lanes[~done]

    def _advance(self, lanes: Integers, dx: Array, size: Array) -> Integers:
        """Take the steps, halved where they are inadmissible or do not reduce the residual."""
        trial = self.trial
        arrangement.keep(trial.x, lanes, trial.base)
        squares, terms, fraction = trial.squares[lanes], trial.terms[lanes], np.ones(lanes.size)
        pending = np.arange(lanes.size)
        for _ in range(MAXIMUM_HALVINGS):
            if pending.size == 0:
                break
            chosen = lanes[pending]
            trial.take(chosen, dx, fraction[pending])
            good = trial.evaluate(chosen)
            falls = self._reduces(chosen, squares[pending], terms[pending])
            # Close to the solution round-off keeps the residual from falling; the step's own size
            # then decides.
            good &= falls | (size[chosen] < 1e-5) | (not self.monotone)
            pending = pending[~good]
            fraction[pending] *= 0.5
        stuck = lanes[pending]
        outside = np.where(
            trial.inside[stuck], Status.NO_CONVERGENCE.value, Status.INADMISSIBLE.value
        )
        self.status[stuck] = outside
        arrangement.keep(trial.base, stuck, trial.x)
        self.last[lanes[fraction < 1.0]] = np.inf
        kept = np.ones(lanes.size, dtype=bool)
        kept[pending] = False
        lanes = lanes[kept]
        # A linear problem is solved by its first step.
        done = (self.merit[lanes] < ROUND_OFF) & (self.iterations[lanes] > 1)
        self.status[lanes[done]] = Status.CONVERGED.value
        return lanes[~done]


def sensitivities(problem: Boundary, p: Array, solution: Solution) -> tuple[Solution, Array, Array]:
    """Derivatives of converged solutions with respect to the active parameters.

    Parameters
    ----------
    problem : Boundary
        As solved.
    p : ndarray, shape (L, np)
        Constants.
    solution : Solution
        Of :func:`solve_periodic`.

    Returns
    -------
    solution : Solution
        With the status ``SINGULAR`` where the linear problem has no solution.
    x_theta : ndarray, shape (L, n, w, na)
        ``-G^-1 dg/dtheta`` (Verbeek 1993, eq. 4.28).
    monodromy : ndarray, shape (L, D, D)
        Its eigenvalues are the Floquet multipliers of the discretised time map.
    """
    lanes = np.flatnonzero(solution.status == Status.CONVERGED.value)
    count, n, _ = solution.x.shape
    d, points = len(problem.scheme.orders), problem.inputs.shape[1]
    nz = problem.scheme.state_size + d
    z = np.zeros((count, nz, points))
    g, gz = np.zeros((count, d, points)), np.zeros((count, d, nz, points))
    gp = np.zeros((count, d, problem.active, points))
    problem.scheme.rows(solution.x, lanes, problem.step(n), z)
    problem.equations.jacobian(z, problem.inputs, p, lanes, g, gz)
    problem.equations.parameters(z, problem.inputs, p, lanes, gp)
    x_theta, monodromy, ok = linear_by_column(problem.scheme, gz, gp, lanes, problem.step(n))
    status = solution.status.copy()
    status[lanes[~ok[lanes]]] = Status.SINGULAR.value
    return replace(solution, status=status), x_theta, monodromy


def sensitivities_at(problem: Boundary, p: Array, x: Array) -> tuple[Array, Array] | None:
    """Derivatives of one motion that solves the equations for several sets of constants.

    Candidates of a search are absent at their null: the motion is that of the present model,
    whatever their shape. One elimination then serves all sets.

    Parameters
    ----------
    problem : Boundary
    p : ndarray, shape (L, np)
        Constants.
    x : ndarray, shape (n, w)
        Unknowns of the motion.

    Returns
    -------
    x_theta : ndarray, shape (L, n, w, na)
    monodromy : ndarray, shape (L, D, D)
        The same for all sets.

    Notes
    -----
    None is returned where the motion does not solve all of them, to :data:`KNOWN_MERIT`, where it
    leaves the admissible region, or where small changes move it in another way for some of them.
    """
    count, lanes = p.shape[0], np.arange(p.shape[0])
    trial = Trial(problem, p, np.repeat(x[None], count, axis=0))
    if not trial.evaluate(lanes).all():
        return None
    with np.errstate(all="ignore"):
        merit = np.sqrt(np.sum(trial.squares / (trial.terms + 1e-300), axis=1))
    if not (merit < KNOWN_MERIT).all() or not (trial.gz == trial.gz[:1]).all():
        return None
    gp = np.zeros((count, len(trial.g[0]), problem.active, trial.g.shape[2]))
    problem.equations.parameters(trial.z, problem.inputs, p, lanes, gp)
    right = np.moveaxis(gp, 0, 1).reshape(1, gp.shape[1], -1, gp.shape[3])
    dx, monodromy, ok = linear_by_column(
        problem.scheme, trial.gz[:1], np.ascontiguousarray(right), lanes[:1], trial.step
    )
    if not ok[0]:
        return None
    by_set = np.moveaxis(dx[0].reshape(*x.shape, count, problem.active), 2, 0)
    return np.ascontiguousarray(by_set), np.repeat(monodromy, count, axis=0)


def linear_by_column(
    scheme: Scheme, gz: Array, right: Array, lanes: Integers, step: float, *, initial: bool = False
) -> tuple[Array, Array, Flags]:
    """Solve ``G dx = -right`` where many columns may be zero.

    Most parameters of a force law act on its outputs alone, and move no state: only columns with a
    right-hand side are solved for.

    Parameters
    ----------
    scheme : Scheme
    gz : ndarray, shape (L, d, nz, N)
        Partial derivatives of the equations at the points.
    right : ndarray, shape (L, d, k, N)
        A column for each parameter.
    lanes : ndarray of int
        Which of the L to solve.
    step : float
        Mean length of a step, s.
    initial : bool
        Hold the first state instead of closing the period.

    Returns
    -------
    dx, monodromy, ok : ndarray
        As of :meth:`Scheme.linear`.
    """
    moves = right.any(axis=(0, 1, 3))
    moves[:1] |= not moves.any()  # the monodromy and the status are asked for in any case
    if moves.all():
        return scheme.linear(gz, right, None, lanes, step, initial=initial)
    few = np.ascontiguousarray(right[:, :, moves])
    found, monodromy, ok = scheme.linear(gz, few, None, lanes, step, initial=initial)
    dx = np.zeros((*found.shape[:3], right.shape[2]))
    dx[..., moves] = found
    return dx, monodromy, ok


def solve_from_guess(
    problem: Boundary, p: Array, start: Array, *, exchange: bool = True
) -> Solution:
    """Solve each lane directly; those that fail by continuation in the amplitude of the inputs,
    then by undamped Newton steps.

    Parameters
    ----------
    problem : Boundary
        Equations, scheme and inputs at full amplitude.
    p : ndarray, shape (L, np)
        Constants.
    start : ndarray, shape (L, n, w)
        Where each lane starts: a guess of the full motion, or a static one.
    exchange : bool
        As of :func:`solve_periodic`.

    Returns
    -------
    Solution
    """
    solution = solve_periodic(problem, p, start, exchange=exchange)
    x, status, iterations = solution.x.copy(), solution.status.copy(), solution.iterations.copy()
    for lane in np.flatnonzero(status != Status.CONVERGED.value):
        one = slice(lane, lane + 1)
        better = _raise_forcing(problem, p[one], start[one], exchange)
        if better is None:
            # Where the branch from rest folds back before full amplitude, wandering steps find the
            # other branch.
            better = solve_periodic(
                problem, p[one], start[one], max_iterations=200, monotone=False, exchange=exchange
            )
        if better.status[0] == Status.CONVERGED.value:
            x[one], status[one] = better.x, better.status
            iterations[one] += better.iterations
    return Solution(x, status, iterations)


def _raise_forcing(problem: Boundary, p: Array, start: Array, exchange: bool) -> Solution | None:
    """Continuation of one lane from its time average under constant inputs."""
    static = np.broadcast_to(start.mean(axis=1, keepdims=True), start.shape).copy()
    current = _at(problem, p, static, 0.0, exchange)
    if current.status[0] != Status.CONVERGED.value:
        return None
    amount, step, previous = 0.0, FIRST_STEP, None
    while amount < 1.0:
        target = min(1.0, amount + step)
        guess = current.x
        if previous is not None:
            before, x_before = previous
            guess = current.x + (target - amount) / (amount - before) * (current.x - x_before)
        trial = _at(problem, p, guess, target, exchange)
        if trial.status[0] != Status.CONVERGED.value:
            step /= 2
            if step < SMALLEST_STEP:
                return None
            continue
        previous, current, amount = (amount, current.x), trial, target
        if trial.iterations[0] <= 4:
            step *= 2
    return current


def _at(problem: Boundary, p: Array, start: Array, amount: float, exchange: bool) -> Solution:
    mean = problem.inputs.mean(axis=1, keepdims=True)
    scaled = replace(problem, inputs=mean + amount * (problem.inputs - mean))
    return solve_periodic(scaled, p, start, max_iterations=15, exchange=exchange)
