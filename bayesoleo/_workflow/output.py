"""Output folder, the stages of a long calculation, and the tree and files that come of it.

A folder is checked before anything is computed and written as soon as something is known; the
files of a result appear in it together. A stage that fails takes nothing with it that was known
before. One tree holds everything that was found and where it comes from.
"""

from __future__ import annotations

import json
import os
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._report.page import write_report
from bayesoleo._report.page_figures import Ahead
from bayesoleo._report.sentences import headline, response_entries
from bayesoleo._report.terminal import write_plain_report
from bayesoleo._storage.files import (
    SUMS,
    check_free,
    check_writable,
    only_writer,
    settle,
    sweep,
    together,
    write_text_atomic,
)
from bayesoleo._storage.result_files import provenance, read_attributes, read_tree, write_tree
from bayesoleo._storage.resume import digest, keep_state, kept_state, package_digest
from bayesoleo._types import ProgressCallback
from bayesoleo._workflow.model_files import to_document
from bayesoleo._workflow.task import Task, silent
from bayesoleo.data._frequency_response import stored
from bayesoleo.discovery._curves import CurveFacts
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._loop import ClosedLoop
from bayesoleo.discovery._open_questions import Question, proposals_entry, proposals_group
from bayesoleo.discovery._result_tree import (
    loop_groups,
    loop_predictive,
    point_group,
    posterior_groups,
    records_tree,
)
from bayesoleo.discovery._round import Progress
from bayesoleo.discovery._summary import summarise
from bayesoleo.errors import BayesoleoError, InputError, UnfinishedError, memory_text
from bayesoleo.posterior._comparison import compare
from bayesoleo.posterior._diagnostics import Samples
from bayesoleo.posterior._log_density import LogDensity
from bayesoleo.systems._systems import equations, equations_latex

RESULTS, REPORT, SUMMARY = "results.nc", "report.html", "summary.json"
FILES = (RESULTS, REPORT, SUMMARY)
#: Files and folders of which a process that was killed may have left a draft.
SWEPT = (*FILES, "each.nc", "replications.nc", "campaign")
CHECKPOINTS, SEARCH, OLDER = "checkpoints", "search.pickle", "older"
#: Seconds between results of a search that goes on. One takes two or three to write, a twentieth of
#: the time at most, and the search goes on from what is kept besides.
OFTEN = 60.0
#: By this file a folder of an older result is known as one that was made here, and may go.
PUT_ASIDE = ".put-aside"


@dataclass
class ResultFolder:
    """The folder of a result.

    Parameters
    ----------
    folder : Path or None
        None writes nothing.
    begun : bool
        Whether a result of this calculation has been written, as far as it was known.
    """

    folder: Path | None
    begun: bool = field(default=False, init=False)
    _written: float = field(default_factory=time.monotonic, init=False)

    @classmethod
    def checked(cls, out: str | os.PathLike[str] | None) -> ResultFolder:
        """A folder that was found to take files; nothing is made yet.

        Raises
        ------
        InputError
            If it is no path, another process is writing there, or files cannot be written without
            writing over others.
        """
        if out is None:
            return cls(None)
        folder = check_writable(out, FILES, (CHECKPOINTS, OLDER))
        check_free(folder)
        aside = folder / OLDER
        if not (aside / PUT_ASIDE).is_file() and any((aside / name).exists() for name in FILES):
            raise InputError(
                "holds a result that was not put aside here, which would be written over",
                file=aside,
                hint="rename or move it, or choose another folder",
            )
        return cls(folder)

    @property
    def checkpoints(self) -> Path | None:
        """Folder from which a calculation that was stopped goes on."""
        return None if self.folder is None else self.folder / CHECKPOINTS

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other processes from writing here; what one that was killed left is put in order.

        Raises
        ------
        ResultsError
            If one does already.
        """
        with only_writer(self.folder):
            if self.folder is not None:
                settle(self.folder)
                sweep(self.folder, SWEPT)
                sweep(self.folder / CHECKPOINTS, (SEARCH,))
            yield

    # -- results ------------------------------------------------------------------------

    def write(self, tree: xr.DataTree, summary: dict[str, Any] | None = None) -> None:
        """Write a result; an older one that was finished is put aside until this one is."""
        if self.folder is not None:
            with self.draft() as draft:
                write_files(tree, summary, draft)

    @contextmanager
    def draft(self) -> Iterator[Path]:
        """A folder to write files to, which replace those that are there on leaving.

        An older result that was finished is put aside.
        """
        assert self.folder is not None
        aside = None
        if not self.begun and is_finished(self.folder / RESULTS):
            aside = OLDER
            _drop(self.folder / OLDER)
            (self.folder / OLDER).mkdir(parents=True, exist_ok=True)
            (self.folder / OLDER / PUT_ASIDE).touch()
        with together(self.folder, FILES, aside=aside) as draft:
            yield draft
        self.begun, self._written = True, time.monotonic()

    @property
    def due(self) -> bool:
        """Whether what goes on has been written so long ago that it is worth writing again, or an
        older result stands in its place."""
        if self.folder is None:
            return False
        older = not self.begun and (self.folder / RESULTS).exists()
        return older or time.monotonic() - self._written > OFTEN

    def finish(self, *, ended: bool = True) -> None:
        """Drop the older result; and what the search would go on from, unless a longer one may."""
        if self.folder is not None and self.checkpoints is not None:
            _drop(self.folder / OLDER)
            if ended:  # fits of many candidates take tens of megabytes
                (self.checkpoints / SEARCH).unlink(missing_ok=True)

    # -- how far a search has come ------------------------------------------------------

    def keep(self, task: Task, progress: Progress) -> None:
        """Keep what the search needs to go on."""
        if self.checkpoints is not None:
            keep_state(self.checkpoints / SEARCH, search_key(task), progress)

    def kept(self, task: Task, callback: ProgressCallback) -> Progress | None:
        """How far the same search came before."""
        if self.checkpoints is None:
            return None
        path = self.checkpoints / SEARCH
        found, reason = kept_state(path, search_key(task))
        if reason:
            callback(f"start anew: {path} cannot be gone on from, {reason}")
        if not isinstance(found, Progress):
            return None
        callback(f"go on after round {len(found.rounds)}, which {path} holds")
        return found


def write_files(tree: xr.DataTree, summary: dict[str, Any] | None, folder: Path) -> None:
    """Write a tree and its summary, if it has one."""
    write_tree(tree, folder / RESULTS)
    if summary is not None:
        write_text_atomic(folder / SUMMARY, schema.summary_json(summary))


def _drop(aside: Path) -> None:
    """Remove a result that was put aside; whatever else is in its folder stays."""
    if not (aside / PUT_ASIDE).is_file():
        return
    for name in (*FILES, SUMS, PUT_ASIDE):
        (aside / name).unlink(missing_ok=True)
    with suppress(OSError):  # a user's own files are in it
        aside.rmdir()


def is_finished(results: Path) -> bool:
    """Whether a file holds a result of which nothing is missing; one that cannot be read may."""
    return results.is_file() and schema.UNFINISHED not in read_attributes(results)


def search_key(task: Task) -> dict[str, str]:
    """Digests of all that a search depends on."""
    # How much is drawn from the posterior has no say in what is missing, and probabilities of
    # structures are computed once the search has ended.
    same = {
        "quick": False, "effective_size": 0, "sampler": "", "command": "", "structure_prior": None,
    }  # fmt: skip
    settings = {f.name: getattr(task.settings, f.name) for f in fields(task.settings)} | same
    return {
        "campaign": digest((task.campaign.sha256, task.reduced.records)),
        "model": digest(task.assembly),
        "setting": digest(settings),
        "version": package_digest(),
    }


#: Those of the schema of the summary, in the order in which a run that is not quick does them.
SEARCH_STAGE, PROPOSALS_STAGE, POSTERIOR_STAGE, PREDICTIONS_STAGE, REPORT_STAGE = (
    "search",
    "proposals",
    "posterior",
    "predictions",
    "report",
)
_PACKAGE = Path(__file__).parents[1]


@dataclass
class Stages:
    """Stages that have failed so far.

    Parameters
    ----------
    callback : callable
        Told of each failure as it happens.
    """

    callback: ProgressCallback = silent
    failed: list[dict[str, str]] = field(default_factory=list)
    first: Exception | None = None

    def attempt[Value](
        self, stage: str, work: Callable[[], Value], default: Callable[[], Value]
    ) -> Value:
        """The result of a stage, or a default where it fails; a stop by the user goes through."""
        try:
            return work()
        except Exception as error:
            self.fail(stage, reason_of(error), error)
            return default()

    def fail(self, stage: str, reason: str, error: Exception | None = None) -> None:
        """Note that a stage did not finish."""
        self.callback(f"{stage} failed: {reason}")
        self.failed.append({"stage": stage, "reason": reason})
        self.first = self.first or error

    def finish(self, tree: xr.DataTree, folder: Path | None) -> xr.DataTree:
        """The result if all stages finished.

        Raises
        ------
        UnfinishedError
            If one failed; it carries the result without it.
        """
        if self.failed:
            raise UnfinishedError(self.failed, tree, folder) from self.first
        return tree


def reason_of(error: Exception) -> str:
    """An exception in a line: what it says, and where it came from if it was not foreseen."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, MemoryError):
        return memory_text(error)
    text = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(": ")
    own = [
        (Path(frame.filename), frame.lineno)
        for frame in traceback.extract_tb(error.__traceback__)
        if Path(frame.filename).is_relative_to(_PACKAGE)
    ]
    if not own:
        return text
    file, line = own[-1]
    return f"{text} ({file.relative_to(_PACKAGE.parent).as_posix()}, line {line})"


Drawn = tuple[Samples, LogDensity]
Groups = dict[str, xr.Dataset]


def write_result(
    task: Task,
    loop: ClosedLoop,
    drawn: Drawn | None,
    output: ResultFolder,
    stages: Stages,
    questions: Sequence[Question] = (),
    groups: Groups | None = None,
    ahead: Ahead | None = None,
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
    groups : mapping of str to Dataset, optional
        What :func:`result_groups` has made of it, if that was done before.
    ahead : Ahead, optional
        Another process that draws figures.
    """
    tree, summary = result_tree(task, loop, drawn, output, stages, questions, groups)
    if output.folder is None:
        return tree
    stages.callback("write results and report")
    with output.draft() as draft:
        failed = len(stages.failed)
        first = _Files(tree, summary, draft)
        for figure in stages.attempt(
            REPORT_STAGE,
            lambda: write_report(tree, draft / REPORT, first.write, ahead),
            lambda: write_plain_report(
                {**summary, schema.UNFINISHED: stages.failed}, draft / REPORT
            ),
        ):
            stages.fail(REPORT_STAGE, figure)
        if len(stages.failed) > failed:
            summary[schema.UNFINISHED] = list(stages.failed)
            _mark(tree, summary)
        if len(stages.failed) > failed or not first.written:
            write_files(tree, summary, draft)
    return tree


@dataclass
class _Files:
    """The files of a tree and its summary, written while another process draws figures.

    What fails here is tried again when the figures have been drawn, and fails then.
    """

    tree: xr.DataTree
    summary: dict[str, Any]
    folder: Path
    written: bool = False

    def write(self) -> None:
        with suppress(Exception):
            write_files(self.tree, self.summary, self.folder)
            self.written = True


def report_what_is_there(output: ResultFolder, stages: Stages) -> xr.DataTree | None:
    """The result as it was last written, with what failed since, and a report of it.

    None where this calculation has written nothing, or that cannot be read.
    """
    if output.folder is None or not output.begun:
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
    with output.draft() as draft:
        write_files(tree, summary, draft)
        write_plain_report(summary, draft / REPORT)
    return tree


def search_groups(loop: ClosedLoop, stages: Stages) -> Groups:
    """The groups of :func:`write_result` that follow from the search alone, without probabilities
    of structures and new runs."""
    groups = {schema.POINT: point_group(loop.final.fit)}
    return groups | stages.attempt(PREDICTIONS_STAGE, lambda: loop_groups(loop), dict)


def result_groups(
    task: Task, loop: ClosedLoop, drawn: Drawn | None, stages: Stages, known: Groups | None = None
) -> Groups:
    """The same with those of draws; what is known already is not made again."""
    groups = search_groups(loop, stages) if known is None else known
    if drawn is None:
        return groups
    seed, fit = task.settings.seed, loop.final.fit
    groups = groups | stages.attempt(
        PREDICTIONS_STAGE, lambda: loop_predictive(loop, drawn, seed), dict
    )
    return groups | stages.attempt(
        POSTERIOR_STAGE, lambda: _posterior(fit, drawn, seed, groups), dict
    )


def result_tree(
    task: Task,
    loop: ClosedLoop,
    drawn: Drawn | None,
    output: ResultFolder,
    stages: Stages,
    questions: Sequence[Question] = (),
    groups: Groups | None = None,
) -> tuple[xr.DataTree, dict[str, Any]]:
    """The tree of :func:`write_result` and its summary; nothing is written."""
    fit, unit = loop.final.fit, _drive_unit(task, loop)
    groups = result_groups(task, loop, drawn, stages) if groups is None else groups
    groups = groups | proposals_group(questions, unit)
    samples = drawn[0] if drawn is not None and schema.POSTERIOR in groups else None
    # Bare names: they stay true when the folder moves.
    names = {"report": REPORT, "result": RESULTS, "summary": SUMMARY}
    files = {} if output.folder is None else names
    facts = stages.attempt(
        PREDICTIONS_STAGE, lambda: CurveFacts.of(loop.final), lambda: CurveFacts()
    )
    summary = summarise(loop, samples, {**task.about(), "files": files}, facts)
    summary["notes"] = [*summary["notes"], *task.data_warnings]
    if task.frequency_response is not None:
        summary[schema.FREQUENCY_RESPONSE] = response_entries(task.frequency_response)
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
    if task.frequency_response is not None:
        measured[schema.FREQUENCY_RESPONSE] = stored(task.frequency_response)
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
