"""Anchors: known solutions with derivatives, from which solutions at other parameters start.

An anchor that is fixed before sampling makes a solution a function of its own parameters alone. It
also detects a change of branch: the linear prediction from which a solve starts then errs by more
than the distance moved.

Where Newton's method does not converge from a guess, the anchor comes from a motion that an
integrator found. Steep friction gives Newton's method on a mesh little information until it knows
where the motion sticks; an integrator finds this as it proceeds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayesoleo._types import Array, Flags, Float, Integers
from bayesoleo.errors import ModelError
from bayesoleo.model._kernels import Kernels
from bayesoleo.model._model import Model
from bayesoleo.prediction._inputs import dynamics_of
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._stability import compared, count_unstable, is_jump, jumps, swings
from bayesoleo.solvers._orbit import Status, floquet_multipliers
from bayesoleo.solvers._periodic import Boundary, Solution, solve_periodic
from bayesoleo.solvers._periodic_newton import Extrapolation
from bayesoleo.solvers._shooting import solve_shooting

#: A start extrapolated too far is retried along a path of this many pieces.
PATH_PIECES = (4, 16)
#: Longest and shortest step, in parts of the way, of a walk that looks for a jump: the shortest
#: passes a resonance of a few hundred times the static answer, not a fold.
LONGEST, SHORTEST = 0.25, 1 / 512
#: Two solutions of the same equations are one if they differ by less of the swing: Newton's method
#: leaves far less, other branches far more.
SAME = 1e-3
#: A start needs no more than the first; where that is too coarse for shooting to close, the second.
TOLERANCES = (1e-6, 1e-8)


@dataclass(frozen=True)
class Anchor:
    """A solution with derivatives: others start at ``x + x_p (p - p0)``.

    Parameters
    ----------
    p : ndarray, shape (np,)
        Constants.
    x : ndarray, shape (n, w)
        The scheme's unknowns.
    x_p : ndarray, shape (na, n, w)
        Their derivatives by the active parameters.
    monodromy : ndarray, shape (D, D), or None
        Of a periodic solution; None for a transient.
    jumped : bool
        Whether it left the branch of the anchor before it, or changed its stability.
    """

    p: Float[Array, " constants"]
    x: Float[Array, "steps width"]
    x_p: Float[Array, "active steps width"]
    monodromy: Float[Array, "states states"] | None = None
    jumped: bool = False

    def predict(self, change: Array) -> Array:
        """Starts, shape (L, n, w), at changes of the active parameters, shape (L, na)."""
        return self.extrapolation.starts(change)

    @cached_property
    def extrapolation(self) -> Extrapolation:
        """Extrapolation from which solutions at other parameters start."""
        return Extrapolation(self.x, self.x_p)

    @cached_property
    def unstable(self) -> int:
        """Number of Floquet multipliers outside the unit circle, -1 where they are not known."""
        if self.monodromy is None:
            return -1
        return int(count_unstable(floquet_multipliers(self.monodromy)))

    def left_by(self, change: Array, x: Array) -> Flags:
        """Whether solutions ``x (L, n, w)`` at changes ``(L, na)`` of the active parameters lie
        farther from their prediction than that moved, and than a tenth of the swing.
        """
        found = np.zeros(x.shape[0], dtype=np.bool_)
        swing, nodes = self.scale
        jumps(self.x, self.x_p, swing, nodes, change, x, found)
        return found

    @cached_property
    def scale(self) -> tuple[Array, Integers]:
        """Swing of each state, shape (D,), and the nodes at which motions are compared."""
        states = self.x.shape[1] if self.monodromy is None else len(self.monodromy)
        return swings(self.x, min(states, self.x.shape[1])), compared(len(self.x))

    def after(self, old: Anchor | None, boundary: Boundary, active: Integers) -> Anchor:
        """The same, knowing whether it is on the branch of the anchor before it."""
        if old is None:
            return self
        far = old.left_by((self.p - old.p)[active][None], self.x[None])[0]
        left = far and not old.leads_to(self.p, self.x, boundary, active)
        return replace(self, jumped=bool(left or old.unstable != self.unstable))

    def leads_to(self, p: Array, x: Array, boundary: Boundary, active: Integers) -> bool:
        """Whether small steps from here to constants ``p (np,)`` arrive at a solution ``x (n, w)``.

        A linear prediction fails over a long way too; another branch is where no path leads.
        """
        end = self._walked(p, boundary, active)
        if end is None:
            return False
        swing = self.scale[0]
        return bool(np.all(np.abs(end - x)[:, : swing.size] <= SAME * swing))

    def _walked(self, p: Array, boundary: Boundary, active: Integers) -> Array | None:
        """Where a path of steps, each predicted by the last, ends; None where it has an end of its
        own.
        """
        nodes, states = self.scale[1], self.scale[0].size
        here, slope = self.x, np.tensordot((p - self.p)[active], self.x_p, 1)
        place, step = 0.0, LONGEST
        while place < 1.0:
            length = min(step, 1.0 - place)
            ahead = here + length * slope
            now = (self.p + (place + length) * (p - self.p))[None]
            trial = solve_periodic(boundary, now, ahead[None], max_iterations=15)
            lost = trial.status[0] != Status.CONVERGED.value
            if lost or is_jump(here, ahead, trial.x[0], swings(here, states), nodes):
                step = length / 2
                if step < SHORTEST:
                    return None
                continue
            here, slope = trial.x[0], (trial.x[0] - here) / length
            place, step = place + length, min(2 * length, LONGEST)
        return here


def solve_from_shot(
    model: Model,
    kernels: Kernels,
    record: Record,
    boundary: Boundary,
    p: Array,
    guess: Array,
) -> Solution | None:
    """Solve one lane from the orbit of shooting.

    Parameters
    ----------
    model, kernels, record : Model, Kernels and Record
        Of the run.
    boundary : Boundary
        Its equations on a mesh.
    p : ndarray, shape (np,)
        Constants.
    guess : ndarray, shape (1, n, w)
        Unknowns, of which shooting takes the first state.

    Returns
    -------
    Solution or None
        None where shooting finds nothing either, or cannot integrate the model.
    """
    scheme, n = boundary.scheme, guess.shape[1]
    nodes, points = np.arange(n) / n, scheme.phases(n)
    rows = scheme.sample(guess[..., None], scheme.plan(np.zeros(1), n), boundary.step(n))
    first = np.cumsum([0, *(order + 1 for order in scheme.orders)])
    states = [int(first[j]) + k for j, order in enumerate(scheme.orders) for k in range(order)]
    try:
        # Compiled whatever the mesh is solved with: that takes a second or two, and an integrator
        # that calls NumPy's kernels back step by step takes minutes to fail.
        dynamics = dynamics_of(model, record, kernels.derived.active, "numba")
    except ModelError:
        return None
    begin = np.ascontiguousarray(rows[0, states, 0, 0])
    for tolerance in TOLERANCES:
        shot = solve_shooting(
            dynamics, p, boundary.period, begin, tolerance=tolerance, sensitivities=False
        )
        if shot.status is Status.CONVERGED:
            start = scheme.from_motion(shot.sample(nodes)[None], shot.sample(points)[None])
            return solve_periodic(boundary, p[None], start)
    return None
