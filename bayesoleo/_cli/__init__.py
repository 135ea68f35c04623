"""How bayesoleo is asked for: the commands, their options, and what they print.

Commands import what they need when they run, so that ``--help`` comes at once.
"""

from __future__ import annotations

import atexit
import os
import sys
from typing import Annotated, NoReturn

import typer

from bayesoleo._cli import assessing, closing, listing, records, steps
from bayesoleo._cli.shell import UNUSABLE, Commands, complain, flowing, machine_text
from bayesoleo._parallel import ONE_THREAD

__all__ = ["app", "main", "run"]

#: Exit status where nobody read to the end what was printed; Python's own.
UNREAD = 120

app = typer.Typer(
    name="bayesoleo",
    cls=Commands,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import PackageNotFoundError, version

        try:
            number = version("bayesoleo")
        except PackageNotFoundError:
            number = "(not installed)"
        print(f"bayesoleo {number}")
        raise typer.Exit


def _top(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and stop."
        ),
    ] = False,
) -> None:
    """Identify nonlinear dynamic systems from periodic data, and find the effect they lack.

    A folder of measurements and an equation go in. Out come the parameters with their posterior,
    what the model leaves unexplained held against the noise, the physical effect that is missing,
    and the error before and after on runs that were not used.

    \b
    First look         bayesoleo demo
    Your own data      bayesoleo check FOLDER --model model.py:model
                       bayesoleo close FOLDER --model model.py:model
    What is built in   bayesoleo systems;  bayesoleo effects

    FOLDER holds campaign.toml, which says what is in the files of the runs. Input that cannot be
    used gets one line that says where, what, and what to write instead; the exit status is then 2.
    With BAYESOLEO_DEBUG=1 the error is shown with its traceback instead.
    """


app.callback(help=flowing(_top.__doc__ or ""))(_top)
for _add in (
    closing.add_loop,
    closing.add_propose,
    records.add_reduce,
    steps.add_to,
    assessing.add_to,
    records.add_results,
    listing.add_to,
):
    _add(app)


def main() -> None:
    """Entry point of the ``bayesoleo`` command.

    The work has threads of its own. Linear algebra gets one, unless the environment says
    otherwise; how many is read where the library is loaded, which is later.
    """
    if not any(name in os.environ for name in ONE_THREAD):
        os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        app()
    except (MemoryError, ImportError) as error:  # before a command is begun: it answers for itself
        text = machine_text(error)
        if not text:
            raise
        complain(f"error: {text}")
        sys.exit(UNUSABLE)


def run() -> NoReturn:
    """:func:`main` in a process of its own, which ends with it.

    Python would take a second or two to clear away the objects of a large result one by one, while
    the user waits for a prompt. Files are written by then, and other processes are told.

    Raises
    ------
    SystemExit
        Only with a message, which Python prints.
    """
    status = 0
    try:
        main()
    except SystemExit as ended:
        if isinstance(ended.code, str):
            raise
        status = ended.code or 0
    atexit._run_exitfuncs()
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except (OSError, ValueError):  # nobody reads any more
            status = status or UNREAD
    os._exit(status)
