"""From a campaign folder and a model to results: the verbs that the command line and scripts
call."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import xarray as xr

from bayesoleo import schema
from bayesoleo.data import Campaign, ReducedCampaign, load_campaign, reduce_campaign
from bayesoleo.data.units import parse_unit
from bayesoleo.effects import Effect
from bayesoleo.errors import CampaignError, ModelError
from bayesoleo.estimation.runs.nuisance import declared_nuisance, uncertain_conditions
from bayesoleo.estimation.runs.per_run import by_run_dataset
from bayesoleo.model import Model, driven_by, possible_drives
from bayesoleo.model.document import to_document
from bayesoleo.posterior import LogDensity, Samples, compare
from bayesoleo.posterior import sample as draw_samples
from bayesoleo.posterior.error_models import ERROR_MODELS
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.report import write_report
from bayesoleo.simulation import merged, model_of, parameter_sets, simulate_like
from bayesoleo.solvers.schemes.choose import DEFAULT_SCHEME
from bayesoleo.storage import provenance, write_text_atomic, write_tree
from bayesoleo.systems import equations, equations_latex
from bayesoleo.tracing.assembly import Assembly
from bayesoleo.tracing.fit import Fit, Numerics, first_steps, fit_model
from bayesoleo.tracing.inference import Inference, at_mode, mixture_at, mode_group, mode_of
from bayesoleo.tracing.loop import ClosedLoop, close_loop
from bayesoleo.tracing.result import (
    loop_groups,
    point_group,
    posterior_groups,
    predictive_groups,
    records_tree,
)
from bayesoleo.tracing.roles import Roles, assign
from bayesoleo.tracing.summary import summarise

Say = Callable[[str], None]
Source = str | os.PathLike[str] | Campaign | ReducedCampaign

RESULTS, REPORT, SUMMARY = "results.nc", "report.html", "summary.json"


#: Starts drawn from the priors that look for other modes than the estimate before sampling.
STARTS = 4


@dataclass(frozen=True)
class Settings:
    """What a run of the workflow depends on besides data and model.

    Parameters
    ----------
    seed : int
        Everything random follows from it.
    jobs : int, optional
        Threads; by default all cores. Results do not depend on it.
    scheduler : str, optional
        Other processes or machines that take part: ``local:4``, or the address of a Dask scheduler;
        see :func:`bayesoleo.machines.connected`. Results do not depend on them either.
    quick : bool
        Draw enough for two-digit intervals only.
    effective_size : int
        Effective draws asked of the sampler.
    scheme : str
        Discretisation: ``radau3`` …, or ``thesis``.
    steps : int, optional
        Steps of the mesh in a period; by default refined until the estimate no longer moves.
    max_effects : int
        Effects added at most.
    drive : str, optional
        Channel that drives the model; ``"model"`` keeps the model's own inputs. By default the
        channel that the rig controls, if the model can be driven by it.
    effects : tuple of Effect, optional
        Instead of the catalogue.
    command : str
        Kept in the result.
    nuisance : tuple of {"conditions", "offset", "gain"}
        What is estimated within its declared tolerance: conditions by run (``sd``), offset and gain
        of sensors (``accuracy``).
    error_model : {"independent", "per-run", "full", "correlated", "discrepancy"}
        What the errors of the outputs have in common; see :mod:`bayesoleo.posterior.error_models`.
    between_runs : tuple of str
        Parameters that scatter between runs about a mean that is estimated; see
        :mod:`bayesoleo.posterior.hierarchy`.
    """

    seed: int = 0
    jobs: int | None = None
    quick: bool = False
    effective_size: int = 1000
    scheme: str = DEFAULT_SCHEME
    steps: int | None = None
    max_effects: int = 4
    drive: str | None = None
    effects: tuple[Effect, ...] | None = None
    command: str = ""
    nuisance: tuple[str, ...] = ()
    error_model: str = ERROR_MODELS[0]
    between_runs: tuple[str, ...] = ()
    scheduler: str | None = None

    @property
    def inference(self) -> Inference:
        """What is assumed of errors and of runs."""
        return Inference(self.error_model, self.between_runs)

    @property
    def numerics(self) -> Numerics:
        """How models are solved."""
        return Numerics(self.scheme, self.steps, self.jobs, scheduler=self.scheduler)


def _silent(_: str) -> None:
    """Say nothing."""


def reduce(campaign: Source, *, jobs: int | None = None, progress: bool = False) -> ReducedCampaign:
    """Load a campaign and reduce its runs to records.

    Parameters
    ----------
    campaign : path-like, Campaign or ReducedCampaign
        Folder with ``campaign.toml``, or what was loaded from one.
    jobs : int, optional
        Threads.
    progress : bool
        Whether to show a bar.

    Raises
    ------
    CampaignError
        If anything in it cannot be used.
    """
    if isinstance(campaign, ReducedCampaign):
        return campaign
    loaded = campaign if isinstance(campaign, Campaign) else load_campaign(campaign)
    return reduce_campaign(loaded, jobs=jobs, progress=progress)


@dataclass(frozen=True)
class Task:
    """A campaign and a model, ready for work.

    Parameters
    ----------
    reduced : ReducedCampaign
    roles : Roles
    assembly : Assembly
        The declared model with its drive.
    settings : Settings
    """

    reduced: ReducedCampaign
    roles: Roles
    assembly: Assembly
    settings: Settings

    @property
    def campaign(self) -> Campaign:
        """As loaded."""
        return self.reduced.campaign

    def about(self) -> dict[str, Any]:
        """Top-level keys of the summary."""
        return {
            "format": schema.FORMAT,
            "campaign": self.campaign.name,
            "model": self.assembly.native.name,
            "drive": self.assembly.drive or ", ".join(self.assembly.native.inputs),
            "seed": self.settings.seed,
        }


def prepare(campaign: Source, model: Model, settings: Settings, *, progress: bool = False) -> Task:
    """Bring a campaign and a model together, and find out early what does not fit.

    Raises
    ------
    InputError
        If the campaign lacks a channel or a condition of the model, or the drive has no inverse.
    """
    model = settings.inference.declare(model)
    reduced = reduce(campaign, jobs=settings.jobs, progress=progress)
    drive = choose_drive(model, reduced.campaign, settings.drive)
    starts = not all(record.periodic for record in reduced.records)
    assembly = Assembly(model, drive, starts=starts)
    assembly, reduced = _with_nuisance(assembly, reduced, settings.nuisance)
    roles = assign(reduced.records)
    driven = assembly.model()
    # Building a predictor of one step checks channels, conditions and priors of every run without
    # solving anything.
    predictor = Predictor(driven, reduced.records, steps=8, backend="numpy", jobs=1)
    predictor.layout.priors(driven)
    if not predictor.layout.names:
        raise ModelError(
            f"model {model.name!r} has no parameter to estimate",
            hint="give at least one a prior (sd=…, relative_sd=…, bounds=…) without fixed=True",
        )
    _check_units(driven, reduced.campaign)
    return Task(reduced, roles, assembly, settings)


def _with_nuisance(
    assembly: Assembly, reduced: ReducedCampaign, kinds: tuple[str, ...]
) -> tuple[Assembly, ReducedCampaign]:
    """Let what is known to a tolerance only be estimated within it."""
    if not kinds:
        return assembly, reduced
    accuracy = {name: item.accuracy for name, item in reduced.campaign.channels.items()}
    found = declared_nuisance(kinds, assembly.model(), reduced.records, accuracy)
    records = found.complete(reduced.records)
    return replace(assembly, nuisance=found), ReducedCampaign(reduced.campaign, records)


def _check_units(model: Model, campaign: Campaign) -> None:
    """Data come in SI: a model in other units, or of another quantity, is a mistake that no
    estimate survives."""
    declared = dict(model.inputs) | {name: output.unit for name, output in model.outputs.items()}
    for name, unit in declared.items():
        channel, wanted = campaign.channels[name], parse_unit(unit or "1")
        if not unit:
            continue
        if wanted.si_name != channel.si_unit:
            raise CampaignError(
                f"channel {name!r} is in {channel.unit}, model {model.name!r} expects {unit}",
                file=campaign.path / "campaign.toml",
                key=f"channels.{name}.unit",
                value=channel.unit,
                hint=f"write a unit that converts to {unit}, or declare the model otherwise",
            )
        if wanted.factor != 1.0 or wanted.shift != 0.0:
            raise ModelError(
                f"model {model.name!r}: channel {name!r} is in {unit}, but data come in SI",
                value=unit,
                hint=f"declare the model in {wanted.si_name}",
            )


def choose_drive(model: Model, campaign: Campaign, wanted: str | None) -> str | None:
    """The channel that is to drive a model; ``None`` for its own inputs."""
    if wanted == "model":
        return None
    if wanted is not None:
        driven_by(model, wanted)
        return None if wanted in model.inputs else wanted
    controlled = campaign.controlled
    if controlled is None or controlled in model.inputs or controlled not in possible_drives(model):
        return None
    return controlled


def check(campaign: Source, model: Model, settings: Settings = Settings()) -> dict[str, Any]:
    """Say what would be done; write nothing.

    Returns
    -------
    dict
        Campaign, model, drive, runs by role, unknowns, outputs, steps of the mesh and number of
        candidate effects.
    """
    from bayesoleo.effects import catalogue

    task = prepare(campaign, model, settings)
    driven = task.assembly.model()
    predictor = Predictor(driven, task.roles.fitted, steps=8, backend="numpy", jobs=1)
    return {
        **task.about(),
        "inputs": list(driven.inputs),
        "outputs": list(driven.outputs),
        "fit": [record.label for record in task.roles.fitted],
        "hold_out": [record.label for record in task.roles.held_out],
        "strategy": task.roles.description,
        "unknowns": list(predictor.layout.names),
        "possible_drives": list(possible_drives(model)),
        "steps": settings.steps or first_steps(driven, task.roles.fitted),
        "effects": sum(
            bool(effect.places(driven if effect.family == "sensor" else model))
            for effect in (catalogue() if settings.effects is None else settings.effects)
        ),
    }


def estimate(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: Path | None = None,
    say: Say = _silent,
) -> xr.DataTree:
    """Estimate a model's parameters from the fitted runs: MBE, then the posterior's mode.

    Parameters
    ----------
    campaign, model, settings
        See :func:`close`.
    out : Path, optional
        Folder for ``results.nc``.
    say : callable
        Told what is being done.

    Returns
    -------
    xarray.DataTree
        With the groups of the records and ``point``.
    """
    task = prepare(campaign, model, settings)
    fit = fit_model(task.assembly.model(), task.roles.fitted, settings.numerics, progress=say)
    fit, more = _under_error_model(fit, settings, say)
    return _finish(task, {schema.POINT: point_group(fit), **more}, fit, out)


def _under_error_model(fit: Fit, settings: Settings, say: Say) -> tuple[Fit, dict[str, xr.Dataset]]:
    """The estimate moved to the mode under the error model that was chosen, with what it found."""
    inference = settings.inference
    if inference.plain:
        return fit, {}
    say(f"posterior mode, {inference.error_model} errors")
    density = inference.density(fit, settings.jobs)
    mode = mode_of(density, fit.point.theta)
    group = mode_group(density, mode, inference.error_model)
    return at_mode(fit, density, mode, inference.error_model), {schema.ERROR_MODEL: group}


def estimate_each(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    say: Say = _silent,
) -> xr.Dataset:
    """Estimate a model's parameters from each run by itself, fitted and held-out runs alike.

    Parameters
    ----------
    campaign, model, settings
        See :func:`close`.
    say : callable
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
        say(f"run {record.label}")
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


def sample(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: Path | None = None,
    say: Say = _silent,
    progress: bool = False,
) -> xr.DataTree:
    """Estimate, then sample the posterior from there with emcee.

    Parameters are those of :func:`close`; the tree has the groups of the records, the point and the
    posterior.
    """
    task = prepare(campaign, model, settings)
    fit = fit_model(task.assembly.model(), task.roles.fitted, settings.numerics, progress=say)
    fit, more = _under_error_model(fit, settings, say)
    samples, density = _sample(task, fit, out, say, progress)
    groups = {schema.POINT: point_group(fit), **more}
    groups |= posterior_groups(fit, samples, settings.seed, density)
    groups |= predictive_groups(fit, samples, density, settings.seed)
    groups[schema.COMPARISON] = compare(groups)
    return _finish(task, groups, fit, out)


def trace(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: Path | None = None,
    say: Say = _silent,
    progress: bool = False,
) -> xr.DataTree:
    """Hold a fitted model's residual against the noise and rank what might be missing; add nothing.

    Parameters are those of :func:`close`.
    """
    task = prepare(campaign, model, settings, progress=progress)
    loop = _loop(task, 0, say)
    return _result(task, loop, None, out, say)


def close(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: Path | None = None,
    say: Say = _silent,
    progress: bool = False,
) -> xr.DataTree:
    """Close the loop: estimate, find what is missing, add it, sample the posterior, compare before
    and after.

    Parameters
    ----------
    campaign : path-like, Campaign or ReducedCampaign
        What was measured.
    model : Model
        In its own drive.
    settings : Settings
        Seed, threads, drive and so on.
    out : Path, optional
        Folder for ``results.nc``, ``report.html``, ``summary.json`` and the sampler's checkpoints,
        from which a run that was stopped goes on.
    say : callable
        Told what is being done.
    progress : bool
        Whether to show bars.

    Returns
    -------
    xarray.DataTree
        The result; its root attribute ``summary`` is the JSON of the summary.

    Raises
    ------
    InputError
        If campaign, model and settings do not fit together.
    """
    task = prepare(campaign, model, settings, progress=progress)
    loop = _loop(task, settings.max_effects, say)
    say("sample the posterior")
    drawn = _sample(task, loop.final.fit, out, say, progress)
    return _result(task, loop, drawn, out, say)


def _loop(task: Task, max_effects: int, say: Say) -> ClosedLoop:
    settings = task.settings
    for record in task.reduced.records:
        if record.kept is not None:
            raise CampaignError(
                "the loop compares whole periods, and cannot leave stretches out of one",
                file=task.campaign.path / "campaign.toml",
                run=record.label,
                key="mask",
                hint="cut the run with start and stop, or estimate and sample only",
            )
    return close_loop(
        task.assembly,
        task.roles,
        settings.numerics,
        effects=settings.effects,
        seed=settings.seed,
        max_effects=max_effects,
        say=say,
    )


def _sample(
    task: Task, fit: Fit, out: Path | None, say: Say, progress: bool
) -> tuple[Samples, LogDensity]:
    settings = task.settings
    density = settings.inference.density(fit, settings.jobs)
    starts = 0 if settings.quick else STARTS
    start = mixture_at(density, fit.point.theta, starts=starts, seed=settings.seed)
    # Another seed or quality is another run, with a folder of its own.
    parts = [task.campaign.sha256, fit.model.digest(), fit.steps, settings.scheme]
    parts += [settings.seed, settings.quick, settings.error_model, settings.between_runs]
    fingerprint = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    samples = draw_samples(
        density,
        start,
        effective_size=settings.effective_size,
        seed=settings.seed,
        out=None if out is None else out / "checkpoints" / fingerprint[:16],
        fingerprint=fingerprint,
        progress=progress,
        quick=settings.quick,
        scheduler=settings.scheduler,
    )
    return samples, density


def _result(
    task: Task,
    loop: ClosedLoop,
    drawn: tuple[Samples, LogDensity] | None,
    out: Path | None,
    say: Say,
) -> xr.DataTree:
    seed, fit = task.settings.seed, loop.final.fit
    samples, density = drawn or (None, None)
    # Bare names: they stay true when the folder moves.
    names = {"report": REPORT, "result": RESULTS, "summary": SUMMARY}
    files = {} if out is None else names
    summary = summarise(loop, samples, {**task.about(), "files": files})
    groups = {schema.POINT: point_group(fit), **loop_groups(loop, drawn, seed)}
    if samples is not None:
        groups |= posterior_groups(fit, samples, seed, density)
        groups[schema.COMPARISON] = compare(groups)
    tree = _finish(task, groups, fit, None, summary=summary)
    if out is not None:
        say("write results and report")
        out.mkdir(parents=True, exist_ok=True)
        write_tree(tree, out / RESULTS)
        write_report(tree, out / REPORT)
        write_text_atomic(out / SUMMARY, schema.summary_json(summary))
    return tree


def _finish(
    task: Task,
    groups: Mapping[str, xr.Dataset],
    fit: Fit,
    out: Path | None,
    summary: Mapping[str, Any] | None = None,
) -> xr.DataTree:
    """One tree with provenance; written if a folder is given."""
    roles = task.roles
    runs = {record.label: record for record in (*roles.fitted, *roles.held_out)}
    tree = xr.DataTree.from_dict({**records_tree(list(runs.values()), task.campaign), **groups})
    more: dict[str, Any] = {
        schema.CAMPAIGN: task.campaign.name,
        schema.CAMPAIGN_DESCRIPTION: task.campaign.description,
        schema.CAMPAIGN_SHA256: task.campaign.sha256,
        schema.MODEL: task.assembly.native.name,
        schema.DRIVE: task.about()["drive"],
        schema.EQUATIONS: "\n".join(
            f"{name}: {text}" for name, text in equations(fit.model).items()
        ),
        schema.EQUATIONS_LATEX: list(equations_latex(fit.model)),
        schema.COMMAND: task.settings.command,
        schema.MODEL_DOCUMENT: json.dumps(to_document(fit.model)),
    }
    if summary is not None:
        more |= {
            schema.EFFECTS: list(summary["effects"]),
            schema.VERDICT: summary["verdict"],
            schema.SUMMARY: schema.summary_json(dict(summary)),
        }
    tree.attrs.update(provenance(task.settings.seed, **more))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_tree(tree, out / RESULTS)
    return tree


def simulate(
    source: Model | xr.DataTree,
    campaign: Source,
    settings: Settings = Settings(),
    *,
    out: Path,
    values: Mapping[str, float] | None = None,
    draws: int | None = None,
    noise: Mapping[str, float] | None = None,
) -> Path:
    """Simulate a campaign with the runs, inputs and conditions of another.

    Parameters
    ----------
    source : Model or xarray.DataTree
        A model at its nominal values, or a result: its extended model at the estimate.
    campaign : path-like, Campaign or ReducedCampaign
        Gives inputs, sampling, conditions, channels and the noise.
    settings : Settings
        Seed, drive (of a model), scheme and steps.
    out : Path
        Folder of the new campaign; must not hold files.
    values : mapping of str to float, optional
        Parameters at other values, SI.
    draws : int, optional
        Simulate with so many draws of the result's posterior, each a copy of every run.
    noise : mapping of str to float, optional
        Standard deviations by channel, SI, instead of the measured ones.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        If a name is unknown, or the model cannot be solved.
    """
    reduced = reduce(campaign, jobs=settings.jobs)
    if isinstance(source, Model):
        drive = choose_drive(source, reduced.campaign, settings.drive)
        model = source if drive is None else driven_by(source, drive)
        sets: list[dict[str, float]] = [{}]
    else:
        model, sets = model_of(source), parameter_sets(source, draws, settings.seed)
    return simulate_like(
        model,
        reduced.campaign,
        uncertain_conditions(model).complete(reduced.records),
        merged(sets, values, model),
        out=out,
        noise=noise,
        seed=settings.seed,
        scheme=settings.scheme,
        steps=settings.steps,
    )
