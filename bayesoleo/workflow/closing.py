"""Look for what is missing: one round that adds nothing, or the whole loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import xarray as xr

from bayesoleo.effects import catalogue
from bayesoleo.model import Model
from bayesoleo.tracing.deciding.loop import ClosedLoop, close_loop
from bayesoleo.tracing.experiments.questions import Question, questions_of
from bayesoleo.workflow.result import write_result
from bayesoleo.workflow.sampling import draw
from bayesoleo.workflow.settings import Settings
from bayesoleo.workflow.task import Say, Source, Task, prepare, silent


def trace(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: Path | None = None,
    say: Say = silent,
    progress: bool = False,
) -> xr.DataTree:
    """Hold a fitted model's residual against the noise and rank what might be missing; add nothing.

    Parameters are those of :func:`close`.
    """
    task = prepare(campaign, model, settings, progress=progress)
    loop = run_loop(task, 0, say)
    return write_result(task, loop, None, out, say, what_next(task, loop, say))


def close(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: Path | None = None,
    say: Say = silent,
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
    loop = run_loop(task, settings.max_effects, say)
    found = what_next(task, loop, say)
    say("sample the posterior")
    drawn = draw(task, loop.final.fit, out, say, progress)
    return write_result(task, loop, drawn, out, say, found)


def run_loop(task: Task, max_effects: int, say: Say) -> ClosedLoop:
    """Rounds until nothing is missing, or nothing helps; the posterior is not sampled."""
    settings = task.settings
    for effect in settings.effects or ():
        base = task.assembly.model() if effect.on_channels else task.assembly.native
        if effect not in catalogue() and not effect.places(base):
            say(f"effect {effect.id} has no place in this model: it needs {effect.applies_to}")
    return close_loop(
        task.assembly,
        task.roles,
        settings.numerics,
        effects=settings.effects,
        seed=settings.seed,
        max_effects=max_effects,
        say=say,
    )


def what_next(
    task: Task,
    loop: ClosedLoop,
    say: Say,
    *,
    rivals: Sequence[str] = (),
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> tuple[Question, ...]:
    """The runs that would tell apart what the loop could not.

    Parameters
    ----------
    task : Task
    loop : ClosedLoop
    say : callable
        Told what is being done.
    rivals : sequence of str, optional
        Effects of the last round to be told apart; by default those that each round leaves.
    limits : mapping of str to (float, float), optional
        Of the rig, SI, before those of the campaign.
    """
    rig = {**task.campaign.rig, **(limits or {})}
    return questions_of(loop, rig, task.settings.numerics, effects=rivals, say=say)
