"""One tree with everything that was found and where it comes from; the files made of it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._report.page import write_report
from bayesoleo._report.sentences import headline
from bayesoleo._report.terminal import write_plain_report
from bayesoleo._storage.result_files import provenance, read_tree
from bayesoleo._workflow import output as stage_names
from bayesoleo._workflow.output import REPORT, RESULTS, SUMMARY, ResultFolder, Stages
from bayesoleo._workflow.task import Task
from bayesoleo.data._data_warnings import data_warnings
from bayesoleo.discovery._curves import CurveFacts
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._loop import ClosedLoop
from bayesoleo.discovery._open_questions import Question, proposals_entry, proposals_group
from bayesoleo.discovery._result_tree import (
    loop_groups,
    point_group,
    posterior_groups,
    records_tree,
)
from bayesoleo.discovery._summary import summarise
from bayesoleo.errors import BayesoleoError
from bayesoleo.model._documents import to_document
from bayesoleo.posterior._comparison import compare
from bayesoleo.posterior._diagnostics import Samples
from bayesoleo.posterior._log_density import LogDensity
from bayesoleo.systems._systems import equations, equations_latex

Drawn = tuple[Samples, LogDensity]


def write_result(
    task: Task,
    loop: ClosedLoop,
    drawn: Drawn | None,
    output: ResultFolder,
    stages: Stages,
    questions: Sequence[Question] = (),
) -> xr.DataTree:
    """The tree of a closed loop, with its summary and its report; with a folder, its three files.

    Parameters
    ----------
    task : Task
    loop : ClosedLoop
    drawn : tuple of (Samples, LogDensity) or None
        The posterior of the final model, if it was sampled.
    output : ResultFolder
        The folder.
    stages : Stages
        What failed before; what fails here is added.
    questions : sequence of Question, optional
        What it left to be told apart, and by which runs that could be done.
    """
    tree, summary = result_tree(task, loop, drawn, output, stages, questions)
    if output.folder is None:
        return tree
    stages.callback("write results and report")
    output.write(tree, summary)
    page, failed = output.folder / REPORT, len(stages.failed)
    for figure in stages.attempt(
        stage_names.REPORT_STAGE,
        lambda: write_report(tree, page),
        lambda: write_plain_report({**summary, schema.UNFINISHED: stages.failed}, page),
    ):
        stages.fail(stage_names.REPORT_STAGE, figure)
    if len(stages.failed) > failed:
        summary[schema.UNFINISHED] = list(stages.failed)
        _mark(tree, summary)
        output.write(tree, summary)
    return tree


def report_what_is_there(output: ResultFolder, stages: Stages) -> xr.DataTree | None:
    """The result as it was last written, with what failed since, and a report of it.

    None where nothing was written, or that cannot be read.
    """
    if output.folder is None:
        return None
    try:
        tree = read_tree(output.folder / RESULTS)
        summary = json.loads(tree.attrs[schema.SUMMARY])
    except (BayesoleoError, KeyError, ValueError):
        return None
    # What was missing when it was written is missing still.
    before = [one for one in summary.get(schema.UNFINISHED, []) if one not in stages.failed]
    summary[schema.UNFINISHED] = [*stages.failed, *before]
    summary["headline"] = headline(summary)
    _mark(tree, summary)
    output.write(tree, summary)
    write_plain_report(summary, output.folder / REPORT)
    return tree


def result_tree(
    task: Task,
    loop: ClosedLoop,
    drawn: Drawn | None,
    output: ResultFolder,
    stages: Stages,
    questions: Sequence[Question] = (),
) -> tuple[xr.DataTree, dict[str, Any]]:
    """The tree of :func:`write_result` and its summary; nothing is written."""
    seed, fit = task.settings.seed, loop.final.fit
    unit = _drive_unit(task, loop)
    groups = {schema.POINT: point_group(fit)}
    groups |= stages.attempt(
        stage_names.PREDICTIONS_STAGE,
        lambda: loop_groups(loop, drawn, seed),
        lambda: _without_failing(loop, seed),
    )
    groups |= proposals_group(questions, unit)
    if drawn is not None:
        groups |= stages.attempt(
            stage_names.POSTERIOR_STAGE, lambda: _posterior(fit, drawn, seed, groups), dict
        )
    samples = drawn[0] if drawn is not None and schema.POSTERIOR in groups else None
    # Bare names: they stay true when the folder moves.
    names = {"report": REPORT, "result": RESULTS, "summary": SUMMARY}
    files = {} if output.folder is None else names
    facts = stages.attempt(
        stage_names.PREDICTIONS_STAGE, lambda: CurveFacts.of(loop.final), lambda: CurveFacts()
    )
    summary = summarise(loop, samples, {**task.about(), "files": files}, facts)
    summary["notes"] = [
        *summary["notes"],
        *data_warnings(task.reduced.records, task.campaign.units),
    ]
    summary["proposals"] = [proposals_entry(question, unit) for question in questions]
    summary[schema.UNFINISHED] = list(stages.failed)
    summary["headline"] = headline(summary)
    return finish(task, groups, fit, summary), summary


def _posterior(
    fit: ModelFit, drawn: Drawn, seed: int, groups: Mapping[str, xr.Dataset]
) -> dict[str, xr.Dataset]:
    """The groups of the posterior, and how the point compares with it."""
    samples, density = drawn
    found = posterior_groups(fit, samples, seed, density)
    return {**found, schema.COMPARISON: compare({**groups, **found})}


def _without_failing(loop: ClosedLoop, seed: int) -> dict[str, xr.Dataset]:
    """The groups of a loop that do not need its posterior; none if these fail too."""
    try:
        return loop_groups(loop, None, seed)
    except Exception:  # what failed is known already
        return {}


def _drive_unit(task: Task, loop: ClosedLoop) -> str:
    """SI unit of the channel that drives the model."""
    (channel, *_) = loop.final.fit.model.inputs or ("",)
    found = task.campaign.channels.get(task.assembly.drive or channel)
    return "" if found is None else found.si_unit


def finish(
    task: Task,
    groups: Mapping[str, xr.Dataset],
    fit: ModelFit,
    summary: Mapping[str, Any] | None = None,
) -> xr.DataTree:
    """One tree with provenance."""
    roles = task.roles
    runs = {record.label: record for record in (*roles.fitted, *roles.held_out)}
    measured = records_tree(list(runs.values()), task.campaign)
    constant = measured[schema.CONSTANT_DATA]
    if schema.CONSTANT_DATA in groups:  # of blocks, beside that of runs
        blocks = groups[schema.CONSTANT_DATA]
        taken = [name for name in blocks.data_vars if name in constant]
        constant = blocks.drop_vars(taken).merge(constant)  # first: az.plot_lm takes the first
    tree = xr.DataTree.from_dict({**measured, **groups, schema.CONSTANT_DATA: constant})
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
    tree.attrs.update(provenance(task.settings.seed, **more))
    if summary is not None:
        _mark(tree, summary)
    return tree


def _mark(tree: xr.DataTree, summary: Mapping[str, Any]) -> None:
    """Put a summary into a tree's attributes."""
    tree.attrs[schema.EFFECTS] = json.dumps(list(summary["effects"]), ensure_ascii=False)
    tree.attrs[schema.VERDICT] = summary["verdict"]
    tree.attrs[schema.SUMMARY] = schema.summary_json(dict(summary))
    mark_unfinished(tree, summary[schema.UNFINISHED])


def mark_unfinished(tree: xr.DataTree, failed: Sequence[Mapping[str, str]]) -> None:
    """Say in a tree's attributes what is missing in it, if anything is."""
    if failed:
        tree.attrs[schema.UNFINISHED] = json.dumps(list(failed), ensure_ascii=False)
