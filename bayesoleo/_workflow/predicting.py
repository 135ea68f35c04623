"""Predict runs that were not used, from a result with all of its uncertainty, and score it.

Unknowns come as draws: of the posterior where the result holds one, else of the normal distribution
about the estimate. What the result does not know, such as a by-run parameter of a new run, is drawn
from its prior; where a transient starts, its own record says. Noise of a sample is added to the
interval.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import LabelledResult, columns, variable
from bayesoleo._types import Array, Float
from bayesoleo._workflow.predicted_starts import drawn_starts, estimated_starts, unknown_starts
from bayesoleo._workflow.settings import DISTURBANCES
from bayesoleo._workflow.simulating import model_of, parameter_sets, same_noise, same_samples
from bayesoleo.assessment._residual_breakdown import judged_errors
from bayesoleo.assessment._residual_tests import PredictiveScore, score_draws
from bayesoleo.data._data_warnings import removed_text
from bayesoleo.data._disturbances import without_disturbances
from bayesoleo.data._noise import local_means
from bayesoleo.data._reduction import ReducedCampaign
from bayesoleo.discovery._expected_error import most_by_chance
from bayesoleo.discovery._fit_and_hold_out_error import compared
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._run_predictions import Prediction
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.errors import InputError, check_level, number_of
from bayesoleo.estimation._baselines import (
    Baseline,
    added_text,
    baselines_in,
    check_baselines,
    with_common_baselines,
)
from bayesoleo.estimation._nuisance import uncertain_conditions
from bayesoleo.model._drive_and_start import with_estimated_starts
from bayesoleo.model._model import Model
from bayesoleo.prediction._input_bandwidth import without_invented
from bayesoleo.prediction._mesh_steps import MOST_STEPS, first_steps
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._orbit import Status, count, counted
from bayesoleo.solvers._schemes import COLLOCATION, DEFAULT_SCHEME

#: Steps of the mesh in a period, and points of one at which the band is kept.
STEPS, POINTS = 512, 200
#: Bins of the probability integral transform.
BINS = 20
#: Attribute that tells which offsets were added.
ADDED = "added"
#: Attribute that tells what was removed from outputs.
REMOVED = "removed"
_NUMBERS = {
    "rms": ("root mean square of what was measured less the mean of the prediction", True),
    "bias": ("mean of it", True),
    "expected_rms": ("root mean square that the prediction expects", True),
    "repeating": ("root mean square of what repeats of the error of the estimate", True),
    "noise": ("standard error of that", True),
    "expected_error": ("what noise and the unknowns let it be", True),
    "ratio_to_noise": ("repeating over noise", False),
    "ratio_to_expected": ("repeating over what is expected", False),
    "log_score": ("mean log density of a sample, higher is better", False),
    "coverage": ("part of the samples inside the interval", False),
    "pit_distance": ("distance of the probability integral transform from uniform", False),
}


@dataclass(frozen=True)
class Known:
    """What a result knows, as draws.

    Parameters
    ----------
    values : mapping of str to float
        The estimate.
    draws : mapping of str to ndarray, shape (m,)
        Of each unknown; together they are joint draws.
    sd : mapping of str to ndarray, shape (m,)
        Standard deviation of an output's errors, one for each draw.
    """

    values: Mapping[str, float]
    draws: Mapping[str, Float[Array, " draws"]]
    sd: Mapping[str, Float[Array, " draws"]]


def predict(
    tree: xr.DataTree,
    campaign: ReducedCampaign,
    *,
    model: Model | None = None,
    runs: Sequence[str] | None = None,
    draws: int = 200,
    level: float = 0.95,
    seed: int = 0,
    scheme: str = DEFAULT_SCHEME,
    solver: str = COLLOCATION,
    steps: int | None = None,
    jobs: int | None = None,
    common_offset: bool = False,
    disturbances: Sequence[str] = DISTURBANCES,
) -> LabelledResult:
    """Predict runs from a result and hold the prediction against what was measured.

    Parameters
    ----------
    tree : DataTree
        Of ``estimate``, ``sample`` or ``close``.
    campaign : ReducedCampaign
        With the runs to be predicted, which need not be those that were fitted.
    model : Model, optional
        Another model with parameters of the same names, for example the oleo in a drop test; by
        default the result's own.
    runs : sequence of str, optional
        Labels; by default all.
    draws : int, optional
        Number of draws.
    level : float, optional
        Of the intervals.
    seed : int, optional
    scheme, solver
        How runs are solved.
    steps : int, optional
        Of a period; by default as many as its inputs ask for.
    jobs : int, optional
        Threads.
    common_offset : bool, optional
        Add to outputs that drift the offset that the fitted runs have in common, with its
        uncertainty; a fitted run has its own. Nothing is added by default.
    disturbances : sequence of {"drift", "tone", "tails"}, optional
        What is removed from outputs before they are compared, as before an estimate: tones that are
        no harmonics, and outliers. Drift stays, since a prediction says where an output is.

    Returns
    -------
    LabelledResult
        By ``(output, run)``: ``rms``, ``bias``, ``expected_rms``, ``log_score``, ``coverage``,
        ``pit_distance``; ``repeating``, ``noise``, ``expected_error`` and the ratios to both, as in
        the search, and of a run that the result holds those of its verdict; ``failed(run)``, the
        draws without a solution, which are left out;
        ``pit(output, run, bin)``, a histogram that is flat where the prediction is calibrated;
        ``time(run, point)``, and ``mean``, ``low``, ``high`` and ``measured``
        ``(output, run, point)`` over the first period, or the whole of a transient. With
        ``common_offset`` what was added is in ``offset`` and ``offset_sd`` ``(output)``.

    Raises
    ------
    InputError
        If there is no such run, a run cannot be predicted, or no output has a common offset.

    References
    ----------
    Gneiting and Raftery (2007); Dawid (1984); Verbeek (1993), section 6.4 (drop tests).
    """
    check_level(level)
    if draws < 2:
        raise InputError("draws must be two or more", key="draws", value=draws)
    rng = np.random.default_rng(seed)
    known = draws_of(tree, draws, rng)
    used = model_of(tree) if model is None else model
    chosen = campaign.records if runs is None else [campaign.record(label) for label in runs]
    # As inputs the channels count as far as they did in the fit.
    given = [name for name, c in campaign.campaign.channels.items() if c.bandwidth is not None]
    chosen, _ = without_invented(used, chosen, given)
    kinds = [kind for kind in disturbances if kind != "drift"]
    measured = [name for name in used.outputs if name in campaign.campaign.channels]
    chosen = without_disturbances(chosen, measured, kinds)
    removed = removed_text(chosen, campaign.campaign.units)
    added = baselines_in(tree[schema.POINT].to_dataset()) if common_offset else []
    if common_offset:
        check_baselines(added, used)
        chosen = with_common_baselines(chosen, added, partial(same_noise, tree))
    records = uncertain_conditions(used).complete(chosen)
    if not all(record.periodic for record in records):
        # A result of periodic runs alone knows nothing of starts.
        used = with_estimated_starts(used)
    found = [
        _one_run(used, record, known, rng, level, scheme, solver, steps, jobs) for record in records
    ]
    found = [
        _as_judged(tree, record, run, used) for record, run in zip(records, found, strict=True)
    ]
    data = _dataset(used, records, found)
    data.attrs = {"level": level, "draws": draws, "model": used.name, REMOVED: removed}
    if added:
        data = _with_added(data, added)
    return LabelledResult(data, forecast_text(data))


def _with_added(data: xr.Dataset, added: Sequence[Baseline]) -> xr.Dataset:
    """Also what was added to each output, and the sentences that say so."""
    by_output = {one.output: one for one in added}
    for key, of in (("offset", "value"), ("offset_sd", "sd")):
        values = [
            getattr(by_output[name], of) if name in by_output else 0.0
            for name in data[schema.OUTPUT].values
        ]
        text = "offset added to runs that were not fitted" + ", sd" * (of == "sd")
        data[key] = variable((schema.OUTPUT,), np.array(values), text, "output's SI unit")
    data.attrs[ADDED] = added_text(added)
    return data


def draws_of(tree: xr.DataTree, number: int, rng: np.random.Generator) -> Known:
    """Joint draws of what a result knows.

    Parameters
    ----------
    tree : DataTree
    number : int
        Of draws.
    rng : numpy.random.Generator
    """
    (values,) = parameter_sets(tree, None, 0)
    point = tree[schema.POINT].to_dataset()
    outputs = [str(name) for name in point[schema.OUTPUT].values]
    if schema.POSTERIOR not in tree.children:
        mean, covariance = point[schema.ESTIMATE].values, point[schema.COVARIANCE].values
        # In units of the standard deviations: parameters differ by ten orders of magnitude.
        unit = np.sqrt(np.diag(covariance))
        root = np.linalg.cholesky(covariance / np.outer(unit, unit))
        table = mean + unit * (rng.standard_normal((number, mean.size)) @ root.T)
        sd = np.sqrt(point[schema.VARIANCE].values)
        return Known(
            values,
            dict(zip(values, table.T, strict=True)),
            {name: np.full(number, s) for name, s in zip(outputs, sd, strict=True)},
        )
    posterior = tree[schema.POSTERIOR].to_dataset()
    flat = {str(name): draws.values.ravel() for name, draws in posterior.data_vars.items()}
    size = len(next(iter(flat.values())))
    chosen = rng.choice(size, size=number, replace=number > size)
    sds: dict[str, Array] = {}
    for name, variance in zip(outputs, point[schema.VARIANCE].values, strict=True):
        log_variance = flat.get(schema.log_variance(name))
        if log_variance is None:
            sds[name] = np.full(number, np.sqrt(variance))
        else:
            sds[name] = np.exp(0.5 * log_variance[chosen])
    return Known(values, {name: flat[name][chosen] for name in values if name in flat}, sds)


@dataclass(frozen=True)
class _Run:
    """One run's prediction: draws at the samples, and its score by output."""

    mean: Array
    spread: Array
    low: Array
    high: Array
    scores: Sequence[PredictiveScore]
    errors: Sequence[Mapping[str, float]]
    failed: Mapping[str, int]


def _one_run(
    model: Model,
    record: Record,
    known: Known,
    rng: np.random.Generator,
    level: float,
    scheme: str,
    solver: str,
    steps: int | None,
    jobs: int | None,
) -> _Run:
    if steps is None:
        wanted = 2 * first_steps(model, [record]) if record.periodic else STEPS
        steps = min(max(STEPS, wanted), MOST_STEPS)
    predictor = Predictor(model, [record], steps=steps, scheme=scheme, solver=solver, jobs=jobs)
    names, priors = predictor.layout.names, predictor.layout.priors(model)
    number = len(next(iter(known.sd.values())))
    theta = np.array(
        [known.values.get(n, v) for n, v in zip(names, predictor.layout.start(model), strict=True)]
    )
    (status,) = predictor.set_anchor(theta)
    if not status.ok:
        raise InputError(
            f"cannot be predicted at the estimate: {status.message}",
            run=record.label,
            hint="leave it out with runs=",
        )
    table = np.column_stack(
        [
            known.draws[n] if n in known.draws else prior.sample(rng, number)
            for n, prior in zip(names, priors, strict=True)
        ]
    )
    starts = unknown_starts(predictor, known.values)
    if starts.size and not record.periodic:
        theta = estimated_starts(predictor, theta, starts)
        sd = np.array([float(np.mean(_sd_of(name, known, record))) for name in predictor.outputs])
        table[:, starts] = drawn_starts(predictor, theta, starts, table, sd, rng)
    found = predictor.simulate(table, 0)
    good = found.status == Status.CONVERGED.value
    if good.sum() < 2:
        raise InputError(
            "hardly any draw of the parameters can be solved", run=record.label,
            value=count(found.status), hint="narrow the estimate, or leave the run out",
        )  # fmt: skip
    y = found.y[good]
    noise = np.stack([_sd_of(name, known, record)[good] for name in predictor.outputs], axis=1)
    mean = y.mean(axis=0)
    spread = np.sqrt(y.var(axis=0) + np.mean(noise**2, axis=0)[:, None])
    half = distributions.norm.isf(0.5 * (1 - level)) * spread
    kept = slice(None) if record.kept is None else record.kept
    scores = [
        score_draws(record.samples[name][kept], y[:, b, kept], noise[:, b, None], level=level)
        for b, name in enumerate(predictor.outputs)
    ]
    failed = {key: n for key, n in count(found.status).items() if key != "converged"}
    errors = _errors(predictor, record, theta, y)
    return _Run(mean, spread, mean - half, mean + half, scores, errors, failed)


def _errors(
    predictor: Predictor, record: Record, theta: Array, draws: Array
) -> list[dict[str, float]]:
    """The error of the estimate by output, against its noise and against what draws ``(m, ny, N)``
    of the unknowns add to it."""
    at_estimate = predictor.simulate(theta[None], 0)
    values = dict(zip(predictor.layout.names, map(float, theta), strict=True))
    status = Status(int(at_estimate.status[0]))
    one = Prediction(record, at_estimate.y[0], values, 0, status, predictor)
    entries, _ = compared(one, {record.label: record.role})
    raw = (draws - at_estimate.y[0]) * weights(record)
    averaged = raw if record.periodic else local_means(raw, record.kept)
    moved, of_samples = (np.mean(changes**2, axis=(0, 2)) for changes in (averaged, raw))
    found = []
    for one_output, square, single in zip(entries, moved, of_samples, strict=True):
        by_draws = most_by_chance(float(single), SearchPolicy())
        entry = replace(one_output, feigned=one_output.feigned + by_draws)
        expected = float(np.hypot(entry.noise, np.sqrt(square)))
        found.append(
            {
                "repeating": entry.repeating,
                "noise": entry.noise,
                "expected_error": expected,
                "ratio_to_noise": entry.ratio,
                "ratio_to_expected": entry.repeating / expected,
            }
        )
    return found


def _as_judged(tree: xr.DataTree, record: Record, run: _Run, model: Model) -> _Run:
    """With the errors that the search of the result has found on the very same samples: there is
    one answer. It knows more: what each run said of its own parameters."""
    if schema.RECORDS not in tree.children:
        return run
    errors = []
    for output, computed in zip(model.outputs, run.errors, strict=True):
        same = same_samples(tree, record, output)
        known = judged_errors(tree, output, record.label) if same else {}
        errors.append({key: known.get(key, value) for key, value in computed.items()})
    return replace(run, errors=errors)


def _sd_of(output: str, known: Known, record: Record) -> Array:
    """Noise of an output; of one that was not fitted, what the record itself shows."""
    number = len(next(iter(known.sd.values())))
    shown = float(np.nan_to_num(record.signal_noise.get(output, 0.0)))
    return known.sd.get(output, np.full(number, shown))


def _dataset(model: Model, records: Sequence[Record], found: Sequence[_Run]) -> xr.Dataset:
    outputs = list(model.outputs)
    grid, each = (schema.OUTPUT, schema.RUN), (schema.OUTPUT, schema.RUN, "point")
    tables = {key: np.full((len(outputs), len(records)), np.nan) for key in _NUMBERS}
    pit = np.zeros((len(outputs), len(records), BINS))
    bands = {
        key: np.full((len(outputs), len(records), POINTS), np.nan)
        for key in ("mean", "low", "high", "measured")
    }
    time = np.full((len(records), POINTS), np.nan)
    for r, (record, run) in enumerate(zip(records, found, strict=True)):
        shown = _shown(record)
        time[r, : shown.size] = record.time[shown] - record.time[0]
        for b, name in enumerate(outputs):
            kept = slice(None) if record.kept is None else record.kept
            error, score = (record.samples[name] - run.mean[b])[kept], run.scores[b]
            numbers = {
                "rms": np.sqrt(np.mean(error**2)),
                "bias": error.mean(),
                "expected_rms": np.sqrt(np.mean(run.spread[b] ** 2)),
                "log_score": score.log_score,
                "coverage": score.coverage,
                "pit_distance": score.distance,
                **run.errors[b],
            }
            for key, value in numbers.items():
                tables[key][b, r] = value
            pit[b, r] = np.histogram(score.pit, BINS, (0.0, 1.0), density=True)[0]
            lines = {"mean": run.mean, "low": run.low, "high": run.high}
            for key, line in lines.items():
                bands[key][b, r, : shown.size] = line[b, shown]
            bands["measured"][b, r, : shown.size] = record.samples[name][shown]
    units = np.array([model.outputs[name].unit for name in outputs], dtype=object)
    own = "output's SI unit"
    failed = np.array([json.dumps(run.failed) for run in found], dtype=object)
    return xr.Dataset(
        {
            **{
                key: variable(grid, tables[key], text, own if in_unit else "1")
                for key, (text, in_unit) in _NUMBERS.items()
            },
            "pit": variable((*grid, "bin"), pit, "density of the transform", "1"),
            **{key: variable(each, band, key, own) for key, band in bands.items()},
            schema.TIME: variable((schema.RUN, "point"), time, "time since the first sample", "s"),
            "failed": ((schema.RUN,), failed),
            schema.UNIT: ((schema.OUTPUT,), units),
        },
        coords={
            schema.OUTPUT: outputs,
            schema.RUN: [record.label for record in records],
            "bin": (np.arange(BINS) + 0.5) / BINS,
        },
    )


def _shown(record: Record) -> NDArray[np.int64]:
    """Samples of the first span, thinned out."""
    first = int(np.searchsorted(record.position, 1.0 + 1e-9))
    return np.unique(np.linspace(0, first - 1, min(first, POINTS)).round().astype(np.int64))


def forecast_text(data: xr.Dataset) -> str:
    """One line for each output of each run.

    Parameters
    ----------
    data : xarray.Dataset
        Of :func:`predict`.
    """
    level = f"{100 * float(data.attrs['level']):.3g} %"
    head = ["output", "run", "rms", "expected", "bias", "unit", "log score"]
    head += [f"within {level}", "PIT off", "over noise", "over expected"]
    rows = []
    for output in data[schema.OUTPUT].values:
        for run in data[schema.RUN].values:
            one = {key: float(data[key].sel(output=output, run=run)) for key in _NUMBERS}
            cells = [f"{one[key]:.3g}" for key in ("rms", "expected_rms", "bias")]
            cells += [str(data[schema.UNIT].sel(output=output).values) or "1"]
            cells += [
                f"{one['log_score']:.3g}",
                f"{100 * one['coverage']:.1f} %",
                f"{one['pit_distance']:.3f}",
                f"{one['ratio_to_noise']:.2f}",
                f"{one['ratio_to_expected']:.2f}",
            ]
            rows.append([str(output), str(run), *cells])
    lines = [
        columns(head, rows),
        f"{number_of(data.attrs['draws'], 'draw')} of {data.attrs['model']}",
    ]
    lines += [str(data.attrs[key]) for key in (ADDED, REMOVED) if data.attrs.get(key)]
    for run in data[schema.RUN].values:
        failed = json.loads(str(data["failed"].sel(run=run).values))
        if failed:
            lines.append(f"run {run}: draws left out: {counted(failed)}")
    return "\n".join(lines)
