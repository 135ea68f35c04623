"""Newton's method on one period, compiled: the same iteration as in ``solve``, with everything a
lane needs in the processor's cache, and last steps with old derivatives.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray  # type: ignore[attr-defined] # not in its __all__

from bayesoleo._types import Array, Integers
from bayesoleo.compiled import pointer
from bayesoleo.solvers.periodic.arrangement import (
    LinearStart,
    Options,
    Sizes,
    Sweep,
    SweepKernels,
    Work,
)
from bayesoleo.solvers.periodic.measures import unit
from bayesoleo.solvers.periodic.recursion import (
    CONVERGED,
    INADMISSIBLE,
    NEEDS_EXCHANGE,
    SINGULAR,
    close,
    evaluate,
    evaluate_again,
    keep,
    move,
    start_chunks,
    take,
    update,
)
from bayesoleo.solvers.schemes.elimination import jit
from bayesoleo.solvers.schemes.unrolled.emit import WIDTH
from bayesoleo.solvers.status import Status

NO_CONVERGENCE = Status.NO_CONVERGENCE.value

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
WITHOUT_SIGN = np.int64(2**63 - 1)


@jit
def solve_lanes(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, options: Options, p: Array,
    x: Array, line: LinearStart, status: Integers, iterations: Integers,
) -> None:  # fmt: skip
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
            _in_order(sizes, sweep, now, pointer(x, lane * sizes.steps * sizes.unknowns))


@jit
def _in_order(sizes: Sizes, sweep: Sweep, now: Array, x: Any) -> None:
    """Copy a solution, step by step and unknown by unknown."""
    unknowns, row = sizes.unknowns, now.shape[1]
    x, swept = carray(x, (sizes.steps * unknowns,)), carray(pointer(now, 0), (now.size,))
    for k in range(unknowns):
        to = k
        for c in range(WIDTH):
            at = k * row + sizes.front * WIDTH + c
            for _ in range(sweep.lengths[c]):
                x[to] = swept[at]
                to += unknowns
                at += WIDTH


@jit
def _extrapolate(line: LinearStart, lane: int, now: Array) -> None:
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
def _iterate(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, options: Options
) -> tuple[int, int]:
    """Newton's method from ``work.now``; returns how it ended and the number of steps."""
    outcome, iteration = evaluate(pieces, sizes, sweep, work), 0
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
            move(work.now, work.dx)
            return CONVERGED, iteration
        if chords and last < CHORD_FROM and _chord_suffices(size, last):
            keep(work.now, work.base)
            steps, last = _chords(pieces, sizes, sweep, work, options, size)
            iteration += steps
            if last == 0.0:
                return CONVERGED, iteration
            chords = last < size
            if not chords:
                keep(work.base, work.now)
            outcome = evaluate(pieces, sizes, sweep, work)
            continue
        outcome, fraction, merit = _advance(pieces, sizes, sweep, work, options.monotone, size)
        last = size if fraction == 1.0 else np.inf
        # A linear problem is solved by its first step.
        if outcome == CONVERGED and merit < 1e-14 and iteration > 1:
            return CONVERGED, iteration
    return (NO_CONVERGENCE if outcome == CONVERGED else outcome), iteration


@jit
def _chords(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, options: Options, size: float
) -> tuple[int, float]:
    """Take the step, and further ones with the same derivatives and closure.

    Returns their number and the last one's size: zero where they converged, infinite where they did
    not contract.
    """
    last = size
    for count in range(1, MOST_CHORDS + 1):
        move(work.now, work.dx)
        if not evaluate_again(pieces, sizes, sweep, work):
            return count, np.inf
        start_chunks(pieces, sizes, work, options.initial)
        update(pieces.update, sizes, sweep, work)
        size, least = _size(work.now, work.dx, sizes.front * WIDTH, sizes.measured, work.scratch)
        if not size < SLOW_CHORD * last:
            return count, np.inf
        # What is left is a geometric series, twice as steep as seen where the first of the two
        # steps was one of Newton's.
        if least < SMALL_STEP or 2.0 * size * size / last < CHORD_LEFT:
            move(work.now, work.dx)
            return count, 0.0
        last = size
    return MOST_CHORDS, last


@jit
def _chord_suffices(size: float, last: float) -> bool:
    """Whether one more step with these derivatives leaves round-off, if Newton's error is squared:
    ``k size**2`` with ``k = size / last**2``, which old derivatives contract by ``2 k size``.
    """
    ratio = size / last
    return 2.0 * size * ratio**4 < CHORD_LEFT


@jit
def _advance(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, monotone: bool, size: float
) -> tuple[int, float, float]:
    """Take the step, halved while it is inadmissible or does not reduce the residual; returns how
    that ended, the fraction taken and the residual's size after it."""
    keep(work.now, work.base)
    keep(work.measures, work.before)
    fraction, outcome = 1.0, CONVERGED
    for _ in range(MAXIMUM_HALVINGS):
        take(work.base, work.dx, fraction, work.now)
        outcome = evaluate(pieces, sizes, sweep, work)
        if outcome == NEEDS_EXCHANGE:
            return outcome, fraction, np.inf
        if outcome == CONVERGED:
            falls, merit = _reduces(work.before, work.measures, sizes.d)
            # Close to the solution round-off keeps the residual from falling; the step's own size
            # then decides.
            if falls or size < 1e-5 or not monotone:
                return outcome, fraction, merit
        fraction *= 0.5
    keep(work.base, work.now)
    return (INADMISSIBLE if outcome == INADMISSIBLE else NO_CONVERGENCE), fraction, np.inf


@jit
def _step(pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, initial: bool) -> int:
    """The Newton step at all positions, from the recursion of the last evaluation."""
    outcome = CONVERGED if initial else close(pieces, sizes, work)
    if outcome == CONVERGED:
        start_chunks(pieces, sizes, work, initial)
        update(pieces.update, sizes, sweep, work)
    return outcome


@jit
def _size(x: Array, dx: Array, begin: int, measured: int, scratch: Array) -> tuple[float, float]:
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
def _largest(values: Any, count: int, level: float, scratch: Array) -> float:
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
    return float(scratch[0])


@jit
def _reduces(before: Array, after: Array, d: int) -> tuple[bool, float]:
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
