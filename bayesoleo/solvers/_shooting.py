"""Periodic solutions by shooting, and the hybrid of shooting with discretised derivatives.

Shooting applies Newton's method to the state that returns to itself. The time map ``phi_T(s)`` and
its derivative come from one integration (steps are differentiated as they are taken), first at a
loose tolerance, which follows the residual, then at the requested one. The last passes use the same
steps, so that the residual is a smooth function of the start and Newton's method ends in round-off
instead of in the noise of step selection.

The hybrid takes the orbit from shooting and its derivatives from a mesh (suggested by Verbeek 1993,
section 4.3.2). Shooting finds motions from far away and steps to where the equations switch; a mesh
has the derivatives by all parameters from one factorisation. The motion is put on the integrator's
own steps, cut into equal parts, and linearised there without change. Equal steps would not do: a
step across a contact leaves an error in the derivatives of its length over the contact's duration.
Nor would a Newton step on the mesh first: it moves a contact of a hundred-thousandth of the period
off the edges (end stop of stiffness 1e11, 460 steps: derivatives err by 8e-2 after it, by 3e-6
without).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from bayesoleo._types import Array, Flags, Float
from bayesoleo.solvers._initial_value import DenseTrajectory, Dynamics, solve_initial_value
from bayesoleo.solvers._mesh import Mesh
from bayesoleo.solvers._orbit import Orbit, Status
from bayesoleo.solvers._periodic import Boundary, Solution, sensitivities
from bayesoleo.solvers._switched import PhaseFunction

#: Tolerance of the first pass.
LOOSE = 1e-3
#: A pass's tolerance over the residual of the one before: its noise must not hide progress.
FOLLOW = 1e-2
#: Residual, over the tolerance, that integration error alone can cause.
NOISE = 30.0
#: A correction this small, over the sizes of the states, leaves its square.
LAST_CORRECTION = 1e-7
#: From a correction this small on steps are kept.
CLOSE = 1e-3
MAXIMUM_PASSES = 25
MAXIMUM_HALVINGS = 12
#: How often, and for how many periods, a motion may settle where Newton's method gets stuck.
SETTLINGS, PERIODS = 3, 10
#: Closures with a smaller reciprocal condition number are singular but for round-off.
SINGULAR = 1e-13
_LANE = np.zeros(1, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Shot:
    """A periodic motion found by shooting.

    Parameters
    ----------
    trajectory : DenseTrajectory
        One period from phase zero.
    status : Status
        How the iteration ended.
    monodromy : ndarray, shape (D, D)
        Derivative of the time map; NaN where it is not known.
    start_theta : ndarray, shape (D, na)
        Derivatives of the first state by the active parameters; empty unless asked for.
    iterations, halvings, evaluations : int
        Newton steps, how often one was halved, and points at which equations were evaluated.
    """

    trajectory: DenseTrajectory
    status: Status
    monodromy: Float[Array, "states states"]
    start_theta: Float[Array, "states active"]
    iterations: int
    halvings: int
    evaluations: int

    @property
    def start(self) -> Array:
        """State at phase zero, shape (D,)."""
        return cast(Array, self.trajectory.states[0])

    @property
    def period(self) -> float:
        """Seconds; of a motion that failed, how far it went."""
        return float(self.trajectory.times[-1] - self.trajectory.times[0])

    def sample(self, phases: Array) -> Array:
        """Values and derivatives ``(nz, N)`` of all dofs at phases in cycles."""
        return self.trajectory.sample((phases % 1.0) * self.period)

    def sample_theta(self, phases: Array) -> Array:
        """Derivatives ``(nz, na, N)`` of :meth:`sample` by the active parameters.

        References
        ----------
        Verbeek (1993), eqs. 4.40-4.41.
        """
        D = self.start.size
        by = self.trajectory.sample_derivatives((phases % 1.0) * self.period)
        return cast(Array, np.einsum("zdn,da->zan", by[:, :D], self.start_theta) + by[:, D:])

    def orbit(self) -> Orbit:
        """The motion as every solver returns it; by itself shooting estimates no error of it."""
        path = self.trajectory
        return Orbit(
            phases=(path.times[:-1] - path.times[0]) / max(self.period, 1e-300),
            states=path.states[:-1],
            period=self.period,
            monodromy=self.monodromy,
            status=Status.NO_ERROR_ESTIMATE if self.status.ok else self.status,
            error=np.nan,
            evaluations=self.evaluations,
        )


def solve_shooting(
    dynamics: Dynamics,
    p: Array,
    period: float,
    start: Array,
    *,
    tolerance: float = 1e-8,
    stages: int = 5,
    sensitivities: bool = False,
    near: Shot | None = None,
) -> Shot:
    """Find the state that returns to itself after a period.

    Parameters
    ----------
    dynamics : Dynamics
        Equations and inputs of that period.
    p : ndarray, shape (np,)
        Constants.
    period : float
        Seconds.
    start : ndarray, shape (D,)
        Where to begin: a static state, or one nearby.
    tolerance : float
        Local error of the integrator over the size of each state.
    stages : {3, 5}
        Order five or nine.
    sensitivities : bool
        Differentiate by the active parameters: the second, linear problem (Verbeek 1993, eqs.
        4.40-4.41), from the same steps and factors.
    near : Shot, optional
        The motion of similar constants: its steps are tried first.

    Returns
    -------
    Shot

    References
    ----------
    Verbeek (1993), section 4.3.2, eqs. 4.36-4.41.
    """
    shooter = _Shooter(dynamics, p, period, tolerance, stages, sensitivities)
    if near is not None and near.status.ok:
        shot = shooter.finish(start, near.trajectory)
        if shot is not None:
            return shot
    return shooter.run(start)


def shoot_on_steps(
    dynamics: Dynamics,
    p: Array,
    like: Shot,
    start: Array,
    steps: Array,
    cut: Flags,
    *,
    tolerance: float = 1e-8,
    sensitivities: bool = False,
) -> Shot | None:
    """Find the state that returns to itself by given steps.

    Parameters
    ----------
    dynamics, p, tolerance, sensitivities
        As in :func:`solve_shooting`.
    like : Shot
        A motion close to it, of the same constants.
    start : ndarray, shape (D,)
        Where to begin.
    steps : ndarray, shape (n + 1,)
        Where steps end, in cycles from 0 to 1.
    cut : ndarray of bool, shape (n,)
        Steps that end at a switch.

    Returns
    -------
    Shot or None
        None where Newton's method does not converge on these steps.
    """
    path = like.trajectory
    shooter = _Shooter(dynamics, p, like.period, tolerance, path.tops.shape[1], sensitivities)
    times = path.times[0] + like.period * steps
    return shooter.finish(start, replace(path, times=times, aims=times[1:], switched=cut))


class _Shooter:
    """One iteration: counts, tolerance and sizes are carried from pass to pass."""

    def __init__(
        self, dynamics: Dynamics, p: Array, period: float, tolerance: float, stages: int,
        sensitivities: bool,
    ):  # fmt: skip
        self.dynamics, self.p, self.period = dynamics, p, period
        self.tolerance, self.stages, self.sensitivities = tolerance, stages, sensitivities
        self.iterations = self.halvings = self.evaluations = 0
        self.scale: Array | None = None

    def run(self, start: Array) -> Shot:
        """Newton's method; where it gets stuck, again from where the motion has settled to."""
        shot = self.newton(start)
        for _ in range(SETTLINGS):
            if shot.status is not Status.NO_CONVERGENCE:
                break
            settled = self.settle(start)
            if settled is None:
                break
            start, shot = settled, self.newton(settled)
        return shot

    def settle(self, start: Array) -> Array | None:
        """State some periods later: a stable motion attracts from further than Newton's method."""
        for _ in range(PERIODS):
            path = self.adaptive(start, LOOSE)
            if not path.status.ok:
                return None
            start = path.states[-1]
        return start

    def newton(self, start: Array) -> Shot:
        """Newton's method with step halving, tighter as it comes closer."""
        tolerance = max(self.tolerance, LOOSE)
        path = self.adaptive(start, tolerance)
        for _ in range(MAXIMUM_PASSES):
            if not path.status.ok:
                break
            step, size = self.correction(path)
            if step is None:
                return self.failed(path, Status.SINGULAR)
            if size < CLOSE and tolerance <= self.tolerance:
                shot = self.finish(path.states[0] + step, path)
                if shot is not None:
                    return shot
            residual = self.residual(path)
            ceiling = max(residual, NOISE * tolerance)
            tolerance = max(self.tolerance, min(tolerance, FOLLOW * residual))
            following = self.advance(path, step, ceiling, tolerance)
            if following is None:
                return self.failed(path, Status.NO_CONVERGENCE)
            path = following
        return self.failed(path, Status.NO_CONVERGENCE if path.status.ok else path.status)

    def adaptive(self, start: Array, tolerance: float) -> DenseTrajectory:
        """One period in steps of its own, with the derivative of the time map."""
        return self.passed(
            solve_initial_value(
                self.dynamics, self.p, start, np.array([0.0, self.period]), tolerance=tolerance,
                stages=self.stages, columns=np.eye(start.size), scale=self.scale,
                exact=False,
            )
        )  # fmt: skip

    def passed(self, path: DenseTrajectory) -> DenseTrajectory:
        self.evaluations += path.evaluations
        self.scale = path.scale if path.status.ok else self.scale
        return path

    def residual(self, path: DenseTrajectory) -> float:
        """How far the end is from the start, over the sizes of the states."""
        return float(np.max(np.abs(path.states[-1] - path.states[0]) / path.scale))

    def correction(self, path: DenseTrajectory) -> tuple[Array | None, float]:
        """Newton's step of the start, or ``None`` if the closure is singular, and its size."""
        closure = np.eye(path.scale.size) - path.derivatives[:, : path.scale.size]
        scaled = closure * path.scale / path.scale[:, None]
        if not np.isfinite(scaled).all() or 1.0 / np.linalg.cond(scaled) < SINGULAR:
            return None, np.inf
        right = (path.states[-1] - path.states[0]) / path.scale
        step = np.linalg.solve(scaled, right)
        return step * path.scale, float(np.max(np.abs(step)))

    def advance(
        self, path: DenseTrajectory, step: Array, ceiling: float, tolerance: float
    ) -> DenseTrajectory | None:
        """Take a Newton step, halved until the motion exists and its residual is low enough."""
        self.iterations += 1
        for _ in range(MAXIMUM_HALVINGS):
            trial = self.adaptive(path.states[0] + step, tolerance)
            if trial.status.ok and self.residual(trial) < ceiling:
                return trial
            step = step / 2
            self.halvings += 1
        return None

    def finish(self, start: Array, near: DenseTrajectory) -> Shot | None:
        """Converge to round-off on the steps of a motion nearby; ``None`` if they do not do."""
        D, count = start.size, self.dynamics.active if self.sensitivities else 0
        self.scale = near.scale
        columns = np.concatenate([np.eye(D), np.zeros((D, count))], axis=1)
        before = np.inf
        for _ in range(8):
            path = self.passed(
                solve_initial_value(
                    self.dynamics, self.p, start, near.mesh, tolerance=self.tolerance,
                    stages=self.stages, cut=near.switched, adaptive=False, columns=columns,
                    scale=self.scale, by_parameter=self.sensitivities, dense=True,
                )
            )  # fmt: skip
            self.iterations += 1
            if not path.status.ok:
                return None
            step, size = self.correction(path)
            if step is None or size > before:
                return None
            if size < LAST_CORRECTION:
                return self.shot(_moved(path, step))
            start, before = start + step, size
        return None

    def shot(self, path: DenseTrajectory) -> Shot:
        D = path.scale.size
        monodromy, by_parameter = path.derivatives[:, :D], path.derivatives[:, D:]
        start_theta = np.linalg.solve(np.eye(D) - monodromy, by_parameter)
        return Shot(
            path, Status.CONVERGED, monodromy, start_theta, self.iterations, self.halvings,
            self.evaluations,
        )  # fmt: skip

    def failed(self, path: DenseTrajectory, status: Status) -> Shot:
        D = path.states.shape[1]
        nothing = np.full((D, D), np.nan)
        return Shot(
            path, status, nothing, np.empty((D, 0)), self.iterations, self.halvings,
            self.evaluations,
        )  # fmt: skip


def _moved(path: DenseTrajectory, step: Array) -> DenseTrajectory:
    """A trajectory from a start moved by a small step: what is left out is the step squared."""
    D = step.size
    tops = path.tops + (path.tops_by[:, :, :D] @ step).reshape(path.tops.shape)
    return replace(path, states=path.states + path.by[:, :, :D] @ step, tops=tops)


@dataclass(frozen=True, eq=False)
class Hybrid:
    """A motion found by shooting, and its derivatives on a mesh.

    Parameters
    ----------
    shot : Shot
        The motion.
    boundary : Boundary
        The equations on the mesh.
    x : ndarray, shape (n, w)
        The motion in the unknowns of the scheme.
    x_theta : ndarray, shape (n, w, na)
        Derivatives of these by the active parameters; NaN unless the status is ``CONVERGED``.
    status : Status
        ``SINGULAR`` where there are no derivatives.
    """

    shot: Shot
    boundary: Boundary
    x: Array
    x_theta: Array
    status: Status

    def sample_theta(self, phases: Array) -> Array:
        """Derivatives ``(nz, na, N)`` of the motion at phases in cycles."""
        scheme, n = self.boundary.scheme, self.x.shape[0]
        plan, step = scheme.plan(phases, n), self.boundary.step(n)
        return np.asarray(scheme.sample(self.x_theta[None], plan, step)[0])


def differentiate_on_mesh(
    shot: Shot, boundary_on: Callable[[Mesh, PhaseFunction], Boundary], p: Array, steps: int
) -> Hybrid:
    """Put a motion found by shooting on a mesh and differentiate it there.

    Parameters
    ----------
    shot : Shot
        Converged, of the same equations.
    boundary_on : callable
        The equations on a given mesh, by collocation, with the modes of a given motion.
    p : ndarray, shape (np,)
        Constants.
    steps : int
        Of the mesh, at least.

    Returns
    -------
    Hybrid
    """
    boundary = boundary_on(_mesh(shot, steps), shot.sample)
    scheme, points = boundary.scheme, boundary.inputs.shape[1]
    stages = (scheme.width - scheme.state_size) // len(scheme.orders)
    n = points // stages
    edges = np.cumsum(scheme.lengths(n, 1.0 / n)) - scheme.lengths(n, 1.0 / n)
    at_nodes, at_points = shot.sample(edges), shot.sample(scheme.phases(n))
    x = scheme.from_motion(at_nodes[None], at_points[None])
    found = Solution(x, _LANE, _LANE)
    found, x_theta, _ = sensitivities(boundary, p[None], found)
    status = Status(int(found.status[0]))
    if not status.ok:
        x_theta = np.full_like(x_theta, np.nan)
    return Hybrid(shot, boundary, x[0], x_theta[0], status)


def _mesh(shot: Shot, steps: int) -> Mesh:
    """The integrator's steps, each cut into equal parts."""
    times = shot.trajectory.times
    parts = -(-steps // (times.size - 1))
    position = np.arange((times.size - 1) * parts + 1) / parts
    edges = np.interp(position, np.arange(times.size), (times - times[0]) / shot.period)
    edges[-1] = 1.0
    return Mesh(edges)
