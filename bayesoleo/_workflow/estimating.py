"""The verbs ``estimate``, ``estimate_each`` and ``sample``.

Parameters are estimated from all fitted runs together, or from each run by itself; the posterior is
sampled from the estimate.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._types import Array, ProgressCallback
from bayesoleo._workflow.output import (
    POSTERIOR_STAGE,
    PREDICTIONS_STAGE,
    ResultFolder,
    Stages,
    finish,
    mark_unfinished,
)
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import Source, Task, prepare, silent
from bayesoleo.discovery._assembly import Assembly
from bayesoleo.discovery._compile_ahead import compile_meanwhile
from bayesoleo.discovery._fewest_steps import for_sampling
from bayesoleo.discovery._fit import ModelFit, fit_model
from bayesoleo.discovery._inference import (
    CATALOGUE,
    Inference,
    at_mode,
    chosen_for,
    mixture_at,
    mode_group,
    mode_of,
)
from bayesoleo.discovery._result_tree import point_group, posterior_groups, predictive_groups
from bayesoleo.discovery._run_predictions import Prediction, predict_held_out
from bayesoleo.discovery._scanned_columns import Scanned
from bayesoleo.error_models._correlated import PowerErrors
from bayesoleo.error_models._registry import AUTO
from bayesoleo.estimation._per_run import by_run_dataset
from bayesoleo.model._model import Model
from bayesoleo.posterior._comparison import compare
from bayesoleo.posterior._diagnostics import Samples
from bayesoleo.posterior._log_density import LogDensity
from bayesoleo.posterior._sampler import NUTS, sample as draw_samples
from bayesoleo.solvers._schemes import COLLOCATION


def estimate(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: str | os.PathLike[str] | None = None,
    callback: ProgressCallback = silent,
) -> xr.DataTree:
    """Estimate a model's parameters from the fitted runs: MBE, then the posterior's mode.

    Parameters
    ----------
    campaign, model, settings
        See :func:`close`.
    out : path-like, optional
        Folder for ``results.nc``; it is tried before anything is computed.
    callback : callable
        Told what is being done.

    Returns
    -------
    xarray.DataTree
        With the groups of the records and ``point``.

    Raises
    ------
    InputError
        If campaign, model and settings do not fit together, or the folder cannot be written to.
    UnfinishedError
        If the mode under another error model was not found; it carries the estimate without it.
    """
    output, stages = ResultFolder.checked(out), Stages(callback)
    task = prepare(campaign, model, settings)
    with output.alone():
        fit, more = estimated(task, stages)
        tree = finish(task, {schema.POINT: point_group(fit), **more}, fit)
        mark_unfinished(tree, stages.failed)
        output.write(tree)
        stages.finish(tree, output.folder)
        output.finish()
    return tree


def estimated(
    task: Task, stages: Stages, method: str = "mbe"
) -> tuple[ModelFit, dict[str, xr.Dataset]]:
    """The estimate, at the mode under the error model that was chosen if that was found."""
    settings, callback = task.settings, stages.callback
    model, runs = task.assembly.model(), task.roles.fitted
    compile_meanwhile(settings.jobs)
    fit = fit_model(model, runs, settings.numerics, method=method, progress=callback)
    if method == "mbe":  # what a search begins with
        task.keep(fit)
    plain: tuple[ModelFit, dict[str, xr.Dataset]] = (fit, {})
    return stages.attempt(
        POSTERIOR_STAGE, lambda: under_error_model(task, fit, callback), lambda: plain
    )


def under_error_model(
    task: Task, fit: ModelFit, callback: ProgressCallback
) -> tuple[ModelFit, dict[str, xr.Dataset]]:
    """The estimate moved to the mode under the error model that was chosen, with what it found."""
    settings = task.settings
    inference = inference_for(task, fit, task.assembly, callback)
    remarks = (inference.reason,) if inference.reason else ()
    if inference.plain:
        return replace(fit, point=replace(fit.point, remarks=remarks)), {}
    callback(f"posterior mode, {inference.error_model} errors")
    density = inference.density(fit, settings.jobs)
    mode = mode_of(density, fit)
    group = mode_group(density, mode, inference.error_model)
    moved = at_mode(fit, density, mode, inference.error_model, inference.reason)
    return moved, {schema.ERROR_MODEL: group}


def inference_for(
    task: Task,
    fit: ModelFit,
    assembly: Assembly,
    callback: ProgressCallback,
    *,
    held_out: Sequence[Prediction] | None = None,
    undecided: Sequence[str] = (),
    scanned: Scanned | None = None,
) -> Inference:
    """Error model and scatter of a fit: the user's choice, or by what the data show.

    What was chosen for this fit before stays.
    """
    settings = task.settings
    inference = settings.inference
    if (
        fit.point.objective_name in (CATALOGUE, "correlated", "power", "spectral")
        and fit.point.remarks
    ):
        return replace(inference, error_model=fit.point.objective_name, reason=fit.point.remarks[0])
    if inference.error_model not in (AUTO, CATALOGUE) or (
        inference.error_model == CATALOGUE and fit.problem.signatures is not None
    ):
        return inference
    callback("compare the residual with effects that may be missing, to choose an error model")
    if held_out is None:
        declared = task.roles.held_out if task.roles.strategy == "declared" else ()
        held_out = predict_held_out(fit, declared)
    return chosen_for(
        inference,
        fit,
        assembly,
        effects=settings.searched,
        held_out=held_out,
        undecided=undecided,
        scanned=scanned,
        jobs=settings.jobs,
    )


def estimate_each(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    callback: ProgressCallback = silent,
) -> xr.Dataset:
    """Estimate a model's parameters from each run by itself, fitted and held-out runs alike.

    Parameters
    ----------
    campaign, model, settings
        See :func:`close`.
    callback : callable
        Told what is being done.

    Returns
    -------
    xarray.Dataset
        MBE's estimates by run, see :func:`~bayesoleo.estimation._per_run.by_run_dataset`, with
        the coordinates ``group`` and ``role`` (run). A parameter that varies by run has one value a
        run like any other. :func:`bayesoleo.estimation.between_runs` says how much the runs differ.
    """
    task = prepare(campaign, model, settings)
    driven = task.assembly.model()
    # Alone, every parameter is one of the run's own.
    shared = {name: replace(item, by_run=False) for name, item in driven.parameters.items()}
    driven = driven.with_parameters(**shared)
    points, residuals = {}, {}
    for record in task.reduced.records:
        callback(f"run {record.label}")
        fit = fit_model(driven, [record], settings.numerics)
        points[record.label] = fit.mbe
        residuals[record.label] = fit.problem.evaluate(fit.mbe.theta).residual
    units = [driven.parameters[name].unit for name in fit.problem.names]
    records = task.reduced.records
    return by_run_dataset(points, residuals, units).assign_coords(
        {
            schema.RUN_GROUP: (schema.RUN, [record.group for record in records]),
            schema.ROLE: (schema.RUN, [record.role for record in records]),
        }
    )


#: Starts drawn from the priors that look for other modes than the estimate before sampling.
STARTS = 4
#: Points about the estimate and from the priors from which the sampler climbs itself: few, because
#: an estimate from a start is the better way.
CLIMBS = 8
NOT_SAMPLED = "the posterior had not been sampled when this was written"


def sample(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: str | os.PathLike[str] | None = None,
    callback: ProgressCallback = silent,
    progress: bool = False,
) -> xr.DataTree:
    """Estimate, then sample the posterior from there.

    Parameters are those of :func:`close`, and so are its errors; the tree has the groups of the
    records, the point and the posterior. The estimate is written before the posterior is sampled.
    """
    output, stages = ResultFolder.checked(out), Stages(callback)
    task = prepare(campaign, model, settings)
    with output.alone():
        fit, groups = estimated(task, stages)
        groups[schema.POINT] = point_group(fit)
        tree = finish(task, groups, fit)
        mark_unfinished(tree, [*stages.failed, {"stage": POSTERIOR_STAGE, "reason": NOT_SAMPLED}])
        output.write(tree)
        place, seed = output.checkpoints, settings.seed
        drawn = stages.attempt(
            POSTERIOR_STAGE, lambda: draw(task, fit, place, callback, progress), lambda: None
        )
        if drawn is not None:
            groups |= drawn_groups(fit, drawn, seed, groups, stages)
        tree = finish(task, groups, fit)
        mark_unfinished(tree, stages.failed)
        output.write(tree)
        stages.finish(tree, output.folder)
        output.finish()
    return tree


def no_groups() -> dict[str, xr.Dataset]:
    """The groups of a stage that failed: none."""
    return {}


def drawn_groups(
    fit: ModelFit,
    drawn: tuple[Samples, LogDensity],
    seed: int,
    groups: Mapping[str, xr.Dataset],
    stages: Stages,
) -> dict[str, xr.Dataset]:
    """Groups of the draws and of their predictions, and a comparison with the point."""
    samples, density = drawn
    found: dict[str, xr.Dataset] = {}
    found |= stages.attempt(
        POSTERIOR_STAGE, lambda: posterior_groups(fit, samples, seed, density), no_groups
    )
    found |= stages.attempt(
        PREDICTIONS_STAGE, lambda: predictive_groups(fit, samples, density, seed), no_groups
    )
    if schema.POSTERIOR in found:
        found[schema.COMPARISON] = compare({**groups, **found})
    return found


def draw(
    task: Task,
    fit: ModelFit,
    checkpoints: Path | None,
    callback: ProgressCallback,
    progress: bool | float,
    inference: Inference | None = None,
) -> tuple[Samples, LogDensity]:
    """Draws of the posterior, from the checkpoints if there are some.

    ``inference`` is what is assumed of errors and runs; by default that of :func:`inference_for`.
    """
    settings = task.settings
    if inference is None:
        inference = inference_for(task, fit, task.assembly, callback)
    if inference.reason:
        callback(inference.reason)
    inference.tell(fit)
    effective = fit.problem.effective if inference.error_model == PowerErrors.word else None
    sampled = for_sampling(fit, effective)
    density = inference.density(sampled, settings.jobs, told=True)
    of = [task.campaign.sha256, fit.model.digest(), sampled.steps, settings.scheme]
    of += [] if settings.solver == COLLOCATION else [settings.solver]
    of += [] if inference.error_model == settings.error_model else [inference.error_model]
    samples = draw_from(
        density, fit.point.theta, settings, of=of, checkpoints=checkpoints, progress=progress
    )
    return samples, density


def draw_from(
    density: LogDensity,
    theta: Array,
    settings: Settings,
    *,
    of: Sequence[object],
    checkpoints: Path | None,
    progress: bool | float,
) -> Samples:
    """Draws of a density, from the checkpoints if there are some.

    Parameters
    ----------
    density : LogDensity
    theta : ndarray, shape (l,)
        The estimate.
    settings : Settings
    of : sequence
        What the density depends on beside the settings; JSON can hold it.
    checkpoints : Path, optional
    progress : bool or float
        Whether to show a bar, at once or after so many seconds.
    """
    starts = 0 if settings.quick else STARTS
    start = mixture_at(density, theta, starts=starts, seed=settings.seed)
    # Another seed or quality is another run, with a folder of its own.
    parts = [*of, settings.seed, settings.quick, settings.error_model, settings.between_runs]
    by_gradients = settings.sampler == NUTS
    parts += [settings.sampler] if by_gradients else []
    fingerprint = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    return draw_samples(
        density,
        start,
        effective_size=settings.effective_size,
        seed=settings.seed,
        out=None if checkpoints is None else checkpoints / fingerprint[:16],
        fingerprint=fingerprint,
        progress=progress,
        quick=settings.quick,
        climbs=CLIMBS,
        scheduler=None if by_gradients else settings.scheduler,
        sampler=settings.sampler,
    )
