"""A transient cut into many short steps that are solved at once: multiple shooting, lifted.

Every node of an equidistant mesh is a shooting node, and one collocation step leads from it towards
the next. The state at the node and the step's stage values are unknowns alike: an iterate need not
solve the equations inside a step, nor be continuous from step to step. Linearised, the stages are
eliminated where they stand, so that what remains is multiple shooting with exact derivatives
(Albersmeyer and Diehl 2010: such lifting never costs more per iteration, and contracts faster).

Intervals of several steps - fewer shooting nodes, up to one interval for the whole record, which is
single shooting - are had by integrating through the inner nodes between iterations.

References
----------
Albersmeyer, J. and Diehl, M. (2010). The lifted Newton method and its application in optimization.
SIAM Journal on Optimization 20, 1655-1684.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.solvers.schemes.collocation import Collocation, SamplePlan

Indices = NDArray[np.int64]

#: Newton iterations for one step of an integration, and the relative change of the stages at which
#: they end: its square, which is what the last one leaves, is round-off.
INTEGRATION_ITERATIONS = 12
INTEGRATION_STEP = 1e-8

_LANE = np.zeros(1, dtype=np.int64)


class SegmentEquations(Protocol):
    """What is needed of implicit equations (see ``bayesoleo.model.kernels.Kernels``)."""

    @property
    def jacobian(self) -> Callable[..., Any]: ...
    @property
    def parameters(self) -> Callable[..., Any]: ...
    @property
    def admissible(self) -> Callable[..., Any]: ...


@dataclass(frozen=True)
class LinearSteps:
    """Steps linearised about present unknowns, their stages eliminated.

    Parameters
    ----------
    columns : ndarray, shape (n, w, 1 + na + D)
        Changes of a step's unknowns: the one that solves its equations at the present state and
        parameters, then those by each active parameter and by each component of its first state.
    gz : ndarray, shape (d, nz, N)
        Partial derivatives of the equations at the points.
    admissible, regular : bool
        Whether all points lie in the admissible region; whether the equations are finite and each
        step can be solved.
    """

    columns: Array
    gz: Array
    admissible: bool
    regular: bool


@dataclass(frozen=True, eq=False)
class Segments:
    """The steps of one transient.

    Parameters
    ----------
    equations : SegmentEquations
        Residuals and partial derivatives.
    scheme : Collocation
        On an equidistant mesh.
    duration : float
        Of the transient, s.
    steps : int
        Of the mesh, n.
    inputs : ndarray, shape (nu, n s)
        Inputs and their derivatives at the scheme's points.
    conditions : int
        Number of conditions on the admissible region.
    active : int
        Number of parameters with derivatives.
    """

    equations: SegmentEquations
    scheme: Collocation
    duration: float
    steps: int
    inputs: Array
    conditions: int
    active: int

    @property
    def length(self) -> float:
        """Of a step, s."""
        return self.duration / self.steps

    @cached_property
    def _ends(self) -> SamplePlan:
        return self.scheme.plan(np.ones(1), 1, initial=True)

    @cached_property
    def _state_rows(self) -> list[int]:
        first = np.cumsum([0, *(order + 1 for order in self.scheme.orders)])
        return [int(first[j]) + k for j, o in enumerate(self.scheme.orders) for k in range(o)]

    def plan(self, time: Array) -> SamplePlan:
        """Where times from 0 to the duration, shape (N,), lie in the mesh."""
        return self.scheme.plan(time / self.duration, self.steps, initial=True)

    def sample(self, columns: Array, plan: SamplePlan) -> Array:
        """Values and derivatives ``(nz, C, N)`` at planned times from unknowns ``(n, w, C)``."""
        return cast(Array, self.scheme.sample(columns[None], plan, self.length)[0])

    def ends(self, columns: Array) -> Array:
        """States ``(n, D, C)`` at the right ends of steps from unknowns ``(n, w, C)``."""
        rows = self.scheme.sample(columns[:, None], self._ends, self.length)
        return rows[..., 0][:, self._state_rows]

    def gaps(self, x: Array) -> Array:
        """Jumps ``(n - 1, D)`` from the end of each step to the node that follows it."""
        return self.ends(x[..., None])[:-1, :, 0] - x[1:, : self.scheme.state_size]

    def linearise(self, x: Array, p: Array) -> LinearSteps:
        """Linearise all steps.

        Parameters
        ----------
        x : ndarray, shape (n, w)
            Unknowns of each step, as in ``Collocation``.
        p : ndarray, shape (np,)
            Constants.
        """
        g, gz, z, inside = self._evaluate(x, p, np.arange(self.steps))
        gp = np.zeros((1, len(self.scheme.orders), self.active, z.shape[2]))
        with np.errstate(all="ignore"):
            self.equations.parameters(z, self.inputs, p[None], _LANE, gp)
            by_state = np.einsum("ezn,szn->esn", gz, self._unit_states)
            right = np.concatenate([g[:, None], gp[0], by_state], axis=1)
            finite = bool(np.isfinite(right).all() and np.isfinite(gz).all())
            columns, regular = self._eliminate(gz, right) if finite else (_none(x, right), False)
        for component in range(self.scheme.state_size):
            columns[:, component, 1 + self.active + component] = 1.0
        return LinearSteps(columns, gz, inside, regular)

    def correction(self, x: Array, p: Array, steps: LinearSteps) -> tuple[Array, bool]:
        """Change ``(n, w)`` of unknowns by which an old linearisation would solve each step, and
        whether they are finite and admissible.
        """
        g, gz, _, inside = self._evaluate(x, p, np.arange(self.steps))
        if not (inside and np.isfinite(g).all() and np.isfinite(gz).all()):
            return np.zeros_like(x), False
        columns, regular = self._eliminate(steps.gz, g[:, None])
        return columns[..., 0], regular

    def integrate(self, x: Array, p: Array, interval: int) -> tuple[Array, bool]:
        """Replace all unknowns by the motions that start from every ``interval``-th node.

        Returns
        -------
        x : ndarray, shape (n, w)
        ok : bool
            Whether all of them could be integrated to their end.
        """
        x, D = x.copy(), self.scheme.state_size
        for offset in range(min(interval, self.steps)):
            chosen = np.arange(offset, self.steps, interval)
            if offset:
                before = chosen - 1
                x[chosen, :D] = self.ends(x[before, :, None])[..., 0]
                # The stages go on as they were where the last step left them: a guess.
                x[chosen, D:] = x[before, D:]
            if not self._solve_steps(x, p, chosen):
                return x, False
        return x, True

    # -- a batch of steps, each by itself -----------------------------------------------------

    @cached_property
    def _unit_states(self) -> Array:
        """Values and derivatives ``(D, nz, N)`` of motions that start from unit states."""
        D, d = self.scheme.state_size, len(self.scheme.orders)
        x = np.zeros((D, self.steps, self.scheme.width))
        x[np.arange(D), :, np.arange(D)] = 1.0
        z = np.zeros((D, D + d, self.inputs.shape[1]))
        self.scheme.rows(x, np.arange(D), self.length, z)
        return z

    def _points(self, chosen: Indices) -> Indices:
        stages = self.scheme.method.stages
        return (chosen[:, None] * stages + np.arange(stages)).ravel()

    def _evaluate(self, x: Array, p: Array, chosen: Indices) -> tuple[Array, Array, Array, bool]:
        """Equations ``g (d, N)``, ``gz (d, nz, N)``, rows ``z (1, nz, N)``; whether admissible."""
        d, D = len(self.scheme.orders), self.scheme.state_size
        points = chosen.size * self.scheme.method.stages
        u = np.ascontiguousarray(self.inputs[:, self._points(chosen)])
        z, g = np.zeros((1, D + d, points)), np.zeros((1, d, points))
        gz, a = np.zeros((1, d, D + d, points)), np.ones((1, self.conditions, points))
        with np.errstate(all="ignore"):
            self.scheme.rows(x[None, chosen], _LANE, self.length, z)
            self.equations.jacobian(z, u, p[None], _LANE, g, gz)
            if self.conditions:
                self.equations.admissible(z, u, p[None], _LANE, a)
        return g[0], gz[0], z, bool((a > 0).all())

    def _eliminate(self, gz: Array, right: Array) -> tuple[Array, bool]:
        """Changes ``(K, w, C)`` of the unknowns of K steps with their states held.

        Each step is a lane of the periodic solver's elimination, an initial value problem of
        one step.
        """
        stages = self.scheme.method.stages

        def by_step(rows: Array) -> Array:
            split = rows.reshape(*rows.shape[:2], -1, stages)
            return np.ascontiguousarray(np.moveaxis(split, 2, 0))

        matrix, target = by_step(gz), by_step(right)
        lanes = np.arange(matrix.shape[0])
        dx, _, ok = self.scheme.linear(matrix, target, None, lanes, self.length, initial=True)
        return dx[:, 0], bool(ok.all())

    def _solve_steps(self, x: Array, p: Array, chosen: Indices) -> bool:
        """Newton's method on the stages of chosen steps, in place."""
        D = self.scheme.state_size
        for _ in range(INTEGRATION_ITERATIONS):
            g, gz, _, inside = self._evaluate(x, p, chosen)
            if not (inside and np.isfinite(g).all() and np.isfinite(gz).all()):
                return False
            dx, regular = self._eliminate(gz, g[:, None])
            if not (regular and np.isfinite(dx).all()):
                return False
            x[chosen] += dx[..., 0]
            moved = np.abs(dx[:, D:, 0]).max(axis=0)
            if np.all(moved <= INTEGRATION_STEP * np.abs(x[chosen, D:]).max(axis=0)):
                return True
        return False


def _none(x: Array, right: Array) -> Array:
    return np.zeros((*x.shape, right.shape[1]))
