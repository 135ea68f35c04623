"""``propose``: which run to make next."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated

import typer

from bayesoleo import schema
from bayesoleo.cli import options, shell, tables
from bayesoleo.errors import InputError

PANEL = "The whole loop"
_LIMIT = re.compile(
    r"\s*(?P<low>[-+.\deE]*)\s*:\s*(?P<high>[-+.\d]*(?:[eE][-+]?\d+)?)\s*(?P<unit>\D.*)?"
)
_EXAMPLE = "write name=low:high unit, such as amplitude=2:60mm, frequency=:10Hz or force=-1:40kN"


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, PANEL, propose)


def propose(
    campaign: options.CampaignPath,
    model: options.ModelText,
    rivals: Annotated[
        str,
        typer.Option(
            metavar="ID,…",
            show_default=False,
            rich_help_panel=options.RUNNING,
            help="Effects to be told apart, by their ids, or id@target; by default those that "
            "might be what is missing.",
        ),
    ] = "",
    limit: Annotated[
        list[str] | None,
        typer.Option(
            "--limit",
            metavar="NAME=LOW:HIGH[UNIT]",
            show_default=False,
            rich_help_panel=options.RUNNING,
            help="What the rig can do: amplitude, frequency, mean, travel, rate, or an output. SI "
            "without a unit; either side may be left out. May be given several times.",
        ),
    ] = None,
    seed: options.Seed = 0,
    jobs: options.Jobs = None,
    drive: options.Drive = None,
    effects: options.Effects = None,
    without: options.Without = "",
    scheme: options.Scheme = "radau3",
    solver: options.Solver = "collocation",
    steps: options.Steps = None,
    nuisance: options.Nuisance = "",
    figure: Annotated[
        Path | None,
        typer.Option(
            "--figure",
            metavar="FILE.png",
            show_default=False,
            rich_help_panel=options.OUTPUT,
            help="Draw the separation over frequency and amplitude.",
        ),
    ] = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Say which run to make next: the one that best tells apart what might be missing.

    Candidate effects that these runs cannot decide between are estimated, each foresees the runs
    that the rig can do, with all that is not known of its parameters, and the runs are ranked by
    what they are expected to tell. The rig can do what it did, unless the campaign or --limit says
    otherwise. Periodic runs and models with one input only.

    \b
    Examples:
      bayesoleo propose shaker --model f16n2d2
      bayesoleo propose shaker --model f16n2d2 --limit amplitude=2:60mm --limit frequency=:10Hz
      bayesoleo propose shaker --model f16n2d2 --rivals oil_compressibility,frame_compliance
    """
    from bayesoleo import plots, workflow
    from bayesoleo.modelfile import load_model

    chosen = options.settings(
        seed=seed, jobs=jobs, drive=drive, effects=effects, scheme=scheme, solver=solver,
        steps=steps, nuisance=nuisance, without=without,
    )  # fmt: skip
    limits = dict(_limit(text) for text in limit or [])
    names = tuple(part.strip() for part in rivals.split(",") if part.strip())
    declared, callback = load_model(model), shell.teller(quiet)
    tree = workflow.propose(
        campaign, declared, chosen, rivals=names, limits=limits, callback=callback
    )
    summary = json.loads(tree.attrs[schema.SUMMARY])
    entries = summary["proposals"]
    if figure is not None:
        if schema.PROPOSAL not in tree.children:
            raise InputError("there is no run to draw", key="--figure", value=figure)
        plots.proposal(tree).savefig(figure, dpi=150)
    if as_json:
        shell.print_json(tables.plain({"proposals": entries}))
    else:
        _print(entries, summary.get("titles", {}))


def _print(entries: list[dict[str, object]], titles: dict[str, str]) -> None:
    from bayesoleo.report.proposals import proposal_lines, proposal_table

    console = shell.console()
    if not entries:
        console.print("Nothing is left to be told apart: fewer than two candidates stand.")
    for entry in entries:
        for line in proposal_lines(entry, titles):
            console.print(line, markup=False, highlight=False, soft_wrap=True)
        content = proposal_table(entry, titles)
        if content is not None:
            console.print()
            console.print(tables.table(content.head, content.rows, content.words))


def _limit(text: str) -> tuple[str, tuple[float, float]]:
    """Name and range, SI, of an option ``--limit``.

    Raises
    ------
    InputError
        If it is none.
    """
    from bayesoleo.data.rig import to_limit

    name, _, rest = text.partition("=")
    found = _LIMIT.fullmatch(rest)
    if found is None:
        raise InputError("no limit", key="--limit", value=text, hint=_EXAMPLE)
    try:
        low, high = (float(found[side]) if found[side] else None for side in ("low", "high"))
    except ValueError:
        raise InputError("no limit", key="--limit", value=text, hint=_EXAMPLE) from None
    unit = (found["unit"] or "").strip()
    if not unit:  # SI
        unit = "Hz" if name.strip() == "frequency" else "1"
    return name.strip(), to_limit(name.strip(), low, high, unit, "--limit")
