"""Estimate the parameters: from all fitted runs together, or from each run by itself."""

from __future__ import annotations

import os
from dataclasses import replace

import xarray as xr

from bayesoleo import schema
from bayesoleo._types import ProgressCallback
from bayesoleo.estimation.runs.per_run import by_run_dataset
from bayesoleo.model import Model
from bayesoleo.tracing.fitting.fit import Fit, fit_model
from bayesoleo.tracing.outcome.inference import at_mode, mode_group, mode_of
from bayesoleo.tracing.outcome.result import point_group
from bayesoleo.workflow.output import ResultFolder
from bayesoleo.workflow.result import finish, mark_unfinished
from bayesoleo.workflow.settings import Settings
from bayesoleo.workflow.stages import POSTERIOR, Stages
from bayesoleo.workflow.task import Source, Task, prepare, silent


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
    fit, more = estimated(task, stages)
    tree = finish(task, {schema.POINT: point_group(fit), **more}, fit)
    mark_unfinished(tree, stages.failed)
    output.write(tree)
    stages.finish(tree, output.folder)
    output.finish()
    return tree


def estimated(task: Task, stages: Stages, method: str = "mbe") -> tuple[Fit, dict[str, xr.Dataset]]:
    """The estimate, at the mode under the error model that was chosen if that was found."""
    settings, callback = task.settings, stages.callback
    model, runs = task.assembly.model(), task.roles.fitted
    fit = fit_model(model, runs, settings.numerics, method=method, progress=callback)
    plain: tuple[Fit, dict[str, xr.Dataset]] = (fit, {})
    return stages.attempt(
        POSTERIOR, lambda: under_error_model(fit, settings, callback), lambda: plain
    )


def under_error_model(
    fit: Fit, settings: Settings, callback: ProgressCallback
) -> tuple[Fit, dict[str, xr.Dataset]]:
    """The estimate moved to the mode under the error model that was chosen, with what it found."""
    inference = settings.inference
    if inference.plain:
        return fit, {}
    callback(f"posterior mode, {inference.error_model} errors")
    density = inference.density(fit, settings.jobs)
    mode = mode_of(density, fit.point.theta)
    group = mode_group(density, mode, inference.error_model)
    return at_mode(fit, density, mode, inference.error_model), {schema.ERROR_MODEL: group}


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
        MBE's estimates by run, see :func:`~bayesoleo.estimation.runs.per_run.by_run_dataset`, with
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
