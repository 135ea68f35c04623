"""The whole loop: ``close`` on one's own data, ``demo`` on simulated ones, ``check`` beforehand."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bayesoleo import schema
from bayesoleo.cli import options, shell, tables
from bayesoleo.errors import InputError, UnfinishedError

if TYPE_CHECKING:
    import xarray as xr

    from bayesoleo.model import Model
    from bayesoleo.workflow import Settings

PANEL = "The whole loop"
DEMO_SYSTEM = "f16n2d2"
FILES = {"report": "report.html", "result": "results.nc", "summary": "summary.json"}


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, PANEL, demo, close, check)


def demo(
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="DIR", rich_help_panel=options.OUTPUT, help="Folder to write to."
        ),
    ] = Path("bayesoleo-demo"),
    seed: options.Seed = 0,
    jobs: options.Jobs = None,
    full: Annotated[
        bool,
        typer.Option(
            "--full",
            rich_help_panel=options.RUNNING,
            help="Draw to the effective size that close asks for; takes longer.",
        ),
    ] = False,
    quiet: options.Quiet = False,
) -> None:
    """Simulate a campaign with an effect that the fitted model lacks; close the loop on it.

    A shaker campaign of an oleo (an aircraft's shock strut) is simulated with noise and with one
    effect more than the model f16n2d2 has. The loop is then closed on it as on measured data: it is
    not told what is missing. Takes less than a minute on two cores, compilation included.

    \b
    Written to DIR:
      campaign/       the simulated records, as a rig would write them
      report.html     the page to read
      results.nc      everything, as one tree of labelled arrays
      summary.json    the figures that matter most

    \b
    Examples:
      bayesoleo demo
      bayesoleo demo --seed 3 --out /tmp/demo
    """
    from bayesoleo.demo import demo_campaign
    from bayesoleo.modelfile import load_model

    shell.check_writable(out)
    chosen = options.settings(seed=seed, jobs=jobs, quick=not full)
    callback, progress = shell.teller(quiet), shell.progress_shown(quiet)
    with shell.stoppable(out):
        callback("simulating a shaker campaign of an oleo")
        campaign = _fresh_campaign(out, seed, demo_campaign)
        model = load_model(DEMO_SYSTEM)
        _closed(campaign, model, chosen, out, callback, progress)


def _fresh_campaign(out: Path, seed: int, make: Callable[[Path, int], Path]) -> Path:
    """Put a newly simulated campaign in the place of an older one of its kind, as a whole."""
    from bayesoleo.storage.atomic import replacing

    target = out / "campaign"
    with replacing(target) as draft:
        make(draft, seed)
        if target.exists() and not _is_demo(target, shell.campaign_name(draft)):
            hint = "choose another folder with --out"
            raise InputError("holds other data than an older demo", file=target, hint=hint)
    return target


def _is_demo(folder: Path, name: str) -> bool:
    try:
        return shell.campaign_name(folder) == name
    except InputError:
        return False


def close(
    campaign: options.CampaignPath,
    model: options.ModelText,
    out: options.Out = None,
    quick: options.Quick = False,
    seed: options.Seed = 0,
    jobs: options.Jobs = None,
    scheduler: options.Scheduler = None,
    effective_size: options.EffectiveSize = 1000,
    max_effects: options.MaxEffects = 4,
    effects: options.Effects = None,
    without: options.Without = "",
    quiet: options.Quiet = False,
    drive: options.Drive = None,
    scheme: options.Scheme = "radau3",
    solver: options.Solver = "collocation",
    steps: options.Steps = None,
    nuisance: options.Nuisance = "",
    error_model: options.ErrorModel = "independent",
    between_runs: options.BetweenRuns = "",
) -> None:
    """Close the loop: estimate, find what is missing, add it, compare before and after.

    The records become periodic runs with a noise floor; the parameters are estimated and their
    posterior is sampled. The residual is held against the noise; every effect of the catalogue is
    scored, the best one is added if it is significant and helps on the hold-out runs, and the round
    starts again. Without hold-out runs each run is left out in turn, and the report says so.

    \b
    Written to DIR, by default bayesoleo-<name of the campaign> in the current folder:
      report.html     one self-contained page for someone who did not run it
      results.nc      everything, as one tree of labelled arrays (xarray, ArviZ)
      summary.json    effects found, parameters with intervals, errors, verdict

    \b
    Examples:
      bayesoleo close shaker --model f16n2d2
      bayesoleo close shaker --model model.py:model --out results --quick
      bayesoleo close shaker --model f16n2d1 --drive force --seed 7
      bayesoleo close shaker --model f16n2d2 --effects mine.py:drag
      bayesoleo close shaker --model f16n2d2 --without humming_force,nonparametric
    """
    from bayesoleo.modelfile import load_model

    folder = shell.output_folder(out, campaign)
    chosen = options.settings(
        seed=seed,
        jobs=jobs,
        scheduler=scheduler,
        quick=quick,
        effective_size=effective_size,
        scheme=scheme,
        solver=solver,
        steps=steps,
        max_effects=max_effects,
        drive=drive,
        effects=effects,
        without=without,
        nuisance=nuisance,
        error_model=error_model,
        between_runs=between_runs,
    )
    callback, progress = shell.teller(quiet), shell.progress_shown(quiet)
    declared = load_model(model)
    with shell.stoppable(folder):
        _closed(campaign, declared, chosen, folder, callback, progress)


def _closed(
    campaign: Path,
    model: Model,
    chosen: Settings,
    folder: Path,
    callback: Callable[[str], None],
    progress: bool,
) -> None:
    """Close the loop and print what came out, also where a late stage failed."""
    from bayesoleo import workflow

    try:
        tree = workflow.close(
            campaign, model, chosen, out=folder, callback=callback, progress=progress
        )
    except UnfinishedError as error:
        _print(error.tree, folder)
        raise
    _print(tree, folder)


def check(
    campaign: options.CampaignPath,
    model: options.ModelText,
    drive: options.Drive = None,
    scheme: options.Scheme = "radau3",
    solver: options.Solver = "collocation",
    steps: options.Steps = None,
    nuisance: options.Nuisance = "",
    without: options.Without = "",
    as_json: options.Json = False,
) -> None:
    """Read a campaign and a model, say what would be done, and touch nothing.

    Channels, units, conditions, priors and roles are checked against each other as close would, and
    the model is solved once at its nominal values: turned signs and wrong units show there.

    \b
    Examples:
      bayesoleo check shaker --model f16n2d2
      bayesoleo check shaker --model model.py:model --json
    """
    from bayesoleo import workflow
    from bayesoleo.modelfile import load_model

    chosen = options.settings(
        scheme=scheme, solver=solver, steps=steps, drive=drive, nuisance=nuisance, without=without
    )
    plan = workflow.check(campaign, load_model(model), chosen)
    if as_json:
        shell.print_json(tables.plain(plan))
        return
    console = shell.console()
    sentences = plan.pop("data_warnings")
    plan.pop("start")
    tables.print_mapping(plan, console)
    for sentence in sentences:
        console.print(sentence, style="dim", markup=False, soft_wrap=True)


def _print(tree: xr.DataTree, folder: Path) -> None:
    """The result in a few lines, and where it was written."""
    from bayesoleo.report import print_summary

    summary = json.loads(tree.attrs[schema.SUMMARY])
    written = {what: folder / name for what, name in FILES.items()}
    present = {what: str(path) for what, path in written.items() if path.exists()}
    print_summary({**summary, "files": present}, shell.console())
