"""Many right-hand sides of a period's linearised equations, swept as Newton's steps are.

The steps' matrices are eliminated once, with the compiled pieces of the scheme; each column then
costs what a Newton step with old derivatives does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import carray

from bayesoleo._compiled import BLOCK, after, inner, integers, jit, numbers, pointer, record
from bayesoleo._types import Array, Flags, Integers
from bayesoleo.solvers import _period_arrangement as arrangement
from bayesoleo.solvers._period_arrangement import Sizes, Sweep, SweepKernels, Work, nothing
from bayesoleo.solvers._periodic_newton import (
    CONVERGED,
    as_swept,
    call_chain,
    call_eliminate,
    call_follow,
    call_product,
    call_rows,
    call_substitute,
    close,
    start_chunks,
    update,
)
from bayesoleo.solvers._unrolled_collocation import REACH, WIDTH
from bayesoleo.solvers._unrolled_program import Program

#: Bytes.
NUMBER = 8


def swept_columns(
    program: Program,
    gz: Array,
    right: Array,
    x: Array | None,
    jumps: Array | None,
    lanes: Integers,
    h: Array,
    initial: bool,
    results: tuple[Array, Array, Flags],
) -> None:
    """Solve ``G dx = -right`` by sweeps; see ``Collocation.linear``.

    Parameters
    ----------
    program : Program
        The scheme's compiled pieces.
    gz : ndarray, shape (L, d, nz, N)
        Partial derivatives of the equations at the points.
    right : ndarray, shape (L, d, k, N)
        Columns.
    x : ndarray, shape (L, n, w), or None
        Present unknowns, whose jumps from step to step the first column removes.
    jumps : ndarray, shape (L, D, k, n), or None
        Added to the state at the end of each step.
    lanes : ndarray of int
        Which of the L to solve.
    h : ndarray, shape (n,)
        Lengths of the steps, s.
    initial : bool
        Hold the first state instead of closing the period.
    results : tuple of ndarray
        ``dx (L, n, w, k)``, ``monodromy (L, D, D)`` and ``ok (L,)``, to be filled; lanes whose
        elimination would have to exchange rows are not ``ok``.
    """
    order = _order_of_steps(program, h.size)
    length = np.ascontiguousarray(h[order.chosen])
    kept = [
        np.empty(0) if array is None else np.ascontiguousarray(array, dtype=np.float64)
        for array in (gz, right, x, jumps)
    ]
    places = (0 if array.size == 0 else array.ctypes.data for array in kept)
    given = dict(zip(("gz", "right", "x", "jumps"), places, strict=True))
    work = arrangement.work_space(order.sizes, program.order)
    solve_columns(
        record(order.pieces), record(order.sizes),
        record(order.sweep._replace(h=length.ctypes.data)), record(work), initial,
        Given(**given, orders=order.orders.ctypes.data, columns=right.shape[2]), lanes, *results,
    )  # fmt: skip


class Given(NamedTuple):
    """Addresses of a lane's arrays, zero of those that are not given; of the dofs' orders; and the
    number of columns."""

    gz: int
    right: int
    x: int
    jumps: int
    orders: int
    columns: int


@dataclass(frozen=True)
class _Order:
    """What depends on a scheme and a number of steps alone: ``sweep`` has addresses of arrays of
    ``arranged``, and ``chosen (blocks, BLOCK)`` says which steps' lengths it needs."""

    pieces: SweepKernels
    sizes: Sizes
    sweep: Sweep
    orders: Integers
    chosen: Integers
    arranged: arrangement.Arranged


@lru_cache(maxsize=16)
def _order_of_steps(program: Program, n: int) -> _Order:
    assert program.front == 0, "columns are of collocation, whose steps look at none before them"
    # Lengths that are the steps' numbers say which step stands where.
    nothing, lengths = np.empty((0, n * program.stages)), np.arange(n, dtype=np.float64)
    arranged = arrangement.Arranged.of(program, nothing, lengths)
    chosen = np.zeros(arranged.lengths.shape, dtype=np.int64)
    chosen[:, : program.steps] = arranged.lengths[:, : program.steps]
    pieces, orders = arrangement.scheme_kernels(program), np.array(program.orders, dtype=np.int64)
    return _Order(pieces, arranged.sizes(0, 0), arranged.sweep, orders, chosen, arranged)


@jit
def solve_columns(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, initial: bool, first: Given,
    lanes: Integers, dx: Array, monodromy: Array, ok: Flags,
) -> None:  # fmt: skip
    """All columns of every lane, one after the other; ``first`` says where the first lane's are."""
    D, solution = sizes.state, sizes.steps * sizes.unknowns
    for lane in lanes:
        given = _of_lane(sizes, first, lane)
        if given.x != 0:
            as_swept(sizes, sweep, numbers(given.x), work.now)
        ok[lane] = _eliminated(pieces, sizes, sweep, work, given)
        if not ok[lane]:
            continue
        _multiply(pieces, sizes, work, pointer(monodromy, lane * D * D))
        ok[lane] = initial or close(pieces, sizes, work) == CONVERGED
        for column in range(given.columns if ok[lane] else 0):
            # A step of Newton's is solved with the elimination. Derivatives all come after it, so
            # that none depends on which of them is the first, by rounding.
            if column > 0 or given.x == 0:
                _substituted(pieces, sizes, sweep, work, given, column)
            start_chunks(pieces, sizes, work, initial)
            update(pieces.update, sizes, sweep, work)
            to = pointer(dx, lane * solution * given.columns)
            _in_column(sizes, sweep, work, given, column, to)


def compile_columns() -> None:
    """Compile the elimination for what it is called with, or load it, as
    :func:`~bayesoleo.solvers._periodic_newton.compile_iteration` does."""
    solve_columns(
        nothing(SweepKernels), nothing(Sizes), nothing(Sweep), nothing(Work), False,
        Given(0, 0, 0, 0, 0, 0), np.empty(0, dtype=np.int64), np.empty((0, 1, 1, 1)),
        np.empty((0, 1, 1)), np.empty(0, dtype=np.bool_),
    )  # fmt: skip


@inner
def _of_lane(sizes: Sizes, first: Given, lane: int) -> Given:
    d, D, points = sizes.d, sizes.state, sizes.steps * sizes.stages
    x, jumps = first.x, first.jumps
    if x != 0:
        x += NUMBER * lane * sizes.steps * sizes.unknowns
    if jumps != 0:
        jumps += NUMBER * lane * D * first.columns * sizes.steps
    gz = first.gz + NUMBER * lane * d * sizes.nz * points
    right = first.right + NUMBER * lane * d * first.columns * points
    return Given(gz, right, x, jumps, first.orders, first.columns)


@inner
def _eliminated(pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, given: Given) -> bool:
    """Eliminate the steps' own unknowns, with the first column; whether no rows need exchange."""
    steps, stages, d, nz = sizes.block, sizes.stages, sizes.d, sizes.nz
    points, per_row = sizes.steps * stages, sizes.new * (sizes.state + 1) * WIDTH
    x, z, sums = numbers(work.x_block), numbers(work.z), numbers(work.sums)
    gz, bad = carray(numbers(given.gz), (d * nz, points)), 0
    source = carray(integers(sweep.source), (sizes.positions,))
    out = carray(numbers(work.out), (d * (1 + nz), BLOCK))
    for b in range(sizes.blocks):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        _fill_right(sizes, sweep, work, given, b, 0)
        for k in range(d * nz):
            for stage in range(stages):
                for i in range(count):
                    out[d + k, stage * steps + i] = gz[k, source[b * steps + i] * stages + stage]
        length = after(numbers(sweep.h), b * BLOCK)
        if given.x == 0:
            _without_jumps(sizes, work)
        else:
            now = after(numbers(work.now), b * steps)
            call_rows(pieces.rows, (now, x, length, z, sizes.positions, steps))
        if given.jumps != 0:
            _add_jumps(sizes, sweep, work, given, b, 0)
        transfer = after(numbers(work.transfer), b * sizes.transfer * steps)
        arguments = numbers(work.out), x, length, z, sums, transfer, count
        bad += call_eliminate(pieces.eliminate, arguments)
        history = after(numbers(work.history), b * (steps // WIDTH) * per_row)
        call_chain(pieces.chain, (transfer, history, count // WIDTH, WIDTH))
    return bad == 0


@inner
def _multiply(pieces: SweepKernels, sizes: Sizes, work: Work, monodromy: Any) -> None:
    """Product of all steps' matrices, ``(D, D)``."""
    D, products = sizes.state, numbers(work.products)
    size = sizes.steps // WIDTH, sizes.steps % WIDTH, WIDTH
    call_product(pieces.product, (numbers(work.history), products, *size))
    product = carray(after(products, WIDTH * D * sizes.columns), (D, sizes.columns))
    found = carray(monodromy, (D, D))
    for i in range(D):
        for k in range(D):
            found[i, k] = product[i, k]


@inner
def _substituted(
    pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work, given: Given, column: int
) -> None:
    """The recursion's constants of another column, by the last elimination."""
    steps, per_row = sizes.block, sizes.new * (sizes.state + 1) * WIDTH
    x, out = numbers(work.x_block), numbers(work.out)
    for b in range(sizes.blocks):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        _fill_right(sizes, sweep, work, given, b, column)
        if b == 0 or given.jumps != 0:
            _without_jumps(sizes, work)
        if given.jumps != 0:
            _add_jumps(sizes, sweep, work, given, b, column)
        length = after(numbers(sweep.h), b * BLOCK)
        transfer = after(numbers(work.transfer), b * sizes.transfer * steps)
        call_substitute(pieces.substitute, (out, x, length, transfer, count))
        history = after(numbers(work.history), b * (steps // WIDTH) * per_row)
        call_follow(pieces.follow, (transfer, history, count // WIDTH, WIDTH))


@inner
def _without_jumps(sizes: Sizes, work: Work) -> None:
    """Unknowns of a block that go on from step to step: none."""
    x = carray(numbers(work.x_block), (sizes.unknowns * REACH,))
    for i in range(sizes.unknowns * REACH):
        x[i] = 0.0


@inner
def _add_jumps(sizes: Sizes, sweep: Sweep, work: Work, given: Given, b: int, column: int) -> None:
    """Add to a block's unknowns what jumps at the end of each step as a column of ``jumps`` says:
    the scheme's pieces remove jumps of unknowns, and know no others."""
    steps, columns = sizes.block, given.columns
    count = min(steps, sizes.rows * WIDTH - b * steps)
    x = carray(numbers(work.x_block), (sizes.unknowns, REACH))
    h = carray(after(numbers(sweep.h), b * BLOCK), (BLOCK,))
    source = carray(integers(sweep.source), (sizes.positions,))
    jumps = carray(numbers(given.jumps), (sizes.state * columns, sizes.steps))
    state = 0
    for order in carray(integers(given.orders), (sizes.d,)):
        last = state + order - 1
        for c in range(WIDTH):
            value = rate = 0.0
            for i in range(c, count, WIDTH):
                m = source[b * steps + i]
                # A velocity that has jumped would move the value along the step.
                value += h[i] * rate - jumps[state * columns + column, m]
                rate -= jumps[last * columns + column, m]
                x[last, i + WIDTH] += rate
                if order == 2:
                    x[state, i + WIDTH] += value
        state += order


@inner
def _fill_right(sizes: Sizes, sweep: Sweep, work: Work, given: Given, b: int, column: int) -> None:
    """A column of ``right (d, columns, N)`` at the points of a block."""
    steps, stages, points = sizes.block, sizes.stages, sizes.steps * sizes.stages
    right = carray(numbers(given.right), (sizes.d * given.columns, points))
    source = carray(integers(sweep.source), (sizes.positions,))
    out = carray(numbers(work.out), (sizes.d, BLOCK))
    for e in range(sizes.d if given.columns > 0 else 0):
        row = e * given.columns + column
        for stage in range(stages):
            for i in range(min(steps, sizes.rows * WIDTH - b * steps)):
                out[e, stage * steps + i] = right[row, source[b * steps + i] * stages + stage]


@inner
def _in_column(sizes: Sizes, sweep: Sweep, work: Work, given: Given, column: int, to: Any) -> None:
    """Copy what was swept to a column of ``(n, w, columns)``."""
    unknowns, row, columns = sizes.unknowns, sizes.positions, given.columns
    swept = carray(numbers(work.dx), (unknowns * row,))
    found = carray(to, (sizes.steps * unknowns * columns,))
    lengths = carray(integers(sweep.lengths), (WIDTH,))
    for k in range(unknowns):
        place = k * columns + column
        for c in range(WIDTH):
            at = k * row + c
            for _ in range(lengths[c]):
                found[place] = swept[at]
                place += unknowns * columns
                at += WIDTH
