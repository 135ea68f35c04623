"""Arguments and options that several commands take, with the words that ``--help`` shows."""

from __future__ import annotations

import difflib
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bayesoleo.errors import InputError

if TYPE_CHECKING:
    from bayesoleo._workflow.settings import Settings


RUNNING, SOLVING, OUTPUT = "How it is run", "How the model is solved", "What is written"
SCHEMES = ("radau2", "radau3", "gauss2", "gauss3", "thesis")
SOLVERS = ("collocation", "adaptive", "shooting", "hybrid", "library")

CampaignPath = Annotated[
    Path,
    typer.Argument(
        metavar="CAMPAIGN", show_default=False, help="Folder with campaign.toml and a file a run."
    ),
]
ModelText = Annotated[
    str,
    typer.Option(
        "--model",
        "-m",
        metavar="MODEL",
        show_default=False,
        help="Built-in system, or file.py:object. A file is code, and is run.",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="DIR",
        show_default=False,
        rich_help_panel=OUTPUT,
        help="Folder to write to. An older result is kept in DIR/older until this one is done.",
    ),
]
Json = Annotated[
    bool, typer.Option("--json", rich_help_panel=OUTPUT, help="Print JSON, for programs.")
]
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        metavar="N",
        rich_help_panel=RUNNING,
        help="The same seed gives the same result, whatever the number of threads.",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        show_default="all cores",
        rich_help_panel=RUNNING,
        help="Threads.",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS|local:N",
        show_default="threads of this process",
        rich_help_panel=RUNNING,
        help="Other machines that take part, by the address of a Dask scheduler, or N processes of "
        "this one. The result is the same.",
    ),
]
Quiet = Annotated[
    bool,
    typer.Option("--quiet", "-q", rich_help_panel=RUNNING, help="No progress, only the result."),
]
Quick = Annotated[
    bool,
    typer.Option(
        "--quick",
        rich_help_panel=RUNNING,
        help="Draw enough for intervals of two digits only.",
    ),
]
EffectiveSize = Annotated[
    int,
    typer.Option(
        min=10,
        metavar="N",
        rich_help_panel=RUNNING,
        help="Draw until every parameter has this effective sample size.",
    ),
]
Drive = Annotated[
    str | None,
    typer.Option(
        metavar="CHANNEL|model",
        show_default="what the campaign says is controlled",
        rich_help_panel=SOLVING,
        help="Channel that drives the model; 'model' keeps its own inputs.",
    ),
]
Scheme = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        rich_help_panel=SOLVING,
        help=f"Discretisation: {', '.join(SCHEMES)} (second-order backward differences).",
    ),
]
Solver = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        rich_help_panel=SOLVING,
        help=f"Solver of periodic runs: {', '.join(SOLVERS)}.",
    ),
]
Steps = Annotated[
    int | None,
    typer.Option(
        min=8,
        metavar="N",
        show_default="refined until the estimate stays",
        rich_help_panel=SOLVING,
        help="Steps a period.",
    ),
]
Nuisance = Annotated[
    str,
    typer.Option(
        metavar="conditions,offset,gain",
        show_default=False,
        rich_help_panel=SOLVING,
        help="Estimate within declared tolerances: conditions (sd), sensors' offset and gain "
        "(accuracy).",
    ),
]
ErrorModel = Annotated[
    str,
    typer.Option(
        "--error-model",
        metavar="NAME",
        rich_help_panel=SOLVING,
        help="What errors have in common: independent (one variance an output), per-run, full "
        "(outputs correlated), correlated (in time), discrepancy (repeats every period), "
        "shared-discrepancy (and is partly alike in all runs).",
    ),
]
BetweenRuns = Annotated[
    str,
    typer.Option(
        "--between-runs",
        metavar="NAME,…",
        show_default=False,
        rich_help_panel=SOLVING,
        help="Parameters that scatter between runs: mean and spread are estimated with them.",
    ),
]
MaxEffects = Annotated[
    int,
    typer.Option(
        min=0,
        metavar="N",
        rich_help_panel=RUNNING,
        help="Add at most this many effects.",
    ),
]

Effects = Annotated[
    str | None,
    typer.Option(
        "--effects",
        metavar="FILE.py:OBJECT",
        show_default=False,
        rich_help_panel=RUNNING,
        help="Effects of your own, one or a list, besides the built-in ones. A file is code.",
    ),
]


Without = Annotated[
    str,
    typer.Option(
        "--without",
        metavar="EFFECT,…",
        show_default=False,
        rich_help_panel=RUNNING,
        help="Effects to leave out of the search; 'nonparametric' leaves out smooth functions.",
    ),
]


def settings(
    *,
    seed: int = 0,
    jobs: int | None = None,
    quick: bool = False,
    effective_size: int = 1000,
    scheme: str = "radau3",
    solver: str = "collocation",
    steps: int | None = None,
    max_effects: int = 4,
    drive: str | None = None,
    effects: str | None = None,
    nuisance: str = "",
    error_model: str = "independent",
    between_runs: str = "",
    scheduler: str | None = None,
    without: str = "",
) -> Settings:
    """Settings of the workflow from options.

    Raises
    ------
    InputError
        If there is no such scheme, solver, error model or effect, or the file of effects cannot be
        used.
    """
    from bayesoleo._workflow.model_files import load_effects
    from bayesoleo._workflow.settings import Settings
    from bayesoleo.error_models._registry import check_word
    from bayesoleo.prediction._periodic_solver import check_solver

    if scheme not in SCHEMES:
        close = difflib.get_close_matches(scheme, SCHEMES, 1)
        hint = f"did you mean {close[0]}? " if close else ""
        hint += f"one of: {', '.join(SCHEMES)}"
        raise InputError("unknown scheme", key="--scheme", value=scheme, hint=hint)
    return Settings(
        seed=seed,
        jobs=jobs,
        scheduler=scheduler,
        quick=quick,
        effective_size=effective_size,
        scheme=scheme,
        solver=check_solver(solver, scheme, "--solver"),
        steps=steps,
        max_effects=max_effects,
        drive=drive,
        effects=None if effects is None else load_effects(effects),
        nuisance=_words(nuisance),
        error_model=check_word(error_model),
        between_runs=_words(between_runs),
        without=_words(without),
        command=shlex.join(["bayesoleo", *sys.argv[1:]]),
    )


def _words(text: str) -> tuple[str, ...]:
    """What stands between commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())
