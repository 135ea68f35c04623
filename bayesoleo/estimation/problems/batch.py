"""Least-squares equations of many parameter vectors at once.

An estimate of one data set spends most of its time in the interpreter, not in the numbers. Where
thousands of data sets are fitted by one model, everything is computed for all of them together, and
each keeps only what a step needs: per output ``J'J``, ``J'e`` and ``e'e``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from bayesoleo._types import Array, Float, Int, Integers
from bayesoleo.estimation.problems.problem import Problem


@dataclass(frozen=True)
class BatchNormalEquations:
    """What a Gauss-Newton step needs, for ``L`` vectors, ``s`` outputs and ``l`` unknowns.

    Parameters
    ----------
    gram : ndarray, shape (L, s, l, l)
        ``J'J`` with ``J`` the sensitivities of the prediction.
    slope : ndarray, shape (L, s, l)
        ``J'e``.
    sums : ndarray, shape (L, s)
        Sums of squared residuals.
    status : ndarray of int, shape (L,)
        Values of :class:`~bayesoleo.solvers.status.Status`; where it is not ``CONVERGED`` the
        numbers mean nothing.
    """

    gram: Float[Array, "vectors outputs unknowns unknowns"]
    slope: Float[Array, "vectors outputs unknowns"]
    sums: Float[Array, "vectors outputs"]
    status: Int[Integers, " vectors"]


@runtime_checkable
class BatchProblem(Problem, Protocol):
    """A problem that can be fitted to many data sets of one shape."""

    @property
    def lanes(self) -> int:
        """Vectors that are best computed together, by the memory that one takes."""

    @property
    def data(self) -> tuple[Array, ...]:
        """Measured samples of each output, shape (n_b,), runs one after the other."""

    def with_data(self, data: Sequence[Array]) -> Problem:
        """The same problem with other measured samples, shape (n_b,) for each output."""

    def normal_equations(self, theta: Array, data: Sequence[Array]) -> BatchNormalEquations:
        """Equations at vectors (L, l), each compared with its own row of data (L, n_b)."""


def reduce_rows(residual: Array, sensitivity: Array) -> tuple[Array, Array, Array]:
    """``J'J`` (L, l, l), ``J'e`` (L, l) and ``e'e`` (L,) of rows (L, n) and (L, n, l)."""
    turned = np.swapaxes(sensitivity, 1, 2)
    slope = (turned @ residual[..., None])[..., 0]
    return turned @ sensitivity, slope, np.einsum("ln,ln->l", residual, residual)
