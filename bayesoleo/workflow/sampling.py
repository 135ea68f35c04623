"""Sample the posterior from the estimate."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import xarray as xr

from bayesoleo import schema
from bayesoleo.model import Model
from bayesoleo.posterior import LogDensity, Samples, compare
from bayesoleo.posterior import sample as draw_samples
from bayesoleo.tracing.fitting.fit import Fit, fit_model
from bayesoleo.tracing.outcome.inference import mixture_at
from bayesoleo.tracing.outcome.result import point_group, posterior_groups, predictive_groups
from bayesoleo.workflow.estimating import under_error_model
from bayesoleo.workflow.result import finish
from bayesoleo.workflow.settings import Settings
from bayesoleo.workflow.task import Say, Source, Task, prepare, silent

#: Starts drawn from the priors that look for other modes than the estimate before sampling.
STARTS = 4


def sample(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: Path | None = None,
    say: Say = silent,
    progress: bool = False,
) -> xr.DataTree:
    """Estimate, then sample the posterior from there with emcee.

    Parameters are those of :func:`close`; the tree has the groups of the records, the point and the
    posterior.
    """
    task = prepare(campaign, model, settings)
    fit = fit_model(task.assembly.model(), task.roles.fitted, settings.numerics, progress=say)
    fit, more = under_error_model(fit, settings, say)
    samples, density = draw(task, fit, out, say, progress)
    groups = {schema.POINT: point_group(fit), **more}
    groups |= posterior_groups(fit, samples, settings.seed, density)
    groups |= predictive_groups(fit, samples, density, settings.seed)
    groups[schema.COMPARISON] = compare(groups)
    return finish(task, groups, fit, out)


def draw(
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
