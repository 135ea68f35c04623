"""What all commands share: how errors, warnings and progress are told, and where to write."""

from __future__ import annotations

import inspect
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperGroup

from bayesoleo import schema
from bayesoleo.errors import BayesoleoError, InputError

if TYPE_CHECKING:
    from rich.console import Console

DEBUG = "BAYESOLEO_DEBUG"
RESULTS = "results.nc"

#: Exit statuses: input that cannot be used; stopped by the user (128 + SIGINT).
UNUSABLE, STOPPED = 2, 130


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
            With status 2 for input that cannot be used, 130 where the user stopped the command.
        """
        try:
            with one_line_warnings():
                return super().invoke(ctx)
        except (Stopped, KeyboardInterrupt) as stop:
            complain(str(stop) or "stopped; nothing was written")
            raise typer.Exit(STOPPED) from None
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
        kept = "nothing was written"
        if folder is not None and folder.is_dir():
            kept = f"an older result in {folder} is as it was"
            if next(folder.rglob("segment-*.npz"), None) is not None:
                kept += "; draws made so far are kept there, and the same command goes on from them"
        raise Stopped(f"stopped: {kept}") from stop


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

    def say(text: str) -> None:
        from tqdm import tqdm

        tqdm.write(text, file=sys.stderr)

    return say


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
    folder = out.expanduser()
    check_writable(folder)
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


def check_writable(folder: Path) -> None:
    """Check that a folder is there, or can be made, and takes files.

    Raises
    ------
    InputError
        If not, with the reason.
    """
    hint = "choose a folder that you may write to, with --out"
    nearest = folder.absolute()
    while not os.path.lexists(nearest):
        nearest = nearest.parent
    if not nearest.is_dir():
        raise InputError("is not a folder; nothing can be written there", file=nearest, hint=hint)
    try:
        # What is allowed shows only in trying: permissions, read-only disks, quotas.
        with tempfile.TemporaryDirectory(prefix=".bayesoleo-", dir=nearest):
            pass
    except OSError as error:
        problem = f"cannot be written to: {error.strerror or error}"
        raise InputError(problem, file=folder, hint=hint) from error


def print_json(value: Any) -> None:
    """Print a value as JSON, for programs."""
    import json

    typer.echo(json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False))
