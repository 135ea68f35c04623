"""What the posterior predicts of runs, over one period or the length of a transient."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.error_models import ErrorModel
from bayesoleo.error_models.base import RunSamples
from bayesoleo.posterior import Samples
from bayesoleo.posterior.outcome.predictive import choose_all, sd_of_averages
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.prediction.records import Record
from bayesoleo.prediction.transient import TransientRun
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.errors.holdout import Prediction
from bayesoleo.tracing.fitting.fit import Fit

#: Points of a period, and draws of the posterior.
PHASES, DRAWS = 200, 100

_CHAINS = (schema.CHAIN, schema.DRAW)
_KINDS: dict[str, tuple[Callable[[str], str], tuple[str, ...], str]] = {
    "sample": (lambda output: output, (*_CHAINS, schema.RUN, schema.PHASE), "a sample of {}"),
    "expected": (
        schema.expected,
        (*_CHAINS, schema.RUN, schema.PHASE),
        "{} as predicted, without errors",
    ),
    "at_estimate": (
        schema.at_estimate,
        (schema.RUN, schema.PHASE),
        "{} as predicted at the estimate, without errors",
    ),
    "average_sd": (
        schema.average_sd,
        (*_CHAINS, schema.RUN),
        "standard deviation of the errors of {} averaged over periods at one of the phases",
    ),
}


def predictive_group(
    fit: Fit, found: Sequence[Prediction], samples: Samples, errors: ErrorModel, seed: int
) -> xr.Dataset:
    """Draws of the outputs, with errors as the error model has them and without.

    Parameters
    ----------
    fit : Fit
        Whose posterior it is.
    found : sequence of Prediction
        The runs, held-out ones too if they are to be predicted.
    samples : Samples
        Draws of the posterior.
    errors : ErrorModel
        Under which they were drawn.
    seed : int
        Seeds choice and errors.

    Returns
    -------
    Dataset
        ``<output>(chain, draw, run, phase)``: samples along one period of the run done anew, so
        that a discrepancy is another one of the same kind; ``<output>_expected`` the same without
        errors; ``<output>_at_estimate(run, phase)``; and ``<output>_average_sd(chain, draw, run)``,
        how much errors leave in an average over all the run's periods, NaN of a transient.
    """
    theta, own = choose_all(samples, DRAWS, seed=seed)
    draws = dict(zip(samples.parameters, theta.T, strict=True))
    rng = np.random.default_rng(seed)
    runs = [_one_run(prediction, draws, errors, own, rng) for prediction in found]
    data = {}
    for b, output in enumerate(fit.predictor.outputs):
        unit = fit.model.outputs[output].unit
        for kind, (name, dims, text) in _KINDS.items():
            values = np.stack([run[kind] for run in runs])[:, :, b]
            # Runs first to where the dims have them; all draws are one chain.
            values = values[:, 0] if kind == "at_estimate" else np.moveaxis(values, 0, 1)[None]
            about = {schema.UNITS: unit, schema.LONG_NAME: text.format(output)}
            data[name(output)] = xr.Variable(dims, values, about)
    coords = {schema.RUN: [p.record.label for p in found], schema.PHASE: np.arange(PHASES) / PHASES}
    return xr.Dataset(data, coords=coords)


def _one_run(
    prediction: Prediction,
    draws: Mapping[str, Array],
    errors: ErrorModel,
    own: Array,
    rng: np.random.Generator,
) -> dict[str, Array]:
    """By kind, arrays that begin with (draws, outputs)."""
    record = prediction.record
    # The estimate itself comes first.
    vectors = np.repeat([list(prediction.theta.values())], len(own) + 1, axis=0)
    for k, name in enumerate(prediction.theta):
        if name in draws:
            vectors[1:, k] = draws[name]
    y = _on_phases(prediction, vectors)
    frequency = record.frequency if record.periodic else None
    points = RunSamples(record.span * _grid(record), frequency)
    sd = np.full((len(own), y.shape[1]), np.nan)
    if record.periodic:
        kept = slice(None) if record.kept is None else record.kept
        taken = RunSamples(record.time[kept], frequency)
        sd = sd_of_averages(errors.draw(own, record.label, taken, rng), taken.phase, PHASES)
    return {
        "sample": y[1:] + errors.draw(own, record.label, points, rng),
        "expected": y[1:],
        "at_estimate": y[:1],
        "average_sd": sd,
    }


def _grid(record: Record) -> Array:
    """Parts of a period, or of a transient's length with its end."""
    return np.arange(PHASES) / (PHASES if record.periodic else PHASES - 1)


def _on_phases(prediction: Prediction, theta: Array) -> Array:
    """Outputs on a grid of one period, or of a transient's length, for many vectors, shape (K, ny,
    PHASES)."""
    old, record = prediction.predictor, prediction.record
    blank: Mapping[str, Array] = {name: np.zeros(PHASES) for name in record.samples}
    predictor = Predictor(
        old.model,
        [replace(record, time=record.span * _grid(record), samples=blank)],
        steps=old.steps,
        scheme=old.scheme,
        solver=old.solver,
        backend=old.backend,
        jobs=1,
    )
    run = old.runs[0]
    if isinstance(run, TransientRun):
        predictor.runs[0] = run.resampled(predictor.records[0])
    predictor.runs[0].anchor = run.anchor
    found = predictor.simulate(theta, 0)
    y = found.y
    y[found.status != Status.CONVERGED.value] = np.nan
    return y
