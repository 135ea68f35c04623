"""Starts of solutions: first guesses, initial states of transients, and anchors.

A first guess takes a dof from its measurement where it is measured, and from its declaration
otherwise.

The initial state of a transient depends on three kinds of symbols: constants of the run, channels
as measured at the first sample, and the equilibrium. The equilibrium solves the equations of the
dofs that use it with all rates zero; its derivatives follow by the implicit function theorem.

Anchors are known solutions with derivatives, from which solutions at other parameters start. An
anchor that is fixed before sampling makes a solution a function of its own parameters alone. It
also detects a change of branch: the linear prediction from which a solve starts then errs by more
than the distance moved.

Where Newton's method does not converge from a guess, the anchor comes from a motion that an
integrator found. Steep friction gives Newton's method on a mesh little information until it knows
where the motion sticks; an integrator finds this as it proceeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import cast

import numpy as np
import sympy as sp

from bayesoleo._compiled import inner, jit
from bayesoleo._types import Array, Flags, Float, Int, Integers
from bayesoleo.errors import ModelError
from bayesoleo.model._derivatives import Derived
from bayesoleo.model._drive_and_start import EQUILIBRIUM, START, START_RATE, start_of
from bayesoleo.model._expressions import (
    derivative_symbol,
    parse,
    split_derivative,
    symbol,
    total_derivative,
)
from bayesoleo.model._kernels import Kernels
from bayesoleo.model._model import Model
from bayesoleo.prediction._inputs import dynamics_of, harmonics_of, input_rows, signal_of
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._stability import compared, count_unstable, is_jump, jumps, swings
from bayesoleo.solvers._elimination import eliminate
from bayesoleo.solvers._orbit import Status, floquet_multipliers
from bayesoleo.solvers._periodic import Boundary, Solution, solve_periodic
from bayesoleo.solvers._periodic_newton import Extrapolation
from bayesoleo.solvers._radau_step import Workspace, evaluate_kernel, workspace
from bayesoleo.solvers._shooting import solve_shooting

#: Known motion of a dof: its values and derivatives, shape (rows, N), at phases in cycles.
Motion = Callable[[Array], Array]
#: Rows of channels at fixed phases, by channel and derivative: they depend on no parameter.
KnownRows = dict[tuple[str, int], Array]
MAXIMUM_ITERATIONS, MAXIMUM_HALVINGS = 60, 30
#: A Newton step this small, over the state's size, leaves round-off only.
SMALL_STEP = 1e-12
#: Evaluations by calls back into Python, where kernels are not compiled; then they are.
CALLED_BACK = 60
#: As compiled code returns them.
UNFINISHED = -1
CONVERGED, NOT_FINITE = Status.CONVERGED.value, Status.NOT_FINITE.value
SINGULAR, NO_CONVERGENCE = Status.SINGULAR.value, Status.NO_CONVERGENCE.value


def guess_rows(
    model: Model,
    derived: Derived,
    record: Record,
    constants: Mapping[str, float],
    phase: Array,
    motions: Mapping[str, Motion] | None = None,
    known_rows: KnownRows | None = None,
) -> Array:
    """Values and derivatives of every dof, shape (nz, N): known motions before guesses.

    With ``known_rows``, of the same record and phases, channels are evaluated once only.
    """
    found = guesses_of(model, derived, record, [constants], phase, motions, known_rows)
    return cast(Array, found[0])


def guesses_of(
    model: Model,
    derived: Derived,
    record: Record,
    constants: Sequence[Mapping[str, float]],
    phase: Array,
    motions: Mapping[str, Motion] | None = None,
    known_rows: KnownRows | None = None,
) -> Array:
    """The same for sets of constants, shape (L, nz, N); known motions are evaluated once."""
    rows: list[Array] = []
    for dof, order in zip(derived.dofs, derived.orders, strict=True):
        if motions is not None and dof in motions:
            known = motions[dof](phase)
            if known.shape[0] == order + 1:
                rows.extend(np.broadcast_to(row, (len(constants), phase.size)) for row in known)
                continue
        expression = _measured_motion(model, dof, record) or _declared(model, dof)
        for _ in range(order + 1):
            each = [_evaluate(expression, record, one, phase, known_rows) for one in constants]
            rows.append(np.stack(each))
            expression = total_derivative(expression, list(record.harmonics))
    return np.stack(rows, axis=1) if rows else np.empty((len(constants), 0, phase.size))


def _measured_motion(model: Model, dof: str, record: Record) -> sp.Expr | None:
    """The channel that measures a dof directly, if there is one."""
    for channel in model.outputs:
        if model.output(channel) == symbol(dof) and channel in record.harmonics:
            return symbol(channel)
    return None


def _declared(model: Model, dof: str) -> sp.Expr:
    known = {name: symbol(name) for name in (*model.parameters, *model.conditions, *model.inputs)}
    return parse(
        model.dofs[dof].guess, known, model.inputs, f"model {model.name!r}, guess of {dof!r}"
    )


def _evaluate(
    expression: sp.Expr,
    record: Record,
    constants: Mapping[str, float],
    phase: Array,
    known_rows: KnownRows | None,
) -> Array:
    function, items = _compiled(expression)
    found: KnownRows = {} if known_rows is None else known_rows
    columns = []
    for item in items:
        channel, order = split_derivative(item)
        if channel in record.harmonics:
            assert item == derivative_symbol(channel, order)
            if (channel, order) not in found:
                item = harmonics_of(record, channel).for_derivative(order)
                found[channel, order] = item.evaluate(phase, record.frequency, order)
            columns.append(found[channel, order])
        else:
            columns.append(np.asarray(constants[channel]))
    return cast(Array, np.zeros(phase.size) + np.asarray(function(*columns), dtype=float))


@lru_cache(maxsize=256)
def _compiled(expression: sp.Expr) -> tuple[Callable[..., Array], tuple[sp.Symbol, ...]]:
    """A guess as a function of its symbols: the same for every run, and slow to make."""
    items = tuple(sorted(expression.free_symbols, key=str))
    return sp.lambdify(items, expression, "numpy"), items


@dataclass(frozen=True)
class StartStates:
    """Initial states of many parameter vectors.

    Parameters
    ----------
    state : ndarray, shape (L, D)
        Value of each dof, and velocity of one of second order.
    by_parameter : ndarray, shape (L, D, na)
        Its derivatives.
    status : ndarray of int, shape (L,)
        Values of :class:`~bayesoleo.solvers.Status`.
    """

    state: Float[Array, "vectors states"]
    by_parameter: Float[Array, "vectors states active"]
    status: Int[Integers, " vectors"]


class InitialState:
    """Initial states of one run.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    kernels : Kernels
        Of that model.
    record : Record
        A transient run.
    """

    def __init__(self, model: Model, kernels: Kernels, record: Record):
        self.kernels, derived = kernels, kernels.derived
        self.record = record
        self.inputs = input_rows(record, derived.inputs, np.zeros(1))
        starts = [start_of(model, dof) for dof in derived.dofs]
        channels = {*model.inputs, *model.outputs} - {*model.parameters, *model.conditions}
        self.resting = np.array([start.from_rest for start in starts], dtype=bool)
        self.first = np.cumsum([0, *(order + 1 for order in derived.orders)])[:-1]
        self.rows = np.array(
            [self.first[j] + k for j, order in enumerate(derived.orders) for k in range(order)],
            dtype=np.int64,
        )
        expressions = [
            start.rate if k else start.value
            for start, order in zip(starts, derived.orders, strict=True)
            for k in range(order)
        ]
        self.declared = expressions
        self.channels = frozenset(channels)
        guesses = [_guess(model, dof) for dof in derived.dofs]
        self._values, self._guesses = (
            _table(
                tuple(_measured(one, record, channels) for one in some),
                tuple(derived.constants),
                tuple(derived.active),
            )
            for some in (expressions, guesses)
        )

    def __call__(self, p: Array) -> StartStates:
        """States and derivatives for constants ``p (L, np)``; each lane by itself."""
        lanes, derived = p.shape[0], self.kernels.derived
        status = np.zeros(lanes, dtype=np.int64)
        rest = np.zeros((lanes, len(derived.dofs)))
        rest_p = np.zeros((lanes, len(derived.dofs), len(derived.active)))
        if self.resting.any():
            rest, rest_p, status = self._equilibrium(p)
        owner = np.repeat(np.arange(len(derived.orders)), derived.orders)
        state, state_p, slope = self._values(p, rest[:, owner])
        state_p = state_p + slope[:, :, None] * rest_p[:, owner]
        bad = ~np.isfinite(state).all(axis=1) | ~np.isfinite(state_p).all(axis=(1, 2))
        status[bad & (status == Status.CONVERGED.value)] = Status.NOT_FINITE.value
        return StartStates(state, state_p, status)

    def states(self, p: Array) -> tuple[Array, Integers]:
        """States (L, D) and statuses (L,) without derivatives: of an equilibrium these take as long
        as itself."""
        status = np.zeros(p.shape[0], dtype=np.int64)
        rest = np.zeros((p.shape[0], len(self.resting)))
        if self.resting.any():
            z, _, _, status = self._at_rest(p)
            rest = z[:, self.first, 0]
        owner = np.repeat(np.arange(len(self.resting)), self.kernels.derived.orders)
        state = self._values(p, rest[:, owner])[0]
        bad = ~np.isfinite(state).all(axis=1)
        status[bad & (status == Status.CONVERGED.value)] = Status.NOT_FINITE.value
        return state, status

    def measured(self) -> list[tuple[str, int, sp.Symbol]]:
        """Channels that a start is read from, with the order of the derivative, where the start is
        not estimated."""
        found: dict[str, tuple[str, int, sp.Symbol]] = {}
        for expression in self.declared:
            for item in () if self._estimated(expression) else expression.free_symbols:
                channel, order = split_derivative(item)
                if channel in self.channels:
                    found[str(item)] = channel, order, item
        return [found[name] for name in sorted(found)]

    def _estimated(self, expression: sp.Expr) -> bool:
        """Whether an estimate corrects what the channel shows."""
        dofs = self.kernels.derived.dofs
        own = {symbol(begin + dof) for begin in (START, START_RATE) for dof in dofs}
        return bool(own & expression.free_symbols)

    def by_measured(self, p: Array) -> Array:
        """Derivatives of the initial state by :meth:`measured`, shape (D, m), at constants ``p``
        of shape (np,)."""
        rest = np.zeros((1, len(self.resting)))
        if self.resting.any():
            rest, _, _ = self._equilibrium(p[None])
        owner = np.repeat(np.arange(len(self.resting)), self.kernels.derived.orders)
        constants = dict(zip(self.kernels.derived.constants, p, strict=True))
        items = self.measured()
        found = np.zeros((len(self.declared), len(items)))
        for row, (expression, dof) in enumerate(zip(self.declared, owner, strict=True)):
            for k, (_, _, item) in enumerate([] if self._estimated(expression) else items):
                slope = _measured(sp.diff(expression, item), self.record, set(self.channels))
                values = {symbol(name): constants[name] for name in constants}
                values[symbol(EQUILIBRIUM)] = rest[0, dof]
                found[row, k] = float(slope.xreplace(values))
        return found

    def _equilibrium(self, p: Array) -> tuple[Array, Array, Integers]:
        """Rest positions ``(L, d)`` of the dofs that ask for them, with derivatives."""
        derived, lanes = self.kernels.derived, np.arange(p.shape[0])
        nz, d = len(derived.states), len(derived.dofs)
        z, z_p, silent, status = self._at_rest(p)
        own, values = np.flatnonzero(self.resting), self.first[self.resting]
        g, gz = np.zeros((p.shape[0], d, 1)), np.zeros((p.shape[0], d, nz, 1))
        gp = np.zeros((p.shape[0], d, len(derived.active), 1))
        with np.errstate(all="ignore"):
            self._evaluate(z, p, lanes, g, gz)
            self.kernels.parameters(z, self.inputs, p, lanes, gp)
        for lane in lanes[status == Status.CONVERGED.value]:
            free = ~silent[lane]
            rows, columns = own[free], values[free]
            kept = z_p[lane].copy()
            kept[columns] = 0.0
            right = gp[lane, rows, :, 0] + gz[lane, rows, :, 0] @ kept
            matrix = gz[lane][np.ix_(rows, columns)][:, :, 0]
            z_p[lane, columns] = -np.linalg.solve(matrix, right)
        return z[:, self.first, 0], z_p[:, self.first], status

    def _at_rest(self, p: Array) -> tuple[Array, Array, Flags, Integers]:
        """Rows ``(L, nz, 1)`` at rest, by damped Newton steps; derivatives ``(L, nz, na)`` of where
        those began, dofs that nothing moves ``(L, resting)``, and statuses."""
        derived, lanes = self.kernels.derived, np.arange(p.shape[0])
        nz, d, moving = len(derived.states), len(derived.dofs), ~self.resting
        nothing = np.zeros((p.shape[0], d))
        guess, guess_p, _ = self._guesses(p, nothing)
        known, known_p, _ = self._values(p, np.zeros((p.shape[0], self.rows.size)))
        z, z_p = np.zeros((p.shape[0], nz, 1)), np.zeros((p.shape[0], nz, len(derived.active)))
        owner = np.repeat(np.arange(d), derived.orders)
        given = self.rows[moving[owner]]
        z[:, given, 0], z_p[:, given] = known[:, moving[owner]], known_p[:, moving[owner]]
        values = self.first[self.resting]
        z[:, values, 0], z_p[:, values] = guess[:, self.resting], guess_p[:, self.resting]
        g, gz = np.zeros((p.shape[0], d, 1)), np.zeros((p.shape[0], d, nz, 1))
        self._evaluate(z, p, lanes, g, gz)
        # An equation that holds wherever the dofs are (a memory at rest) says nothing: its dof
        # stays at its guess.
        own = np.flatnonzero(self.resting)
        silent = (np.abs(gz[:, own][:, :, values, 0]).max(axis=2, initial=0.0) == 0.0) & (
            g[:, own, 0] == 0.0
        )
        status = np.full(p.shape[0], Status.NO_CONVERGENCE.value, dtype=np.int64)
        for lane in lanes:
            free = ~silent[lane]
            status[lane] = self._solve(z[lane, :, 0], p[lane], own[free], values[free])
        return z, z_p, silent, status

    def _evaluate(self, z: Array, p: Array, lanes: Integers, g: Array, gz: Array) -> None:
        with np.errstate(all="ignore"):
            self.kernels.jacobian(z, self.inputs, p, lanes, g, gz)

    def _solve(self, z: Array, p: Array, rows: Integers, columns: Integers) -> int:
        """Newton's method on the static equations at one lane's ``z (nz,)``, in place."""
        kernels, conditions = self.kernels, len(self.kernels.derived.admissible)
        jacobian, admissible = kernels.jacobian, kernels.admissible
        work = workspace(1, kernels.derived.orders, self.inputs.shape[0], 0, conditions, 0)
        work.u[: self.inputs.shape[0], 0] = self.inputs[:, 0]
        for most in (CALLED_BACK, MAXIMUM_ITERATIONS * MAXIMUM_HALVINGS):
            where = admissible.address if conditions else 0
            status = int(
                _rest(jacobian.address, where, conditions, most, z, p, rows, columns, work)
            )
            if status != UNFINISHED:
                return status
            jacobian, admissible = jacobian.compiled, admissible.compiled
        return NO_CONVERGENCE


@jit
def _rest(
    jacobian: int, admissible: int, conditions: int, most: int, z: Array, p: Array, rows: Integers,
    columns: Integers, work: Workspace,
) -> int:  # fmt: skip
    """Zeros of the equations ``rows`` by the entries ``columns`` of ``z (nz,)``.

    Returns a status, or ``UNFINISHED`` after ``most`` evaluations.
    """
    nz, m = z.size, rows.size
    d = work.small.shape[0]
    base, step, unit = np.empty(m), np.empty((m, 1)), np.empty(m)
    matrix = np.empty((m, m))
    for k in range(nz):
        work.z[k, 0] = z[k]
    evaluate_kernel(jacobian, work.z, work.u, p, work.g, 1)
    for _ in range(MAXIMUM_ITERATIONS):
        for i in range(m):
            step[i, 0] = -work.g[rows[i], 0]
            for j in range(m):
                matrix[i, j] = work.g[d + rows[i] * nz + columns[j], 0]
                if not (np.isfinite(matrix[i, j]) and np.isfinite(step[i, 0])):
                    return NOT_FINITE
        if not eliminate(matrix, step, 1e-300):
            return SINGULAR
        small, near, before = True, True, 0.0
        for i in range(m):
            base[i] = work.z[columns[i], 0]
            size = abs(base[i]) + abs(step[i, 0])
            small = small and abs(step[i, 0]) <= SMALL_STEP * size
            near = near and abs(step[i, 0]) <= 1e-7 * size
            unit[i] = abs(work.g[rows[i], 0]) + 1e-300
            for k in range(nz):
                unit[i] += abs(work.g[d + rows[i] * nz + k, 0] * work.z[k, 0])
            before += (work.g[rows[i], 0] / unit[i]) ** 2
        if small:
            break
        fraction, taken = 1.0, False
        for _ in range(MAXIMUM_HALVINGS):
            most -= 1
            if most < 0:
                return UNFINISHED
            for i in range(m):
                work.z[columns[i], 0] = base[i] + fraction * step[i, 0]
            evaluate_kernel(jacobian, work.z, work.u, p, work.g, 1)
            after, felt = 0.0, True
            for i in range(m):
                after += (work.g[rows[i], 0] / unit[i]) ** 2
                # Where nothing answers to a dof, such as below the bottom of a tank, no further
                # step would lead away.
                answer = 0.0
                for e in range(m):
                    answer += abs(work.g[d + rows[e] * nz + columns[i], 0])
                felt = felt and answer > 0.0
            if felt and (after < before or before < 1e-24):
                taken = _is_inside(admissible, conditions, p, work)
            if taken:
                break
            fraction *= 0.5
        if not taken and not near:
            return NO_CONVERGENCE
        if not taken:
            # Round-off keeps the residual from falling where the step is as small as that.
            break
    else:
        return NO_CONVERGENCE
    for k in range(nz):
        z[k] = work.z[k, 0]
    return CONVERGED


@inner
def _is_inside(admissible: int, conditions: int, p: Array, work: Workspace) -> bool:
    """Whether one point lies in the admissible region."""
    if conditions > 0:
        evaluate_kernel(admissible, work.z, work.u, p, work.a, 1)
    for k in range(conditions):  # noqa: SIM110 - Numba compiles no generator
        if not work.a[k, 0] > 0.0:
            return False
    return True


@lru_cache(maxsize=1_000)
def _table(
    expressions: tuple[sp.Expr, ...], constants: tuple[str, ...], active: tuple[str, ...]
) -> _Table:
    """Candidates of a search start alike: what is compiled for one serves the others."""
    return _Table(expressions, constants, active)


class _Table:
    """Expressions over a model's constants and the equilibrium, with their derivatives."""

    def __init__(
        self, expressions: tuple[sp.Expr, ...], constants: Sequence[str], active: Sequence[str]
    ):
        names, rest = [symbol(name) for name in constants], symbol(EQUILIBRIUM)
        self.count, self.active = len(expressions), len(active)
        flat: list[sp.Expr] = []
        for expression in expressions:
            flat += [expression, sp.diff(expression, rest)]
            flat += [sp.diff(expression, symbol(name)) for name in active]
        used = set().union(*(e.free_symbols for e in flat)) if flat else set()
        self.alike = rest not in used
        self.used = [k for k, item in enumerate(names) if item in used]
        self.function = sp.lambdify([*(names[k] for k in self.used), rest], flat, "numpy")

    def __call__(self, p: Array, rest: Array) -> tuple[Array, Array, Array]:
        """Values ``(L, k)``, derivatives ``(L, k, na)`` and slopes by the equilibrium ``(L, k)``.

        Lane by lane: a library's loop over an array may round by its place in it.
        """
        table = np.zeros((p.shape[0], self.count, 2 + self.active))
        with np.errstate(all="ignore"):
            for lane in range(p.shape[0]):
                row: list[float] = []
                for k in range(self.count):
                    if not (row and self.alike):
                        row = self.function(*p[lane, self.used], rest[lane, k])
                    size = 2 + self.active
                    table[lane, k] = row[k * size : (k + 1) * size]
        return table[:, :, 0], table[:, :, 2:], table[:, :, 1]


def _measured(expression: sp.Expr, record: Record, channels: set[str]) -> sp.Expr:
    """Put in what channels show at the first sample."""
    values = {}
    for item in expression.free_symbols:
        channel, order = split_derivative(item)
        if channel in channels:
            # One sample is no start: its noise is taken off as for a derivative.
            signal = signal_of(record, channel, max(order, 1))
            values[item] = float(signal.evaluate(np.zeros(1), record.rate, order)[0])
    return expression.xreplace({item: sp.Float(value) for item, value in values.items()})


def _guess(model: Model, dof: str) -> sp.Expr:
    known = (*model.parameters, *model.conditions, *model.inputs)
    where = f"model {model.name!r}, guess of {dof!r}"
    return parse(model.dofs[dof].guess, {name: symbol(name) for name in known}, model.inputs, where)


#: A start extrapolated too far is retried along a path of this many pieces.
PATH_PIECES = (4, 16)
#: Longest and shortest step, in parts of the way, of a walk that looks for a jump: the shortest
#: passes a resonance of a few hundred times the static answer, not a fold.
LONGEST, SHORTEST = 0.25, 1 / 512
#: Two solutions of the same equations are one if they differ by less of the swing: Newton's method
#: leaves far less, other branches far more.
SAME = 1e-3
#: A start needs no more than the first; where that is too coarse for shooting to close, the second.
TOLERANCES = (1e-6, 1e-8)


@dataclass(frozen=True)
class Anchor:
    """A solution with derivatives: others start at ``x + x_p (p - p0)``.

    Parameters
    ----------
    p : ndarray, shape (np,)
        Constants.
    x : ndarray, shape (n, w)
        The scheme's unknowns.
    x_p : ndarray, shape (na, n, w)
        Their derivatives by the active parameters.
    monodromy : ndarray, shape (D, D), or None
        Of a periodic solution; None for a transient.
    jumped : bool
        Whether it left the branch of the anchor before it, or changed its stability.
    changed : bool
        Whether it did the latter only.
    """

    p: Float[Array, " constants"]
    x: Float[Array, "steps width"]
    x_p: Float[Array, "active steps width"]
    monodromy: Float[Array, "states states"] | None = None
    jumped: bool = False
    changed: bool = False

    def predict(self, change: Array) -> Array:
        """Starts, shape (L, n, w), at changes of the active parameters, shape (L, na)."""
        return self.extrapolation.starts(change)

    @cached_property
    def extrapolation(self) -> Extrapolation:
        """Extrapolation from which solutions at other parameters start."""
        return Extrapolation(self.x, self.x_p)

    @cached_property
    def unstable(self) -> int:
        """Number of Floquet multipliers outside the unit circle, -1 where they are not known."""
        if self.monodromy is None:
            return -1
        return int(count_unstable(floquet_multipliers(self.monodromy)))

    def left_by(self, change: Array, x: Array) -> Flags:
        """Whether solutions ``x (L, n, w)`` at changes ``(L, na)`` of the active parameters lie
        farther from their prediction than that moved, and than a tenth of the swing.
        """
        found = np.zeros(x.shape[0], dtype=np.bool_)
        swing, nodes = self.scale
        jumps(self.x, self.x_p, swing, nodes, change, x, found)
        return found

    @cached_property
    def scale(self) -> tuple[Array, Integers]:
        """Swing of each state, shape (D,), and the nodes at which motions are compared."""
        states = self.x.shape[1] if self.monodromy is None else len(self.monodromy)
        return swings(self.x, min(states, self.x.shape[1])), compared(len(self.x))

    def after(self, old: Anchor | None, boundary: Boundary, active: Integers) -> Anchor:
        """The same, knowing whether it is on the branch of the anchor before it."""
        if old is None:
            return self
        far = old.left_by((self.p - old.p)[active][None], self.x[None])[0]
        left = far and not old.leads_to(self.p, self.x, boundary, active)
        changed = not left and old.unstable != self.unstable
        return replace(self, jumped=bool(left or changed), changed=changed)

    def leads_to(self, p: Array, x: Array, boundary: Boundary, active: Integers) -> bool:
        """Whether small steps from here to constants ``p (np,)`` arrive at a solution ``x (n, w)``.

        A linear prediction fails over a long way too; another branch is where no path leads.
        """
        end = self._walked(p, boundary, active)
        if end is None:
            return False
        swing = self.scale[0]
        return bool(np.all(np.abs(end - x)[:, : swing.size] <= SAME * swing))

    def _walked(self, p: Array, boundary: Boundary, active: Integers) -> Array | None:
        """Where a path of steps, each predicted by the last, ends; None where it has an end of its
        own.
        """
        nodes, states = self.scale[1], self.scale[0].size
        here, slope = self.x, np.tensordot((p - self.p)[active], self.x_p, 1)
        place, step = 0.0, LONGEST
        while place < 1.0:
            length = min(step, 1.0 - place)
            ahead = here + length * slope
            now = (self.p + (place + length) * (p - self.p))[None]
            trial = solve_periodic(boundary, now, ahead[None], max_iterations=15)
            lost = trial.status[0] != Status.CONVERGED.value
            if lost or is_jump(here, ahead, trial.x[0], swings(here, states), nodes):
                step = length / 2
                if step < SHORTEST:
                    return None
                continue
            here, slope = trial.x[0], (trial.x[0] - here) / length
            place, step = place + length, min(2 * length, LONGEST)
        return here


def solve_from_shot(
    model: Model,
    kernels: Kernels,
    record: Record,
    boundary: Boundary,
    p: Array,
    guess: Array,
) -> Solution | None:
    """Solve one lane from the orbit of shooting.

    Parameters
    ----------
    model, kernels, record : Model, Kernels and Record
        Of the run.
    boundary : Boundary
        Its equations on a mesh.
    p : ndarray, shape (np,)
        Constants.
    guess : ndarray, shape (1, n, w)
        Unknowns, of which shooting takes the first state.

    Returns
    -------
    Solution or None
        None where shooting finds nothing either, or cannot integrate the model.
    """
    scheme, n = boundary.scheme, guess.shape[1]
    nodes, points = np.arange(n) / n, scheme.phases(n)
    rows = scheme.sample(guess[..., None], scheme.plan(np.zeros(1), n), boundary.step(n))
    first = np.cumsum([0, *(order + 1 for order in scheme.orders)])
    states = [int(first[j]) + k for j, order in enumerate(scheme.orders) for k in range(order)]
    try:
        # Compiled whatever the mesh is solved with: that takes a second or two, and an integrator
        # that calls NumPy's kernels back step by step takes minutes to fail.
        dynamics = dynamics_of(model, record, kernels.derived.active, "numba", exact=False)
    except ModelError:
        return None
    begin = np.ascontiguousarray(rows[0, states, 0, 0])
    for tolerance in TOLERANCES:
        shot = solve_shooting(
            dynamics, p, boundary.period, begin, tolerance=tolerance, sensitivities=False
        )
        if shot.status is Status.CONVERGED:
            start = scheme.from_motion(shot.sample(nodes)[None], shot.sample(points)[None])
            return solve_periodic(boundary, p[None], start)
    return None
