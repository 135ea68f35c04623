"""From results: ``report`` writes the page again, ``simulate`` makes new data."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from bayesoleo.cli import options, shell
from bayesoleo.errors import InputError

PANEL = "From results and models"
RESULT_SUFFIXES = (".nc", ".zarr")
PAGE, PAGE_SUFFIXES = "report.html", (".html", ".htm")


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, PANEL, report, simulate)


def report(
    results: Annotated[
        Path,
        typer.Argument(
            metavar="RESULTS.nc", show_default=False, help="results.nc of close or trace."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE.html|DIR",
            show_default="report.html beside the result",
            rich_help_panel=options.OUTPUT,
            help="Page to write, or folder for report.html; an older page is replaced as a whole.",
        ),
    ] = None,
) -> None:
    """Write the report of a result of close or trace again: one self-contained page.

    \b
    Examples:
      bayesoleo report bayesoleo-shaker/results.nc
      bayesoleo report results.nc --out for-colleagues.html
    """
    from bayesoleo.report import write_report
    from bayesoleo.storage import read_tree

    page = results.parent / PAGE if out is None else out.expanduser()
    if page.suffix.lower() not in PAGE_SUFFIXES or page.is_dir():
        page /= PAGE
    tree = read_tree(results)
    if page.is_dir():
        raise InputError("is a folder", file=page, hint="give another file or folder with --out")
    shell.check_writable(page.parent)
    page.parent.mkdir(parents=True, exist_ok=True)
    write_report(tree, page)
    shell.console().print(f"report    {page}", markup=False, soft_wrap=True)


def simulate(
    source: Annotated[
        str,
        typer.Argument(
            metavar="MODEL|RESULTS.nc",
            show_default=False,
            help="Built-in system, file.py:object, or a result with its posterior.",
        ),
    ],
    like: Annotated[
        Path,
        typer.Option(
            metavar="CAMPAIGN",
            show_default=False,
            help="Campaign whose runs, inputs, conditions and channels the new one has.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            show_default=False,
            rich_help_panel=options.OUTPUT,
            help="Folder of the new campaign; must not hold files.",
        ),
    ],
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            show_default=False,
            help="Parameter value in SI; may be repeated.",
        ),
    ] = None,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CHANNEL=VALUE",
            show_default=False,
            help="Standard deviation of the noise of a channel in SI; may be repeated.",
        ),
    ] = None,
    draws: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            show_default=False,
            help="From a result: simulate with so many draws of its posterior.",
        ),
    ] = None,
    seed: options.Seed = 0,
    jobs: options.Jobs = None,
    drive: options.Drive = None,
    scheme: options.Scheme = "radau3",
    solver: options.Solver = "collocation",
    steps: options.Steps = None,
) -> None:
    """Simulate a campaign with a model, or with the model and posterior of a result.

    The new folder is read by every other command as if it had been measured.

    \b
    Examples:
      bayesoleo simulate f16n2d2 --like shaker --out simulated
      bayesoleo simulate f16n2d2 --like shaker --out stiffer --set initial_volume=9e-4
      bayesoleo simulate f16n2d2 --like shaker --out noisy --noise force=20 --noise pressure=5e3
      bayesoleo simulate bayesoleo-shaker/results.nc --like shaker --out predicted --draws 20
    """
    from bayesoleo import workflow
    from bayesoleo.modelfile import load_model
    from bayesoleo.storage import read_tree

    if out.is_dir() and any(out.iterdir()):
        raise InputError("folder is not empty", file=out, hint="choose another with --out")
    shell.check_writable(out)
    chosen = options.settings(
        seed=seed, jobs=jobs, drive=drive, scheme=scheme, solver=solver, steps=steps
    )
    amounts = pairs(noise or [], "--noise")
    for channel, sd in amounts.items():
        if sd < 0:
            hint = "write a standard deviation of zero or more"
            raise InputError("noise is negative", key=f"--noise {channel}", value=sd, hint=hint)
    from_result = Path(source).suffix in RESULT_SUFFIXES
    if draws is not None and not from_result:
        raise InputError(
            "a model has no posterior to draw from",
            key="--draws",
            value=draws,
            hint="give a results.nc, or leave --draws out",
        )
    changed = pairs(values or [], "--set") or None
    made_from = read_tree(source) if from_result else load_model(source)
    more = {"noise": amounts} if amounts else {}
    folder = workflow.simulate(
        made_from, like, chosen, out=out, values=changed, draws=draws, **more
    )
    shell.console().print(f"campaign  {folder}", markup=False, soft_wrap=True)


def pairs(texts: list[str], option: str) -> dict[str, float]:
    """Numbers by name from ``name=value`` texts.

    Raises
    ------
    InputError
        If a text is not that, or a name comes twice.
    """
    found: dict[str, float] = {}
    for text in texts:
        name, equals, number = (part.strip() for part in text.partition("="))
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not (name and equals and math.isfinite(value)):
            hint = f"write name=number in SI units, e.g. {option} force=20"
            raise InputError("is not name=value", key=option, value=text, hint=hint)
        if name in found:
            raise InputError("is given twice", key=f"{option} {name}", value=text, hint="drop one")
        found[name] = value
    return found
