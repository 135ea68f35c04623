"""Newton's method on all steps of a period at once, compiled.

It is the same iteration as in ``_periodic.py``, with all arrays of a lane in the processor's cache,
and last steps with old derivatives. The linearised equations of a period are solved by a recursion
through its steps. Models and schemes come as compiled pieces of fixed signature
(``bayesoleo._compiled`` and ``_unrolled_program.py``), and arrays as their addresses, so this file
is compiled once, and fast.

Starts that follow from one solution and its derivatives are made when they are needed. For a batch
of parameter vectors all starts together exceed a processor's cache; the solution and its
derivatives do not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import carray

from bayesoleo._compiled import (
    BLOCK,
    after,
    call_kernel,
    caller,
    inner,
    integers,
    jit,
    numbers,
    pointer,
)
from bayesoleo._types import Array, Integers
from bayesoleo.solvers._elimination import LARGEST_GROWTH, close as solve_closure, close_balanced
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._period_arrangement import (
    NO_LINE,
    LinearStart,
    Options,
    Sizes,
    Sweep,
    SweepKernels,
    SweepLayout,
    Work,
    nothing,
    total,
    unit,
)
from bayesoleo.solvers._unrolled_collocation import WIDTH
from bayesoleo.solvers._unrolled_program import FEW_CHORDS, SIGNATURES

#: A pivot that asks for an exchange of rows, or a recursion that grows so much that its rounding
#: errors would spoil the closure: neither is a failure of the problem, only of this elimination.
NEEDS_EXCHANGE = -1

CONVERGED = Status.CONVERGED.value
INADMISSIBLE = Status.INADMISSIBLE.value
SINGULAR = Status.SINGULAR.value
NOT_FINITE = Status.NOT_FINITE.value

call_rows, call_chain = caller(SIGNATURES["rows"]), caller(SIGNATURES["chain"])
call_eliminate = caller(SIGNATURES["eliminate"])
call_substitute, call_follow = caller(SIGNATURES["substitute"]), caller(SIGNATURES["follow"])
call_product, call_begin = caller(SIGNATURES["product"]), caller(SIGNATURES["begin"])
call_update = caller(SIGNATURES["update"])
NO_CONVERGENCE = Status.NO_CONVERGENCE.value
#: Newton's error after a step is about the step squared: a relative step of 1e-7 that is still
#: contracting leaves 1e-14. Steep friction contracts slower at first: no guess of the next step
#: from the last two is safe.
LAST_STEP = 1e-7
#: The same without quadratic contraction (at a kink), where a small step is all there is to see.
SMALL_STEP = 1e-11
MAXIMUM_HALVINGS = 12
#: A residual of this size, in units of the equations' terms, cannot fall any more. The motion of
#: what is at rest has no scale of its own by which a step could be seen to be small.
ROUND_OFF = 1e-14
#: Old derivatives are tried only below this relative step.
CHORD_FROM = 0.1
#: Ratio of successive steps above which old derivatives converge too slowly.
SLOW_CHORD = 0.1
#: What the steps that are not taken would add up to.
CHORD_LEFT = 1e-14
#: Old derivatives are tried after the first step already below this, only where new ones cost more
#: than a few steps with old ones: five of them that contract by the first step leave its sixth
#: power, and most contract by a twentieth of it. One that contracts too slowly is a step closer all
#: the same, and costs a third to a fifth of what it may save.
FIRST_CHORD_FROM = 1e-2
WITHOUT_SIGN = np.int64(2**63 - 1)


@inner
def keep(source: int, target: int, count: int) -> None:
    """Copy numbers from one address to another."""
    begin, to = carray(numbers(source), (count,)), carray(numbers(target), (count,))
    for i in range(count):
        to[i] = begin[i]


@inner
def take(fraction: float, sizes: Sizes, work: Work) -> None:
    """``now = base + fraction dx``."""
    size = sizes.unknowns * sizes.positions
    to, change = carray(numbers(work.now), (size,)), carray(numbers(work.dx), (size,))
    begin = carray(numbers(work.base), (size,))
    for i in range(size):
        to[i] = begin[i] + fraction * change[i]


@inner
def move(sizes: Sizes, work: Work) -> None:
    """``now += dx``."""
    size = sizes.unknowns * sizes.positions
    to, change = carray(numbers(work.now), (size,)), carray(numbers(work.dx), (size,))
    for i in range(size):
        to[i] += change[i]


@inner
def evaluate(pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work) -> int:
    """Equations at the present unknowns, and the recursion that solves them linearised."""
    steps, stages = sizes.block, sizes.stages
    points, per_row = steps * stages, sizes.new * (sizes.state + 1) * WIDTH
    x, p = numbers(work.x_block), numbers(work.constants)
    z, out, sums = numbers(work.z), numbers(work.out), numbers(work.sums)
    squares = carray(sums, (2 * sizes.d * BLOCK,))
    for i in range(2 * sizes.d * BLOCK):
        squares[i] = 0.0
    bad, outside, odd = 0, 0, 0
    for b in range(sizes.blocks):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        inputs = after(numbers(sweep.inputs), b * sizes.inputs * BLOCK)
        length, now = after(numbers(sweep.h), b * BLOCK), after(numbers(work.now), b * steps)
        call_rows(pieces.rows, (now, x, length, z, sizes.positions, steps))
        if sizes.conditions > 0:
            call_kernel(pieces.admissible, (z, inputs, p, out, points))
            broken, undefined = _outside(out, sizes, count)
            outside, odd = outside + broken, odd + undefined
        call_kernel(pieces.jacobian, (z, inputs, p, out, points))
        if b == sizes.blocks - 1:
            _silence(sizes, sweep, b, count, work)
        transfer = after(numbers(work.transfer), b * sizes.transfer * steps)
        arguments = out, x, length, z, sums, transfer, count
        bad += call_eliminate(pieces.eliminate, arguments)
        history = after(numbers(work.history), b * (steps // WIDTH) * per_row)
        call_chain(pieces.chain, (transfer, history, count // WIDTH, WIDTH))
    if outside > 0:
        return INADMISSIBLE
    finite, measures = odd == 0, carray(numbers(work.measures), (2 * sizes.d,))
    for k in range(2 * sizes.d):
        measures[k] = total(carray(after(sums, k * BLOCK), (BLOCK,))) / (sizes.steps * stages)
        finite = finite and measures[k] < np.inf
    if not finite:
        return NOT_FINITE
    return NEEDS_EXCHANGE if bad > 0 else CONVERGED


@inner
def evaluate_again(pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work) -> bool:
    """Equations alone at the present unknowns, solved with the last derivatives; whether the
    unknowns are admissible."""
    steps, stages = sizes.block, sizes.stages
    points, per_row = steps * stages, sizes.new * (sizes.state + 1) * WIDTH
    x, p = numbers(work.x_block), numbers(work.constants)
    z, out = numbers(work.z), numbers(work.out)
    outside, odd = 0, 0
    for b in range(sizes.blocks):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        inputs = after(numbers(sweep.inputs), b * sizes.inputs * BLOCK)
        length, now = after(numbers(sweep.h), b * BLOCK), after(numbers(work.now), b * steps)
        call_rows(pieces.rows, (now, x, length, z, sizes.positions, steps))
        if sizes.conditions > 0:
            call_kernel(pieces.admissible, (z, inputs, p, out, points))
            broken, undefined = _outside(out, sizes, count)
            outside, odd = outside + broken, odd + undefined
        call_kernel(pieces.residual, (z, inputs, p, out, points))
        transfer = after(numbers(work.transfer), b * sizes.transfer * steps)
        call_substitute(pieces.substitute, (out, x, length, transfer, count))
        history = after(numbers(work.history), b * (steps // WIDTH) * per_row)
        call_follow(pieces.follow, (transfer, history, count // WIDTH, WIDTH))
    return outside == 0 and odd == 0


@inner
def _outside(a: Any, sizes: Sizes, count: int) -> tuple[int, int]:
    """At how many points a condition is broken, and at how many it is not a number."""
    outside, odd = 0, 0
    for k in range(sizes.conditions):
        for stage in range(sizes.stages):
            values = carray(after(a, k * BLOCK + stage * sizes.block), (count,))
            for i in range(count):
                outside += values[i] <= 0.0
                odd += values[i] != values[i]
    return outside, odd


@inner
def _silence(sizes: Sizes, sweep: Sweep, b: int, count: int, work: Work) -> None:
    """Keep points that repeat a step out of the measures: beyond the end, behind short chunks.

    They are equations of a step that stands elsewhere, and can be solved; nothing uses the result.
    """
    steps, lengths = sizes.block, carray(integers(sweep.lengths), (WIDTH,))
    z = carray(numbers(work.z), (sizes.nz, BLOCK))
    out = carray(numbers(work.out), (sizes.d, BLOCK))
    begin = (sizes.rows - 1) * WIDTH - b * steps
    for stage in range(sizes.stages):
        for i in range(steps):
            short = begin <= i < begin + WIDTH and lengths[i - begin] < lengths[0]
            if i >= count or short:
                for k in range(sizes.d):
                    out[k, stage * steps + i] = 0.0
                for k in range(sizes.nz):
                    z[k, stage * steps + i] = 0.0


@inner
def close(pieces: SweepKernels, sizes: Sizes, work: Work) -> int:
    """Invert the closure of the period, from the recursion's matrices alone."""
    D, products = sizes.state, numbers(work.products)
    whole, rest = sizes.steps // WIDTH, sizes.steps % WIDTH
    call_product(pieces.product, (numbers(work.history), products, whole, rest, WIDTH))
    product = carray(after(products, WIDTH * D * sizes.columns), (D, sizes.columns))
    inverse = carray(numbers(work.inverse), (D, D))
    closure = carray(numbers(work.closure), (D, D))
    _set_identity(inverse)
    regular, growth = solve_closure(product, inverse, closure)
    if not regular or growth > LARGEST_GROWTH:
        _set_identity(inverse)
        scale = carray(numbers(work.scale), (D,))
        regular, growth = close_balanced(product, inverse, closure, scale)
    if growth > LARGEST_GROWTH:
        return NEEDS_EXCHANGE
    return CONVERGED if regular else SINGULAR


@inner
def _set_identity(matrix: Array) -> None:
    for i in range(matrix.shape[0]):
        for k in range(matrix.shape[1]):
            matrix[i, k] = 1.0 if i == k else 0.0


@inner
def start_chunks(pieces: SweepKernels, sizes: Sizes, work: Work, initial: bool) -> None:
    """First state of every chunk: that of the period from its closure, or zero."""
    history, whole, rest = numbers(work.history), sizes.steps // WIDTH, sizes.steps % WIDTH
    inverse, start = numbers(work.inverse), numbers(work.start)
    call_begin(pieces.begin, (history, inverse, start, whole, rest, 0 if initial else 1))


@inner
def update(update: int, sizes: Sizes, sweep: Sweep, work: Work) -> None:
    """The Newton step block by block, and at positions that repeat a step."""
    steps, positions = sizes.block, sizes.positions
    per_row = sizes.new * (sizes.state + 1) * WIDTH
    start, to = numbers(work.start), numbers(work.dx_block)
    for b in range(sizes.blocks):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        transfer = after(numbers(work.transfer), b * sizes.transfer * steps)
        history = after(numbers(work.history), b * (steps // WIDTH) * per_row)
        begin = after(numbers(work.dx), sizes.front * WIDTH + b * steps)
        size = positions, count // WIDTH, WIDTH
        call_update(update, (transfer, history, start, to, begin, *size))
    again = carray(integers(sweep.again), (positions,))
    for k in range(sizes.unknowns):
        dx = carray(after(numbers(work.dx), k * positions), (positions,))
        for i in range(sizes.front * WIDTH):
            dx[i] = dx[again[i]]
        for i in range((sizes.front + sizes.rows - 1) * WIDTH, positions):
            dx[i] = dx[again[i]]


@jit
def solve_lanes(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, options: Options, p: Array,
    x: Array, line: LinearStart, status: Integers, iterations: Integers,
) -> None:  # fmt: skip
    """Newton's method for every lane of ``x (L, n, w)``, in place; see ``solve``."""
    constants = carray(numbers(work.constants), (sizes.constants,))
    for lane in range(x.shape[0]):
        for k in range(sizes.constants):
            constants[k] = p[lane, k]
        solution = pointer(x, lane * sizes.steps * sizes.unknowns)
        if line.base == 0:
            as_swept(sizes, sweep, solution, work.now)
        else:
            _extrapolate(line, lane, sizes, work.now)
        status[lane], iterations[lane] = _iterate(pieces, sizes, sweep, work, options)
        if status[lane] != NEEDS_EXCHANGE:
            _in_order(sizes, sweep, work.now, solution)


def compile_iteration() -> None:
    """Compile the iteration for what it is called with, or load it, by lanes of which there are
    none: no model is needed for it, nor the libraries of one."""
    status = np.empty(0, dtype=np.int64)
    solve_lanes(
        nothing(SweepKernels), nothing(Sizes), nothing(Sweep), nothing(Work),
        Options(0, True, False), np.empty((0, 1)), np.empty((0, 1, 1)), NO_LINE, status,
        status.copy(),
    )  # fmt: skip


@inner
def as_swept(sizes: Sizes, sweep: Sweep, x: Any, now: int) -> None:
    """Copy a start ``x (n, w)`` to where the sweep has it."""
    unknowns, positions = sizes.unknowns, sizes.positions
    x, swept = carray(x, (sizes.steps, unknowns)), carray(numbers(now), (unknowns, positions))
    source = carray(integers(sweep.source), (positions,))
    for k in range(unknowns):
        for i in range(positions):
            swept[k, i] = x[source[i], k]


@inner
def _in_order(sizes: Sizes, sweep: Sweep, now: int, x: Any) -> None:
    """Copy a solution, step by step and unknown by unknown."""
    unknowns, row = sizes.unknowns, sizes.positions
    x, swept = carray(x, (sizes.steps * unknowns,)), carray(numbers(now), (unknowns * row,))
    lengths = carray(integers(sweep.lengths), (WIDTH,))
    for k in range(unknowns):
        to = k
        for c in range(WIDTH):
            at = k * row + sizes.front * WIDTH + c
            for _ in range(lengths[c]):
                x[to] = swept[at]
                to += unknowns
                at += WIDTH


@inner
def _extrapolate(line: LinearStart, lane: int, sizes: Sizes, now: int) -> None:
    """``now = base + slopes change``, two slopes at a time."""
    size, count = sizes.unknowns * sizes.positions, line.active
    to, base = carray(numbers(now), (size,)), carray(numbers(line.base), (size,))
    change, slopes = carray(after(numbers(line.change), lane * count), (count,)), line.slopes
    for i in range(size):
        to[i] = base[i]
    for k in range(0, count - count % 2, 2):
        first, second = change[k], change[k + 1]
        a = carray(after(numbers(slopes), k * size), (size,))
        b = carray(after(numbers(slopes), (k + 1) * size), (size,))
        for i in range(size):
            to[i] += first * a[i] + second * b[i]
    for k in range(count - count % 2, count):
        first, a = change[k], carray(after(numbers(slopes), k * size), (size,))
        for i in range(size):
            to[i] += first * a[i]


@inner
def _iterate(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, options: Options
) -> tuple[int, int]:
    """Newton's method from ``work.now``; returns how it ended and the number of steps."""
    outcome, iteration = evaluate(pieces, sizes, sweep, work), 0
    last, chords, everything = np.inf, True, sizes.unknowns * sizes.positions
    while outcome == CONVERGED and iteration < options.max_iterations:
        iteration += 1
        outcome = _step(pieces, sizes, sweep, work, options.initial)
        if outcome != CONVERGED:
            return outcome, iteration
        size, least = _size(sizes, work)
        if not size < np.inf:
            return SINGULAR, iteration
        if least < SMALL_STEP or (size < 0.1 * last and size < LAST_STEP):
            move(sizes, work)
            return CONVERGED, iteration
        early = sizes.chords > FEW_CHORDS and size < FIRST_CHORD_FROM and not options.initial
        if chords and (early or (last < CHORD_FROM and _chord_suffices(size, last))):
            keep(work.now, work.base, everything)
            steps, last = _chords(pieces, sizes, sweep, work, options, size)
            iteration += steps
            if last == 0.0:
                return CONVERGED, iteration
            chords = last < size
            if not chords:
                keep(work.base, work.now, everything)
            outcome = evaluate(pieces, sizes, sweep, work)
            if chords and outcome != CONVERGED:  # the last of them led out of the region
                chords = False
                keep(work.base, work.now, everything)
                outcome = evaluate(pieces, sizes, sweep, work)
            continue
        outcome, fraction, merit = _advance(pieces, sizes, sweep, work, options.monotone, size)
        last = size if fraction == 1.0 else np.inf
        # A linear problem is solved by its first step. In a motion that grows from a given state
        # late terms are so large that errors of early ones do not show in this.
        if outcome == CONVERGED and merit < ROUND_OFF and iteration > 1 and not options.initial:
            return CONVERGED, iteration
    return (NO_CONVERGENCE if outcome == CONVERGED else outcome), iteration


@inner
def _chords(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, options: Options, size: float
) -> tuple[int, float]:
    """Take the step, and further ones with the same derivatives and closure.

    Returns their number and the last one's size: zero where they converged, infinite where they did
    not contract. They end before their time where all that are left would not suffice.
    """
    last, most = size, sizes.chords
    for count in range(1, most + 1):
        move(sizes, work)
        if not evaluate_again(pieces, sizes, sweep, work):
            return count, np.inf
        start_chunks(pieces, sizes, work, options.initial)
        update(pieces.update, sizes, sweep, work)
        size, least = _size(sizes, work)
        if not size < SLOW_CHORD * last:
            return count, np.inf
        # What is left is a geometric series, twice as steep as seen where the first of the two
        # steps was one of Newton's.
        if least < SMALL_STEP or 2.0 * size * size / last < CHORD_LEFT:
            move(sizes, work)
            return count, 0.0
        if count == most or size * (size / last) ** (most - count) > CHORD_LEFT:
            move(sizes, work)
            return count, size
        last = size
    return most, last


@inner
def _chord_suffices(size: float, last: float) -> bool:
    """Whether one more step with these derivatives leaves round-off, if Newton's error is squared:
    ``k size**2`` with ``k = size / last**2``, which old derivatives contract by ``2 k size``.
    """
    ratio = size / last
    return 2.0 * size * ratio**4 < CHORD_LEFT


@inner
def _advance(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, monotone: bool, size: float
) -> tuple[int, float, float]:
    """Take the step, halved while it is inadmissible or does not reduce the residual; returns how
    that ended, the fraction taken and the residual's size after it."""
    everything = sizes.unknowns * sizes.positions
    keep(work.now, work.base, everything)
    keep(work.measures, work.before, 2 * sizes.d)
    fraction, outcome = 1.0, CONVERGED
    for _ in range(MAXIMUM_HALVINGS):
        take(fraction, sizes, work)
        outcome = evaluate(pieces, sizes, sweep, work)
        if outcome == NEEDS_EXCHANGE:
            return outcome, fraction, np.inf
        if outcome == CONVERGED:
            before = carray(numbers(work.before), (2 * sizes.d,))
            after_it = carray(numbers(work.measures), (2 * sizes.d,))
            falls, merit = _reduces(before, after_it, sizes.d)
            # Close to the solution round-off keeps the residual from falling; the step's own size
            # then decides.
            if falls or size < 1e-5 or not monotone:
                return outcome, fraction, merit
        fraction *= 0.5
    keep(work.base, work.now, everything)
    return (INADMISSIBLE if outcome == INADMISSIBLE else NO_CONVERGENCE), fraction, np.inf


@inner
def _step(pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, initial: bool) -> int:
    """The Newton step at all positions, from the recursion of the last evaluation."""
    outcome = CONVERGED if initial else close(pieces, sizes, work)
    if outcome == CONVERGED:
        start_chunks(pieces, sizes, work, initial)
        update(pieces.update, sizes, sweep, work)
    return outcome


@inner
def _size(sizes: Sizes, work: Work) -> tuple[float, float]:
    """Largest change of a state, over what :func:`unit` says; not finite where one is not.

    Also over its largest value, which digits are lost against.
    """
    size = least = 0.0
    begin = sizes.front * WIDTH
    count = sizes.positions - begin
    for k in range(sizes.unknowns):
        at = k * sizes.positions + begin
        change = _largest(after(numbers(work.dx), at), count, 0.0, work.scratch)
        if not change < np.inf:
            return np.inf, np.inf
        if k < sizes.measured and change > 0.0:
            x = after(numbers(work.now), at)
            level = carray(x, (1,))[0]
            motion = _largest(x, count, level, work.scratch)
            size = max(size, change / unit(motion, level, change))
            least = max(least, change / max(motion + abs(level), change))
    return size, least


@inner
def _largest(values: Any, count: int, level: float, scratch: int) -> float:
    """Largest distance from a level, not a number where one is not.

    Without their sign, floating-point numbers are ordered as the integers with their bits, and what
    is not finite comes last: integers, which have no exceptions, are compared in vectors.
    """
    values, distances = carray(values, (count,)), carray(numbers(scratch), (count,))
    for i in range(count):
        distances[i] = values[i] - level
    bits, largest = carray(integers(scratch), (count,)), np.int64(0)
    for i in range(count):
        magnitude = bits[i] & WITHOUT_SIGN
        largest = magnitude if magnitude > largest else largest
    bits[0] = largest
    return float(distances[0])


@inner
def _reduces(before: Array, after: Array, d: int) -> tuple[bool, float]:
    """Whether the residual fell, in units of the equations' terms, or is round-off, and its size in
    its own.

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
    falls = np.sqrt(new) < max(np.sqrt(old), ROUND_OFF)
    return falls, np.sqrt(left)


@dataclass(frozen=True, eq=False)
class Extrapolation:
    """Starts at ``x + x_p change``.

    Parameters
    ----------
    x : ndarray, shape (n, w)
        A solution's unknowns.
    x_p : ndarray, shape (na, n, w)
        Their derivatives.
    """

    x: Array
    x_p: Array

    @cached_property
    def moving(self) -> Integers:
        """Which parameters move the motion: most of a force law act on outputs alone."""
        return np.flatnonzero(self.x_p.any(axis=(1, 2)))

    def starts(self, change: Array) -> Array:
        """Starts, shape (L, n, w), at changes of shape (L, na)."""
        start = np.empty((change.shape[0], *self.x.shape))
        slopes = self.x_p.reshape(len(self.x_p), self.x.size)
        flat = start.reshape(change.shape[0], -1)
        _extrapolate_lanes(self.x.ravel(), slopes, change, self.moving, flat)
        return start

    def swept(self, layout: SweepLayout) -> tuple[Array, Array]:
        """The same in the order of a sweep: ``(w, positions)`` and, of the parameters that move it,
        ``(moving, w, positions)``."""
        known = self._swept.get("last")
        if known is None or known[0] is not layout:
            base = np.ascontiguousarray(self.x[layout.source].T)
            slopes = np.moveaxis(self.x_p[self.moving][:, layout.source], 2, 1)
            known = self._swept["last"] = layout, base, np.ascontiguousarray(slopes)
        return known[1:]

    @cached_property
    def _swept(self) -> dict[str, tuple[SweepLayout, Array, Array]]:
        return {}


@jit
def _extrapolate_lanes(x: Array, x_p: Array, change: Array, moving: Integers, start: Array) -> None:
    """Lane by lane: the order of summation of a matrix product would vary with the batch."""
    for lane in range(change.shape[0]):
        for i in range(x.size):
            start[lane, i] = x[i]
        for k in moving:
            for i in range(x.size):
                start[lane, i] += change[lane, k] * x_p[k, i]
