"""Multiple shooting: a transient cut into short steps that are solved at once.

Every node of an equidistant mesh is a shooting node, and one collocation step leads from it towards
the next. The state at the node and the step's stage values are unknowns alike: an iterate need not
solve the equations inside a step, nor be continuous from step to step. Linearised, the stages are
eliminated locally, which leaves multiple shooting with exact derivatives (Albersmeyer and Diehl
2010: such lifting never costs more per iteration, and contracts faster). Intervals of several
steps - fewer shooting nodes, up to one interval for the whole record, which is single shooting -
result from integrating through the inner nodes between iterations.

The states ``s_m`` at the nodes and the parameters ``theta`` minimise a quadratic form under
``s_{m+1} = F_m s_m + C_m theta + d_m``. States and Lagrange multipliers in the order of time make
the optimality conditions a band of half width ``2 D - 1`` with a border as wide as the parameters.
One factorisation of the band, whose cost grows with the number of nodes, leaves the small
information matrix of the parameters. Nothing is multiplied along the trajectory, so that the
exponential growth of disturbances in a chaotic system does no harm. The condensing recursion of
the literature, which forms the products ``F_m ... F_1``, has no digits left after some thirty
Lyapunov times (``exp(36) = 1e16``).

References
----------
Bock, H. G. (1987). Randwertproblemmethoden zur Parameteridentifizierung in Systemen nichtlinearer
Differentialgleichungen. Bonner Mathematische Schriften 183.

Albersmeyer, J. and Diehl, M. (2010). The lifted Newton method and its application in optimization.
SIAM Journal on Optimization 20, 1655-1684.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs

from bayesoleo._compiled import ImplicitEquations
from bayesoleo._types import Array, Integers
from bayesoleo.solvers._collocation import Collocation, SamplePlan

_gbtrf, _gbtrs = get_lapack_funcs(("gbtrf", "gbtrs"), (np.zeros(1),))
#: Newton iterations for one step of an integration, and the relative change of the stages at which
#: they end: its square, which is what the last one leaves, is round-off.
INTEGRATION_ITERATIONS = 12
INTEGRATION_STEP = 1e-8
_LANE = np.zeros(1, dtype=np.int64)


@dataclass(frozen=True)
class ContinuousLeastSquares:
    """The factorised conditions of one trajectory.

    Parameters
    ----------
    band, pivots : ndarray
        LAPACK's factors of the band matrix.
    coupling : ndarray, shape (n, D, l)
        Second derivatives of the quadratic form by states and parameters.
    by_parameter : ndarray, shape (n - 1, D, l)
        ``C_m``.
    states, multipliers : ndarray, shapes (n, D, l) and (n - 1, D, l)
        Derivatives of the solution by the parameters.
    regular : bool
        Whether the data determine the states at given parameters.
    """

    band: Array
    pivots: NDArray[np.int32]
    coupling: Array
    by_parameter: Array
    states: Array
    multipliers: Array
    regular: bool

    @classmethod
    def of(
        cls,
        hessian: Array,
        coupling: Array,
        transition: Array,
        by_parameter: Array,
        slack: Array,
    ) -> ContinuousLeastSquares:
        """Factorise.

        Parameters
        ----------
        hessian : ndarray, shape (n, D, D)
            Second derivatives of the quadratic form by the state of each node.
        coupling : ndarray, shape (n, D, l)
        transition : ndarray, shape (n - 1, D, D)
            ``F_m``.
        by_parameter : ndarray, shape (n - 1, D, l)
        slack : ndarray, shape (n - 1, D)
            Variance that each gap is allowed: a gap costs half its square over that; zero for
            continuity.
        """
        band, pivots, info = _gbtrf(_band(hessian, transition, slack), *_widths(hessian.shape[1]))
        empty = np.zeros((0, 0))
        plain = cls(band, pivots, coupling, by_parameter, empty, empty, info == 0)
        states, multipliers = plain._substitute(-coupling, by_parameter)
        finite = bool(np.isfinite(states).all() and np.isfinite(multipliers).all())
        return cls(
            band, pivots, coupling, by_parameter, states, multipliers, plain.regular and finite
        )

    def solve(self, gradient: Array, gap: Array) -> tuple[Array, Array]:
        """States ``(n, D)`` and multipliers ``(n - 1, D)`` at parameters that stay as they are.

        Parameters
        ----------
        gradient : ndarray, shape (n, D)
            Descent direction of the quadratic form at zero.
        gap : ndarray, shape (n - 1, D)
            ``d_m``.
        """
        states, multipliers = self._substitute(gradient[..., None], gap[..., None])
        return states[..., 0], multipliers[..., 0]

    def information(self, hessian: Array) -> Array:
        """Information matrix of the parameters, ``(l, l)``, states eliminated.

        ``hessian (l, l)`` holds the second derivatives by the parameters.
        """
        total = hessian + np.einsum("nab,nac->bc", self.coupling, self.states)
        total -= np.einsum("nab,nac->bc", self.by_parameter, self.multipliers)
        return cast(Array, 0.5 * (total + total.T))

    def descent(self, gradient: Array, states: Array, multipliers: Array) -> Array:
        """Descent direction by the parameters, ``(l,)``, states eliminated.

        ``gradient (l,)`` is that at fixed states; the others are the answer of :meth:`solve`.
        """
        total = gradient - np.einsum("nab,na->b", self.coupling, states)
        return np.asarray(total + np.einsum("nab,na->b", self.by_parameter, multipliers))

    def initial_covariance(self) -> Array:
        """Covariance ``(D, D)`` of the first state at given parameters."""
        n, D, _ = self.states.shape
        units = np.zeros((n, D, D))
        units[0] = np.eye(D)
        return cast(Array, self._substitute(units, np.zeros((n - 1, D, D)))[0][0])

    def _substitute(self, gradient: Array, gap: Array) -> tuple[Array, Array]:
        n, D, columns = gradient.shape
        first, second = _places(n, D)
        right = np.zeros((D * (2 * n - 1), columns))
        right[first], right[second] = gradient, gap
        if not self.regular:
            right[:] = np.nan
            return right[first], right[second]
        answer, _ = _gbtrs(self.band, *_widths(D), right, self.pivots)
        return answer[first], answer[second]


def _widths(D: int) -> tuple[int, int]:
    return 2 * D - 1, 2 * D - 1


def _places(n: int, D: int) -> tuple[Integers, Integers]:
    """Rows of the states (n, D) and of the multipliers (n - 1, D)."""
    first = 2 * D * np.arange(n)[:, None] + np.arange(D)
    return first, first[:-1] + D


def _band(hessian: Array, transition: Array, slack: Array) -> Array:
    """The symmetric, indefinite matrix in LAPACK's band storage."""
    n, D, _ = hessian.shape
    width = 2 * D - 1
    band = np.zeros((3 * width + 1, D * (2 * n - 1)))
    states, multipliers = _places(n, D)

    def put(rows: Integers, columns: Integers, values: Array | float) -> None:
        band[2 * width + rows - columns, columns] = values

    put(states[:, :, None], states[:, None, :], hessian)
    put(multipliers[:, :, None], states[:-1, None, :], -transition)
    put(states[:-1, None, :], multipliers[:, :, None], -transition)
    put(multipliers, multipliers, -slack)
    put(multipliers, states[1:], 1.0)
    put(states[1:], multipliers, 1.0)
    return band


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
    equations : ImplicitEquations
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

    equations: ImplicitEquations
    scheme: Collocation
    duration: float
    steps: int
    inputs: Array
    conditions: int
    active: int

    @property
    def length(self) -> float:
        """Length of a step, s."""
        return self.duration / self.steps

    @cached_property
    def _ends(self) -> SamplePlan:
        return self.scheme.plan(np.ones(1), 1, initial=True)

    @cached_property
    def _state_rows(self) -> list[int]:
        first = np.cumsum([0, *(order + 1 for order in self.scheme.orders)])
        return [int(first[j]) + k for j, o in enumerate(self.scheme.orders) for k in range(o)]

    def plan(self, time: Array) -> SamplePlan:
        """Place in the mesh of times from 0 to the duration, shape (N,)."""
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

    def _points(self, chosen: Integers) -> Integers:
        stages = self.scheme.method.stages
        return (chosen[:, None] * stages + np.arange(stages)).ravel()

    def _evaluate(self, x: Array, p: Array, chosen: Integers) -> tuple[Array, Array, Array, bool]:
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

    def _solve_steps(self, x: Array, p: Array, chosen: Integers) -> bool:
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
