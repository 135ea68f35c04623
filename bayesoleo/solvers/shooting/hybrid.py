"""The orbit by shooting, its derivatives by discretisation (the hybrid that Verbeek 1993, section
4.3.2, suggests).

Shooting finds motions from far away and steps to where the equations switch; a mesh has the
derivatives by all parameters from one factorisation. The motion is put on the integrator's own
steps, cut into equal parts, and linearised there as it is. Equal steps would not do: those across a
contact leave derivatives in error by their length over the contact's duration. Nor would a Newton
step on the mesh first: it moves a contact of a hundred-thousandth of the period off the edges (end
stop of stiffness 1e11, 460 steps: derivatives err by 8e-2 after it, by 3e-6 without).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.adaptive.switched import Motion
from bayesoleo.solvers.periodic.solve import Boundary, Solution, sensitivities
from bayesoleo.solvers.schemes.mesh import Mesh
from bayesoleo.solvers.shooting.shoot import Shot
from bayesoleo.solvers.status import Status

_LANE = np.zeros(1, dtype=np.int64)


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
    shot: Shot, boundary_on: Callable[[Mesh, Motion], Boundary], p: Array, steps: int
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
