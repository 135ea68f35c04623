"""The closed loop and its predictions as a DataTree, in the layout of the package's schema.

Predictions cover one period of a periodic run, or the length of a transient.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from bayesoleo import _schema as schema
from bayesoleo._types import Array
from bayesoleo.data._campaign import CampaignData
from bayesoleo.discovery._curves import shape_group
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_and_hold_out_error import RunError, chance
from bayesoleo.discovery._loop import ClosedLoop
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._round import Round
from bayesoleo.discovery._run_predictions import Prediction, predict_fitted
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.discovery._state import State
from bayesoleo.discovery._summary import in_words, titles_of
from bayesoleo.error_models._base import ErrorModel, RunSamples
from bayesoleo.estimation._baselines import (
    ATTRIBUTE,
    common_baselines,
    notes_on,
    to_attribute,
)
from bayesoleo.estimation._point_estimate import to_dataset
from bayesoleo.model._parameters import Coordinate
from bayesoleo.posterior._datatree import (
    block_groups,
    choose_all,
    common_to_runs,
    sd_of_averages,
    to_datasets,
)
from bayesoleo.posterior._diagnostics import Samples
from bayesoleo.posterior._log_density import LogDensity
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._transient_run import TransientRun
from bayesoleo.solvers._orbit import Status

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

#: Draws beyond which the stored ones are thinned: files stay below a hundred megabytes.
MOST_DRAWS = 20_000
BEFORE = "before"
_OUTPUT_UNIT = "SI unit of each output"


def predictive_group(
    fit: ModelFit, found: Sequence[Prediction], samples: Samples, density: LogDensity, seed: int
) -> xr.Dataset:
    """Draws of the outputs, with errors as the error model has them and without.

    Parameters
    ----------
    fit : ModelFit
        Whose posterior it is.
    found : sequence of Prediction
        The runs, held-out ones too if they are to be predicted.
    samples : Samples
        Draws of the posterior.
    density : LogDensity
        From which they were drawn.
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
    errors = density.errors
    common = common_to_runs(density, np.concatenate([theta, own], axis=1), rng)
    runs = [_one_run(prediction, draws, errors, own, rng, common) for prediction in found]
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
    common: Array | None,
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
        drawn = errors.draw(own, record.label, taken, rng, common)
        sd = sd_of_averages(drawn, taken.phase, PHASES)
    return {
        "sample": y[1:] + errors.draw(own, record.label, points, rng, common),
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


def records_tree(records: Sequence[Record], campaign: CampaignData) -> dict[str, xr.Dataset]:
    """Groups that hold what was measured: observed data, constant data and noise."""
    units = {name: channel.si_unit for name, channel in campaign.channels.items()}
    labels = [record.label for record in records]
    channels = [name for name in units if all(name in record.samples for record in records)]
    rows = (schema.RUN, schema.SAMPLE)
    observed = {
        name: _padded([r.samples[name] for r in records], rows, units[name], name)
        for name in channels
    }
    observed[schema.TIME] = _padded(
        [r.time - r.time[0] for r in records], rows, "s", "time since the first sample"
    )
    observed[schema.PHASE] = _padded([r.phase for r in records], rows, "1", "phase in cycles")
    constant = {
        schema.FREQUENCY: _by_run([r.frequency for r in records], "Hz", "fundamental frequency"),
        schema.FREQUENCY_SD: _by_run(
            [r.frequency_sd for r in records], "Hz", "its standard deviation"
        ),
        schema.PERIODS: _by_run([r.periods for r in records], "1", "whole periods"),
        schema.ROLE: (schema.RUN, [r.role for r in records]),
        schema.RUN_GROUP: (schema.RUN, [r.group for r in records]),
    }
    condition_units = {
        name: unit for run in campaign.runs for name, unit in run.condition_units.items()
    }
    for name, unit in condition_units.items():
        constant[name] = _by_run([r.conditions.get(name, np.nan) for r in records], unit, name)
    noise = {
        name: _by_run(
            [r.signal_noise[name] for r in records], units[name], f"noise of a sample of {name}"
        )
        for name in channels
    }
    coords = {schema.RUN: labels}
    return {
        schema.RECORDS: xr.Dataset(observed, coords=coords),
        schema.CONSTANT_DATA: xr.Dataset(constant, coords=coords),
        schema.NOISE: xr.Dataset(noise, coords=coords),
    }


def point_group(fit: ModelFit) -> xr.Dataset:
    """The group ``point``, with the mesh on which it was found and what that may have moved."""
    point = to_dataset(fit.point, mbe=fit.mbe, units=_units(fit))
    offsets = common_baselines(fit.problem, fit.point.theta, fit.point.covariance)
    notes = [*fit.point.notes, *(fit.doubts if fit.model.dofs else []), *notes_on(offsets)]
    point.attrs["notes"] = json.dumps(notes, ensure_ascii=False)
    if offsets:
        point.attrs[ATTRIBUTE] = to_attribute(offsets)
    if fit.model.dofs:
        scheme = fit.numerics.scheme
        point.attrs |= {
            "scheme": scheme,
            "solver": fit.numerics.solver,
            "steps": fit.steps,
            "mesh_shift": fit.shift,
            "motion_error": fit.motion_error,
        }
    return point


def _units(fit: ModelFit) -> list[str]:
    layout = fit.predictor.layout
    return [
        fit.model.parameters[layout.parameters[layout.names.index(name)]].unit
        for name in fit.problem.names
    ]


def posterior_groups(
    fit: ModelFit, samples: Samples, seed: int, density: LogDensity | None = None
) -> dict[str, xr.Dataset]:
    """The groups of :func:`to_datasets` and :func:`block_groups`, of at most so many draws."""
    units = dict(zip(fit.problem.names, _units(fit), strict=True))
    units |= {name: fit.model.outputs[name].unit for name in fit.predictor.outputs}
    scattering = [] if density is None else density.unknowns.scattering
    for name in scattering:
        unit = fit.model.parameters[name].unit
        support = fit.problem.priors[fit.problem.names.index(f"{name}[{samples.runs[0]}]")].support
        units[schema.population_mean(name)] = unit
        # With a bound the spread is that of a logarithm.
        units[schema.spread(name)] = "1" if np.isfinite(support).any() else unit
    samples = samples.thinned(MOST_DRAWS)
    groups = to_datasets(samples, fit.problem.priors, units=units, seed=seed, density=density)
    groups[schema.POSTERIOR].attrs[schema.BETWEEN_RUNS] = json.dumps(list(scattering))
    if density is not None:
        units |= fit.model.inputs
        inputs = partial(_inputs, fit)
        groups |= block_groups(samples, density, inputs, units=units, seed=seed)
    return groups


def _inputs(fit: ModelFit, run: int, shown: NDArray[np.int64]) -> dict[str, Array]:
    """Measured inputs of a run at some of the samples that count."""
    record, problem = fit.predictor.records[run], fit.problem
    names = [name for name in fit.model.inputs if name in record.samples]
    return {name: problem.kept(run, record.samples[name])[shown] for name in names}


def predictive_groups(
    fit: ModelFit, samples: Samples, density: LogDensity, seed: int
) -> dict[str, xr.Dataset]:
    """The groups prediction and period_predictive of the fitted runs."""
    found = predict_fitted(fit)
    return {
        schema.PREDICTION: _predictions([(BEFORE, fit, found)]),
        schema.PERIOD_PREDICTIVE: predictive_group(fit, found, samples, density, seed),
    }


def fitted_groups(fit: ModelFit) -> dict[str, xr.Dataset]:
    """The groups prediction and residual of the fitted runs, without averages over periods."""
    found = predict_fitted(fit)
    left = {}
    for b, output in enumerate(fit.predictor.outputs):
        rows = [_counted(p.record, p.record.samples[output] - p.y[b]) for p in found]
        unit, dims = fit.model.outputs[output].unit, (schema.RUN, schema.SAMPLE)
        left[schema.before(output)] = _padded(rows, dims, unit, f"residual of {output}")
    return {
        schema.PREDICTION: _predictions([(BEFORE, fit, found)]),
        schema.RESIDUAL: xr.Dataset(left, coords={schema.RUN: [p.record.label for p in found]}),
    }


def loop_groups(loop: ClosedLoop) -> dict[str, xr.Dataset]:
    """The groups prediction, residual, discovery and nonparametric."""
    groups = {
        schema.PREDICTION: _predictions(
            [(stage, state.fit, ordered(state)) for stage, state in _stages(loop)]
        ),
        schema.RESIDUAL: _residuals(loop),
        schema.DISCOVERY: _discovery(loop.rounds, titles_of(loop)),
    }
    shape = shape_group(loop)
    if shape is not None:
        groups[schema.NONPARAMETRIC] = shape
    return groups


def loop_predictive(
    loop: ClosedLoop, drawn: tuple[Samples, LogDensity], seed: int
) -> dict[str, xr.Dataset]:
    """The group period_predictive of the final model."""
    final, (samples, density) = loop.final, drawn
    found = predictive_group(final.fit, ordered(final), samples, density, seed)
    return {schema.PERIOD_PREDICTIVE: found}


# -- pieces ---------------------------------------------------------------------------


def _padded(values: Sequence[Array], dims: tuple[str, str], unit: str, name: str) -> xr.Variable:
    table = np.full((len(values), max(map(len, values))), np.nan)
    for row, item in zip(table, values, strict=True):
        row[: len(item)] = item
    return xr.Variable(dims, table, {schema.UNITS: unit, schema.LONG_NAME: name})


def _by_run(values: Sequence[float], unit: str, name: str) -> xr.Variable:
    return xr.Variable(schema.RUN, np.asarray(values), {schema.UNITS: unit, schema.LONG_NAME: name})


def ordered(state: State) -> list[Prediction]:
    """One prediction a run, the held-out one where there is one."""
    held = {p.record.label: p for p in state.held_out}
    rest = [p for p in state.fitted if p.record.label not in held]
    return [*rest, *held.values()]


def _stages(loop: ClosedLoop) -> list[tuple[str, State]]:
    return [(BEFORE, loop.first)] + (
        [("after", loop.final)] if loop.final is not loop.first else []
    )


def _predictions(stages: Sequence[tuple[str, ModelFit, list[Prediction]]]) -> xr.Dataset:
    data = {}
    for stage, fit, found in stages:
        for b, output in enumerate(fit.predictor.outputs):
            unit = fit.model.outputs[output].unit
            data[f"{output}_{stage}"] = _padded(
                [p.y[b] for p in found], (schema.RUN, schema.SAMPLE), unit, f"predicted {output}"
            )
    return xr.Dataset(data, coords={schema.RUN: [p.record.label for p in stages[0][2]]})


def _residuals(loop: ClosedLoop) -> xr.Dataset:
    data, rows = {}, (schema.RUN, schema.SAMPLE)
    for stage, state in _stages(loop):
        found = ordered(state)
        for b, output in enumerate(state.fit.predictor.outputs):
            unit = state.fit.model.outputs[output].unit
            errors = [state.errors.at(output, p.record.label) for p in found]
            data[f"{output}_{stage}"] = _padded(
                [_counted(p.record, p.record.samples[output] - p.y[b]) for p in found],
                rows,
                unit,
                f"residual of {output}",
            )
            means = np.stack([e.average.on_phase(PHASES) for e in errors])
            data[f"{output}_{stage}_mean"] = xr.Variable(
                (schema.RUN, schema.PHASE),
                means,
                {
                    schema.UNITS: unit,
                    schema.LONG_NAME: f"residual of {output}, average over periods",
                },
            )
            data[schema.noise(output)] = _by_run(
                [e.noise for e in errors], unit, "standard error of that average"
            )
    for name, (values, unit, text) in _coordinate(loop).items():
        data[name] = _padded(values, rows, unit, text)
    coords = {
        schema.RUN: [p.record.label for p in ordered(loop.first)],
        schema.PHASE: np.arange(PHASES) / PHASES,
    }
    return xr.Dataset(data, coords=coords)


def _counted(record: Record, residual: Array) -> Array:
    """A residual without the samples that do not count."""
    return np.where(weights(record) > 0, residual, np.nan)


def _place(loop: ClosedLoop) -> Coordinate | None:
    """The coordinate to look at: where the first added effect acts, else the best candidate, else
    the first that has a velocity."""
    moving = [c for c in loop.final.assembly.native.coordinates() if c.velocity is not None]
    ranking = loop.rounds[-1].ranking
    for target in (*loop.targets, *(item.target for item in ranking[:1])):
        for place in moving:
            if target in (place.name, place.target):
                return place
    return moving[0] if moving else None


def _coordinate(loop: ClosedLoop) -> dict[str, tuple[list[Array], str, str]]:
    """Position and velocity, with unit and name, of one coordinate for plots of the residual."""
    state, place = loop.final, _place(loop)
    native = state.assembly.native
    if place is None:
        return {}
    names = (place.name,) if place.position is None else (place.position_name, place.name)
    units = [native.dofs[n].unit if n in native.dofs else native.inputs[n] for n in names]
    unit, rate = units[0], units[-1]
    if place.order > 0:
        rate = f"{unit}/s" if unit else "1/s"
    position, velocity = [], []
    for prediction in ordered(state):
        moved, *moving = (_motion_of(name, prediction, state.assembly.drive) for name in names)
        rates = moving[0] if moving else moved
        if moved is None or rates is None:
            return {}
        position.append(moved[0])
        velocity.append(rates[place.order])
    found = {schema.VELOCITY: (velocity, rate, f"velocity of {place.name}")}
    if place.position is None:
        return found
    # A dof that is called position has no position of its own.
    stroke = names[0] if names[0] == "position" else f"position of {names[0]}"
    return {schema.STROKE: (position, unit, stroke), **found}


def _motion_of(name: str, prediction: Prediction, drive: str | None) -> Array | None:
    """Value and rate of a dof, or of the channel that stands for it, at the samples of a run."""
    record, run = prediction.record, prediction.predictor.runs[0]
    motion = run.known_motions().get(name)
    if motion is not None:
        return np.asarray(motion(record.position))
    channel = name if name in record.signals else drive
    if channel is None:
        return None
    item = record.signals[channel]
    return np.stack([item.evaluate(record.position, record.rate, k) for k in range(2)])


def _discovery(rounds: Sequence[Round], titles: Mapping[str, str]) -> xr.Dataset:
    keys = list(dict.fromkeys(_key(item) for entry in rounds for item in entry.ranking))
    shape = (len(rounds), len(keys))
    numbers = {name: np.full(shape, np.nan) for name in (schema.GAIN, schema.P_VALUE, schema.Z)}
    texts = {
        name: np.full(shape, "", dtype=object)
        for name in (schema.EXPECTED, schema.INDISTINGUISHABLE)
    }
    family = np.full(len(keys), "", dtype=object)
    for r, entry in enumerate(rounds):
        for item in entry.ranking:
            k = keys.index(_key(item))
            numbers[schema.GAIN][r, k], numbers[schema.P_VALUE][r, k] = item.gain, item.p_value
            numbers[schema.Z][r, k] = item.score.z
            expected = dict(zip(item.score.names, map(float, item.score.expected), strict=True))
            texts[schema.EXPECTED][r, k] = json.dumps(expected)
            texts[schema.INDISTINGUISHABLE][r, k] = json.dumps(list(item.same))
            family[k] = item.score.option.candidate.family
    dims = (schema.ROUND, schema.EFFECT)
    data: dict[str, xr.Variable] = {
        name: xr.Variable(dims, values, {schema.UNITS: "1"}) for name, values in numbers.items()
    }
    data |= {name: xr.Variable(dims, values.astype(str)) for name, values in texts.items()}
    data[schema.CANDIDATE_FAMILY] = xr.Variable(schema.EFFECT, family.astype(str))
    data |= _error_tables(rounds)
    data[schema.ACCEPTED] = xr.Variable(
        schema.ROUND, np.array([e.accepted.effect if e.accepted else "" for e in rounds])
    )
    data[schema.ACCEPTED_TARGET] = xr.Variable(
        schema.ROUND, np.array([e.accepted.target if e.accepted else "" for e in rounds])
    )
    reasons = [in_words(entry.reason, titles) for entry in rounds]
    data[schema.REASON] = xr.Variable(schema.ROUND, np.array(reasons))
    first = rounds[0].before
    coords = {
        schema.ROUND: np.arange(1, len(rounds) + 1),
        schema.EFFECT: np.array(keys, dtype=str),
        schema.OUTPUT: list(first.errors.outputs),
        schema.RUN: [p.record.label for p in ordered(first)],
    }
    return xr.Dataset(data, coords=coords)


def _key(item: Ranked) -> str:
    return f"{item.effect} at {item.score.option.candidate.target}"


def _error_tables(rounds: Sequence[Round]) -> dict[str, xr.Variable]:
    dims = (schema.ROUND, schema.OUTPUT, schema.RUN)
    first = rounds[0].before
    runs = [p.record.label for p in ordered(first)]
    numbers: dict[str, tuple[Callable[[RunError], float], str]] = {
        schema.RMS: (lambda e: e.rms, _OUTPUT_UNIT),
        schema.REPEATING: (lambda e: e.repeating, _OUTPUT_UNIT),
        schema.NOISE: (lambda e: e.noise, _OUTPUT_UNIT),
        schema.RATIO_TO_NOISE: (lambda e: e.ratio, "1"),
        schema.EXPECTED_ERROR: (lambda e: e.expected, _OUTPUT_UNIT),
        schema.RATIO_TO_EXPECTED: (lambda e: e.ratio_to_expected, "1"),
        schema.CHANCE: (lambda e: chance([e]), "1"),
    }

    def table(number: Callable[[RunError], float]) -> list[list[list[float]]]:
        outputs = first.errors.outputs
        return [
            [[number(entry.before.errors.at(output, run)) for run in runs] for output in outputs]
            for entry in rounds
        ]

    return {
        name: xr.Variable(
            dims, np.array(table(number)), {schema.LONG_NAME: name, schema.UNITS: unit}
        )
        for name, (number, unit) in numbers.items()
    }
