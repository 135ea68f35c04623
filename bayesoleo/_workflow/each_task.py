"""A task of many: a campaign, a model and a seed, as it is sent to a process and as it comes back.

It goes by path where the process sees the same files; else the files of the campaign go by value,
and those of the result come back.
"""

from __future__ import annotations

import json
import os
import time
import warnings
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from bayesoleo import _schema as schema
from bayesoleo._report.structures import of_added
from bayesoleo._storage.files import check_free
from bayesoleo._storage.result_files import package_version
from bayesoleo._storage.resume import digest
from bayesoleo._workflow.closing import close
from bayesoleo._workflow.model_files import load_model
from bayesoleo._workflow.output import FILES, ResultFolder, reason_of
from bayesoleo._workflow.settings import Settings
from bayesoleo.data._campaign import (
    CampaignData,
    CampaignFiles,
    campaign_files,
    declared_in,
    load_campaign,
)
from bayesoleo.data._campaign_toml import FILE, read_declaration
from bayesoleo.errors import (
    BayesoleoError,
    InputError,
    ModelError,
    ResultsError,
    UnfinishedError,
    check_path,
)
from bayesoleo.model._model import Model

WAITING, DONE, FAILED = "waiting", "done", "failed"
#: Seconds in which a process of an earlier call, which was killed, has ended.
PATIENCE = 30.0


@dataclass
class EachTask:
    """A campaign, a model and a seed, and what became of them.

    Parameters
    ----------
    campaign : str
        Absolute path of its folder, or of its ``campaign.toml``.
    model : str
        As it was given; the name of one that was given as an object.
    seed : int
    folder : str
        Of the result, below that of all.
    state : {"waiting", "done", "failed"}
    reason : str or None
        Why it failed, in one line.
    attempts : int
        How often it was begun, without those that were stopped.
    seconds : float or None
        Which the last attempt took.
    digests : dict of str to str
        Of ``campaign``, ``model`` and ``settings``, and the ``version`` of bayesoleo. A task that
        is done is done again where one of them has changed.
    found : dict or None
        The row of the summary: ``effect``, ``target``, ``certainty``, ``probability``, ``output``,
        ``unit``, ``error_before`` and ``error_after`` (root mean square, SI).
    """

    campaign: str
    model: str
    seed: int
    folder: str
    state: str = WAITING
    reason: str | None = None
    attempts: int = 0
    seconds: float | None = None
    digests: dict[str, str] = field(default_factory=dict)
    found: dict[str, Any] | None = None

    @property
    def key(self) -> tuple[str, str, int]:
        """By which it is known again."""
        return self.campaign, self.model, self.seed

    def row(self) -> dict[str, Any]:
        """Its line in the table."""
        own = {"campaign": self.campaign, "model": self.model, "seed": self.seed}
        more = {"seconds": self.seconds, "attempts": self.attempts, "folder": self.folder}
        found = dict.fromkeys(FOUND) | (self.found or {})
        return {**own, "status": self.state, **found, **more, "reason": self.reason}


#: Columns of the table that come from a result.
FOUND = (
    "effect", "target", "certainty", "probability", "output", "unit", "error_before", "error_after",
)  # fmt: skip


@dataclass
class Wanted:
    """A task with its inputs, on the side of the caller.

    Parameters
    ----------
    task : EachTask
    files : CampaignFiles or None
        None where they cannot be used.
    model : Model or None
    settings : Settings
    problem : str
        Why the task cannot be begun; empty where it can.
    """

    task: EachTask
    files: CampaignFiles | None
    model: Model | None
    settings: Settings
    problem: str = ""

    def work(self, out: Path | None) -> Work:
        """What is sent to a process; with no folder the campaign goes by value, and so does the
        result.

        Raises
        ------
        BayesoleoError, OSError
            If the campaign cannot be read.
        """
        assert self.files is not None
        assert self.model is not None
        about = (self.model, self.settings, self.task.digests["version"], self.task.campaign)
        if out is not None:
            return Work(*about, None, {}, out)
        if not self.files.inside:  # nor would it be a campaign elsewhere
            return Work(*about, load_campaign(self.task.campaign), {}, None)
        paths = {FILE: self.files.toml, **self.files.files}
        return Work(*about, None, {n: zlib.compress(p.read_bytes(), 1) for n, p in paths.items()})


def every_task(campaigns: Any, models: Any, seeds: int, settings: Settings) -> Iterator[Wanted]:
    """Every combination.

    Raises
    ------
    InputError
        If there is no such campaign or model. One that is there and cannot be used is a problem of
        its own tasks.
    """
    read = [(path, *_read(path)) for path in _paths(campaigns)]
    known = [(name, *_loaded(one)) for name, one in _models(models).items()]
    version = package_version("bayesoleo")
    for path, files, sha256, unread in read:
        for name, model, unloaded in known:
            for seed in range(settings.seed, settings.seed + seeds):
                own = replace(settings, seed=seed, jobs=1, scheduler=None)
                task = EachTask(path, name, seed, "")
                task.digests = {
                    "campaign": sha256,
                    "model": "" if model is None else model.digest(),
                    "settings": settings_digest(own),
                    "version": version,
                }
                yield Wanted(task, files, model, own, unread or unloaded)


def settings_digest(settings: Settings) -> str:
    """Digest of all settings on which a result depends."""
    same = {"command": "", "jobs": None, "scheduler": None}
    return digest({one.name: getattr(settings, one.name) for one in fields(settings)} | same)


def _paths(campaigns: Any) -> list[str]:
    """Absolute paths, each once."""
    given = [campaigns] if isinstance(campaigns, str | os.PathLike) else list(campaigns)
    if not given:
        raise InputError("names none", key="campaigns", hint="give at least one folder")
    for one in given:
        check_path(one, "campaigns", hint='write ["shaker-1", "shaker-2"]')
    return list(dict.fromkeys(os.path.abspath(os.path.expanduser(one)) for one in given))


def _models(models: Any) -> dict[str, str | Model]:
    """What was given, by name."""
    one_only = isinstance(models, str | os.PathLike | Model)
    given: list[Any] = [models] if one_only else list(models)
    if not given:
        raise InputError("names none", key="models", hint="give at least one")
    found: dict[str, str | Model] = {}
    for one in given:
        name = one.name if isinstance(one, Model) else os.fspath(one)
        if found.setdefault(name, one) != one:
            hint = "their results could not be told apart; rename one"
            raise InputError("two models have this name", key="models", value=name, hint=hint)
    return found


def _read(path: str) -> tuple[CampaignFiles | None, str, str]:
    """Files of a campaign, their digest, and why there are none."""
    if not declared_in(path).is_file():
        read_declaration(declared_in(path))  # it says what is there instead
    try:
        files = campaign_files(path)
        return files, files.sha256, ""
    except (BayesoleoError, OSError) as error:
        return None, "", said(error)


def _loaded(given: str | Model) -> tuple[Model | None, str]:
    """A model, or why there is none."""
    if isinstance(given, Model):
        return given, ""
    try:
        return load_model(given), ""
    except ModelError as error:
        if error.__cause__ is None or isinstance(error.__cause__, OSError):
            raise  # there is no such model
        return None, said(error)


@dataclass(frozen=True)
class Outcome:
    """What a process returns.

    Parameters
    ----------
    reason : str
        Why it failed; empty where it did not.
    seconds : float or None
        None where it was not begun, or lost.
    files : mapping of str to bytes
        The result, where it is to be written by the caller.
    """

    reason: str
    seconds: float | None = None
    files: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Work:
    """A task as it is sent to a process: a function of a folder of its own.

    Parameters
    ----------
    model : Model
    settings : Settings
    version : str
        Of bayesoleo where it was sent.
    path : str
        Of the campaign where it was sent.
    campaign : CampaignData or None
        Where it goes by value, but not as files.
    files : mapping of str to bytes
        Of the campaign, compressed, by name; empty where they are read under ``path``.
    out : Path or None
        Folder to write to; None returns the files.
    """

    model: Model
    settings: Settings
    version: str
    path: str
    campaign: CampaignData | None
    files: Mapping[str, bytes]
    out: Path | None = None

    def __call__(self, place: Path) -> Outcome:
        """Close the loop; whatever goes wrong is told and not raised."""
        begin, reason = time.perf_counter(), ""
        out = self.out or place / "result"
        try:
            self._close(place / "campaign", out)
        except Exception as error:
            reason = said(error).replace(str(place / "campaign"), self.path)
        files = {}
        if self.out is None:
            files = {name: (out / name).read_bytes() for name in FILES if (out / name).is_file()}
        return Outcome(reason, time.perf_counter() - begin, files)

    def _close(self, unpacked: Path, out: Path) -> None:
        version = package_version("bayesoleo")
        if version != self.version:
            raise InputError(
                "a worker has another version of bayesoleo", value=version,
                hint=f"install {self.version} there",
            )  # fmt: skip
        for name, content in self.files.items():
            target = unpacked / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(zlib.decompress(content))
        await_free(out)
        with warnings.catch_warnings():  # those about data stand in the summary's notes
            warnings.simplefilter("ignore")
            source = self.campaign or (unpacked if self.files else self.path)
            close(source, self.model, self.settings, out=out)


def await_free(folder: Path) -> None:
    """Wait for a process of an earlier call to end, which does so once it finds that call gone.

    Raises
    ------
    ResultsError
        If it still writes after a while.
    """
    until = time.monotonic() + PATIENCE
    while True:
        try:
            check_free(folder)
            return
        except ResultsError:
            if time.monotonic() > until:
                raise
        time.sleep(0.2)


def said(error: BaseException) -> str:
    """An error in one line."""
    if isinstance(error, UnfinishedError):
        return "; ".join(f"{item['stage']}: {item['reason']}" for item in error.stages)
    if isinstance(error, BayesoleoError):
        return " ".join(str(error).split())
    return reason_of(error) if isinstance(error, Exception) else type(error).__name__


def store(folder: Path, outcome: Outcome) -> None:
    """Write the files of a result together, as ``close`` does."""
    output = ResultFolder.checked(folder)
    with output.alone():
        with output.draft() as draft:
            for name, content in outcome.files.items():
                (draft / name).write_bytes(content)
        if not outcome.reason:
            output.finish()


def found_in(path: Path) -> dict[str, Any]:
    """The row of a result, from its summary.

    Errors are those of the hold-out runs where there are some, and of the output that stood
    highest above its noise.
    """
    summary = json.loads(path.read_text(encoding="utf-8"))
    effects, targets = summary["effects"], summary.get("targets", [])
    chances = of_added(summary)
    structures = summary.get("structures")
    nothing = None if structures is None else structures["nothing"]
    before, after = summary["error_before"], summary["error_after"]
    role = schema.HOLD_OUT if before.get(schema.HOLD_OUT) else schema.FIT
    output = max(before[role], key=lambda name: before[role][name]["ratio_to_noise"] or 0.0)
    return {
        "effect": effects[0] if effects else None,
        "target": targets[0] if targets else None,
        "certainty": summary["certainty"],
        "probability": (chances[0] if chances else None) if effects else nothing,
        "output": output,
        "unit": summary.get("units", {}).get(output),
        "error_before": before[role][output]["rms"],
        "error_after": after[role][output]["rms"],
    }
