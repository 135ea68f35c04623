"""Starts that follow from one solution and its derivatives, made where they are needed.

For a batch of parameter vectors all starts together are larger than a processor's cache; the
solution and its derivatives are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.periodic.arrangement import SweepLayout
from bayesoleo.solvers.schemes.elimination import jit


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

    def starts(self, change: Array) -> Array:
        """Starts, shape (L, n, w), at changes of shape (L, na)."""
        start = np.empty((change.shape[0], *self.x.shape))
        slopes = self.x_p.reshape(self.x_p.shape[0], -1)
        _extrapolate(self.x.ravel(), slopes, change, start.reshape(change.shape[0], -1))
        return start

    def swept(self, layout: SweepLayout) -> tuple[Array, Array]:
        """The same in the order of a sweep: ``(w, positions)`` and ``(na, w, positions)``."""
        known = self._swept.get("last")
        if known is None or known[0] is not layout:
            base = np.ascontiguousarray(self.x[layout.source].T)
            slopes = np.ascontiguousarray(np.moveaxis(self.x_p[:, layout.source], 2, 1))
            known = self._swept["last"] = layout, base, slopes
        return known[1:]

    @cached_property
    def _swept(self) -> dict[str, tuple[SweepLayout, Array, Array]]:
        return {}


@jit
def _extrapolate(x: Array, x_p: Array, change: Array, start: Array) -> None:
    """Lane by lane: the order of summation of a matrix product would vary with the batch."""
    for lane in range(change.shape[0]):
        for i in range(x.size):
            start[lane, i] = x[i]
        for k in range(change.shape[1]):
            for i in range(x.size):
                start[lane, i] += change[lane, k] * x_p[k, i]
