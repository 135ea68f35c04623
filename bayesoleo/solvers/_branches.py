"""Branches of periodic solutions through folds, by pseudo-arclength, and limit cycles.

A periodic orbit has one more unknown, a parameter or the period, and one more condition. All
unknowns of a period are reduced to the state at its start. Linearised, the state at its end is
``M`` times that at its start plus the contribution of the other unknown, with ``M`` the monodromy
matrix. The closure, bordered by the condition, is regular where the closure alone is not: at a
fold, and for an autonomous system, which has a multiplier of one.

Along a branch the first state and one other value - a parameter, the frequency or the amplitude of
the forcing - change together. A step goes along the tangent and returns to the branch in the plane
perpendicular to it, so that the branch may turn round in the value. Every orbit comes with its
multipliers: one passes through 1 at a fold and through -1 where the period doubles.

The period and the phase of a limit cycle of an autonomous system are unknown. The closure is then
bordered by the period and by a phase condition: the first state stays in the plane through the
guess, perpendicular to the motion.

References
----------
Keller, H. B. (1977). Numerical solution of bifurcation and nonlinear eigenvalue problems. In:
Applications of Bifurcation Theory, 359-384. Verbeek (1993), section 4.3, names path following.
Seydel, R. (2010). Practical Bifurcation and Stability Analysis, 3rd ed., section 7.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.optimize import brentq

from bayesoleo._types import Array, Complex, ComplexArray, Float
from bayesoleo.errors import number_of
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._orbit import Orbit, Status, floquet_multipliers
from bayesoleo.solvers._periodic import Boundary

#: ``value -> (discretised problem, constants (np,))``: what depends on the other unknown.
Family = Callable[[float], tuple[Boundary, Array]]

#: Relative step of the central difference by the other unknown: the cube root of round-off balances
#: its errors. Newton's direction needs no more; the solution does not depend on it.
DIFFERENCE = 6e-6
#: Newton's error is about the square of the last step.
LAST_STEP = 1e-8

_LANE = np.zeros(1, dtype=np.int64)
#: A step with more iterations than these is followed by a shorter one, with fewer by a longer.
MANY_ITERATIONS, FEW_ITERATIONS = 6, 4
#: Least cosine between tangents of neighbouring points: a larger turn may be another branch.
LEAST_COSINE = 0.9
#: A step may shrink to this part of the longest before the branch is given up.
SMALLEST_STEP = 1e-4
#: Special orbits in what is printed of a branch.
MOST_SHOWN = 20
#: Where along a step a special orbit lies, over its length.
PLACE = 1e-12


@dataclass(frozen=True, eq=False)
class BorderedSweep:
    """A period linearised with its first state held.

    Parameters
    ----------
    x : ndarray, shape (n, w)
        Unknowns after one Newton step of the initial value problem.
    gap : ndarray, shape (D,)
        State at the end less that at the start.
    monodromy : ndarray, shape (D, D)
    """

    x: Array
    gap: Array
    monodromy: Array


@dataclass(frozen=True, eq=False)
class PhaseCondition:
    """The additional equation ``row @ (state, value) = target``, linear in the first state.

    Parameters
    ----------
    row : ndarray, shape (D + 1,)
    target : float
    """

    row: Array
    target: float


@dataclass(frozen=True, eq=False)
class BorderedSolution:
    """A closed motion with the value of the other unknown.

    Parameters
    ----------
    x : ndarray, shape (n, w)
        The scheme's unknowns.
    value : float
    monodromy : ndarray, shape (D, D)
    by_value : ndarray, shape (D,)
        Derivative of the gap by the value.
    status : Status
    iterations : int
    """

    x: Float[Array, "steps width"]
    value: float
    monodromy: Float[Array, "states states"]
    by_value: Float[Array, " states"]
    status: Status
    iterations: int


def sweep(family: Family, x: Array, value: float) -> tuple[BorderedSweep | None, Status]:
    """Linearise a period about unknowns ``x (n, w)``; None with the reason where it cannot be."""
    problem, p = family(value)
    method = _one_step(problem)
    D, d = method.state_size, len(method.orders)
    points, step = problem.inputs.shape[1], problem.step(len(x))
    z, g = np.zeros((1, D + d, points)), np.zeros((1, d, points))
    gz, a = np.zeros((1, d, D + d, points)), np.ones((1, problem.conditions, points))
    with np.errstate(all="ignore"):
        method.rows(x[None], _LANE, step, z)
        problem.equations.jacobian(z, problem.inputs, p[None], _LANE, g, gz)
        if problem.conditions:
            problem.equations.admissible(z, problem.inputs, p[None], _LANE, a)
    if not (np.isfinite(g).all() and np.isfinite(gz).all()):
        return None, Status.NOT_FINITE
    if not (a > 0).all():
        return None, Status.INADMISSIBLE
    dx, monodromy, ok = method.linear(gz, g[:, :, None], x[None], _LANE, step, initial=True)
    if not (ok[0] and np.isfinite(dx).all() and np.isfinite(monodromy).all()):
        return None, Status.SINGULAR
    moved = x + dx[0, :, :, 0]
    end = end_states(problem, moved[..., None])[:, 0]
    return BorderedSweep(moved, end - moved[0, :D], monodromy[0]), Status.CONVERGED


def end_states(problem: Boundary, columns: Array) -> Array:
    """States ``(D, C)`` at the end of the period from unknowns, or changes, ``(n, w, C)``."""
    method = _one_step(problem)
    last = method.plan(np.ones(1), len(columns), initial=True)
    rows = method.sample(columns[None], last, problem.step(len(columns)))[0, :, :, 0]
    first = np.cumsum([0, *(order + 1 for order in method.orders)])
    return rows[[first[j] + k for j, o in enumerate(method.orders) for k in range(o)]]


def solve_bordered(
    family: Family, x: Array, value: float, condition: PhaseCondition, *, max_iterations: int = 25
) -> BorderedSolution:
    """Newton's method for a closed motion that fulfils one more condition.

    Parameters
    ----------
    family : callable
        See :data:`Family`; its scheme is a one-step collocation.
    x : ndarray, shape (n, w)
        Where the unknowns of the period start.
    value : float
        Where the other unknown starts.
    condition : PhaseCondition
    max_iterations : int

    Returns
    -------
    BorderedSolution
    """
    status, iterations, D = Status.NO_CONVERGENCE, 0, condition.row.size - 1
    monodromy, by_value = np.full((D, D), np.nan), np.full(D, np.nan)
    for number in range(1, max_iterations + 1):
        iterations = number
        here, reason = sweep(family, x, value)
        slope = _gap_by_value(family, x, value)
        if here is None or slope is None:
            status = reason if here is None else Status.NOT_FINITE
            break
        monodromy, by_value = here.monodromy, slope
        border = np.block([[np.eye(D) - monodromy, -by_value[:, None]], [condition.row[None]]])
        left = condition.target - condition.row @ np.append(x[0, :D], value)
        change = _solve(border, np.append(here.gap, left))
        if change is None:
            status = Status.SINGULAR
            break
        moved = x.copy()
        moved[0, :D] += change[:D]
        after, reason = sweep(family, moved, value + change[D])
        if after is None:
            status = reason
            break
        spread = np.abs(x[:, :D]).max(axis=0) + np.finfo(float).tiny
        size = float((np.abs(after.x - x)[:, :D] / spread).max())
        x, value = after.x, float(value + change[D])
        if size < LAST_STEP:
            status = Status.CONVERGED
            break
    return BorderedSolution(x, value, monodromy, by_value, status, iterations)


def _gap_by_value(family: Family, x: Array, value: float) -> Array | None:
    width = DIFFERENCE * max(abs(value), DIFFERENCE)
    ahead, _ = sweep(family, x, value + width)
    behind, _ = sweep(family, x, value - width)
    if ahead is None or behind is None:
        return None
    return (ahead.gap - behind.gap) / (2 * width)


def _solve(matrix: Array, right: Array) -> Array | None:
    """Solution with rows and columns brought to one size, None where it is singular."""
    scale = np.abs(matrix).max(axis=1, keepdims=True)
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        return None
    try:
        answer = np.linalg.solve(matrix / scale, right / scale[:, 0])
    except np.linalg.LinAlgError:
        return None
    return answer if np.isfinite(answer).all() else None


def _one_step(problem: Boundary) -> Collocation:
    assert isinstance(problem.scheme, Collocation)  # its state closes a period; differences' do not
    return problem.scheme


@dataclass(frozen=True, eq=False)
class BranchPoint:
    """An orbit on a branch.

    Parameters
    ----------
    value : float
    x : ndarray, shape (n, w)
        The scheme's unknowns.
    multipliers : ndarray of complex, shape (D,)
        Floquet multipliers, largest first.
    tangent : ndarray, shape (D + 1,)
        Direction of the branch in scaled units, the value last.
    """

    value: float
    x: Float[Array, "steps width"]
    multipliers: Complex[ComplexArray, " states"]
    tangent: Float[Array, " states+1"]

    @property
    def unstable(self) -> int:
        """Number of multipliers outside the unit circle."""
        return int(np.sum(np.abs(self.multipliers) > 1.0))

    def __repr__(self) -> str:
        largest = np.abs(self.multipliers).max(initial=0.0)
        return f"{self.value:>12.6g}  {self.unstable:>8}  {largest:>18.6g}"


@dataclass(frozen=True, eq=False)
class SpecialPoint:
    """A point where a branch folds back (``fold``) or its period doubles (``doubling``)."""

    kind: str
    point: BranchPoint

    def __repr__(self) -> str:
        return f"{self.kind:<8}  {self.point!r}"


@dataclass(frozen=True, eq=False)
class Branch:
    """A branch of orbits.

    Parameters
    ----------
    points : tuple of BranchPoint
        In the order in which they were met.
    special : tuple of SpecialPoint
    status : Status
        ``CONVERGED`` where an end of the span was reached.
    """

    points: tuple[BranchPoint, ...]
    special: tuple[SpecialPoint, ...]
    status: Status

    @property
    def values(self) -> Array:
        """Shape (K,)."""
        return np.array([point.value for point in self.points])

    def of_kind(self, kind: str) -> tuple[BranchPoint, ...]:
        """Special orbits of one kind."""
        return tuple(item.point for item in self.special if item.kind == kind)

    def __repr__(self) -> str:
        """Its ends and special orbits, a line each; of many the first."""
        status = self.status.name.lower().replace("_", " ")
        head = f"branch of {number_of(len(self.points), 'orbit')}, {status}"
        if not self.points:
            return head
        shown = (
            SpecialPoint("start", self.points[0]),
            *self.special[:MOST_SHOWN],
            SpecialPoint("end", self.points[-1]),
        )
        lines = [head, f"{'':<8}  {'value':>12}  {'unstable':>8}  {'largest multiplier':>18}"]
        lines += map(repr, shown)
        more = len(self.special) - MOST_SHOWN
        return "\n".join(lines + ([f"and {more} more special orbits"] if more > 0 else []))


def follow(
    family: Family,
    x: Array,
    value: float,
    span: tuple[float, float],
    *,
    forward: bool = True,
    longest: float = 0.1,
    most: int = 400,
) -> Branch:
    """Follow the branch through an orbit until it leaves a span of values.

    Parameters
    ----------
    family : callable
        See :data:`~bayesoleo.solvers._branches.Family`; its scheme is a one-step
        collocation.
    x : ndarray, shape (n, w)
        Unknowns of an orbit at ``value``, or near one.
    value : float
    span : tuple of float
        Least and largest value.
    forward : bool
        Whether to set out towards larger values.
    longest : float
        Length of a step, in spans of the value and in largest values of the states so far.
    most : int
        Orbits on the branch.

    Returns
    -------
    Branch
    """
    D = family(value)[0].scheme.state_size
    held = PhaseCondition(np.append(np.zeros(D), 1.0), value)
    first = solve_bordered(family, x, value, held)
    if not first.status.ok:
        return Branch((), (), first.status)
    spread = np.abs(first.x[:, :D]).max(axis=0)
    units = np.append(np.where(spread > 0, spread, 1.0), span[1] - span[0])
    onward = np.append(np.zeros(D), 1.0 if forward else -1.0)
    return _Walk(family, units, longest).run(_point(first, units, onward), span, most)


def _point(solution: BorderedSolution, units: Array, onward: Array) -> BranchPoint:
    """An orbit with the tangent that goes the same way as ``onward``."""
    D = units.size - 1
    matrix = np.column_stack([np.eye(D) - solution.monodromy, -solution.by_value]) * units
    # Rows have units of their own; the null space does not depend on them.
    tangent = np.linalg.svd(matrix / np.abs(matrix).max(axis=1, keepdims=True))[2][-1]
    tangent = tangent if tangent @ onward >= 0 else -tangent
    multipliers = floquet_multipliers(solution.monodromy)
    return BranchPoint(solution.value, solution.x, multipliers, tangent)


class _Walk:
    """Steps along one branch."""

    def __init__(self, family: Family, units: Array, longest: float) -> None:
        self.family, self.units, self.longest = family, units, longest

    def run(self, first: BranchPoint, span: tuple[float, float], most: int) -> Branch:
        points, special, length = [first], list[SpecialPoint](), self.longest
        while len(points) < most:
            here, trial = points[-1], self.step(points[-1], length)
            if trial is None:
                length /= 2
                if length < SMALLEST_STEP * self.longest:
                    return Branch(tuple(points), tuple(special), Status.NO_CONVERGENCE)
                continue
            point, iterations = trial
            special += self.between(here, point, length)
            points.append(self.grown(point))
            if not span[0] <= point.value <= span[1]:
                return Branch(tuple(points), tuple(special), Status.CONVERGED)
            if iterations <= FEW_ITERATIONS:
                length = min(2 * length, self.longest)
            elif iterations > MANY_ITERATIONS:
                length /= 2
        return Branch(tuple(points), tuple(special), Status.NO_CONVERGENCE)

    def grown(self, point: BranchPoint) -> BranchPoint:
        """The orbit, with its tangent in units that grow with the motion."""
        units, D = self.units, self.units.size - 1
        self.units = np.append(np.maximum(units[:D], np.abs(point.x[:, :D]).max(axis=0)), units[D])
        tangent = point.tangent * units / self.units
        return replace(point, tangent=tangent / np.linalg.norm(tangent))

    def step(self, point: BranchPoint, length: float) -> tuple[BranchPoint, int] | None:
        """The orbit at a length along the tangent, with Newton's iterations; None if there is none
        or the branch turns too much to be sure that it is the same.
        """
        D = self.units.size - 1
        row = point.tangent / self.units
        at = np.append(point.x[0, :D], point.value)
        ahead = at + length * point.tangent * self.units
        x = point.x.copy()
        x[0, :D] = ahead[:D]
        target = float(row @ at) + length
        found = solve_bordered(self.family, x, float(ahead[D]), PhaseCondition(row, target))
        if not found.status.ok:
            return None
        after = _point(found, self.units, point.tangent)
        if after.tangent @ point.tangent < LEAST_COSINE:
            return None
        return after, found.iterations

    def between(self, before: BranchPoint, after: BranchPoint, length: float) -> list[SpecialPoint]:
        """Folds and doublings between two neighbouring orbits."""
        found = []
        for kind, test in TESTS.items():
            if np.sign(test(before)) * np.sign(test(after)) < 0:
                point = self.zero(before, length, test)
                found += [SpecialPoint(kind, point)] if point is not None else []
        return found

    def zero(
        self, before: BranchPoint, length: float, test: Callable[[BranchPoint], float]
    ) -> BranchPoint | None:
        """The place along a step where a test function vanishes."""

        def value(part: float) -> float:
            trial = self.step(before, part)
            return np.nan if trial is None else test(trial[0])

        if not value(length) * test(before) < 0:
            return None
        place = brentq(value, 0.0, length, xtol=PLACE * length)
        trial = self.step(before, float(place))
        return None if trial is None else trial[0]


def _doubling(point: BranchPoint) -> float:
    """``det(M + 1)``, over its terms' size."""
    return float(np.real(np.prod((1.0 + point.multipliers) / (1.0 + np.abs(point.multipliers)))))


#: Functions whose sign changes at a special orbit.
TESTS: dict[str, Callable[[BranchPoint], float]] = {
    "fold": lambda point: float(point.tangent[-1]),
    "doubling": _doubling,
}


@dataclass(frozen=True, eq=False)
class LimitCycle:
    """A cycle of an autonomous system.

    Parameters
    ----------
    solution : BorderedSolution
        Its value is the period, s.
    orbit : Orbit
    period_theta : ndarray, shape (na,)
        Derivatives of the period by the active parameters; NaN where the solve failed.
    """

    solution: BorderedSolution
    orbit: Orbit
    period_theta: Float[Array, " active"]

    @property
    def own(self) -> complex:
        """The multiplier along the motion: one, but for the errors of the solution."""
        values = self.orbit.multipliers
        return complex(values[np.argmin(np.abs(values - 1.0))])

    @property
    def stable(self) -> bool:
        """Whether all multipliers but the motion's own lie inside the unit circle."""
        values = self.orbit.multipliers
        others = np.delete(values, np.argmin(np.abs(values - 1.0)))
        return self.orbit.status.solved and bool(np.all(np.abs(others) < 1.0))

    def __repr__(self) -> str:
        status = self.orbit.status
        if not status.solved:
            return f"limit cycle, {status.name.lower().replace('_', ' ')}"
        kind = "stable" if self.stable else "unstable"
        return f"{kind} limit cycle of period {self.solution.value:.8g} s"


def solve_limit_cycle(problem: Boundary, p: Array, x: Array, period: float) -> LimitCycle:
    """Solve for a cycle and its period.

    Parameters
    ----------
    problem : Boundary
        With constant inputs; its own period does not count.
    p : ndarray, shape (np,)
        Constants.
    x : ndarray, shape (n, w)
        Where the scheme's unknowns start: a motion near the cycle. At a rest position the condition
        on the phase is void, and the status says that it is singular.
    period : float
        Where the period starts, s.

    Returns
    -------
    LimitCycle
        Without an estimate of its error; see :func:`with_error`.
    """

    def family(value: float) -> tuple[Boundary, Array]:
        return replace(problem, period=value), p

    D, method = problem.scheme.state_size, problem.scheme
    plan = method.plan(np.zeros(1), len(x))
    rows = method.sample(x[None, :, :, None], plan, period / len(x))[0, :, 0, 0]
    first = np.cumsum([0, *(order + 1 for order in method.orders)])
    moving = rows[[first[j] + k + 1 for j, o in enumerate(method.orders) for k in range(o)]]
    condition = PhaseCondition(np.append(moving, 0.0), float(moving @ x[0, :D]))
    solution = solve_bordered(family, x, period, condition)
    orbit = Orbit(
        phases=np.arange(len(x)) / len(x),
        states=solution.x[:, :D],
        period=solution.value,
        monodromy=solution.monodromy,
        status=Status.NO_ERROR_ESTIMATE if solution.status.ok else solution.status,
        error=np.nan,
        evaluations=4 * solution.iterations * problem.inputs.shape[1],
    )
    return LimitCycle(solution, orbit, _period_theta(family, solution, condition))


def with_error(cycle: LimitCycle, problem: Boundary, finer: LimitCycle) -> LimitCycle:
    """A cycle with its error, by the same cycle on steps half as long.

    Parameters
    ----------
    cycle : LimitCycle
        Of :func:`solve_limit_cycle`.
    problem : Boundary
        As solved.
    finer : LimitCycle
        On twice as many steps of equal length, started from it.

    Returns
    -------
    LimitCycle
        Its error is the larger of those of a state over its swing and of the period over itself.
        Where the finer one failed there is none, as its status says.
    """
    if not (cycle.solution.status.ok and finer.solution.status.ok):
        return cycle
    scheme, x, states = problem.scheme, cycle.solution.x, finer.orbit.states
    plan, step = scheme.plan(finer.orbit.phases, len(x)), cycle.solution.value / len(x)
    rows = scheme.sample(x[None, :, :, None], plan, step)[0, :, 0]
    first = np.cumsum([0, *(order + 1 for order in scheme.orders)])
    kept = [int(first[j]) + k for j, o in enumerate(scheme.orders) for k in range(o)]
    swing = np.maximum(np.ptp(states, axis=0), 1e-300)
    away = float((np.abs(rows[kept].T - states).max(axis=0) / swing).max())
    late = abs(finer.solution.value / cycle.solution.value - 1.0)
    orbit = replace(cycle.orbit, status=Status.CONVERGED, error=max(away, late))
    return replace(cycle, orbit=orbit)


def _period_theta(family: Family, solution: BorderedSolution, condition: PhaseCondition) -> Array:
    problem, p = family(solution.value)
    if not solution.status.ok:
        return np.full(problem.active, np.nan)
    method, x = problem.scheme, solution.x
    D, d, points, step = (
        method.state_size,
        len(method.orders),
        problem.inputs.shape[1],
        problem.step(len(x)),
    )
    z, g = np.zeros((1, D + d, points)), np.zeros((1, d, points))
    gz, gp = np.zeros((1, d, D + d, points)), np.zeros((1, d, problem.active, points))
    method.rows(x[None], _LANE, step, z)
    problem.equations.jacobian(z, problem.inputs, p[None], _LANE, g, gz)
    problem.equations.parameters(z, problem.inputs, p[None], _LANE, gp)
    dx, _, _ = method.linear(gz, gp, None, _LANE, step, initial=True)
    border = np.block(
        [[np.eye(D) - solution.monodromy, -solution.by_value[:, None]], [condition.row[None]]]
    )
    right = np.concatenate([end_states(problem, dx[0]), np.zeros((1, problem.active))])
    return cast(Array, np.linalg.solve(border, right)[D])
