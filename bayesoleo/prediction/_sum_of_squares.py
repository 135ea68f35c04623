"""Outputs at raw samples, or their sums of squared residuals alone, for a sampler.

Samples are taken in blocks: in the order of their phase where they are only compared, so that a
solution is read once, and as they were recorded where outputs are kept. Each block goes through
interpolation, outputs, conditions and comparison while it is in the nearest cache. Sums need no
array of the length of a record, and outputs none but their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayesoleo._compiled import BLOCK, BlockKernel, call_kernel, jit, pointer
from bayesoleo._types import Array, Flags, Float, Integers
from bayesoleo.model._derivatives import Derived
from bayesoleo.model._kernels import Kernels
from bayesoleo.solvers._collocation import Collocation, SamplePlan, sample_block
from bayesoleo.solvers._period_arrangement import total


class Places(NamedTuple):
    """A :class:`~bayesoleo.solvers.SamplePlan` in blocks: number of the first unknown of each
    sample's step, without a sign, and position (blocks, BLOCK), weights (blocks, s, BLOCK)."""

    first: Any  # whole numbers
    position: Float[Array, "blocks BLOCK"]
    w0: Float[Array, "blocks stages BLOCK"]
    w1: Float[Array, "blocks stages BLOCK"]
    w2: Float[Array, "blocks stages BLOCK"]


@dataclass(frozen=True)
class FusedOutputs:
    """How outputs of one run follow from its solutions, and are compared with its samples.

    Parameters
    ----------
    kernels : Kernels
        Compiled.
    order : ndarray of int, shape (N,)
        Samples in the order in which they are taken.
    inputs : ndarray, shape (blocks, nu, BLOCK)
        Input rows in that order.
    places : Places
        How the dofs' rows follow from the scheme's unknowns, in that order.
    orders : ndarray of int, shape (d,)
        Of the dofs.
    needed : ndarray of bool, shape (nz,)
        Rows that an output or a condition depends on.
    """

    kernels: Kernels
    order: Integers
    inputs: Array
    places: Places
    orders: Integers
    needed: Flags

    @classmethod
    def of(
        cls, kernels: Kernels, scheme: Any, plan: Any, inputs: Array, *, by_phase: bool
    ) -> FusedOutputs | None:
        """For samples at planned phases with input rows (nu, N), taken in the order of their phase
        or of the record; None where there is no code for the scheme, or the kernels are not
        compiled."""
        compiled = isinstance(kernels.output, BlockKernel)
        if not compiled or not isinstance(scheme, Collocation) or not isinstance(plan, SamplePlan):
            return None
        derived = kernels.derived
        order = np.arange(plan.index.size)
        if by_phase:
            order = np.lexsort((plan.position, plan.index))
        return cls(
            kernels,
            order,
            _blocks(inputs[:, order]),
            _places(plan, order, scheme.width),
            np.array(derived.orders, dtype=np.int64),
            _needed(derived),
        )

    def sums(
        self, measured: Array, x: Array, p: Array, step: float, lanes: Integers
    ) -> tuple[Array, Flags, Flags]:
        """Compare the chosen lanes with measured samples.

        Parameters
        ----------
        measured : ndarray, shape (ny, N)
            In the record's order, SI.
        x : ndarray, shape (L, n, w)
            Solutions.
        p : ndarray, shape (L, np)
            Constants.
        step : float
            Mean length of a step, s.
        lanes : ndarray of int
            Which of the L to compare.

        Returns
        -------
        sums : ndarray, shape (L, ny)
            Sums of squared residuals; NaN in other lanes.
        inside : ndarray of bool, shape (L,)
            No condition is broken at any sample.
        defined : ndarray of bool, shape (L,)
            All conditions are numbers.
        """
        sums = np.full((len(p), len(self.kernels.derived.outputs)), np.nan)
        nowhere = np.empty((len(p), len(measured), 0))
        return sums, *self._run(measured, x, p, step, lanes, sums, nowhere)

    def outputs(
        self, measured: Array, x: Array, p: Array, step: float, lanes: Integers
    ) -> tuple[Array, Flags, Flags]:
        """The outputs themselves, shape (L, ny, N), in the order in which samples are taken.

        Parameters and the other results are those of :meth:`sums`; ``defined`` also says that all
        outputs are finite. Other lanes have no outputs.
        """
        sums = np.empty((len(p), len(self.kernels.derived.outputs)))
        y = np.empty((*sums.shape, self.order.size))
        return y, *self._run(measured, x, p, step, lanes, sums, y)

    def _run(
        self, measured: Array, x: Array, p: Array, step: float, lanes: Integers, sums: Array,
        y: Array,
    ) -> tuple[Flags, Flags]:  # fmt: skip
        kernels = self.kernels
        inside, defined = np.ones(len(p), dtype=np.bool_), np.ones(len(p), dtype=np.bool_)
        _compare(
            kernels.output.address, kernels.admissible.address, len(kernels.derived.admissible),
            self.order, self.inputs, self.places, self.orders, self.needed,
            np.ascontiguousarray(measured), np.ascontiguousarray(x), np.ascontiguousarray(p),
            step, lanes, sums, y, inside, defined,
        )  # fmt: skip
        return inside, defined


def squared_distances(measured: Array, y: Array) -> Array:
    """Sums of squared residuals ``(L, ny)`` of predictions ``y (L, ny, N)``, lane by lane."""
    sums = np.empty(y.shape[:2])
    _distances(measured, y, sums)
    return sums


@jit
def _distances(measured: Array, y: Array, sums: Array) -> None:
    for lane in range(y.shape[0]):
        for k in range(y.shape[1]):
            error = measured[k] - y[lane, k]
            sums[lane, k] = total(error * error)


def _needed(derived: Derived) -> Flags:
    used = {s for item in (*derived.output, *derived.admissible) for s in item.free_symbols}
    return np.array([state in used for state in derived.states], dtype=np.bool_)


def _blocks(rows: NDArray[Any]) -> NDArray[Any]:
    """Rows (k, N) as blocks (blocks, k, BLOCK), the last one filled up with the last sample."""
    fill = -rows.shape[1] % BLOCK
    whole = np.concatenate([rows, np.repeat(rows[:, -1:], fill, axis=1)], axis=1)
    count = whole.shape[1] // BLOCK  # not left to reshape: a model may have no inputs
    return np.ascontiguousarray(whole.reshape(len(rows), count, BLOCK).swapaxes(0, 1))


def _places(plan: SamplePlan, order: Integers, width: int) -> Places:
    first = (plan.index * width).astype(np.uint64)
    first, position = (_blocks(row[None, order])[:, 0] for row in (first, plan.position))
    w0, w1, w2 = (_blocks(weights[:, order]) for weights in (plan.w0, plan.w1, plan.w2))
    return Places(first, position, w0, w1, w2)


@jit
def _compare(
    output: int, admissible: int, conditions: int, order: Integers, inputs: Array, places: Places,
    orders: Integers, needed: Flags, measured: Array, x: Array, p: Array, step: float,
    lanes: Integers, sums: Array, y: Array, inside: Flags, defined: Flags,
) -> None:  # fmt: skip
    """Block by block, and in each lane by lane: all but the solutions stays in the cache.

    Squares are added point by point, and the points of a block only at the end: in an order that
    depends on nothing, and without waiting for one addition after the other. Outputs are kept if
    ``y (L, ny, N)`` has room for any, one after the other: to put each where it was recorded would
    take longer than to compute it. All is one function: counting the references of arrays that are
    passed to another one for each block would take a third of the time.
    """
    ny, count = measured.shape[0], order.size
    z, out = np.zeros((max(needed.size, 1), BLOCK)), np.zeros((max(ny, conditions, 1), BLOCK))
    near = np.zeros((2 + places.w0.shape[1], BLOCK))
    data, partial = np.zeros((ny, BLOCK)), np.zeros((lanes.size, ny, BLOCK))
    for b in range(inputs.shape[0]):
        size = min(BLOCK, count - b * BLOCK)
        for k in range(ny):
            for i in range(size):
                data[k, i] = measured[k, order[b * BLOCK + i]]
        u, to, rows = pointer(inputs, b * inputs.shape[1] * BLOCK), pointer(out, 0), pointer(z, 0)
        for place in range(lanes.size):
            lane = lanes[place]
            constants = pointer(p, lane * p.shape[1])
            sample_block(
                x, lane, b, places.first, places.position, places.w0, places.w1, places.w2,
                step, orders, needed, near, z,
            )  # fmt: skip
            call_kernel(output, (rows, u, constants, to, size))
            for k in range(ny):
                for i in range(size):
                    error = data[k, i] - out[k, i]
                    partial[place, k, i] += error * error
            if y.shape[2] > 0:
                odd = 0
                for k in range(ny):
                    for i in range(size):
                        odd += not abs(out[k, i]) < np.inf
                    for i in range(size):
                        y[lane, k, b * BLOCK + i] = out[k, i]
                defined[lane] = defined[lane] and odd == 0
            if conditions > 0:
                call_kernel(admissible, (rows, u, constants, to, size))
                broken = odd = 0
                for k in range(conditions):
                    for i in range(size):
                        broken += out[k, i] <= 0.0
                        odd += out[k, i] != out[k, i]
                inside[lane] = inside[lane] and broken == 0
                defined[lane] = defined[lane] and odd == 0
    for place in range(lanes.size):
        for k in range(ny):
            sums[lanes[place], k] = total(partial[place, k])
