"""The verbs ``trace``, ``close`` and ``propose``.

``trace`` runs one round of the search and adds nothing; ``close`` runs the whole loop; ``propose``
ranks new runs by how well they separate the candidate effects.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path

import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._first_compilation import is_marked
from bayesoleo._report.page_figures import Ahead, Pictures
from bayesoleo._types import ProgressCallback
from bayesoleo._worker_processes import Beside, start_ahead
from bayesoleo._workflow.estimating import NOT_SAMPLED, draw, inference_for
from bayesoleo._workflow.output import (
    POSTERIOR_STAGE,
    PROPOSALS_STAGE,
    REPORT_STAGE,
    SEARCH_STAGE,
    Drawn,
    Groups,
    ResultFolder,
    Stages,
    finish,
    reason_of,
    report_what_is_there,
    result_groups,
    result_tree,
    search_groups,
    write_result,
)
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.structures_beside import (
    Answer,
    Asked,
    DrawnAhead,
    Early,
    answered,
    begun_beside,
    drawn_beside,
    pictures_meanwhile,
)
from bayesoleo._workflow.task import Source, Task, prepare, silent
from bayesoleo.discovery._compile_ahead import compile_meanwhile
from bayesoleo.discovery._inference import CATALOGUE
from bayesoleo.discovery._loop import ClosedLoop, Provisional, close_loop, judged, loop_of
from bayesoleo.discovery._next_experiment import check_aim
from bayesoleo.discovery._open_questions import Question, questions_of
from bayesoleo.discovery._round import Progress
from bayesoleo.discovery._state import forget_bases
from bayesoleo.discovery._work import QUICK
from bayesoleo.effects._catalogue import catalogue, catalogue_titles, with_titles
from bayesoleo.error_models._registry import AUTO
from bayesoleo.errors import ResultsError
from bayesoleo.model._model import Model
from bayesoleo.posterior._diagnostics import Samples
from bayesoleo.posterior._log_density import LogDensity

#: Seconds of a quick search from which on its result is written before the posterior is sampled:
#: a command that is killed then says that the search had ended.
WORTH_KEEPING = 60.0
#: What stands in the place of the search's last round while it goes on.
NOT_YET = "the search had not finished when this was written"


def trace(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: str | os.PathLike[str] | None = None,
    callback: ProgressCallback = silent,
    progress: bool = False,
) -> xr.DataTree:
    """Hold a fitted model's residual against the noise and rank what might be missing; add nothing.

    Parameters are those of :func:`close`, and so are its errors.
    """
    output = ResultFolder.checked(out)
    task = prepare(campaign, model, settings, progress=progress)
    _check_aim(task)
    with output.alone():
        stages = Stages(callback)
        loop, questions = search(task, 0, stages, output)
        return written(task, loop, None, output, stages, questions)


def close(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    out: str | os.PathLike[str] | None = None,
    callback: ProgressCallback = silent,
    progress: bool = False,
) -> xr.DataTree:
    """Close the loop: estimate, find what is missing, add it, sample the posterior, compare before
    and after.

    The estimate and each round are kept as soon as they are known, in a quick search that other
    processes help with half a second later: the same call, with the same campaign, model and
    settings, goes on after the last one. While the search goes on, its result so far is written as
    well, once a minute at most.

    Parameters
    ----------
    campaign : path-like, Campaign or ReducedCampaign
        What was measured.
    model : Model
        In its own drive.
    settings : Settings
        Seed, threads, drive and so on.
    out : path-like, optional
        Folder for ``results.nc``, ``report.html``, ``summary.json`` and ``checkpoints``, from which
        a run that was stopped goes on. It is tried before anything is computed.
    callback : callable
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
        If campaign, model and settings do not fit together, or the folder cannot be written to.
    UnfinishedError
        If a stage after the first estimate failed. It carries the tree of what is known, whose
        summary says in ``unfinished`` what is missing and why; it is written like any other.
    """
    output = ResultFolder.checked(out)
    if is_marked():
        start_ahead(jobs=settings.jobs)
    task = prepare(campaign, model, settings, progress=progress)
    start_ahead(jobs=settings.jobs)  # else once less is compiled at the same time
    _check_aim(task)
    stages, begun = Stages(callback), time.monotonic()

    def is_long() -> bool:
        return time.monotonic() - begun > WORTH_KEEPING

    def begin(loop: ClosedLoop) -> tuple[Groups | None, Beside[Asked, Answer] | None]:
        if not settings.quick or is_long() or not Beside.may_begin(settings.jobs):
            return None, None
        beside = begun_beside(_asked_of(task, loop), settings.jobs)
        if beside is None:
            return None, None
        with beside:  # an interrupt ends the process: nobody else knows of it yet
            known, shown = _shown_early(task, loop, output)
            if shown is not None:
                drawn_beside(beside, shown)
        return known, beside

    with output.alone(), Early(begin, settings.jobs) as early:
        loop = run_loop(
            task, settings.max_effects, stages, output, resume=True,
            provisional=early if settings.quick else None,
        )  # fmt: skip
        # A search that took long is written with its probabilities before the draws.
        first = not settings.quick or is_long()
        known, beside = early.of(loop)
        questions, groups, ahead, place = no_questions(), None, None, output.checkpoints
        if beside is None or first:
            if beside is not None:  # else it is said as it begins
                callback("compare structures")
            found = beside.result() if beside else answered(_asked_of(task, loop), callback)
            loop, questions = with_structures(task, loop, found, stages)
        if first:
            _write_found(task, loop, output, stages, questions)
        callback("sample the posterior")
        with beside or nullcontext():
            drawn = stages.attempt(
                POSTERIOR_STAGE,
                lambda: draw_final(task, loop, place, callback, progress),
                lambda: None,
            )
            if beside is not None:
                groups = _groups_of(task, loop, drawn, stages, known)
                pictures = _pictures_of_draws(task, loop, drawn, groups, output, beside, callback)
                if not first:
                    callback("compare structures")
                    loop, questions = with_structures(task, loop, beside.result(), stages)
                ahead = DrawnAhead(beside, pictures)
        return written(task, loop, drawn, output, stages, questions, groups, ahead)


def _asked_of(task: Task, loop: ClosedLoop) -> Asked:
    settings = task.settings
    return Asked(
        loop, settings.numerics, settings.structure_prior, task.campaign.rig, settings.next_run
    )


def _shown_early(
    task: Task, loop: ClosedLoop, output: ResultFolder
) -> tuple[Groups | None, xr.DataTree | None]:
    """What follows from the search alone, and a tree of it where a report is to be written; nothing
    where that fails, which is told when it is made again."""
    stages = Stages()
    try:
        known = search_groups(loop, stages)
        shown = None if output.folder is None else finish(task, known, loop.final.fit)
    except Exception:
        return None, None
    return (None, None) if stages.failed else (known, shown)


def _groups_of(
    task: Task, loop: ClosedLoop, drawn: Drawn | None, stages: Stages, known: Groups | None
) -> Groups | None:
    """What does not depend on structures; None where that fails, which is told when it is made
    again."""
    failed = len(stages.failed)
    try:
        return result_groups(task, loop, drawn, stages, known)
    except Exception:
        del stages.failed[failed:]
        return None


def _pictures_of_draws(
    task: Task,
    loop: ClosedLoop,
    drawn: Drawn | None,
    groups: Groups | None,
    output: ResultFolder,
    beside: Beside[Asked, Answer],
    callback: ProgressCallback,
) -> Pictures:
    """Figures of the posterior, where a report is to be written; none where that fails, which is
    told when they are drawn again."""
    nothing = groups is None or output.folder is None or schema.POSTERIOR not in groups
    if nothing or beside.answered:
        return {}
    callback("draw figures of the posterior")
    with suppress(Exception):
        # With a summary: of many parameters, figures show those of the effects that were added.
        tree, _ = result_tree(task, loop, drawn, output, Stages(), (), groups)
        return pictures_meanwhile(beside, tree)
    return {}


def with_structures(
    task: Task, loop: ClosedLoop, found: Answer | None, stages: Stages
) -> tuple[ClosedLoop, tuple[Question, ...]]:
    """The loop with the probabilities, and the runs that would tell apart what is left."""
    if found is None:  # the loop had them, or has none
        return loop, asked(task, loop, stages)
    failure = found.failure
    if failure is not None and failure.stage == SEARCH_STAGE:
        assert loop.without_structures is not None
        return _broken_off(loop.without_structures, task, stages, failure.error, failure.reason), ()
    if failure is not None:
        stages.fail(failure.stage, failure.reason, failure.error)
    return judged(loop, found.structures), found.questions


def draw_final(
    task: Task,
    loop: ClosedLoop,
    checkpoints: Path | None,
    callback: ProgressCallback,
    progress: bool | float,
) -> tuple[Samples, LogDensity]:
    """Draws of the posterior of the final model, with the error model that suits its residual.

    Effects that the search could not tell from one that it added are undecided: the catalogue then
    takes part in the errors.
    """
    final = loop.final
    rivals = [
        name for item in loop.rounds if item.accepted is not None for name in item.accepted.same
    ]
    inference = inference_for(
        task,
        final.fit,
        final.assembly,
        callback,
        held_out=final.held_out,
        undecided=rivals,
        scanned=loop._scanned,
    )
    if loop._scanned is not None:
        loop._scanned.drop()
    forget_bases()
    return draw(task, final.fit, checkpoints, callback, progress, inference)


def no_questions() -> tuple[Question, ...]:
    """Where none could be asked."""
    return ()


def _write_found(
    task: Task,
    loop: ClosedLoop,
    output: ResultFolder,
    stages: Stages,
    questions: Sequence[Question],
) -> None:
    """Write what was found without draws: before they are made, which may take hours, or where
    nothing else can be written."""
    so_far = Stages(failed=list(stages.failed))
    if all(one["stage"] != POSTERIOR_STAGE for one in stages.failed):
        so_far.failed.append({"stage": POSTERIOR_STAGE, "reason": NOT_SAMPLED})
    try:
        write_result(task, loop, None, output, so_far, questions)
    except Exception as error:
        stages.callback(f"what is known so far could not be written: {reason_of(error)}")


def written(
    task: Task,
    loop: ClosedLoop,
    drawn: Drawn | None,
    output: ResultFolder,
    stages: Stages,
    questions: Sequence[Question],
    groups: Groups | None = None,
    ahead: Ahead | None = None,
) -> xr.DataTree:
    """The result, written; if nothing failed on the way to it."""
    try:
        tree = write_result(task, loop, drawn, output, stages, questions, groups, ahead)
    except ResultsError:  # nothing more can be written than was
        raise
    except Exception as error:
        stages.fail(REPORT_STAGE, reason_of(error), error)
        if not output.begun:
            _write_found(task, loop, output, stages, questions)
        found = report_what_is_there(output, stages)
        if found is None:
            raise
        tree = found
    stages.finish(tree, output.folder)
    output.finish(ended=loop.complete)
    return tree


def search(
    task: Task, max_effects: int, stages: Stages, output: ResultFolder, *, resume: bool = False
) -> tuple[ClosedLoop, tuple[Question, ...]]:
    """The loop of :func:`run_loop`, and the runs that would tell apart what it could not."""
    loop = run_loop(task, max_effects, stages, output, resume=resume)
    return loop, asked(task, loop, stages)


def asked(task: Task, loop: ClosedLoop, stages: Stages) -> tuple[Question, ...]:
    """What the loop leaves open, with the runs that would tell."""
    if not loop.complete:
        return ()  # what it would have found is not among what a run were to tell apart
    ask = partial(what_next, task, loop, stages.callback)
    return stages.attempt(PROPOSALS_STAGE, ask, no_questions)


def run_loop(
    task: Task,
    max_effects: int,
    stages: Stages,
    output: ResultFolder,
    *,
    resume: bool = False,
    provisional: Provisional | None = None,
) -> ClosedLoop:
    """Rounds until nothing is missing, or nothing helps; the posterior is not sampled.

    Parameters
    ----------
    task : Task
    max_effects : int
        Effects added at most.
    stages : Stages
        A search that fails after the first estimate is a failed stage: the loop is then what was
        found before.
    output : ResultFolder
        Written to after the estimate and after each round.
    resume : bool
        Whether to keep how far the search has come, and to go on from there.
    provisional : callable, optional
        As of :func:`~bayesoleo.discovery._loop.close_loop`; where it is given, the probabilities of
        structures are left to :func:`with_structures`.

    Raises
    ------
    Exception
        Of any kind, if the model could not be estimated.
    """
    settings, titles = task.settings, dict(catalogue_titles())
    titles |= {effect.id: effect.title for effect in task.settings.effects or ()}

    def callback(text: str) -> None:
        stages.callback(with_titles(text, titles))

    for effect in settings.searched if settings.effects else ():
        base = task.assembly.model() if effect.on_channels else task.assembly.native
        if effect not in catalogue() and not effect.places(base):
            stages.callback(
                f"effect {effect.id} has no place in this model: it needs {effect.applies_to}"
            )
    known = output.kept(task, callback) if resume else None
    reached = [] if known is None else [known]

    def keep(progress: Progress) -> None:
        reached.append(progress)
        write_so_far(task, progress, output, callback, resume=resume)

    compile_meanwhile(settings.jobs)
    try:
        return close_loop(
            task.assembly,
            task.roles,
            settings.numerics,
            effects=settings.searched,
            seed=settings.seed,
            max_effects=max_effects,
            nonparametric=settings.nonparametric,
            most_work=QUICK if settings.quick and max_effects > 0 else math.inf,
            known=known,
            prior=settings.structure_prior,
            keep=keep,
            keep_columns=max_effects > 0 and settings.inference.error_model in (AUTO, CATALOGUE),
            declared=task.declared,
            provisional=provisional,
            callback=callback,
        )
    except Exception as error:
        if not reached:
            raise
        return _broken_off(reached[-1], task, stages, error, reason_of(error))


def _broken_off(
    reached: Progress, task: Task, stages: Stages, error: Exception, reason: str
) -> ClosedLoop:
    """What a search had found when it failed."""
    stages.fail(SEARCH_STAGE, reason, error)
    return loop_of(reached.ended(f"the search broke off here: {reason}"), task.roles)


def write_so_far(
    task: Task,
    progress: Progress,
    output: ResultFolder,
    callback: ProgressCallback,
    *,
    resume: bool,
) -> None:
    """Keep what is known, and write it where the last result is old; failing at that must not end
    what goes on."""
    if output.folder is None:
        return
    stages = Stages()
    stages.fail(SEARCH_STAGE, NOT_YET)
    try:
        if resume:
            output.keep(task, progress)
            if not output.due:
                return
        loop = loop_of(progress.ended(NOT_YET), task.roles)
        output.write(*result_tree(task, loop, None, output, stages))
    except Exception as error:
        callback(f"what is known so far could not be written: {reason_of(error)}")


def what_next(
    task: Task,
    loop: ClosedLoop,
    callback: ProgressCallback,
    *,
    rivals: Sequence[str] = (),
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> tuple[Question, ...]:
    """The runs that would tell apart what the loop could not.

    Parameters
    ----------
    task : Task
    loop : ClosedLoop
    callback : callable
        Told what is being done.
    rivals : sequence of str, optional
        Effects of the last round to be told apart; by default those that each round leaves.
    limits : mapping of str to (float, float), optional
        Of the rig, SI, before those of the campaign.
    """
    rig, settings = {**task.campaign.rig, **(limits or {})}, task.settings
    return questions_of(
        loop, rig, settings.numerics, aim=settings.next_run, effects=rivals, callback=callback
    )


def _check_aim(task: Task) -> None:
    """Raise where there is no parameter that the next run is to make more precise."""
    model = task.assembly.model()
    shared = [name for name in model.estimated() if not model.parameters[name].by_run]
    check_aim(task.settings.next_run, shared)


def propose(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    rivals: Sequence[str] = (),
    limits: Mapping[str, tuple[float, float]] | None = None,
    callback: ProgressCallback = silent,
) -> xr.DataTree:
    """Rank the runs that a rig can do by what they are expected to tell.

    They tell which of several structures is true, weighted by their probabilities, or make the
    parameters more precise (``Settings(next_run="parameters")``). Each of the rivals is estimated
    from the runs that there are. What it foresees of a new run is uncertain by what these leave
    unknown of its parameters; the noise is that of the others. Transients, and runs with several
    inputs, vary those that were measured.

    Parameters
    ----------
    campaign, model, settings
        See :func:`close`. No effect is added to the model.
    rivals : sequence of str, optional
        Ids of effects, or ``effect@target`` where one has several places. By default the most
        probable structures, nothing included.
    limits : mapping of str to (float, float), optional
        What the rig can do, in place of what the campaign says and its runs suggest:
        ``amplitude``, ``frequency``, ``mean``, ``travel``, ``rate`` or an output, SI; infinite
        where there is no limit.

    Returns
    -------
    xarray.DataTree
        As of :func:`trace`, with the group ``proposal``: ``information(round, mean, amplitude,
        frequency)`` in bits and ``sigma``, the standard deviations that separate the least
        separated pair. ``summary["proposals"]`` lists the best runs.

    Raises
    ------
    InputError
        If there is no such effect, limit or parameter.

    References
    ----------
    Lindley (1956), Annals of Mathematical Statistics 27, 986-1005; Box and Hill (1967),
    Technometrics 9, 57-71; Chaloner and Verdinelli (1995), Statistical Science 10, 273-304.
    """
    task = prepare(campaign, model, settings)
    _check_aim(task)  # before anything is estimated for nothing
    output, stages = ResultFolder(None), Stages(callback)
    loop = run_loop(task, 0, stages, output)
    found = what_next(task, loop, callback, rivals=rivals, limits=limits)
    return stages.finish(write_result(task, loop, None, output, stages, found), None)
