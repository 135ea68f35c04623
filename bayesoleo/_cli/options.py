"""Arguments and options that several commands take, with the words that ``--help`` shows.

The options of settings are declared with the fields of
:class:`~bayesoleo._workflow.settings.Settings`; :func:`of_settings` gives them to a command.
"""

from __future__ import annotations

import inspect
import shlex
import sys
from collections.abc import Callable
from dataclasses import MISSING, fields
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from bayesoleo._cli import shell
from bayesoleo._workflow.settings import OPTION, RUNNING, SettingOption, Settings
from bayesoleo.errors import InputError

OUTPUT = "What is written"
#: Settings that say how the model is solved, in the order of ``--help``.
SOLVED = ("drive", "scheme", "solver", "steps")
#: Settings of the sampler.
SAMPLED = ("quick", "seed", "jobs", "scheduler", "effective_size", "sampler")
_OPTIONS: dict[str, SettingOption] = {
    item.name: item.metadata[OPTION] for item in fields(Settings) if OPTION in item.metadata
}


def argument(metavar: str, text: str) -> Any:
    """An argument; ``text`` is its help."""
    return typer.Argument(metavar=metavar, show_default=False, help=text)


def option(
    flags: str, metavar: str, text: str, panel: str | None = OUTPUT, shown: Any = False
) -> Any:
    """An option with a value.

    Parameters
    ----------
    flags : str
        Its names, separated by spaces.
    metavar : str
        Name of the value in ``--help``.
    text : str
        The help.
    panel : str or None
        Heading in ``--help``; None for that of all options.
    shown : str or bool
        The default in ``--help``: a text, or whether the value is shown.
    """
    return typer.Option(
        *flags.split(), metavar=metavar, show_default=shown, rich_help_panel=panel, help=text
    )


def figure(text: str) -> Any:
    """The option ``--figure``; ``text`` is its help."""
    return option("--figure", "FILE.png", text)


def runs(shown: str) -> Any:
    """The option ``--runs``; ``shown`` is its default in ``--help``."""
    return option("--runs", "A,B,…", "Labels of the runs.", None, shown)


CampaignPath = Annotated[Path, argument("CAMPAIGN", "Folder with campaign.toml and a file a run.")]
ResultPath = Annotated[Path, argument("RESULTS.nc", "results.nc of close or trace.")]
MODEL_HELP = "Built-in system, or file.py:object. A file is code, and is run."
ModelText = Annotated[str, option("--model -m", "MODEL", MODEL_HELP, None)]
OUT_HELP = "Folder to write to. An older result is kept in DIR/older until this one is done."
Out = Annotated[Path | None, option("--out -o", "DIR", OUT_HELP)]
Json = Annotated[
    bool, typer.Option("--json", rich_help_panel=OUTPUT, help="Print JSON, for programs.")
]
Quiet = Annotated[
    bool,
    typer.Option("--quiet", "-q", rich_help_panel=RUNNING, help="No progress, only the result."),
]


def of_settings(
    *names: str, search: bool = False
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of settings in place of its parameter ``chosen``.

    The command receives ``chosen`` as :class:`~bayesoleo._workflow.settings.Settings`.

    Parameters
    ----------
    *names : str
        Names of the settings, in the order of ``--help``.
    search : bool
        Whether the command searches although it is given no campaign.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @wraps(command)
        def called(**given: Any) -> None:
            if search or ("quick" in names and "campaign" in given):  # it takes long
                shell.begin(command.__name__, given, search=search or "max_effects" in names)
            chosen = settings(**{name: given.pop(name) for name in names})
            command(**given, chosen=chosen)

        parameters: list[inspect.Parameter] = []
        signature = inspect.signature(command, eval_str=True)
        for item in signature.parameters.values():
            whole = [item] if item.name != "chosen" else [_parameter(name) for name in names]
            # Typer calls by keyword, so that a default may stand before none.
            parameters += [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in whole]
        called.__dict__["__signature__"] = signature.replace(parameters=parameters)
        return called

    return decorate


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _parameter(name: str) -> inspect.Parameter:
    """The parameter of a command for a setting."""
    one = _OPTIONS[name]
    shown = typer.Option(_flag(name), rich_help_panel=one.panel, help=one.help, **one.shown)
    kind = inspect.Parameter.KEYWORD_ONLY
    annotated: Any = Annotated
    return inspect.Parameter(name, kind, default=one.default, annotation=annotated[one.kind, shown])


def settings(**given: Any) -> Settings:
    """Settings from the values of options; the others have their defaults.

    Raises
    ------
    InputError
        If there is no such scheme, solver, error model or effect, or the file of effects or the
        prior of structures cannot be used.
    """
    found = {}
    made = {item.name for item in fields(Settings) if item.default_factory is not MISSING}
    for name, value in given.items():
        if value is None and name in made:
            continue
        read = _OPTIONS[name].read
        found[name] = value if read is None or value is None else read(value)
    try:
        return Settings(**found, command=shlex.join(["bayesoleo", *sys.argv[1:]]))
    except InputError as error:
        if error.key not in found:
            raise
        raise InputError(
            error.problem, key=_flag(error.key), value=error.value, hint=error.hint
        ) from error
