"""Predictions of fitted and hold-out runs, and the noise of their records.

Shared parameters keep their estimates in a hold-out run; by-run parameters are estimated on it.

The noise of an input is propagated through the model by its spectrum. A model that differentiates
its input amplifies this noise, and the spectrum between the harmonics of the input may contain real
motion of the rig, which the output follows, or quantisation steps. A residual is the sum of model
error and noise and is not smaller than either. The power of the residual therefore limits the
propagated noise, band by band. The noise is the same for all models.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array, Float
from bayesoleo.data._noise import innovation_noise
from bayesoleo.discovery._assembly import RecordNoise, halves
from bayesoleo.discovery._beginnings import LIMITS, on_beginning
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._mesh_error import changed_squares
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._samples_that_count import weights, without_masked
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._estimate import estimate
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.model._drive_and_start import start_parameters
from bayesoleo.prediction._mesh_steps import MOST_COMPARED, WHOLE
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._orbit import Status

#: Columns whose overlap says how many independent coefficients a band holds.
MOST_COLUMNS = 128


def borne_out(
    columns: Array,
    residuals: Sequence[Array],
    *,
    drawn: bool = False,
    policy: SearchPolicy = SearchPolicy(),
) -> float:
    """Largest factor, at most one, of the input's noise that the residual has the power for.

    Parameters
    ----------
    columns : ndarray, shape (ny, k, N)
        Change of the outputs by one standard deviation of each input coefficient.
    residuals : sequence of ndarray, shape (N,)
        What the average over periods (or neighbouring samples) leaves of each output.
    drawn : bool
        Whether columns are draws of an error with as many coefficients as samples, as those of a
        transient's input are, or sums of many coefficients, instead of one coefficient each.
    policy : SearchPolicy

    Returns
    -------
    float
        One factor for all outputs of the run, because it is the input's; what it leaves in doubt by
        chance is left in.
    """
    least = 1.0
    for block, residual in zip(columns, residuals, strict=True):
        if block.shape[0] == 0 or not (block.any() and np.isfinite(residual).all()):
            continue
        lines = scipy.fft.rfft(block, axis=1)
        power, there = np.sum(np.abs(lines) ** 2, axis=0), np.abs(scipy.fft.rfft(residual)) ** 2
        for band in _bands(power, policy.noise_bands):
            count = _of_draws if drawn else _coefficients
            coefficients = count(lines[:, band])
            level = policy.noise_false_alarm / policy.noise_bands
            low = float(distributions.chi2.ppf(level, coefficients)) / coefficients
            ratio = float(there[band].sum() / power[band].sum())
            least = min(least, ratio / max(low, 1e-300))
    return float(np.sqrt(least))


def _bands(power: Array, count: int) -> list[slice]:
    """Stretches of lines with about the same part of the power each."""
    total = np.cumsum(power)
    edges = np.searchsorted(total, np.arange(1, count) / count * total[-1]) + 1
    ends = np.unique(np.concatenate([[0], edges, [power.size]]))
    found = [slice(int(a), int(b)) for a, b in pairwise(ends)]
    return [band for band in found if power[band].sum() > 0.01 * total[-1]]


def _of_draws(lines: NDArray[np.complex128]) -> float:
    """The same of draws of noise: two of each line, but fewer where draws resemble each other, as
    where a contact amplifies what came before it.

    The square of a product of two draws has the mean ``tr(C^2)``, and their own squares ``tr(C)``.
    """
    power = np.sum(np.abs(lines) ** 2, axis=0)
    apart = 2.0 * float(power.sum() ** 2 / np.sum(power**2))
    draws = len(lines)
    if draws > 1:
        gram = (lines @ lines.conj().T).real
        own = np.diag(gram)
        alike = float(np.sum(gram**2) - np.sum(own**2)) / (draws * (draws - 1))
        apart = min(apart, float(np.mean(own)) ** 2 / max(alike, 1e-300))
    return max(apart, 1.0)


def _coefficients(lines: NDArray[np.complex128]) -> float:
    """Number of equally large independent coefficients that a band's power scatters like."""
    size = np.sum(np.abs(lines) ** 2, axis=1)
    chosen = np.argsort(-size)[:MOST_COLUMNS]
    gram = (lines[chosen] @ lines[chosen].conj().T).real
    return max(float(np.trace(gram) ** 2 / np.sum(gram**2)), 1.0)


def sample_noise(
    record: Record,
    output: str,
    residual: Array,
    before: RecordNoise | None = None,
    *,
    policy: SearchPolicy = SearchPolicy(),
) -> float:
    """Standard deviation of the noise of a transient's sample, SI.

    Differences of neighbours see whatever is not smooth as noise, be it the record's or what a
    model predicts. Both the record and the residual hold the noise: it is no more than the smaller.

    Parameters
    ----------
    record : Record
    output : str
    residual : ndarray, shape (N,)
        Of the present model.
    before : RecordNoise, optional
        Where it was measured before.
    policy : SearchPolicy
    """
    shown = innovation_noise(residual, record.kept)
    if before is not None:
        known = before.sigma
        return shown if shown < policy.clearly_less_noise * known else known
    samples = without_masked(record, record.samples[output])
    return min(shown, innovation_noise(samples, record.kept))


@dataclass(frozen=True)
class Prediction:
    """Outputs of one run at an estimate.

    Parameters
    ----------
    record : Record
        The run.
    y : ndarray, shape (ny, N)
        Predicted outputs at the raw samples, SI; NaN where the solve failed.
    theta : mapping of str to float
        Unknowns of that run.
    re_estimated : int
        Number of by-run parameters estimated on the run itself.
    status : Status
    predictor : Predictor
        Of this run, anchored at ``theta``.
    """

    record: Record
    y: Float[Array, "outputs samples"]
    theta: dict[str, float]
    re_estimated: int
    status: Status
    predictor: Predictor

    @property
    def vector(self) -> Array:
        """Unknowns in the predictor's order, shape (l,)."""
        return np.array([self.theta[name] for name in self.predictor.layout.names])


def predict_fitted(fit: ModelFit) -> list[Prediction]:
    """Predictions of the runs that were fitted."""
    found = []
    for run, solved in zip(fit.predictions, fit.predictor.runs, strict=True):
        record = solved.record
        mine = {
            name: v
            for name, v in fit.values.items()
            if name in fit.model.parameters or name.endswith(f"[{record.label}]")
        }
        predictor = _single(fit, record)
        # Stay on the branch of the fit; a transient on its mesh is not solved again.
        if record.periodic or predictor.runs[0].steps == solved.steps:
            predictor.runs[0].anchor = solved.anchor
        prediction = Prediction(record, run.y, mine, 0, run.status, predictor)
        predictor.set_anchor(prediction.vector)
        found.append(prediction)
    return found


def predict_held_out(fit: ModelFit, records: Sequence[Record]) -> list[Prediction]:
    """Predictions of runs that were not fitted."""
    return [_held_out(fit, record) for record in records]


def _single(
    fit: ModelFit, record: Record, steps: int | None = None, share: Predictor | None = None
) -> Predictor:
    numerics = fit.numerics
    return Predictor(
        fit.model,
        [record],
        steps=steps or fit.steps_for([record]),
        scheme=numerics.scheme,
        solver=numerics.solver,
        backend=numerics.backend,
        jobs=numerics.jobs,
        share=share or fit.predictor,
    )


def _held_out(fit: ModelFit, record: Record) -> Prediction:
    """On the mesh of the fit, or a finer one where a long transient asks for it, or a run that
    repeats after a fit to transients, which says nothing of its steps."""
    predictor = _single(fit, record)
    other_kind = record.periodic and not any(known.periodic for known in fit.records)
    known: Mapping[str, float] = {}
    while True:
        found, steps = _estimated_on(fit, record, predictor, known), predictor.steps
        run = predictor.runs[0]
        if not (run.can_be_coarser or other_kind) or steps >= MOST_COMPARED:
            return found
        finer = _single(fit, record, 2 * steps, predictor)
        if found.status.ok:
            (fine,) = finer.solved_anew(found.vector)
            solved = fine.status[0] == Status.CONVERGED.value
            halved = fine.y[0] if solved else np.array(np.nan)
            counts = weights(record) > 0
            left = np.mean((run.measured - found.y)[:, counts] ** 2, axis=1)
            if np.isfinite(halved).all():
                own = changed_squares(run.measured, found.y, halved, left, weights(record))
                if own[0] + abs(own[1]) <= fit.policy.unseen:
                    return found
            elif steps >= WHOLE:  # nothing says that finer steps would be better
                return found
        elif steps >= WHOLE:
            return found
        predictor, known = finer, found.theta if found.status.ok else {}


def _estimated_on(
    fit: ModelFit, record: Record, predictor: Predictor, known: Mapping[str, float]
) -> Prediction:
    """Prediction of a run, its own unknowns estimated on it, from where they are known."""
    problem = CampaignProblem(predictor).holding(fit.shared)
    own = len(problem.names)
    start = np.array([known[name] for name in problem.names]) if known else problem.start
    theta = np.empty(0)
    if own:
        told = _told_by_beginning(fit, problem, start)
        theta = _estimate_of(problem, start).theta if told is None else told
    full = problem.full(theta[None])[0]
    status = predictor.set_anchor(full)[0]
    samples = predictor.simulate(full[None], 0)
    names = predictor.layout.names
    return Prediction(
        record,
        samples.y[0],
        dict(zip(names, map(float, full), strict=True)),
        own,
        status if status is not Status.CONVERGED else Status(int(samples.status[0])),
        predictor,
    )


def _estimate_of(problem: CampaignProblem, start: Array) -> PointEstimate:
    """What is known of a nuisance parameter counts; of any other, only what the run says."""
    method = "be" if problem.nuisances.intersection(problem.names) else "mbe"
    return estimate(problem, method, start=start, **LIMITS)  # type: ignore[arg-type]


def _told_by_beginning(fit: ModelFit, problem: CampaignProblem, start: Array) -> Array | None:
    """Where a transient starts, by the part of it that tells; None where that is most of it, or
    the run has other unknowns."""
    (run,) = problem.predictor.runs
    record, layout = run.record, problem.predictor.layout
    starts = start_parameters(fit.model)
    owners = dict(zip(layout.names, layout.parameters, strict=True))
    if record.periodic or not all(owners[name] in starts for name in problem.names):
        return None
    shorter = on_beginning(problem, fit.shared, start)
    if shorter is None:
        return None
    found = _estimate_of(shorter, start)
    # It ends on its best point; where that is rough, all of the record is no smoother.
    return found.theta if found.status in (Status.CONVERGED, Status.NO_CONVERGENCE) else None


def crossed(prediction: Prediction) -> Prediction | None:
    """Predict each half of a held-out run with what was estimated on its other half.

    No sample is then compared with parameters that it took part in estimating.

    Parameters
    ----------
    prediction : Prediction
        Of a run with parameters of its own.

    Returns
    -------
    Prediction or None
        The same with other outputs; ``None`` where a run has no halves that repeat, or one of them
        could not be solved.
    """
    record = prediction.record
    if not record.periodic or record.periods < 2 or not prediction.status.ok:
        return None
    parts = [replace(part, label=record.label) for part in halves(record)]
    outputs = []
    for estimated, predicted in zip(reversed(parts), parts, strict=True):
        vector = _own_estimate(prediction, estimated)
        predictor = _like(prediction, predicted)
        if vector is None or predictor.set_anchor(vector)[0] is not Status.CONVERGED:
            return None
        samples = predictor.simulate(vector[None], 0)
        if samples.status[0] != Status.CONVERGED.value:
            return None
        outputs.append(samples.y[0])
    return replace(prediction, y=np.concatenate(outputs, axis=1), re_estimated=0)


def _like(prediction: Prediction, record: Record) -> Predictor:
    old = prediction.predictor
    return Predictor(
        old.model, [record], steps=old.steps, scheme=old.scheme, solver=old.solver,
        backend=old.backend, jobs=1,
    )  # fmt: skip


def _own_estimate(prediction: Prediction, record: Record) -> Array | None:
    """All unknowns, those of the run estimated on part of it."""
    predictor = _like(prediction, record)
    shared = {n: v for n, v in prediction.theta.items() if n in predictor.model.parameters}
    problem = CampaignProblem(predictor).holding(shared)
    start = np.array([prediction.theta[name] for name in problem.names])
    point = _estimate_of(problem, start)
    usable = point.status in (Status.CONVERGED, Status.NO_CONVERGENCE)
    return problem.full(point.theta[None])[0] if usable else None
