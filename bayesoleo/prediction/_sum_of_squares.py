"""Sums of squared residuals at raw samples, without the residuals themselves, for a sampler.

Samples are taken in the order of their phase, in blocks. Each block goes through interpolation,
outputs and comparison while it is in the nearest cache. No array has the length of a record.
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
    """A :class:`~bayesoleo.solvers.SamplePlan` in blocks: index and position
    (blocks, BLOCK), weights (blocks, s, BLOCK)."""

    index: Any  # whole numbers; tuples have a method of this name
    position: Float[Array, "blocks BLOCK"]
    w0: Float[Array, "blocks stages BLOCK"]
    w1: Float[Array, "blocks stages BLOCK"]
    w2: Float[Array, "blocks stages BLOCK"]


@dataclass(frozen=True)
class FusedSquares:
    """How predictions of one run are compared with its samples.

    Parameters
    ----------
    kernels : Kernels
        Compiled.
    order : ndarray of int, shape (N,)
        Samples in the order of their phase.
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
    def of(cls, kernels: Kernels, scheme: Any, plan: Any, inputs: Array) -> FusedSquares | None:
        """For samples at planned phases with input rows (nu, N); None where there is no code for
        the scheme, or the kernels are not compiled."""
        compiled = isinstance(kernels.output, BlockKernel)
        if not compiled or not isinstance(scheme, Collocation) or not isinstance(plan, SamplePlan):
            return None
        derived = kernels.derived
        order = np.lexsort((plan.position, plan.index))
        return cls(
            kernels,
            order,
            _blocks(inputs[:, order]),
            _places(plan, order),
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
        derived = self.kernels.derived
        sums = np.full((len(p), len(derived.outputs)), np.nan)
        inside, defined = np.ones(len(p), dtype=np.bool_), np.ones(len(p), dtype=np.bool_)
        _compare(
            self.kernels.output.address, self.kernels.admissible.address, len(derived.admissible),
            self.order, self.inputs, self.places, self.orders, self.needed,
            np.ascontiguousarray(measured), np.ascontiguousarray(x), np.ascontiguousarray(p),
            step, lanes, sums, inside, defined,
        )  # fmt: skip
        return sums, inside, defined


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


def _places(plan: SamplePlan, order: Integers) -> Places:
    index, position = (_blocks(row[None, order])[:, 0] for row in (plan.index, plan.position))
    w0, w1, w2 = (_blocks(weights[:, order]) for weights in (plan.w0, plan.w1, plan.w2))
    return Places(index, position, w0, w1, w2)


@jit
def _compare(
    output: int, admissible: int, conditions: int, order: Integers, inputs: Array, places: Places,
    orders: Integers, needed: Flags, measured: Array, x: Array, p: Array, step: float,
    lanes: Integers, sums: Array, inside: Flags, defined: Flags,
) -> None:  # fmt: skip
    """Block by block, and in each lane by lane: all but the solutions stays in the cache.

    Squares are added point by point, and the points of a block only at the end: in an order that
    depends on nothing, and without waiting for one addition after the other.
    """
    ny, count = measured.shape[0], order.size
    z, out = np.zeros((max(needed.size, 1), BLOCK)), np.zeros((max(ny, conditions, 1), BLOCK))
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
                x, lane, b, places.index, places.position, places.w0, places.w1, places.w2,
                step, orders, needed, z,
            )  # fmt: skip
            call_kernel(output, (rows, u, constants, to, size))
            for k in range(ny):
                for i in range(size):
                    error = data[k, i] - out[k, i]
                    partial[place, k, i] += error * error
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
