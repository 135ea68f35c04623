"""The equations of a period, linearised, and the recursion through its steps that solves them.

Models and schemes come as compiled pieces of fixed signature (``bayesoleo.compiled`` and
``solvers.schemes.unrolled``), so this is compiled once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray  # type: ignore[attr-defined] # not in its __all__

from bayesoleo._types import Array, Integers
from bayesoleo.compiled import BLOCK, after, call_kernel, caller, pointer
from bayesoleo.solvers.periodic.arrangement import Sizes, Sweep, SweepKernels, Work
from bayesoleo.solvers.periodic.measures import total
from bayesoleo.solvers.schemes.closure import LARGEST_GROWTH, close_balanced
from bayesoleo.solvers.schemes.closure import close as solve_closure
from bayesoleo.solvers.schemes.elimination import jit
from bayesoleo.solvers.schemes.unrolled.emit import REACH, WIDTH
from bayesoleo.solvers.schemes.unrolled.program import SIGNATURES
from bayesoleo.solvers.status import Status

#: A pivot that asks for an exchange of rows, or a recursion that grows so much that its rounding
#: errors would spoil the closure: neither is a failure of the problem, only of this elimination.
NEEDS_EXCHANGE = -1

CONVERGED = Status.CONVERGED.value
INADMISSIBLE = Status.INADMISSIBLE.value
SINGULAR = Status.SINGULAR.value
NOT_FINITE = Status.NOT_FINITE.value

_call_rows, _call_chain = caller(SIGNATURES["rows"]), caller(SIGNATURES["chain"])
_call_eliminate = caller(SIGNATURES["eliminate"])
_call_substitute, _call_follow = caller(SIGNATURES["substitute"]), caller(SIGNATURES["follow"])
_call_product, _call_begin = caller(SIGNATURES["product"]), caller(SIGNATURES["begin"])
_call_update = caller(SIGNATURES["update"])


@jit
def keep(source: Array, target: Array) -> None:
    _copy(pointer(source, 0), pointer(target, 0), source.size)


@jit
def _copy(source: Any, target: Any, count: int) -> None:
    """Copy numbers. Cutting rows out of arrays instead would cost more than copying them: arrays
    count references; and indices that may be negative allow no vector instructions."""
    source, target = carray(source, (count,)), carray(target, (count,))
    for i in range(count):
        target[i] = source[i]


@jit
def take(base: Array, dx: Array, fraction: float, now: Array) -> None:
    """``now = base + fraction dx``, two different arrays."""
    size = now.size
    to, change = carray(pointer(now, 0), (size,)), carray(pointer(dx, 0), (size,))
    begin = carray(pointer(base, 0), (size,))
    for i in range(size):
        to[i] = begin[i] + fraction * change[i]


@jit
def move(now: Array, dx: Array) -> None:
    """``now += dx``. In :func:`take` they would overlap, which forbids vector instructions."""
    size = now.size
    to, change = carray(pointer(now, 0), (size,)), carray(pointer(dx, 0), (size,))
    for i in range(size):
        to[i] += change[i]


@jit
def evaluate(pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work) -> int:
    """Equations at the present unknowns, and the recursion that solves them linearised."""
    steps, stages = sizes.block, sizes.stages
    reach = steps + (sizes.front + 1) * WIDTH
    points, per_row = steps * stages, sizes.new * (sizes.state + 1) * WIDTH
    x, u, h, p = pointer(work.x_block, 0), sweep.inputs, sweep.h, pointer(work.constants, 0)
    z, out, sums = pointer(work.z, 0), pointer(work.out, 0), pointer(work.sums, 0)
    work.sums[:] = 0.0
    bad, outside = 0, 0
    for b in range(u.shape[0]):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        inputs, length = pointer(u, b * u.shape[1] * BLOCK), pointer(h, b * BLOCK)
        _gather(pointer(work.now, b * steps), work.now.shape[1], x, sizes.unknowns, reach)
        _call_rows(pieces.rows, (x, length, z, steps))
        if sizes.conditions > 0:
            call_kernel(pieces.admissible, (z, inputs, p, out, points))
            outside += _outside(out, sizes, count)
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
def evaluate_again(pieces: SweepKernels, sizes: Sizes, sweep: Sweep, work: Work) -> bool:
    """Equations alone at the present unknowns, solved with the last derivatives; whether the
    unknowns are admissible."""
    steps, stages = sizes.block, sizes.stages
    reach = steps + (sizes.front + 1) * WIDTH
    points, per_row = steps * stages, sizes.new * (sizes.state + 1) * WIDTH
    x, u, h, p = pointer(work.x_block, 0), sweep.inputs, sweep.h, pointer(work.constants, 0)
    z, out = pointer(work.z, 0), pointer(work.out, 0)
    outside = 0
    for b in range(u.shape[0]):
        count = min(steps, sizes.rows * WIDTH - b * steps)
        inputs, length = pointer(u, b * u.shape[1] * BLOCK), pointer(h, b * BLOCK)
        _gather(pointer(work.now, b * steps), work.now.shape[1], x, sizes.unknowns, reach)
        _call_rows(pieces.rows, (x, length, z, steps))
        if sizes.conditions > 0:
            call_kernel(pieces.admissible, (z, inputs, p, out, points))
            outside += _outside(out, sizes, count)
        call_kernel(pieces.residual, (z, inputs, p, out, points))
        transfer = pointer(work.transfer, b * work.transfer.shape[1])
        _call_substitute(pieces.substitute, (out, x, length, transfer, count))
        history = pointer(work.history, b * (steps // WIDTH) * per_row)
        _call_follow(pieces.follow, (transfer, history, count // WIDTH, WIDTH))
    return outside == 0


@jit
def _gather(now: Any, row: int, x: Any, unknowns: int, reach: int) -> None:
    """Copy a block's unknowns, and those before it that its steps reach."""
    for k in range(unknowns):
        _copy(after(now, k * row), after(x, k * REACH), reach)


@jit
def _outside(a: Any, sizes: Sizes, count: int) -> int:
    """How many points break a condition; one that is not a number shows in the equations."""
    outside = 0
    for k in range(sizes.conditions):
        for stage in range(sizes.stages):
            values = carray(after(a, k * BLOCK + stage * sizes.block), (count,))
            for i in range(count):
                outside += values[i] <= 0.0
    return outside


@jit
def _silence(sizes: Sizes, lengths: Integers, b: int, count: int, z: Array, out: Array) -> None:
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
def close(pieces: SweepKernels, sizes: Sizes, work: Work) -> int:
    """Invert the closure of the period, from the recursion's matrices alone."""
    inverse, closure, products = work.inverse, work.closure, work.products
    history, whole, rest = pointer(work.history, 0), sizes.steps // WIDTH, sizes.steps % WIDTH
    _call_product(pieces.product, (history, pointer(products, 0), whole, rest, WIDTH))
    product = products[WIDTH]
    _set_identity(inverse)
    regular, growth = solve_closure(product, inverse, closure)
    if not regular or growth > LARGEST_GROWTH:
        _set_identity(inverse)
        regular, growth = close_balanced(product, inverse, closure, work.scale)
    if growth > LARGEST_GROWTH:
        return NEEDS_EXCHANGE
    return CONVERGED if regular else SINGULAR


@jit
def _set_identity(matrix: Array) -> None:
    for i in range(matrix.shape[0]):
        for k in range(matrix.shape[1]):
            matrix[i, k] = 1.0 if i == k else 0.0


@jit
def start_chunks(pieces: SweepKernels, sizes: Sizes, work: Work, initial: bool) -> None:
    """First state of every chunk: that of the period from its closure, or zero."""
    history, whole, rest = pointer(work.history, 0), sizes.steps // WIDTH, sizes.steps % WIDTH
    inverse, start = pointer(work.inverse, 0), pointer(work.start, 0)
    _call_begin(pieces.begin, (history, inverse, start, whole, rest, 0 if initial else 1))


@jit
def update(update: int, sizes: Sizes, sweep: Sweep, work: Work) -> None:
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
            dx[k, i] = dx[k, sweep.again[i]]
        for i in range((sizes.front + sizes.rows - 1) * WIDTH, sweep.source.size):
            dx[k, i] = dx[k, sweep.again[i]]
