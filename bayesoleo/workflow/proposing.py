"""What to measure next: the run that would best tell apart what these runs cannot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import xarray as xr

from bayesoleo._types import ProgressCallback
from bayesoleo.model import Model
from bayesoleo.tracing.experiments.propose import check_periodic
from bayesoleo.workflow.closing import run_loop, what_next
from bayesoleo.workflow.output import ResultFolder
from bayesoleo.workflow.result import write_result
from bayesoleo.workflow.settings import Settings
from bayesoleo.workflow.stages import Stages
from bayesoleo.workflow.task import Source, prepare, silent


def propose(
    campaign: Source,
    model: Model,
    settings: Settings = Settings(),
    *,
    rivals: Sequence[str] = (),
    limits: Mapping[str, tuple[float, float]] | None = None,
    callback: ProgressCallback = silent,
) -> xr.DataTree:
    """Rank the runs that a rig can do by how well they would tell candidate effects apart.

    Each of the rivals is estimated from the runs that there are. What it foresees of a new run is
    uncertain by what these leave unknown of its parameters; the noise is that of the others.

    Parameters
    ----------
    campaign, model, settings
        See :func:`close`. No effect is added to the model.
    rivals : sequence of str, optional
        Ids of effects, or ``effect@target`` where one has several places. By default those that are
        significant and explain a part of what is left.
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
        If there is no such effect or limit, runs are transient, or the model has several inputs.

    References
    ----------
    Box and Hill (1967), Technometrics 9, 57-71; Kolchinsky and Tracey (2017), Entropy 19, 361.
    """
    task = prepare(campaign, model, settings)
    check_periodic(task.reduced.records)  # before anything is estimated for nothing
    output, stages = ResultFolder(None), Stages(callback)
    loop = run_loop(task, 0, stages, output)
    found = what_next(task, loop, callback, rivals=rivals, limits=limits)
    return stages.finish(write_result(task, loop, None, output, stages, found), None)
