"""How far the motion of a run, as it is solved for, is from what its equations ask for.

The mesh of a run is frozen, so that a log density is the same function everywhere; how good it is
is asked for once, at the estimate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.prediction.dynamics import signal_of_rows
from bayesoleo.prediction.inputs import input_rows
from bayesoleo.prediction.run import RunPredictor
from bayesoleo.prediction.solved_run import SolvedRun
from bayesoleo.solvers.adaptive.error_estimate import NONE, ErrorEstimate, estimate_error
from bayesoleo.solvers.adaptive.switched import PeriodicProblem
from bayesoleo.solvers.schemes.choose import DEFAULT_SCHEME
from bayesoleo.solvers.schemes.collocation import Collocation
from bayesoleo.solvers.schemes.mesh import equidistant
from bayesoleo.solvers.schemes.tableau import tableau
from bayesoleo.solvers.shooting.signals import evaluate

#: Error over the swing below which nothing more is resolved: what no channel shows.
TOLERANCE = 1e-6
#: Points of a run at which its equations are looked at: every run of every fit is.
LOOKS = 16_384


def motion_error(run: RunPredictor, tolerance: float = TOLERANCE) -> ErrorEstimate:
    """Estimate the error of a run's anchored motion.

    Parameters
    ----------
    run : RunPredictor
        Of a periodic run or of a transient, anchored.
    tolerance : float
        Error over the swing below which it need not be known.

    Returns
    -------
    ErrorEstimate
        Its error is NaN where there is no motion, or no estimate of its error.
    """
    anchor, derived = run.anchor, run.kernels.derived
    if anchor is None or not derived.dofs:
        return NONE
    if isinstance(run, SolvedRun):
        return run.error()
    initial = not run.record.periodic
    problem = PeriodicProblem(
        equations=run.kernels,
        orders=derived.orders,
        period=run.period,
        inputs_at=_inputs_at(run),
        conditions=len(derived.admissible),
        active=len(derived.active),
    )
    scheme = run.scheme
    method, mesh = tableau(DEFAULT_SCHEME), equidistant(run.steps)
    if isinstance(scheme, Collocation):
        method, mesh = scheme.method, scheme.mesh or mesh

    return estimate_error(
        problem,
        method,
        anchor.p,
        lambda phase: run.rows(anchor.x, phase),
        mesh,
        tolerance,
        initial=initial,
        looks=LOOKS,
    )


def _inputs_at(run: RunPredictor) -> Callable[[Array], Array]:
    """Input rows at phases; harmonics by rotation, since so many phases are asked for."""
    rows, record = run.kernels.derived.inputs, run.record
    if not record.periodic:
        return lambda position: input_rows(record, rows, position)
    signal = signal_of_rows(record, rows)
    return lambda phase: evaluate(signal, phase * run.period)


def outputs_of(run: RunPredictor, estimate: ErrorEstimate) -> Array | None:
    """Outputs ``(ny, N)`` at the raw samples of the better motion that an estimate found."""
    better, anchor = estimate.better, run.anchor
    if better is None or anchor is None:
        return None
    position = run.record.phase if run.record.periodic else run.record.position
    plan = better.scheme.plan(position, better.mesh.steps, initial=not run.record.periodic)
    step = better.boundary.step(better.mesh.steps)
    z = better.scheme.sample(better.x[None, :, :, None], plan, step)[:, :, 0]
    y = np.empty((1, len(run.kernels.derived.outputs), position.size))
    with np.errstate(all="ignore"):
        run.kernels.output(z, run.sample_inputs, anchor.p[None], np.array([0]), y)
    return cast(Array, y[0])
