"""Predict runs that were not used: shared parameters stay, by-run parameters are estimated on the
run itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import Array, Float
from bayesoleo.estimation import estimate
from bayesoleo.estimation.problems.campaign_problem import CampaignProblem
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.prediction.records import Record
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.fitting.fit import Fit
from bayesoleo.tracing.fitting.roles import halves


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


def predict_fitted(fit: Fit) -> list[Prediction]:
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
        if record.periodic:  # stay on the branch of the fit
            predictor.runs[0].anchor = solved.anchor
        prediction = Prediction(record, run.y, mine, 0, run.status, predictor)
        predictor.set_anchor(prediction.vector)
        found.append(prediction)
    return found


def predict_held_out(fit: Fit, records: Sequence[Record]) -> list[Prediction]:
    """Predictions of runs that were not fitted."""
    return [_held_out(fit, record) for record in records]


def _single(fit: Fit, record: Record) -> Predictor:
    numerics = fit.numerics
    return Predictor(
        fit.model,
        [record],
        steps=fit.steps,
        scheme=numerics.scheme,
        solver=numerics.solver,
        backend=numerics.backend,
        jobs=numerics.jobs,
        share=fit.predictor,
    )


def _held_out(fit: Fit, record: Record) -> Prediction:
    predictor = _single(fit, record)
    problem = CampaignProblem(predictor).holding(fit.shared)
    own = len(problem.names)
    # What is known of a nuisance parameter counts; of any other, only what the run says.
    method = "be" if problem.nuisances.intersection(problem.names) else "mbe"
    theta = estimate(problem, method).theta if own else np.empty(0)
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
    method = "be" if problem.nuisances.intersection(problem.names) else "mbe"
    point = estimate(problem, method, start=start)
    return problem.full(point.theta[None])[0] if point.status.ok else None
