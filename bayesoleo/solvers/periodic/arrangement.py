"""Where the steps of a period stand while they are swept, and the arrays that a lane needs.

Steps are kept in the order in which they are swept:
:data:`~bayesoleo.solvers.schemes.unrolled.emit.WIDTH` chunks side by side, with as many rows before
and after them as a scheme looks at; chunks that are a step shorter are filled up with the first
step of the next.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array, Float, Integers
from bayesoleo.compiled import BLOCK
from bayesoleo.solvers.schemes.unrolled.emit import COLUMNS, REACH, WIDTH
from bayesoleo.solvers.schemes.unrolled.program import Program, chunks

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
class SweepLayout:
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
    def of(n: int, front: int, block: int) -> SweepLayout:
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


class Sweep(NamedTuple):
    """Order of the steps, inputs and lengths of steps, as they are swept; ``again`` is where the
    step of each position stands for good."""

    again: Integers
    source: Integers
    lengths: Integers
    order: Integers
    inputs: Array
    h: Array


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
    closure: Any
    scale: Any
    inverse: Any
    measures: Any
    before: Any
    constants: Any


#: Numbers in a cache line.
LINE = 8


def work_space(sizes: Sizes, sweep: Sweep) -> Work:
    """Arrays for lanes of given sizes; a thread keeps those it used last."""
    key = sizes, sweep.source.size, sweep.inputs.shape[0], sweep.order.tobytes()
    if getattr(_kept, "key", None) != key:
        _kept.key, _kept.work = key, _allocate(*key[:3], sweep.order)
    work: Work = _kept.work
    return work


_kept = threading.local()


def _allocate(sizes: Sizes, positions: int, blocks: int, order: NDArray[np.int64]) -> Work:
    """Zeros, each array from the beginning of a cache line on: vector instructions that straddle
    two lines take twice as long."""
    shapes = _shapes(sizes, positions, blocks)
    ends = list(accumulate(-(-math.prod(shape) // LINE) * LINE for shape in shapes))
    room = np.zeros(ends[-1] + LINE)
    room = room[-(room.ctypes.data // room.itemsize) % LINE :]
    begins = zip(shapes, [0, *ends], strict=False)
    work = Work(*[room[at : at + math.prod(shape)].reshape(shape) for shape, at in begins])
    own = np.arange(sizes.state)
    work.history[order, own] = 1.0  # a chunk's first state, in terms of itself
    work.products[0, own, own] = 1.0
    return work


def _shapes(sizes: Sizes, positions: int, blocks: int) -> Work:
    w, D, d = sizes.unknowns, sizes.state, sizes.d
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
        products=(WIDTH + 1, D, COLUMNS),
        closure=(D, D),
        scale=(D,),
        inverse=(D, D),
        measures=(2 * d,),
        before=(2 * d,),
        constants=(max(sizes.constants, 1),),
    )


class Options(NamedTuple):
    """How the iteration goes; see :func:`bayesoleo.solvers.periodic.solve.solve_periodic`."""

    max_iterations: int
    monotone: bool
    initial: bool


class LinearStart(NamedTuple):
    """Where lanes start: ``base (w, positions)`` and ``change (L, na)`` times ``slopes (na, w,
    positions)``; empty where ``x`` says it."""

    base: Float[Array, "width positions"]
    slopes: Float[Array, "active width positions"]
    change: Float[Array, "vectors active"]


NO_LINE = LinearStart(np.empty((0, 0)), np.empty((0, 0, 0)), np.empty((0, 0)))


@dataclass(frozen=True)
class Arranged:
    """A period's inputs and mesh as they are swept.

    Parameters
    ----------
    program : Program
        The scheme's compiled pieces.
    layout : SweepLayout
        Order of the steps.
    inputs, lengths : ndarray, shapes (b, nu, BLOCK) and (b, BLOCK)
        Of each block.
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
        for b in range(count):
            begin = program.front * WIDTH + b * steps
            chosen = layout.source[begin : begin + steps]
            of_steps[b, :steps] = lengths[chosen]
            for stage in range(s):
                part = slice(stage * steps, (stage + 1) * steps)
                blocks[b, :nu, part] = inputs[:, chosen * s + stage]
        return Arranged(program, layout, blocks, of_steps)

    @cached_property
    def sweep(self) -> Sweep:
        """The same for compiled code."""
        layout, order = self.layout, np.array(self.program.order, dtype=np.int64)
        source = layout.source
        return Sweep(layout.place[source], source, layout.lengths, order, self.inputs, self.lengths)

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
