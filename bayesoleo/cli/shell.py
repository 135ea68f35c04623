"""What all commands share: how errors, warnings and progress are told, and where to write."""

from __future__ import annotations

import inspect
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperGroup

from bayesoleo import schema
from bayesoleo.errors import BayesoleoError, InputError, UnfinishedError

if TYPE_CHECKING:
    from rich.console import Console

DEBUG = "BAYESOLEO_DEBUG"
RESULTS, OLDER = "results.nc", "older"

#: Exit statuses: input that cannot be used; a late stage failed, and what was known before it is
#: written; stopped by the user (128 + SIGINT).
UNUSABLE, UNFINISHED, STOPPED = 2, 3, 130


class Stopped(BayesoleoError):  # noqa: N818 - the user's wish is not an error
    """The user stopped a command; the message says what is kept."""


class Commands(TyperGroup):
    """Runs a command so that what goes wrong on purpose is told in one line on standard error."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command of a context.

        Parameters
        ----------
        ctx : typer.Context
            With the arguments as parsed.

        Raises
        ------
        typer.Exit
            With status 2 for input that cannot be used, 3 where a late stage failed, 130 where the
            user stopped the command.
        """
        try:
            with one_line_warnings():
                return super().invoke(ctx)
        except (Stopped, KeyboardInterrupt) as stop:
            complain(str(stop) or "stopped; nothing was written")
            raise typer.Exit(STOPPED) from None
        except UnfinishedError as error:
            if os.environ.get(DEBUG, "0") not in ("", "0"):
                raise
            complain(f"error: {error}")
            raise typer.Exit(UNFINISHED) from None
        except BayesoleoError as error:
            if os.environ.get(DEBUG, "0") not in ("", "0"):
                raise
            complain(f"error: {error}")
            raise typer.Exit(UNUSABLE) from None


def add(app: typer.Typer, panel: str, *commands: Callable[..., None]) -> None:
    """Add commands to an app; the docstring of each is its help.

    Parameters
    ----------
    app : typer.Typer
        To add to.
    panel : str
        Under which heading they are listed.
    *commands : callable
        In the order of the list.
    """
    for command in commands:
        app.command(rich_help_panel=panel, help=flowing(command.__doc__ or ""))(command)


def flowing(text: str) -> str:
    r"""A docstring whose paragraphs fill the line, except those that start with ``\b``."""
    paragraphs = inspect.cleandoc(text).split("\n\n")
    return "\n\n".join(p if p.startswith("\b") else " ".join(p.split()) for p in paragraphs)


def complain(text: str) -> None:
    """Print one line on standard error, whatever is in the text."""
    line = " ".join(text.split())
    encoding = sys.stderr.encoding or "utf-8"
    print(line.encode(encoding, "replace").decode(encoding), file=sys.stderr, flush=True)


@contextmanager
def one_line_warnings() -> Iterator[None]:
    """Show warnings as one line each, without the code that raised them."""

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        complain(f"warning: {message}")

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextmanager
def stoppable(folder: Path | None) -> Iterator[None]:
    """Turn an interrupt into a line that says what is kept in a folder.

    Parameters
    ----------
    folder : Path or None
        Where the command writes, if it does.

    Raises
    ------
    Stopped
        In place of KeyboardInterrupt.
    """
    try:
        yield
    except KeyboardInterrupt as stop:
        raise Stopped(f"stopped: {kept_in(folder)}") from stop


def kept_in(folder: Path | None) -> str:
    """What a command that was stopped leaves in its folder."""
    if folder is None or not folder.is_dir():
        return "nothing was written"
    older, results = folder / OLDER, folder / RESULTS
    said = "no result was written"
    if (older / RESULTS).is_file():
        said = f"an older result is in {older}, what is known of the new one in {folder}"
    elif results.is_file() and _unfinished(results):
        said = f"what is known is in {results}"
    elif results.is_file():
        said = f"an older result in {folder} is as it was"
    kinds = {"draws made so far": "segment-*.npz", "finished rounds": "search.pickle"}
    kept = [kind for kind, name in kinds.items() if next(folder.rglob(name), None) is not None]
    if kept:
        said += f"; {' and '.join(kept)} are kept there, and the same command goes on from them"
    return said


def _unfinished(results: Path) -> bool:
    from bayesoleo.storage import read_attributes

    return schema.UNFINISHED in read_attributes(results)


def console() -> Console:
    """Standard output; wide where it is not a terminal, so that tables are not cut."""
    from rich.console import Console

    wide = None if sys.stdout.isatty() else 160
    return Console(width=wide, highlight=False, soft_wrap=False)


def progress_shown(quiet: bool) -> bool:
    """Whether progress bars make sense: somebody looks at them."""
    return not quiet and sys.stderr.isatty()


def teller(quiet: bool) -> Callable[[str], None]:
    """Prints what is being done on standard error, above progress bars.

    Parameters
    ----------
    quiet : bool
        Says nothing.
    """
    if quiet:
        return lambda _: None

    def callback(text: str) -> None:
        from tqdm import tqdm

        tqdm.write(text, file=sys.stderr)

    return callback


def campaign_name(campaign: Path) -> str:
    """Name of a campaign, as a folder can carry it.

    Parameters
    ----------
    campaign : Path
        Its folder, or its ``campaign.toml``.

    Raises
    ------
    CampaignError
        If the declaration cannot be used.
    """
    return re.sub(r"[^\w.-]+", "-", _declared_name(campaign)).strip("-.") or "campaign"


def _declared_name(campaign: Path) -> str:
    from bayesoleo.data.checked_table import FILE
    from bayesoleo.data.declaration import read_declaration

    toml = campaign if campaign.suffix == ".toml" else campaign / FILE
    return read_declaration(toml).name


def output_folder(out: Path | None, campaign: Path, ending: str = "") -> Path:
    """Where to write results of a campaign, checked before any work is done; nothing is made yet.

    Parameters
    ----------
    out : Path or None
        As the user gave it; by default a folder in the current one, with the campaign's name.
    campaign : Path
        Its folder, or its ``campaign.toml``.
    ending : str, optional
        Of the default's name.

    Raises
    ------
    InputError
        If a folder cannot be made there, cannot be written to, or holds results of another
        campaign.
    """
    if out is None:
        out = Path(f"bayesoleo-{campaign_name(campaign)}{ending}")
    folder = check_writable(out.expanduser())
    _check_own(folder, campaign)
    return folder


def _check_own(folder: Path, campaign: Path) -> None:
    """Raise where the results of another campaign would be lost."""
    from bayesoleo.storage import read_attributes

    older = folder / RESULTS
    if not older.is_file():
        return
    name = read_attributes(older).get(schema.CAMPAIGN)
    if name is not None and name != _declared_name(campaign):
        raise InputError(
            "holds results of another campaign",
            file=older,
            key=schema.CAMPAIGN,
            value=name,
            hint="choose another folder with --out, or remove that file",
        )


def check_writable(folder: Path) -> Path:
    """See :func:`bayesoleo.storage.check_writable`."""
    from bayesoleo.storage import check_writable

    return check_writable(folder)


def print_json(value: Any) -> None:
    """Print a value as JSON, for programs."""
    import json

    typer.echo(json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False))
