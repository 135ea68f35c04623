"""Rows of a batch that share their unknowns: each vector is solved for once, whatever the errors.

Searches for modes and differences of a density vary the quantities of an error model at a motion
that stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from bayesoleo._types import Array, Flags, Integers


@dataclass(frozen=True)
class Block:
    """Some vectors, and the rows that have them.

    Parameters
    ----------
    lanes : ndarray of int, shape (L,)
        Numbers of the vectors.
    rows : ndarray of int, shape (R,)
        Numbers of the rows, in the order of their vectors.
    of_row : ndarray of int, shape (R,)
        Of each row, the place of its vector among ``lanes``.
    """

    lanes: Integers
    rows: Integers
    of_row: Integers

    def by_row(self, values: Array) -> Array:
        """Values of the rows, (R, ...), from those of the vectors, (L, ...)."""
        return values if self.rows.size == self.lanes.size else values[self.of_row]

    def only(self, good: Flags) -> Block:
        """What is left of it where some of its vectors, (L,), are left."""
        kept, number = good[self.of_row], np.cumsum(good) - 1
        return Block(self.lanes[good], self.rows[kept], number[self.of_row[kept]])


@dataclass(frozen=True)
class SameUnknowns:
    """The different vectors of a batch.

    Parameters
    ----------
    theta : ndarray, shape (V, l)
        Each of them once.
    of_row : ndarray of int, shape (W,)
        Which of them each row of the batch has.
    """

    theta: Array
    of_row: Integers

    @classmethod
    def of(cls, theta: Array) -> Self:
        """Of a batch, shape (W, l)."""
        # Proposals differ in every unknown, which one of them tells in a tenth of the time.
        if theta.size and len(np.unique(theta[:, 0])) == len(theta):
            return cls(theta, np.arange(len(theta)))
        found, of_row = np.unique(theta, axis=0, return_inverse=True)
        if len(found) == len(theta):
            return cls(theta, np.arange(len(theta)))
        return cls(found, of_row.reshape(-1))

    def blocks(self, size: int) -> list[Block]:
        """Blocks of so many vectors; none of no rows."""
        if not len(self.theta):
            return []
        order = np.argsort(self.of_row, kind="stable")
        starts = range(0, len(self.theta), size)
        cuts = np.searchsorted(self.of_row[order], starts[1:])
        return [
            Block(np.arange(len(self.theta))[k : k + size], rows, self.of_row[rows] - k)
            for k, rows in zip(starts, np.split(order, cuts), strict=True)
        ]
