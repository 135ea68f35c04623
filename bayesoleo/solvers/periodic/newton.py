"""Newton's method on one period, compiled: the same iteration as in ``periodic``, with everything a
lane needs in the processor's cache.

Models and schemes come as compiled pieces of fixed signature (``bayesoleo.compiled`` and
``solvers.schemes.unrolled``), so this is compiled once. Steps are kept in the order in which they
are swept: :data:`~bayesoleo.solvers.schemes.unrolled.WIDTH` chunks side by side, with as many rows
before and after them as a scheme looks at; chunks that are a step shorter are filled up with the
first step of the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import carray
from numpy.typing import NDArray

from bayesoleo.compiled import BLOCK, call_kernel, caller, pointer
from bayesoleo.solvers.periodic.measures import total, unit
from bayesoleo.solvers.schemes.sweep import LARGEST_GROWTH, ROUND_OFF, eliminate, jit
from bayesoleo.solvers.schemes.unrolled import REACH, SIGNATURES, WIDTH, Program, chunks
from bayesoleo.solvers.status import Status

Array = NDArray[np.float64]
Lanes = NDArray[np.int64]

#: A pivot that asks for an exchange of rows, or a recursion that grows so much that its rounding
#: errors would spoil the closure: neither is a failure of the problem, only of this elimination.
NEEDS_EXCHANGE = -1

CONVERGED = Status.CONVERGED.value
INADMISSIBLE = Status.INADMISSIBLE.value
NO_CONVERGENCE = Status.NO_CONVERGENCE.value
SINGULAR = Status.SINGULAR.value
NOT_FINITE = Status.NOT_FINITE.value

#: Newton's error after a step is about the step squared: a relative step of 1e-7 that is still
#: contracting leaves 1e-14. Steep friction contracts slower at first: no guess of the next step
#: from the last two is safe.
LAST_STEP = 1e-7
#: The same without quadratic contraction (at a kink), where a small step is all there is to see.
SMALL_STEP = 1e-11
MAXIMUM_HALVINGS = 12
#: Relative step from which on steps can be taken for those of a contraction.
CHORD_FROM = 0.1
#: Steps with old derivatives, half as expensive, before there are new ones.
MOST_CHORDS = 2
#: Contraction that is none.
SLOW_CHORD = 0.1
#: What the steps that are not taken would add up to.
CHORD_LEFT = 1e-14
#: At least as many as a state has components.
COLUMNS = 8
WITHOUT_SIGN = np.int64(2**63 - 1)
#: Fewer steps than that leave chunks empty.
LEAST_STEPS = WIDTH


class Sizes(NamedTuple):
    """Numbers that a compiled lane needs; most are those of the scheme's program."""

    steps: int
    rows: int
    inputs: int
    constants: int
    nz: int
    d: int
    conditions: int
    unknowns: int
    state: int
    new: int
    window: int
    front: int
    stages: int
    block: int
    transfer: int
    measured: int


@dataclass(frozen=True)
class Layout:
    """Where the steps of a period stand while they are swept.

    Parameters
    ----------
    place : ndarray of int, shape (n,)
        Position of each step, in rows of ``WIDTH`` chunks, rows before the first included.
    source : ndarray of int, shape (positions,)
        Step that stands at each position; steps stand more than once.
    lengths : ndarray of int, shape (WIDTH,)
        Of the chunks.
    """

    place: NDArray[np.int64]
    source: NDArray[np.int64]
    lengths: NDArray[np.int64]

    @staticmethod
    def of(n: int, front: int, block: int) -> Layout:
        """Of a period of ``n`` steps in blocks of ``block``, with ``front`` rows before it."""
        lengths = chunks(n)
        first = np.concatenate(([0], np.cumsum(lengths)[:-1]))
        rows = int(lengths[0])
        whole = -(-rows * WIDTH // block) * block // WIDTH
        t = np.arange(-front, whole + 1)  # the last block, and what its last row looks at
        source = (first + t[:, None]) % n
        place = np.empty(n, dtype=np.int64)
        for c in range(WIDTH):
            own = np.arange(lengths[c])
            place[first[c] + own] = (front + own) * WIDTH + c
        return Layout(place, source.ravel(), lengths)


class Pieces(NamedTuple):
    """Addresses of the compiled functions of a model and of a scheme."""

    residual: int
    jacobian: int
    admissible: int
    rows: int
    eliminate: int
    chain: int
    substitute: int
    follow: int
    update: int


_call_rows, _call_chain = caller(SIGNATURES["rows"]), caller(SIGNATURES["chain"])
_call_eliminate = caller(SIGNATURES["eliminate"])
_call_substitute, _call_follow = caller(SIGNATURES["substitute"]), caller(SIGNATURES["follow"])
_call_update = caller(SIGNATURES["update"])


class Sweep(NamedTuple):
    """Order of the steps, inputs and lengths of steps, as they are swept."""

    place: Any
    source: Any
    lengths: Any
    order: Any
    inputs: Any
    h: Any


class Work(NamedTuple):
    """Arrays of one lane at a time, allocated once."""

    now: Any
    base: Any
    dx: Any
    x_block: Any
    dx_block: Any
    z: Any
    out: Any
    sums: Any
    scratch: Any
    transfer: Any
    history: Any
    start: Any
    products: Any
    inverse: Any
    measures: Any
    before: Any
    constants: Any


def work_space(sizes: Sizes, sweep: Sweep) -> Work:
    """Arrays for lanes of given sizes."""
    positions, w, D, d = sweep.source.size, sizes.unknowns, sizes.state, sizes.d
    rows = max(d * (1 + sizes.nz), sizes.conditions)
    blocks = sweep.inputs.shape[0]
    length = (blocks * sizes.block // WIDTH + 1) * sizes.new + sizes.window
    history = np.zeros((length, D + 1, WIDTH))
    history[sweep.order, np.arange(D)] = 1.0  # a chunk's first state, in terms of itself
    return Work(
        now=np.empty((w, positions)),
        base=np.empty((w, positions)),
        dx=np.zeros((w, positions)),
        x_block=np.zeros((w, REACH)),
        dx_block=np.zeros((w, BLOCK)),
        z=np.zeros((sizes.nz, BLOCK)),
        out=np.zeros((rows, BLOCK)),
        sums=np.zeros((2 * d, BLOCK)),
        scratch=np.zeros(positions),
        transfer=np.zeros((blocks, sizes.transfer * sizes.block)),
        history=history,
        start=np.zeros((D, WIDTH)),
        products=np.zeros((2, D, COLUMNS)),
        inverse=np.zeros((D, D)),
        measures=np.zeros(2 * d),
        before=np.zeros(2 * d),
        constants=np.zeros(max(sizes.constants, 1)),
    )


class Options(NamedTuple):
    """How the iteration goes; see :func:`bayesoleo.solvers.periodic.solve.solve_periodic`."""

    max_iterations: int
    monotone: bool
    initial: bool


class Line(NamedTuple):
    """Where lanes start: ``base (w, positions)`` and ``change (L, na)`` times ``slopes (na, w,
    positions)``; empty where ``x`` says it."""

    base: Any
    slopes: Any
    change: Any


NO_LINE = Line(np.empty((0, 0)), np.empty((0, 0, 0)), np.empty((0, 0)))


@jit
def solve_lanes(pieces, sizes, sweep, work, options, p, x, line, status, iterations):
    """Newton's method for every lane of ``x (L, n, w)``, in place; see ``solve``."""
    now = work.now
    for lane in range(x.shape[0]):
        for k in range(sizes.constants):
            work.constants[k] = p[lane, k]
        if line.base.size > 0:
            _extrapolate(line, lane, now)
        else:
            for k in range(sizes.unknowns):
                for i in range(sweep.source.size):
                    now[k, i] = x[lane, sweep.source[i], k]
        status[lane], iterations[lane] = _iterate(pieces, sizes, sweep, work, options)
        if status[lane] != NEEDS_EXCHANGE:
            for m in range(sizes.steps):
                for k in range(sizes.unknowns):
                    x[lane, m, k] = now[k, sweep.place[m]]


@jit
def _extrapolate(line, lane, now):
    """``now = base + slopes change``, two slopes at a time."""
    size, count = now.size, line.change.shape[1]
    to, base = carray(pointer(now, 0), (size,)), carray(pointer(line.base, 0), (size,))
    for i in range(size):
        to[i] = base[i]
    for k in range(0, count - count % 2, 2):
        first, second = line.change[lane, k], line.change[lane, k + 1]
        a = carray(pointer(line.slopes, k * size), (size,))
        b = carray(pointer(line.slopes, (k + 1) * size), (size,))
        for i in range(size):
            to[i] += first * a[i] + second * b[i]
    for k in range(count - count % 2, count):
        first, a = line.change[lane, k], carray(pointer(line.slopes, k * size), (size,))
        for i in range(size):
            to[i] += first * a[i]


@jit
def _iterate(pieces, sizes, sweep, work, options):
    """Newton's method from ``work.now``; returns how it ended and the number of steps."""
    outcome, iteration = _evaluate(pieces, sizes, sweep, work), 0
    last, chords = np.inf, True
    while outcome == CONVERGED and iteration < options.max_iterations:
        iteration += 1
        outcome = _step(pieces, sizes, sweep, work, options.initial)
        if outcome != CONVERGED:
            return outcome, iteration
        size, least = _size(work.now, work.dx, sizes.front * WIDTH, sizes.measured, work.scratch)
        if not size < np.inf:
            return SINGULAR, iteration
        if least < SMALL_STEP or (size < 0.1 * last and size < LAST_STEP):
            _take(work.now, work.dx, 1.0, work.now)
            return CONVERGED, iteration
        if chords and last < CHORD_FROM and _chord_suffices(size, last):
            _keep(work.now, work.base)
            steps, last = _chords(pieces, sizes, sweep, work, options, size)
            iteration += steps
            if last == 0.0:
                return CONVERGED, iteration
            chords = last < size
            if not chords:
                _keep(work.base, work.now)
            outcome = _evaluate(pieces, sizes, sweep, work)
            continue
        outcome, fraction, merit = _advance(pieces, sizes, sweep, work, options.monotone, size)
        last = size if fraction == 1.0 else np.inf
        # A linear problem is solved by its first step.
        if outcome == CONVERGED and merit < 1e-14 and iteration > 1:
            return CONVERGED, iteration
    return (NO_CONVERGENCE if outcome == CONVERGED else outcome), iteration


@jit
def _chords(pieces, sizes, sweep, work, options, size):
    """Take the step, and further ones with the same derivatives and closure.

    Returns their number and the last one's size: zero where they converged, infinite where they did
    not contract.
    """
    last = size
    for count in range(1, MOST_CHORDS + 1):
        _take(work.now, work.dx, 1.0, work.now)
        if not _evaluate_again(pieces, sizes, sweep, work):
            return count, np.inf
        _start(sizes, sweep, work, options.initial)
        _update(pieces.update, sizes, sweep, work)
        size, least = _size(work.now, work.dx, sizes.front * WIDTH, sizes.measured, work.scratch)
        if not size < SLOW_CHORD * last:
            return count, np.inf
        # What is left is a geometric series, twice as steep as seen where the first of the two
        # steps was one of Newton's.
        if least < SMALL_STEP or 2.0 * size * size / last < CHORD_LEFT:
            _take(work.now, work.dx, 1.0, work.now)
            return count, 0.0
        last = size
    return MOST_CHORDS, last


@jit
def _chord_suffices(size, last):
    """Whether one more step with these derivatives leaves round-off, if Newton's error is squared:
    ``k size**2`` with ``k = size / last**2``, which old derivatives contract by ``2 k size``.
    """
    ratio = size / last
    return 2.0 * size * ratio**4 < CHORD_LEFT


@jit
def _advance(pieces, sizes, sweep, work, monotone, size):
    """Take the step, halved while it is inadmissible or does not reduce the residual; returns how
    that ended, the fraction taken and the residual's size after it."""
    _keep(work.now, work.base)
    _keep(work.measures, work.before)
    fraction, outcome = 1.0, CONVERGED
    for _ in range(MAXIMUM_HALVINGS):
        _take(work.base, work.dx, fraction, work.now)
        outcome = _evaluate(pieces, sizes, sweep, work)
        if outcome == NEEDS_EXCHANGE:
            return outcome, fraction, np.inf
        if outcome == CONVERGED:
            falls, merit = _reduces(work.before, work.measures, sizes.d)
            # Close to the solution round-off keeps the residual from falling; the step's own size
            # then decides.
            if falls or size < 1e-5 or not monotone:
                return outcome, fraction, merit
        fraction *= 0.5
    _keep(work.base, work.now)
    return (INADMISSIBLE if outcome == INADMISSIBLE else NO_CONVERGENCE), fraction, np.inf


@jit
def _keep(source, target):
    _copy(pointer(source, 0), pointer(target, 0), source.size)


@jit
def _copy(source, target, count):
    """Copy numbers. Cutting rows out of arrays instead would cost more than copying them: arrays
    count references; and indices that may be negative allow no vector instructions."""
    source, target = carray(source, (count,)), carray(target, (count,))
    for i in range(count):
        target[i] = source[i]


@jit
def _take(base, dx, fraction, now):
    """``now = base + fraction dx``; they may be the same."""
    base, dx, now = base.reshape(base.size), dx.reshape(dx.size), now.reshape(now.size)
    for i in range(now.size):
        now[i] = base[i] + fraction * dx[i]


@jit
def _step(pieces, sizes, sweep, work, initial):
    """The Newton step at all positions, from the recursion of the last evaluation."""
    outcome = CONVERGED if initial else _close(sizes, sweep, work)
    if outcome == CONVERGED:
        _start(sizes, sweep, work, initial)
        _update(pieces.update, sizes, sweep, work)
    return outcome


@jit
def _evaluate(pieces, sizes, sweep, work):
    """Equations at the present unknowns, and the recursion that solves them linearised."""
    steps, stages = sizes.block, sizes.stages
    points, per_row = steps * stages, sizes.new * (sizes.state + 1) * WIDTH
    x, u, h, p = pointer(work.x_block, 0), sweep.inputs, sweep.h, pointer(work.constants, 0)
    z, out, sums = pointer(work.z, 0), pointer(work.out, 0), pointer(work.sums, 0)
    work.sums[:] = 0.0
    bad, outside = 0, 0
    for b in range(u.shape[0]):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        for k in range(sizes.unknowns):
            at, reach = k * work.now.shape[1] + b * steps, steps + (sizes.front + 1) * WIDTH
            _copy(pointer(work.now, at), pointer(work.x_block, k * REACH), reach)
        inputs, length = pointer(u, b * u.shape[1] * BLOCK), pointer(h, b * BLOCK)
        _call_rows(pieces.rows, (x, length, z, steps))
        if sizes.conditions > 0:
            call_kernel(pieces.admissible, (z, inputs, p, out, points))
            outside += _outside(work.out, sizes, count)
        call_kernel(pieces.jacobian, (z, inputs, p, out, points))
        if b == u.shape[0] - 1:
            _silence(sizes, sweep.lengths, b, count, work.z, work.out)
        transfer = pointer(work.transfer, b * work.transfer.shape[1])
        arguments = out, x, length, z, sums, transfer, count
        bad += _call_eliminate(pieces.eliminate, arguments)
        history = pointer(work.history, b * (steps // WIDTH) * per_row)
        _call_chain(pieces.chain, (transfer, history, count // WIDTH, WIDTH))
    if outside > 0:
        return INADMISSIBLE
    finite = True
    for k in range(2 * sizes.d):
        work.measures[k] = total(work.sums[k]) / (sizes.steps * stages)
        finite = finite and work.measures[k] < np.inf
    if not finite:
        return NOT_FINITE
    return NEEDS_EXCHANGE if bad > 0 else CONVERGED


@jit
def _evaluate_again(pieces, sizes, sweep, work):
    """Equations alone at the present unknowns, solved with the last derivatives; whether the
    unknowns are admissible."""
    steps, stages = sizes.block, sizes.stages
    points, per_row = steps * stages, sizes.new * (sizes.state + 1) * WIDTH
    x, u, h, p = pointer(work.x_block, 0), sweep.inputs, sweep.h, pointer(work.constants, 0)
    z, out = pointer(work.z, 0), pointer(work.out, 0)
    outside = 0
    for b in range(u.shape[0]):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        for k in range(sizes.unknowns):
            at, reach = k * work.now.shape[1] + b * steps, steps + (sizes.front + 1) * WIDTH
            _copy(pointer(work.now, at), pointer(work.x_block, k * REACH), reach)
        inputs, length = pointer(u, b * u.shape[1] * BLOCK), pointer(h, b * BLOCK)
        _call_rows(pieces.rows, (x, length, z, steps))
        if sizes.conditions > 0:
            call_kernel(pieces.admissible, (z, inputs, p, out, points))
            outside += _outside(work.out, sizes, count)
        call_kernel(pieces.residual, (z, inputs, p, out, points))
        transfer = pointer(work.transfer, b * work.transfer.shape[1])
        _call_substitute(pieces.substitute, (out, x, length, transfer, count))
        history = pointer(work.history, b * (steps // WIDTH) * per_row)
        _call_follow(pieces.follow, (transfer, history, count // WIDTH, WIDTH))
    return outside == 0


@jit
def _outside(a, sizes, count):
    """How many points break a condition; one that is not a number shows in the equations."""
    outside = 0
    for k in range(sizes.conditions):
        for stage in range(sizes.stages):
            values = carray(pointer(a, k * BLOCK + stage * sizes.block), (count,))
            for i in range(count):
                outside += values[i] <= 0.0
    return outside


@jit
def _silence(sizes, lengths, b, count, z, out):
    """Keep points that repeat a step out of the measures: beyond the end, behind short chunks.

    They are equations of a step that stands elsewhere, and can be solved; nothing uses the result.
    """
    steps = sizes.block
    begin = (sizes.rows - 1) * WIDTH - b * steps
    for stage in range(sizes.stages):
        for i in range(steps):
            short = begin <= i < begin + WIDTH and lengths[i - begin] < lengths[0]
            if i >= count or short:
                for k in range(sizes.d):
                    out[k, stage * steps + i] = 0.0
                for k in range(sizes.nz):
                    z[k, stage * steps + i] = 0.0


@jit
def _close(sizes, sweep, work):
    """Invert the closure of the period, from the recursion's matrices alone."""
    D, inverse = sizes.state, work.inverse
    product = _product(D, sizes.new, sweep, work)
    closure, growth = np.empty((D, D)), 0.0
    for i in range(D):
        largest, size = 0.0, 1.0
        for k in range(D):
            inverse[i, k] = 1.0 if i == k else 0.0
            closure[i, k] = inverse[i, k] - product[i, k]
            largest = max(largest, abs(closure[i, k]))
            size += abs(product[i, k])
        growth = max(growth, size)
        if not largest > ROUND_OFF * size:
            return SINGULAR
    if growth > LARGEST_GROWTH:
        return NEEDS_EXCHANGE
    return CONVERGED if eliminate(closure, inverse, ROUND_OFF) else SINGULAR


@jit
def _product(D, new, sweep, work):
    """Matrix of the recursion from the period's start to its end.

    All :data:`COLUMNS` are computed, needed or not: a loop of known length becomes one instruction.
    """
    product, following = work.products[0], work.products[1]
    for i in range(D):
        for k in range(COLUMNS):
            product[i, k] = 1.0 if i == k else 0.0
    for c in range(WIDTH):
        first = sweep.lengths[c] * new
        for i in range(D):
            at = first + sweep.order[i]
            for k in range(COLUMNS):
                following[i, k] = 0.0
            for o in range(D):
                factor = work.history[at, o, c]
                for k in range(COLUMNS):
                    following[i, k] += factor * product[o, k]
        product, following = following, product
    return product


@jit
def _start(sizes, sweep, work, initial):
    """First state of every chunk: that of the period from its closure, or zero."""
    D, start, end = sizes.state, work.start, work.products[0, 0]
    start[:, 0] = 0.0
    if not initial:
        _pass(sizes, sweep, work, end)
        for i in range(D):
            value = 0.0
            for k in range(D):
                value += work.inverse[i, k] * end[k]
            start[i, 0] = value
    _pass(sizes, sweep, work, end)


@jit
def _pass(sizes, sweep, work, end):
    """States at the ends of the chunks, from the first one's start."""
    D, start = sizes.state, work.start
    for c in range(WIDTH):
        first = sweep.lengths[c] * sizes.new
        for i in range(D):
            at = first + sweep.order[i]
            value = work.history[at, D, c]
            for o in range(D):
                value += work.history[at, o, c] * start[o, c]
            if c + 1 < WIDTH:
                start[i, c + 1] = value
            else:
                end[i] = value


@jit
def _update(update, sizes, sweep, work):
    """The Newton step block by block, and at positions that repeat a step."""
    steps, dx = sizes.block, work.dx
    per_row = sizes.new * (sizes.state + 1) * WIDTH
    start, to = pointer(work.start, 0), pointer(work.dx_block, 0)
    for b in range(sweep.inputs.shape[0]):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        transfer = pointer(work.transfer, b * work.transfer.shape[1])
        history = pointer(work.history, b * (steps // WIDTH) * per_row)
        _call_update(update, (transfer, history, start, to, count // WIDTH, WIDTH))
        begin = sizes.front * WIDTH + b * steps
        for k in range(sizes.unknowns):
            at = k * dx.shape[1] + begin
            _copy(pointer(work.dx_block, k * BLOCK), pointer(dx, at), count)
    for k in range(sizes.unknowns):
        for i in range(sizes.front * WIDTH):
            dx[k, i] = dx[k, sweep.place[sweep.source[i]]]
        for i in range((sizes.front + sizes.rows - 1) * WIDTH, sweep.source.size):
            dx[k, i] = dx[k, sweep.place[sweep.source[i]]]


@jit
def _size(x, dx, begin, measured, scratch):
    """Largest change of a state, over what :func:`unit` says; not finite where one is not.

    Also over its largest value, which digits are lost against.
    """
    size = least = 0.0
    count = x.shape[1] - begin
    for k in range(x.shape[0]):
        at = k * x.shape[1] + begin
        change = _largest(pointer(dx, at), count, 0.0, scratch)
        if not change < np.inf:
            return np.inf, np.inf
        if k < measured and change > 0.0:
            level = x[k, begin]
            motion = _largest(pointer(x, at), count, level, scratch)
            size = max(size, change / unit(motion, level, change))
            least = max(least, change / max(motion + abs(level), change))
    return size, least


@jit
def _largest(values, count, level, scratch):
    """Largest distance from a level, not a number where one is not.

    Without their sign, floating-point numbers are ordered as the integers with their bits, and what
    is not finite comes last: integers, which have no exceptions, are compared in vectors.
    """
    values, distances = carray(values, (count,)), carray(pointer(scratch, 0), (count,))
    for i in range(count):
        distances[i] = values[i] - level
    bits, largest = scratch.view(np.int64), np.int64(0)
    for i in range(count):
        magnitude = bits[i] & WITHOUT_SIGN
        largest = magnitude if magnitude > largest else largest
    bits[0] = largest
    return scratch[0]


@jit
def _reduces(before, after, d):
    """Whether the residual fell, in units of the equations' terms, and its size in its own.

    It falls in the larger of the terms before and after: terms before alone would be nothing for an
    equation that a start at rest fulfils, and forbid to leave it. It is small against its own terms
    only: an iteration that comes back from far away has a small residual against those it left.
    """
    old = new = left = 0.0
    for e in range(d):
        larger = max(before[d + e], after[d + e]) + 1e-300
        old += before[e] / larger
        new += after[e] / larger
        left += after[e] / (after[d + e] + 1e-300)
    return np.sqrt(new) < np.sqrt(old), np.sqrt(left)


@dataclass(frozen=True)
class Arranged:
    """A period's inputs and mesh as they are swept.

    Parameters
    ----------
    program : Program
        The scheme's compiled pieces.
    layout : Layout
        Order of the steps.
    inputs, lengths : ndarray, shapes (b, nu, BLOCK) and (b, BLOCK)
        Of each block.
    """

    program: Program
    layout: Layout
    inputs: Array
    lengths: Array

    @staticmethod
    def of(program: Program, inputs: Array, lengths: Array) -> Arranged:
        """From inputs ``(nu, n s)`` at the points and lengths ``(n,)`` of the steps, s."""
        layout = Layout.of(lengths.size, program.front, program.steps)
        steps, s, nu = program.steps, program.stages, inputs.shape[0]
        count = -(-int(layout.lengths[0]) * WIDTH // steps)
        blocks = np.zeros((count, max(nu, 1), BLOCK))
        of_steps = np.ones((count, BLOCK))
        for b in range(count):
            begin = program.front * WIDTH + b * steps
            chosen = layout.source[begin : begin + steps]
            of_steps[b, :steps] = lengths[chosen]
            for stage in range(s):
                part = slice(stage * steps, (stage + 1) * steps)
                blocks[b, :nu, part] = inputs[:, chosen * s + stage]
        return Arranged(program, layout, blocks, of_steps)

    @property
    def sweep(self) -> Sweep:
        """The same for compiled code."""
        layout, order = self.layout, np.array(self.program.order, dtype=np.int64)
        place, source = layout.place, layout.source
        return Sweep(place, source, layout.lengths, order, self.inputs, self.lengths)

    def sizes(self, inputs: int, constants: int, conditions: int) -> Sizes:
        """Sizes for a model with so many inputs, constants and admissibility conditions."""
        program = self.program
        d = len(program.orders)
        return Sizes(
            steps=self.layout.place.size,
            rows=int(self.layout.lengths[0]),
            inputs=inputs,
            constants=constants,
            nz=sum(program.orders) + d,
            d=d,
            conditions=conditions,
            unknowns=program.unknowns,
            state=program.state,
            new=program.new,
            window=program.window,
            front=program.front,
            stages=program.stages,
            block=program.steps,
            transfer=program.transfer,
            measured=min(sum(program.orders), program.unknowns),
        )
