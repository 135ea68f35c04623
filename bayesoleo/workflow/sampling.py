"""Sample the posterior from the estimate."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import xarray as xr

from bayesoleo import schema
from bayesoleo._types import Array, ProgressCallback
from bayesoleo.model import Model
from bayesoleo.posterior import LogDensity, Samples, compare
from bayesoleo.posterior import sample as draw_samples
from bayesoleo.solvers.schemes.choose import COLLOCATION
from bayesoleo.tracing.fitting.fit import Fit
from bayesoleo.tracing.outcome.inference import mixture_at
from bayesoleo.tracing.outcome.result import point_group, posterior_groups, predictive_groups
from bayesoleo.workflow.estimating import estimated
from bayesoleo.workflow.output import ResultFolder
from bayesoleo.workflow.result import finish, mark_unfinished
from bayesoleo.workflow.settings import Settings
from bayesoleo.workflow.stages import POSTERIOR, PREDICTIONS, Stages
from bayesoleo.workflow.task import Source, Task, prepare, silent

#: Starts drawn from the priors that look for other modes than the estimate before sampling.
STARTS = 4
#: Points about the estimate and from the priors from which the sampler climbs itself: few, because
#: an estimate from a start is the better way.
CLIMBS = 8
NOT_YET = "the posterior had not been sampled when this was written"


def sample(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: str | os.PathLike[str] | None = None,
    callback: ProgressCallback = silent,
    progress: bool = False,
) -> xr.DataTree:
    """Estimate, then sample the posterior from there with emcee.

    Parameters are those of :func:`close`, and so are its errors; the tree has the groups of the
    records, the point and the posterior. The estimate is written before the posterior is sampled.
    """
    output, stages = ResultFolder.checked(out), Stages(callback)
    task = prepare(campaign, model, settings)
    with output.alone():
        fit, groups = estimated(task, stages)
        groups[schema.POINT] = point_group(fit)
        tree = finish(task, groups, fit)
        mark_unfinished(tree, [*stages.failed, {"stage": POSTERIOR, "reason": NOT_YET}])
        output.write(tree)
        place, seed = output.checkpoints, settings.seed
        drawn = stages.attempt(
            POSTERIOR, lambda: draw(task, fit, place, callback, progress), lambda: None
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
    """Where a stage failed."""
    return {}


def drawn_groups(
    fit: Fit,
    drawn: tuple[Samples, LogDensity],
    seed: int,
    groups: Mapping[str, xr.Dataset],
    stages: Stages,
) -> dict[str, xr.Dataset]:
    """Of the draws, of what they predict, and how the point compares with them."""
    samples, density = drawn
    found: dict[str, xr.Dataset] = {}
    found |= stages.attempt(
        POSTERIOR, lambda: posterior_groups(fit, samples, seed, density), no_groups
    )
    found |= stages.attempt(
        PREDICTIONS, lambda: predictive_groups(fit, samples, density, seed), no_groups
    )
    if schema.POSTERIOR in found:
        found[schema.COMPARISON] = compare({**groups, **found})
    return found


def draw(
    task: Task,
    fit: Fit,
    checkpoints: Path | None,
    callback: ProgressCallback,
    progress: bool | float,
) -> tuple[Samples, LogDensity]:
    """Draws of the posterior, from the checkpoints if there are some."""
    settings = task.settings
    density = settings.inference.density(fit, settings.jobs)
    of = [task.campaign.sha256, fit.model.digest(), fit.steps, settings.scheme]
    of += [] if settings.solver == COLLOCATION else [settings.solver]
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
        scheduler=settings.scheduler,
    )
