"""Memory layout of a period's steps, and compiled norms of residuals and steps.

Steps are kept in the order in which they are swept: :data:`WIDTH` chunks side by side, with as many
rows before and after them as a scheme looks at; chunks that are a step shorter are filled up with
the first step of the next.

Norms are computed lane by lane in a fixed order. Library reductions would change their order of
summation with the shape of the batch, and with it the last bits of a solution.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate
from typing import Any, NamedTuple, cast

import numpy as np
from numba import config

from bayesoleo._compiled import BLOCK, inner, jit, record
from bayesoleo._types import Array, Flags, Integers
from bayesoleo.solvers._blocked_collocation import columns_of
from bayesoleo.solvers._unrolled_collocation import REACH, WIDTH
from bayesoleo.solvers._unrolled_program import Program, chunks

#: Motion about a level that is smaller than this part of it is measured by the level: the digits of
#: a step are lost against it.
LEAST_MOTION = 1e-6
#: Fewer steps than that leave chunks empty.
LEAST_STEPS = WIDTH
#: Bytes of arrays that a thread keeps, beside those that it uses.
MOST_KEPT = 32_000_000
#: Bytes of the steps' matrices, which a thread keeps, above which the general iteration, that
#: eliminates them in groups, solves: a transient of ten dofs has them at thirty thousand steps.
MOST_BYTES = 5e8
#: Numbers in a cache line.
LINE = 8
_kept = threading.local()


@inner
def total(row: Array) -> float:
    """Sum in eight interleaved partial sums: in fixed order, without waiting for each addition."""
    a = b = c = d = e = f = g = h = 0.0
    whole = row.size - row.size % 8
    for i in range(0, whole, 8):
        a += row[i]
        b += row[i + 1]
        c += row[i + 2]
        d += row[i + 3]
        e += row[i + 4]
        f += row[i + 5]
        g += row[i + 6]
        h += row[i + 7]
    for i in range(whole, row.size):
        a += row[i]
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@jit
def measure(z: Array, g: Array, gz: Array, lanes: Integers, squares: Array, terms: Array) -> None:
    """Mean squares of residuals and of terms, both ``(L, d)``; not finite where anything is not."""
    d, nz, points = gz.shape[1:]
    row = np.empty(points)
    for lane in lanes:
        for e in range(d):
            for i in range(points):
                row[i] = g[lane, e, i] * g[lane, e, i]
            squares[lane, e] = total(row) / points
            for k in range(nz):
                for i in range(points):
                    term = gz[lane, e, k, i] * z[lane, k, i]
                    row[i] += term * term
            terms[lane, e] = total(row) / points


@jit
def positive(a: Array, lanes: Integers, inside: Flags, defined: Flags) -> None:
    """Whether no condition ``a (L, nc, N)`` is broken; whether all are numbers: both (L,)."""
    for lane in lanes:
        outside = odd = 0
        for k in range(a.shape[1]):
            for i in range(a.shape[2]):
                outside += a[lane, k, i] <= 0.0
                odd += a[lane, k, i] != a[lane, k, i]
        inside[lane] = outside == 0
        defined[lane] = odd == 0


@inner
def unit(motion: float, level: float, change: float) -> float:
    """The scale of changes of a state: its motion about a level, not the level itself.

    A preload or an ambient temperature says nothing of how far a solution is from its own motion.
    The change itself bounds it: there is no step longer than the motion that it makes.
    """
    return max(motion, LEAST_MOTION * abs(level), change)


@jit
def step_size(
    x: Array, dx: Array, lanes: Integers, state_size: int, size: Array, least: Array
) -> None:
    """Largest change of a state over its :func:`unit`, and over its largest value, both of shape
    (L,); NaN where one is not finite."""
    n, w = x.shape[1:]
    for lane in lanes:
        spoilt = 0.0
        for m in range(n):
            for j in range(w):
                spoilt += dx[lane, m, j, 0] * 0.0
        size[lane] = least[lane] = spoilt
        for j in range(min(state_size, w)):
            level, motion, change = x[lane, 0, j], 0.0, 0.0
            for m in range(n):
                motion = max(motion, abs(x[lane, m, j] - level))
                change = max(change, abs(dx[lane, m, j, 0]))
            if spoilt == 0.0 and change > 0.0:
                size[lane] = max(size[lane], change / unit(motion, level, change))
                least[lane] = max(least[lane], change / max(motion + abs(level), change))


@jit
def take(base: Array, dx: Array, lanes: Integers, fractions: Array, x: Array) -> None:
    """``x = base + fraction * dx`` in the chosen lanes."""
    n, w = x.shape[1:]
    for k in range(lanes.size):
        lane = lanes[k]
        for m in range(n):
            for j in range(w):
                x[lane, m, j] = base[lane, m, j] + fractions[k] * dx[lane, m, j, 0]


@jit
def keep(source: Array, lanes: Integers, target: Array) -> None:
    """Copy the chosen lanes."""
    n, w = source.shape[1:]
    for lane in lanes:
        for m in range(n):
            for j in range(w):
                target[lane, m, j] = source[lane, m, j]


class Sizes(NamedTuple):
    """Numbers that a compiled lane needs; most are those of the scheme's program."""

    steps: int
    rows: int
    positions: int
    blocks: int
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
    columns: int
    measured: int
    chords: int


@dataclass(frozen=True)
class SweepLayout:
    """Places of the steps of a period while they are swept.

    Parameters
    ----------
    place : ndarray of int, shape (n,)
        Position of each step, in rows of ``WIDTH`` chunks, rows before the first included.
    source : ndarray of int, shape (positions,)
        Step that stands at each position; steps stand more than once.
    lengths : ndarray of int, shape (WIDTH,)
        Of the chunks.
    """

    place: Integers
    source: Integers
    lengths: Integers

    @staticmethod
    @lru_cache(maxsize=64)
    def of(n: int, front: int, block: int) -> SweepLayout:
        """For a period of ``n`` steps in blocks of ``block``, with ``front`` rows before it."""
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
        return SweepLayout(place, source.ravel(), lengths)


class SweepKernels(NamedTuple):
    """Addresses of the compiled functions of a model and of a scheme."""

    residual: int
    jacobian: int
    admissible: int
    rows: int
    eliminate: int
    chain: int
    substitute: int
    follow: int
    product: int
    begin: int
    update: int


def scheme_kernels(program: Program, model: tuple[int, int, int] = (0, 0, 0)) -> SweepKernels:
    """Addresses of a scheme's pieces, behind those of a model: none where none is evaluated."""
    return SweepKernels(
        *model,
        rows=program.rows,
        eliminate=program.eliminate,
        chain=program.chain,
        substitute=program.substitute,
        follow=program.follow,
        product=program.product,
        begin=program.begin,
        update=program.update,
    )


class Sweep(NamedTuple):
    """Order of the steps, inputs and lengths of steps, as they are swept, by their addresses:
    ``again (positions,)``, where the step of each position stands for good, and those of
    :class:`SweepLayout` and :class:`Arranged`."""

    again: int
    source: int
    lengths: int
    inputs: int
    h: int


class Work(NamedTuple):
    """Arrays of one lane at a time, which are allocated once: their addresses for compiled code,
    their shapes, or themselves."""

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
    closure: Any
    scale: Any
    inverse: Any
    measures: Any
    before: Any
    constants: Any


def can_sweep(program: Program, n: int) -> bool:
    """Whether ``n`` steps are enough for all chunks, and not too many for the memory; never where
    functions are not compiled."""
    compiled = not getattr(config, "DISABLE_JIT", False)
    return compiled and n >= LEAST_STEPS and 8 * program.transfer * n <= MOST_BYTES


def work_space(sizes: Sizes, order: Sequence[int]) -> Work:
    """Room for lanes of given sizes, whose history has the state in an order.

    A thread keeps what it used last: addresses hold until it asks for others. To allocate anew for
    every run, where lengths of runs differ, can take half as long as to solve.
    """
    key = sizes, tuple(order)
    rooms: dict[Any, tuple[Work, Work]] = _kept.__dict__.setdefault("rooms", {})
    room = rooms.pop(key, None)
    if room is None:
        arrays = _allocate(*key)
        while rooms and sum(_size(kept) for kept, _ in rooms.values()) + _size(arrays) > MOST_KEPT:
            del rooms[next(iter(rooms))]
        room = arrays, Work(*[array.ctypes.data for array in arrays])
    rooms[key] = room
    return room[1]


def _size(arrays: Work) -> int:
    """Bytes."""
    return sum(array.nbytes for array in arrays)


def _allocate(sizes: Sizes, order: tuple[int, ...]) -> Work:
    """Zeros, each array from the beginning of a cache line on: vector instructions that straddle
    two lines take twice as long."""
    shapes = _shapes(sizes)
    ends = list(accumulate(-(-math.prod(shape) // LINE) * LINE for shape in shapes))
    room = np.zeros(ends[-1] + LINE)
    room = room[-(room.ctypes.data // room.itemsize) % LINE :]
    begins = zip(shapes, [0, *ends], strict=False)
    work = Work(*[room[at : at + math.prod(shape)].reshape(shape) for shape, at in begins])
    own = np.arange(sizes.state)
    work.history[list(order), own] = 1.0  # a chunk's first state, in terms of itself
    work.products[0, own, own] = 1.0
    return work


def _shapes(sizes: Sizes) -> Work:
    w, D, d = sizes.unknowns, sizes.state, sizes.d
    positions, blocks = sizes.positions, sizes.blocks
    length = (blocks * sizes.block // WIDTH + 1) * sizes.new + sizes.window
    return Work(
        now=(w, positions),
        base=(w, positions),
        dx=(w, positions),
        x_block=(w, REACH),
        dx_block=(w, BLOCK),
        z=(sizes.nz, BLOCK),
        out=(max(d * (1 + sizes.nz), sizes.conditions), BLOCK),
        sums=(2 * d, BLOCK),
        scratch=(positions,),
        transfer=(blocks, sizes.transfer * sizes.block),
        history=(length, D + 1, WIDTH),
        start=(D, WIDTH),
        products=(WIDTH + 1, D, sizes.columns),
        closure=(D, D),
        scale=(D,),
        inverse=(D, D),
        measures=(2 * d,),
        before=(2 * d,),
        constants=(max(sizes.constants, 1),),
    )


def nothing[T: tuple[Any, ...]](kind: type[T]) -> T:
    """A record of zeros, to compile what takes one without a problem."""
    named = cast(Any, kind)
    return record(cast(T, named(*[0] * len(named._fields))))


class Options(NamedTuple):
    """How the iteration goes; see :func:`bayesoleo.solvers.solve_periodic`."""

    max_iterations: int
    monotone: bool
    initial: bool


class LinearStart(NamedTuple):
    """Where lanes start: ``base (w, positions)`` and ``change (L, active)`` times ``slopes (active,
    w, positions)``, by their addresses."""

    base: int
    slopes: int
    change: int
    active: int


#: Where ``x`` says it.
NO_LINE = LinearStart(0, 0, 0, 0)


@dataclass(frozen=True)
class Arranged:
    """A period's inputs and mesh as they are swept.

    Parameters
    ----------
    program : Program
        The scheme's compiled pieces.
    layout : SweepLayout
        Order of the steps.
    inputs, lengths : ndarray, shapes (blocks, inputs, BLOCK) and (blocks, BLOCK)
        Of each block, contiguous; at least one input, of zeros.
    """

    program: Program
    layout: SweepLayout
    inputs: Array
    lengths: Array

    @staticmethod
    def of(program: Program, inputs: Array, lengths: Array) -> Arranged:
        """From inputs ``(nu, n s)`` at the points and lengths ``(n,)`` of the steps, s."""
        layout = SweepLayout.of(lengths.size, program.front, program.steps)
        steps, s, nu = program.steps, program.stages, inputs.shape[0]
        count = -(-int(layout.lengths[0]) * WIDTH // steps)
        blocks = np.zeros((count, max(nu, 1), BLOCK))
        of_steps = np.ones((count, BLOCK))
        begin = program.front * WIDTH
        chosen = layout.source[begin : begin + count * steps].reshape(count, steps)
        of_steps[:, :steps] = lengths[chosen]
        for stage in range(s):
            part = slice(stage * steps, (stage + 1) * steps)
            blocks[:, :nu, part] = np.moveaxis(inputs[:, chosen * s + stage], 0, 1)
        return Arranged(program, layout, blocks, of_steps)

    @cached_property
    def sweep(self) -> Sweep:
        """The same for compiled code."""
        layout = self.layout
        arrays = self._again, layout.source, layout.lengths, self.inputs, self.lengths
        return Sweep(*[array.ctypes.data for array in arrays])

    @cached_property
    def _again(self) -> Integers:
        return self.layout.place[self.layout.source]

    def sizes(self, constants: int, conditions: int) -> Sizes:
        """Sizes for a model with so many constants and admissibility conditions."""
        program = self.program
        d = len(program.orders)
        return Sizes(
            steps=self.layout.place.size,
            rows=int(self.layout.lengths[0]),
            positions=self.layout.source.size,
            blocks=self.inputs.shape[0],
            inputs=self.inputs.shape[1],
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
            columns=columns_of(program.state),
            measured=min(sum(program.orders), program.unknowns),
            chords=program.chords,
        )
