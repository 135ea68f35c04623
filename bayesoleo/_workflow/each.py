"""Many loops: each campaign with each model and each seed, on this machine or on a cluster.

Each combination is a task with a folder of its own, in which an ordinary result of ``close``
appears. A manifest lists the tasks with digests of their inputs and says how far each has come; a
call that was stopped, or killed, goes on from it. A task that fails takes no other with it.
"""

from __future__ import annotations

import csv
import io
import json
import os
import queue
import re
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from tqdm.auto import tqdm

from bayesoleo._parallel import LostError, Pending, TaskPool, loss_of, task_pool
from bayesoleo._schema import columns
from bayesoleo._storage.files import (
    check_free,
    check_writable,
    only_writer,
    sweep,
    write_text_atomic,
)
from bayesoleo._storage.result_files import package_version
from bayesoleo._types import ProgressCallback
from bayesoleo._workflow.each_task import (
    DONE,
    FAILED,
    EachTask,
    Outcome,
    Wanted,
    Work,
    every_task,
    found_in,
    said,
    store,
)
from bayesoleo._workflow.output import SUMMARY
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import silent
from bayesoleo.errors import (
    BayesoleoError,
    InputError,
    ResultsError,
    UnfinishedError,
    number_of,
)
from bayesoleo.model._model import Model

MANIFEST, TABLE, FORMAT = "manifest.json", "summary.csv", 1
#: Tasks beyond those that run which are sent ahead, as a share of them: a worker that ends one
#: finds the next one there, and little is held in memory.
AHEAD = 1 / 8
#: Results that are fetched and written at a time.
FETCHED = 4
#: Part of the time in which the manifest is written, at most.
SAVING = 0.1
#: Seconds between two looks at the scheduler.
LOOK = 1.0


@dataclass(frozen=True)
class EachResult:
    """What :func:`close_each` returns.

    Parameters
    ----------
    folder : Path
        With ``manifest.json``, ``summary.csv`` and a folder for each task.
    tasks : tuple of EachTask
        Those that were asked for, in the order of campaigns, models and seeds.
    """

    folder: Path
    tasks: tuple[EachTask, ...]

    @property
    def failed(self) -> tuple[EachTask, ...]:
        """Tasks that failed."""
        return tuple(task for task in self.tasks if task.state == FAILED)

    def table(self) -> list[dict[str, Any]]:
        """A row for each task, as in ``summary.csv``."""
        return [task.row() for task in self.tasks]

    def __repr__(self) -> str:
        names = ["campaign", "model", "seed", "status", "effect", "certainty", "probability"]
        rows = [["" if row[n] is None else str(row[n]) for n in names] for row in self.table()]
        return columns(names, [[Path(row[0]).name, *row[1:]] for row in rows])


def close_each(
    campaigns: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    models: str | Model | Sequence[str | Model],
    *,
    out: str | os.PathLike[str],
    seeds: int = 1,
    settings: Settings = Settings(),
    jobs: int | None = None,
    scheduler: str | None = None,
    shared: bool = False,
    retries: int = 2,
    callback: ProgressCallback = silent,
    progress: bool = False,
) -> EachResult:
    """Close the loop for each campaign with each model and each seed.

    Each task runs in a process of its own, with one thread. The same call goes on where an earlier
    one was stopped; tasks that failed are tried again.

    Parameters
    ----------
    campaigns : path-like or sequence of path-like
        Folders with ``campaign.toml``.
    models : str, Model or sequence of them
        Names of built-in systems, ``file.py:object``, or models.
    out : path-like
        Folder for all results.
    seeds : int
        How many, from that of the settings on.
    settings : Settings
        Of every task; ``jobs`` and ``scheduler`` have no effect.
    jobs : int, optional
        Tasks at a time on this machine; by default one a core.
    scheduler : str, optional
        Instead: address of a Dask scheduler, whose workers do the tasks.
    shared : bool
        Whether those workers see the campaigns and ``out`` under the same paths. They then read and
        write there themselves, and a task that is tried again goes on after its last round.
    retries : int
        How often a task is tried again whose process or worker was lost.
    callback : callable
        Told of failures.
    progress : bool
        Whether to show a bar.

    Returns
    -------
    EachResult

    Raises
    ------
    InputError
        If there is no such campaign, model or scheduler, or the folder cannot be written to or is
        being written to; nothing was run then.
    UnfinishedError
        If the scheduler was lost, or has had no workers for five minutes; the same call goes on.

    Examples
    --------
    >>> found = close_each(["shaker-1", "shaker-2"], "f16n2d2", out="all")  # doctest: +SKIP
    >>> [task.reason for task in found.failed]  # doctest: +SKIP
    []
    """
    if jobs is not None and scheduler is not None:
        hint = "give one of them; the workers of a scheduler say how many tasks they take"
        raise InputError("has no meaning with a scheduler", key="jobs", value=jobs, hint=hint)
    for name, value, least in (("seeds", seeds, 1), ("jobs", jobs, 1), ("retries", retries, 0)):
        _check_count(name, value, least)
    wanted = list(every_task(campaigns, models, seeds, settings))
    folder = check_writable(out, (MANIFEST, TABLE))
    check_free(folder)
    with only_writer(folder):
        sweep(folder, (MANIFEST, TABLE))
        book = Book.of(folder)
        todo = [one for one in wanted if book.enter(one)]
        bar = tqdm(total=len(wanted), initial=len(wanted) - len(todo), disable=not progress)
        with bar:
            if todo:
                with task_pool(scheduler, jobs) as pool:
                    Course(book, pool, retries, scheduler is None or shared, callback, bar).run(
                        todo
                    )
            book.save()
            book.save_table()
    return EachResult(folder, tuple(one.task for one in wanted))


def _check_count(name: str, value: Any, least: int) -> None:
    """Refuse what is no whole number, or too small a one."""
    if value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        hint = f"write {name}={least} or more"
        raise InputError("is no such number", key=name, value=value, hint=hint)


class Book:
    """The manifest of a folder, of which this process is the only writer.

    Parameters
    ----------
    folder : Path
    tasks : dict
        All that were ever asked for, by key.
    """

    def __init__(self, folder: Path, tasks: dict[tuple[str, str, int], EachTask]) -> None:
        self.folder, self.tasks = folder, tasks
        self._taken = {task.folder.lower() for task in tasks.values()}

    @classmethod
    def of(cls, folder: Path) -> Book:
        """As it is on the disk; empty where there is none.

        Raises
        ------
        ResultsError
            If there is a file of this name that is no such manifest.
        """
        path = folder / MANIFEST
        if not path.exists():
            return cls(folder, {})
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content["format"] != FORMAT:
                raise ValueError(content["format"])
            tasks = [EachTask(**entry) for entry in content["tasks"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            hint = "move it away, or choose another folder"
            raise ResultsError("is no manifest of tasks", file=path, hint=hint) from error
        return cls(folder, {task.key: task for task in tasks})

    def enter(self, wanted: Wanted) -> bool:
        """Add a task, or find it again; whether it is to be begun."""
        new = wanted.task
        known = self.tasks.get(new.key)
        folder = self._free_folder(new) if known is None else known.folder
        if known is not None and known.digests == new.digests and self._is_done(known):
            wanted.task = known
            return False
        wanted.task = self.tasks[new.key] = replace(new, folder=folder)
        return True

    def _is_done(self, task: EachTask) -> bool:
        return task.state == DONE and (self.folder / task.folder / SUMMARY).is_file()

    def _free_folder(self, task: EachTask) -> str:
        """A name that says what it is, and that no other task has."""
        path = Path(task.campaign)
        campaign = _plain(path.parent.name if path.suffix == ".toml" else path.name)
        model = _plain(re.split(r"[/\\]", task.model)[-1].replace(".py:", "-").removesuffix(".py"))
        number = 1
        while (found := f"{campaign}/{model}/seed-{task.seed}").lower() in self._taken:
            number += 1
            campaign = f"{campaign.rsplit('~', 1)[0]}~{number}"
        self._taken.add(found.lower())
        return found

    def save(self) -> None:
        """Write the manifest, as a whole or not at all."""
        version = json.dumps(package_version("bayesoleo"))
        # A task a line, without indents: with them Python's own encoder is ten times slower.
        tasks = ",\n".join(
            json.dumps(vars(task), ensure_ascii=False) for task in self.tasks.values()
        )
        text = f'{{"format": {FORMAT}, "bayesoleo_version": {version}, "tasks": [\n{tasks}\n]}}\n'
        write_text_atomic(self.folder / MANIFEST, text)

    def save_table(self) -> None:
        """Write the table of all tasks."""
        rows = [task.row() for task in self.tasks.values()]
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text_atomic(self.folder / TABLE, text.getvalue())


def _plain(name: str) -> str:
    """A name as a folder can carry it."""
    return re.sub(r"[^\w.-]+", "-", name).strip("-.") or "campaign"


@dataclass
class Course:
    """The tasks on their way through a pool.

    Parameters
    ----------
    book : Book
    pool : TaskPool
    retries : int
        How often a task is tried again whose process was lost.
    by_path : bool
        Whether processes read and write files themselves.
    callback : callable
        Told of failures.
    bar : tqdm
    """

    book: Book
    pool: TaskPool
    retries: int
    by_path: bool
    callback: ProgressCallback
    bar: Any
    running: dict[int, Wanted] = field(default_factory=dict)
    ended: queue.SimpleQueue[tuple[int, Outcome | BaseException]] = field(
        default_factory=queue.SimpleQueue
    )
    begun: int = 0
    changed: bool = True
    rest: float = 0.0
    unstored: BaseException | None = None

    def run(self, todo: Sequence[Wanted]) -> None:
        """Do tasks, in any order; the manifest is written as they end.

        Raises
        ------
        UnfinishedError
            If the scheduler is lost, or has no workers for long.
        """
        waiting = deque(todo)
        try:
            with ThreadPoolExecutor(FETCHED) as fetchers:
                while waiting or self.running:
                    self._fill(waiting, fetchers)
                    self._save()
                    for number, end in self._ended():
                        self._end(self.running.pop(number), end, waiting)
                    left = len(waiting) + len(self.running)
                    if left and self.pool.lost:
                        raise self._lost(left)
        finally:
            self.book.save()
            self.book.save_table()

    def _save(self) -> None:
        """Write the manifest, which of many tasks is long, for a part of the time only."""
        begin = time.monotonic()
        if self.changed and begin >= self.rest:
            self.book.save()
            self.changed = False
            self.rest = time.monotonic() + (time.monotonic() - begin) / SAVING

    def _lost(self, left: int) -> UnfinishedError:
        are, them = ("is", "it") if left == 1 else ("are", "them")
        reason = (
            f"{self.pool.lost}; {number_of(left, 'task')} {are} left, and the same command"
            f" does {them}"
        )
        return UnfinishedError([{"stage": "each", "reason": reason}], None, self.book.folder)

    def _fill(self, waiting: deque[Wanted], fetchers: ThreadPoolExecutor) -> None:
        """Begin as many tasks as are wanted."""
        size = self.pool.size
        while waiting and size and len(self.running) < size + max(1, int(AHEAD * size)):
            one = waiting.popleft()
            work = self._work(one)
            if isinstance(work, Outcome):
                self._finish(one, work)
                continue
            number, self.begun = self.begun, self.begun + 1
            self.running[number] = one
            pending = self.pool.submit(work)
            pending.add_done_callback(partial(self._note, fetchers, number, one))

    def _work(self, one: Wanted) -> Work | Outcome:
        """What is to be sent, or how it failed before it was."""
        if one.problem:
            return Outcome(one.problem)
        folder = Path(os.path.abspath(self.book.folder / one.task.folder))
        try:
            return one.work(folder if self.by_path else None)
        except (BayesoleoError, OSError) as error:
            return Outcome(said(error))

    def _note(
        self, fetchers: ThreadPoolExecutor, number: int, one: Wanted, pending: Pending
    ) -> None:
        """In any thread: a task has ended."""
        with suppress(RuntimeError):  # of an executor that is closed: the call was stopped
            fetchers.submit(self._fetch, number, one, pending)

    def _fetch(self, number: int, one: Wanted, pending: Pending) -> None:
        """In a thread: fetch what came of a task, and write its result where that came by value."""
        end: Outcome | BaseException
        storing = False
        try:
            end = pending.result()
            if isinstance(end, Outcome) and end.files:
                storing = True
                store(self.book.folder / one.task.folder, end)
                end = replace(end, files={})
        except BaseException as error:
            end = error
            if storing:  # as would that of the next ones
                self.unstored = error
        self.ended.put((number, end))

    def _ended(self) -> list[tuple[int, Outcome | BaseException]]:
        """What came of the tasks that have ended, after some waiting for the first."""
        found: list[tuple[int, Outcome | BaseException]] = []
        with suppress(queue.Empty):
            if self.running:
                found.append(self.ended.get(timeout=LOOK))
            while True:
                found.append(self.ended.get_nowait())
        if self.unstored is not None:
            raise self.unstored
        if not found and not self.pool.size:  # the scheduler does not answer
            time.sleep(LOOK)
        return found

    def _end(self, one: Wanted, end: Outcome | BaseException, waiting: deque[Wanted]) -> None:
        """Note how a task ended; one whose process was lost is tried again."""
        if isinstance(end, BaseException):
            loss = loss_of(end)
            if loss is not None:
                self._lose(one, loss, waiting)
                return
            if not isinstance(end, Exception):
                raise end
            end = Outcome(said(end))
        one.task.attempts += 1
        self._finish(one, end)

    def _lose(self, one: Wanted, loss: LostError, waiting: deque[Wanted]) -> None:
        """Try a task again, unless that was done often enough."""
        one.task.attempts += loss.times
        if one.task.attempts > self.retries:
            times = f"lost {number_of(one.task.attempts, 'time')}"
            self._finish(one, Outcome(f"{times}, the last time because {loss.reason}"))
            return
        if loss.times:
            self.callback(f"{one.task.folder} was lost and is tried again: {loss.reason}")
            self.changed = True
        waiting.appendleft(one)

    def _finish(self, one: Wanted, outcome: Outcome) -> None:
        """Note what became of a task."""
        task = one.task
        task.state = FAILED if outcome.reason else DONE
        task.reason = outcome.reason or None
        task.seconds = None if outcome.seconds is None else round(outcome.seconds, 3)
        task.found = None if outcome.reason else found_in(self.book.folder / task.folder / SUMMARY)
        self.changed = True
        if outcome.reason:
            self.callback(f"{task.folder} failed: {outcome.reason}")
        self.bar.update()
