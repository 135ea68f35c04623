"""Predict runs that were not used: shared parameters stay, by-run parameters are estimated on the
run itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo.estimation import estimate
from bayesoleo.estimation.campaign_problem import CampaignProblem
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.prediction.records import Record
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.fit import Fit

Array = NDArray[np.float64]


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
    y: Array
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
