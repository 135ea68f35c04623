"""Where the equations of a whole period are not solved from a guess: start from a motion that an
integrator found.

Steep friction leaves Newton's method on a mesh little to go by until it knows where the motion
sticks; an integrator sees that as it goes.
"""

from __future__ import annotations

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import ModelError
from bayesoleo.model import Model
from bayesoleo.model.kernels import Kernels
from bayesoleo.prediction.dynamics import dynamics_of
from bayesoleo.prediction.records import Record
from bayesoleo.solvers.periodic.solve import Boundary, Solution, solve_periodic
from bayesoleo.solvers.shooting.shoot import solve_shooting
from bayesoleo.solvers.status import Status

#: A start needs no more than the first; where that is too coarse for shooting to close, the second.
TOLERANCES = (1e-6, 1e-8)


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
