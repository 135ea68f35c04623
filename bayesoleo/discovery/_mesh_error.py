"""What the steps of a mesh change of an estimate, of its outputs, and of the sum of squares."""

from __future__ import annotations

import numpy as np

from bayesoleo._parallel import thread_map
from bayesoleo._types import Array
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.prediction._predictor import Predictor, RunPrediction
from bayesoleo.prediction._run_errors import motion_error, outputs_of
from bayesoleo.prediction._transient_run import SETTLED
from bayesoleo.solvers._orbit import Status

#: Shift, error of the motion and of the outputs of a mesh of which nothing is known, and what a
#: finer one does to the sum of squares.
UNKNOWN_MESH = (float("nan"), float("nan"), np.full((1, 1), np.nan), float("nan"))
#: Error of a motion over its swing below which its estimate resolves nothing more.
RESOLVED = 1e-3


def mesh_shift(
    problem: CampaignProblem,
    point: PointEstimate,
    predictions: list[RunPrediction],
    policy: SearchPolicy,
) -> tuple[float, float, Array, float]:
    """Shift of the estimate that the discretisation causes, in standard deviations, the largest
    error of a motion over its swing, what a finer mesh changes of each output of each run, and of
    the sum of squares."""
    coarse = problem.predictor
    halved = _halved(problem, point)
    if halved is None:
        return UNKNOWN_MESH
    shift = shift_by(problem, point, predictions, halved)
    found = thread_map(lambda run: motion_error(run, RESOLVED), coarse.runs, coarse.jobs)
    error = float(np.max([one.error for one in found]))  # NaN where one is not known
    better = [outputs_of(run, one) for run, one in zip(coarse.runs, found, strict=True)]
    known = [y for y in better if y is not None and np.isfinite(y).all()]
    if len(known) < len(better):
        changes = squares_of_change(problem, predictions, halved, point)
        return shift, error, _change(predictions, halved), changes
    missed = shift_by(problem, point, predictions, known)
    clearly = missed > max(policy.missed_factor * shift, policy.mesh_shift)
    changes = squares_of_change(problem, predictions, known, point)
    return (missed if clearly else shift), error, _change(predictions, known), changes


def _change(predictions: list[RunPrediction], better: list[Array]) -> Array:
    """Root mean square of the difference, shape (runs, outputs)."""
    pairs = zip(predictions, better, strict=True)
    return np.array([np.sqrt(np.mean((y - run.y) ** 2, axis=1)) for run, y in pairs])


def _halved(problem: CampaignProblem, point: PointEstimate) -> list[Array] | None:
    """Outputs ``(ny, N)`` of every run on half the steps; None where one has no solution."""
    coarse = problem.predictor
    theta = problem.full(point.theta[None])[0]
    fine = Predictor(
        coarse.model,
        coarse.records,
        steps=2 * coarse.steps,
        scheme=coarse.scheme,
        solver=coarse.solver,
        backend=coarse.backend,
        jobs=coarse.jobs,
        share=coarse,
    )
    begin_with(fine, coarse)
    found = fine.solved_anew(theta)
    if any(samples.status[0] != Status.CONVERGED.value for samples in found):
        return None
    return [samples.y[0] for samples in found]


def shift_by(
    problem: CampaignProblem,
    point: PointEstimate,
    predictions: list[RunPrediction],
    better: list[Array],
) -> float:
    """Largest shift ``(J' W J)^-1 J' W delta`` over its standard deviation, by better outputs."""
    names = problem.predictor.layout.names
    gradient = np.zeros(len(names))
    for run, y in zip(predictions, better, strict=True):
        gradient += np.einsum("ylN,yN->l", run.sensitivity, (y - run.y) / point.variance[:, None])
    free = np.array([names.index(name) for name in problem.names])
    return float(np.max(np.abs(point.covariance @ gradient[free]) / point.sd, initial=0.0))


def shows(
    problem: CampaignProblem,
    point: PointEstimate,
    predictions: list[RunPrediction],
    numerics: Numerics,
) -> bool:
    """Whether half the steps would visibly change what a model leaves."""
    if not all(run.status.ok for run in predictions):
        return False
    halved = _halved(problem, point)
    if halved is None:  # where a force sets in, the solution is lost on one mesh and not on another
        return True
    return squares_of_change(problem, predictions, halved, point) > numerics.policy.unseen


def squares_of_change(
    problem: CampaignProblem,
    predictions: list[RunPrediction],
    others: list[Array],
    point: PointEstimate,
) -> float:
    """Largest change of the sum of squares by better predictions, over the variances of what is
    left: ``d.d + |2 r.d|`` of their changes ``d`` and residuals ``r``."""
    squares, along = 0.0, 0.0
    # An integrator's steps, and those of a period, are finer than what long ones are halved to.
    settled = SETTLED if can_be_coarser(problem) else 0.0
    for record, run, here, other in zip(
        problem.predictor.records, problem.predictor.runs, predictions, others, strict=True
    ):
        own = changed_squares(run.measured, here.y, other, point.variance, weights(record), settled)
        squares, along = squares + own[0], along + own[1]
    return squares + abs(along)


def changed_squares(
    measured: Array,
    here: Array,
    other: Array,
    variance: Array,
    weight: Array,
    settled: float = SETTLED,
) -> tuple[float, float]:
    """``d.d`` and ``2 r.d`` of a change ``d`` of outputs to residuals ``r``, over variances.

    Parameters
    ----------
    measured, here, other : ndarray, shape (ny, N)
        Measured outputs, those predicted, and those that they change to.
    variance : ndarray, shape (ny,)
        Of what a model leaves.
    weight : ndarray, shape (N,)
        One for samples that count, zero for others.
    settled : float
        Root mean square of a change, over the size of an output, that is not seen.
    """
    counts = weight > 0
    if not counts.any():
        return 0.0, 0.0
    measured, here, other = (values[:, counts] for values in (measured, here, other))
    squares = np.mean((other - here) ** 2, axis=1)
    products = np.sum((measured - other) * (other - here), axis=1)
    shown = products * _is_shown(measured, squares, settled)
    along = float(np.sum(2.0 * shown / np.maximum(variance, 1e-300)))
    return visible(measured, squares, variance, settled), along


def visible(measured: Array, squares: Array, variance: Array, settled: float = SETTLED) -> float:
    """Sum of squares of a change of outputs, over the variances ``(ny,)`` of what a model leaves.

    Where it leaves next to nothing, what has settled shows no more.

    Parameters
    ----------
    measured : ndarray, shape (ny, N)
    squares : ndarray, shape (ny,)
        Mean squares of the change.
    variance : ndarray, shape (ny,)
    settled : float
        As of :func:`changed_squares`.
    """
    shown = squares * _is_shown(measured, squares, settled)
    return float(np.sum(shown / np.maximum(variance, 1e-300)) * measured.shape[1])


def _is_shown(measured: Array, squares: Array, settled: float) -> Array:
    """One for outputs whose mean squared change ``(ny,)`` is more than what has settled, else
    zero."""
    return (squares > settled**2 * np.var(measured, axis=1)).astype(float)


def can_be_coarser(problem: CampaignProblem) -> bool:
    """Whether any run is so long that its steps may be joined."""
    return any(run.can_be_coarser for run in problem.predictor.runs)


def can_be_joined(problem: CampaignProblem) -> bool:
    """Whether a comparison may do with fewer steps than were chosen for any run."""
    return any(run.can_be_joined for run in problem.predictor.runs)


def begin_with(predictor: Predictor, known: Predictor) -> None:
    """Start periodic runs from the motions of others of the same model, which are on their branch;
    transients do so by themselves."""
    for run, other in zip(predictor.runs, known.runs, strict=True):
        if run.record.periodic:
            run.motions, run.watched = other.known_motions(), other.watched
