"""One tree with everything that was found and where it comes from; the files made of it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from bayesoleo import schema
from bayesoleo.data import findings
from bayesoleo.model.document import to_document
from bayesoleo.posterior import LogDensity, Samples, compare
from bayesoleo.report import write_report
from bayesoleo.storage import provenance, write_text_atomic, write_tree
from bayesoleo.systems import equations, equations_latex
from bayesoleo.tracing.deciding.loop import ClosedLoop
from bayesoleo.tracing.experiments.questions import Question
from bayesoleo.tracing.experiments.stored import proposals_entry, proposals_group
from bayesoleo.tracing.fitting.fit import Fit
from bayesoleo.tracing.outcome.result import (
    loop_groups,
    point_group,
    posterior_groups,
    records_tree,
)
from bayesoleo.tracing.outcome.summary import summarise
from bayesoleo.workflow.task import Say, Task

RESULTS, REPORT, SUMMARY = "results.nc", "report.html", "summary.json"


def write_result(
    task: Task,
    loop: ClosedLoop,
    drawn: tuple[Samples, LogDensity] | None,
    out: Path | None,
    say: Say,
    questions: Sequence[Question] = (),
) -> xr.DataTree:
    """The tree of a closed loop, with its summary; with a folder, its three files.

    Parameters
    ----------
    task : Task
    loop : ClosedLoop
    drawn : tuple of (Samples, LogDensity) or None
        The posterior of the final model, if it was sampled.
    out : Path or None
        The folder.
    say : callable
        Told what is being done.
    questions : sequence of Question, optional
        What it left to be told apart, and by which runs that could be done.
    """
    seed, fit = task.settings.seed, loop.final.fit
    samples, density = drawn or (None, None)
    # Bare names: they stay true when the folder moves.
    names = {"report": REPORT, "result": RESULTS, "summary": SUMMARY}
    files = {} if out is None else names
    summary = summarise(loop, samples, {**task.about(), "files": files})
    summary["notes"] = [*summary["notes"], *findings(task.reduced.records, task.campaign.units)]
    unit = _drive_unit(task, loop)
    summary["proposals"] = [proposals_entry(question, unit) for question in questions]
    groups = {schema.POINT: point_group(fit), **loop_groups(loop, drawn, seed)}
    groups |= proposals_group(questions, unit)
    if samples is not None:
        groups |= posterior_groups(fit, samples, seed, density)
        groups[schema.COMPARISON] = compare(groups)
    tree = finish(task, groups, fit, None, summary=summary)
    if out is not None:
        say("write results and report")
        out.mkdir(parents=True, exist_ok=True)
        write_tree(tree, out / RESULTS)
        write_report(tree, out / REPORT)
        write_text_atomic(out / SUMMARY, schema.summary_json(summary))
    return tree


def _drive_unit(task: Task, loop: ClosedLoop) -> str:
    """SI unit of the channel that drives the model."""
    (channel, *_) = loop.final.fit.model.inputs or ("",)
    found = task.campaign.channels.get(task.assembly.drive or channel)
    return "" if found is None else found.si_unit


def finish(
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
