"""Equations at trial unknowns, many lanes at once: what Newton iterations over a mesh share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.solvers.periodic import measures

if TYPE_CHECKING:
    from bayesoleo.solvers.periodic.solve import Boundary

Lanes = NDArray[np.int64]


class Trial:
    """Unknowns, and the equations with their derivatives at these; arrays are allocated once.

    Parameters
    ----------
    problem : Boundary
    p : ndarray, shape (L, np)
        Constants of each lane.
    x : ndarray, shape (L, n, w)
        Unknowns; whoever moves them evaluates again.

    Attributes
    ----------
    base : ndarray, shape (L, n, w)
        Room for the unknowns that a step starts from.
    z, g, gz : ndarray
        Values at the points, shape (L, nz, N); residual, (L, d, N); derivatives, (L, d, nz, N).
    squares, terms : ndarray, shape (L, d)
        Squared residual, and squared terms it is judged by.
    inside, defined : ndarray of bool, shape (L,)
        Whether the unknowns lie in the admissible region, and whether that could be asked.
    """

    def __init__(self, problem: Boundary, p: Array, x: Array):
        self.problem, self.p, self.x = problem, p, x
        lanes, n, _ = x.shape
        scheme = problem.scheme
        d, points = len(scheme.orders), problem.inputs.shape[1]
        nz = scheme.state_size + d
        self.step, self.base = problem.step(n), np.empty_like(x)
        self.z = np.empty((lanes, nz, points))
        self.g = np.empty((lanes, d, points))
        self.gz = np.empty((lanes, d, nz, points))
        self.a = np.empty((lanes, problem.conditions, points))
        self.squares, self.terms = np.empty((lanes, d)), np.empty((lanes, d))
        self.inside, self.defined = np.ones(lanes, dtype=np.bool_), np.ones(lanes, dtype=np.bool_)

    def evaluate(self, lanes: Lanes) -> NDArray[np.bool_]:
        """Equations at the present unknowns; true where they are finite and admissible, (L,)."""
        equations, u = self.problem.equations, self.problem.inputs
        self.problem.scheme.rows(self.x, lanes, self.step, self.z)
        with np.errstate(all="ignore"):
            equations.jacobian(self.z, u, self.p, lanes, self.g, self.gz)
            if self.problem.conditions:
                equations.admissible(self.z, u, self.p, lanes, self.a)
        measures.positive(self.a, lanes, self.inside, self.defined)
        measures.measure(self.z, self.g, self.gz, lanes, self.squares, self.terms)
        finite = self.defined[lanes] & np.isfinite(self.terms[lanes]).all(axis=1)
        return self.inside[lanes] & finite

    def newton_step(
        self, lanes: Lanes, *, initial: bool = False
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Newton's step, shape (L, n, w), and where the linear problem has a solution, (L,)."""
        dx, _, ok = self.problem.scheme.linear(
            self.gz, self.g[:, :, None], self.x, lanes, self.step, initial=initial
        )
        return dx, ok

    def take(self, lanes: Lanes, dx: Array, fraction: Array) -> None:
        """Move the unknowns to a fraction, shape (lanes,), of a step from where it starts."""
        measures.take(self.base, dx, lanes, fraction, self.x)

    def take_whole(self, lanes: Lanes, dx: Array) -> None:
        """Move the unknowns by a whole step from where they are."""
        measures.keep(self.x, lanes, self.base)
        self.take(lanes, dx, np.ones(lanes.size))
