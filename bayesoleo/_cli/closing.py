"""The commands of the whole loop: ``demo``, ``close``, ``each``, ``check`` and ``propose``."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bayesoleo import _schema as schema
from bayesoleo._cli import options, shell
from bayesoleo._workflow.settings import Settings, words
from bayesoleo.errors import InputError, UnfinishedError, number_of

if TYPE_CHECKING:
    import xarray as xr

    from bayesoleo._workflow.each import EachResult
    from bayesoleo._workflow.first_look import Started
    from bayesoleo.model._model import Model


PANEL = "The whole loop"
_LIMIT = re.compile(
    r"\s*(?P<low>[-+.\deE]*)\s*:\s*(?P<high>[-+.\d]*(?:[eE][-+]?\d+)?)\s*(?P<unit>\D.*)?"
)
_EXAMPLE = "write name=low:high unit, such as amplitude=2:60mm, frequency=:10Hz or force=-1:40kN"


def add_propose(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, PANEL, propose)


@options.of_settings(
    "seed", "jobs", "effects", "without", *options.SOLVED, "nuisance", "disturbances",
    "structure_prior", "next_run",
)  # fmt: skip
def propose(
    campaign: options.CampaignPath,
    model: options.ModelText,
    rivals: Annotated[
        str,
        options.option(
            "--rivals",
            "ID,…",
            "Effects to be told apart, by their ids, or id@target; by default the most "
            "probable structures.",
            options.RUNNING,
        ),
    ] = "",
    limit: Annotated[
        list[str] | None,
        options.option(
            "--limit",
            "NAME=LOW:HIGH[UNIT]",
            "What the rig can do: amplitude, frequency, mean, travel, rate, or an output. SI "
            "without a unit; either side may be left out. May be given several times.",
            options.RUNNING,
        ),
    ] = None,
    *,
    chosen: Settings,
    figure: Annotated[
        Path | None, options.figure("Draw the separation over frequency and amplitude.")
    ] = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Say which run to make next: the one that is expected to tell most of what might be missing.

    Structures that these runs cannot decide between are estimated, each foresees the runs that the
    rig can do, with all that is not known of its parameters, and the runs are ranked by what they
    are expected to tell, in bits. The rig can do what it did, unless the campaign or --limit says
    otherwise. Transients, and runs with several inputs, vary those that were measured.

    \b
    Examples:
      bayesoleo propose shaker --model f16n2d2
      bayesoleo propose shaker --model f16n2d2 --limit amplitude=2:60mm --limit frequency=:10Hz
      bayesoleo propose shaker --model f16n2d2 --rivals oil_compressibility,frame_compliance
      bayesoleo propose shaker --model f16n2d2 --next-run parameters
    """
    from bayesoleo import _workflow as workflow, plots
    from bayesoleo._workflow.model_files import load_model

    limits = dict(_limit(text) for text in limit or [])
    declared, callback = load_model(model), shell.teller(quiet)
    tree = workflow.propose(
        campaign, declared, chosen, rivals=words(rivals), limits=limits, callback=callback
    )
    summary = json.loads(tree.attrs[schema.SUMMARY])
    entries = summary["proposals"]
    if figure is not None:
        if schema.PROPOSAL not in tree.children:
            raise InputError("there is no run to draw", key="--figure", value=figure)
        shell.write_figure(plots.proposal(tree), figure, dpi=150)
    if as_json:
        shell.print_json({"proposals": entries})
    else:
        _print_proposals(summary)


def _print_proposals(summary: Mapping[str, Any]) -> None:
    from bayesoleo._report.sentences import hold_out_objects
    from bayesoleo._report.structures import proposal_lines, proposal_table

    console = shell.console()
    entries, titles = summary["proposals"], summary.get("titles", {})
    objection = hold_out_objects(summary)
    if not entries:
        console.print(
            "No run is proposed: one structure is nearly certain, most probably nothing is"
            " missing, or none of the structures that foresee a run is likely."
        )
    for entry in entries:
        for line in proposal_lines(entry, titles, objection):
            console.print(line, markup=False, highlight=False, soft_wrap=True)
        content = proposal_table(entry, titles)
        if content is not None:
            console.print()
            console.print(shell.table(content.head, content.rows, content.words))


def _limit(text: str) -> tuple[str, tuple[float, float]]:
    """Name and range, SI, of an option ``--limit``.

    Raises
    ------
    InputError
        If it is none.
    """
    from bayesoleo.data._campaign_toml import to_limit

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


def init(
    folder: Annotated[Path, options.argument("FOLDER", "Folder with the files of the runs.")],
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Look at a folder of measurements; write campaign.toml and a model to start from.

    Columns, units, times, sampling rates, runs and frequencies are read off the files, whatever
    their format. What the files do not say is marked with TO FILL IN in campaign.toml, and listed.
    Nothing is overwritten.

    \b
    Written to FOLDER:
      campaign.toml   what the files hold, with comments; it loads as it is
      model.py        a linear model to start from
      channels.png    each channel of the first runs over time

    \b
    Examples:
      bayesoleo init measurements
      bayesoleo init measurements --json
    """
    from bayesoleo._report.terminal import sparkline
    from bayesoleo._workflow.first_look import start_campaign

    found = start_campaign(
        folder, progress=shell.progress_shown(quiet), callback=shell.teller(quiet or as_json)
    )
    if as_json:
        facts = {"written": found.written, "kept": found.kept, "to_fill_in": found.questions}
        shell.print_json({**facts, "notes": found.notes})
        return
    run = found.campaign.runs[0]
    units = found.campaign.units
    rows = [
        [name, f"{v.min():.4g}", f"{v.max():.4g}", units[name] or "1", sparkline(v)]
        for name, v in run.samples.items()
    ]
    console = shell.console()
    head = ["channel", "lowest", "highest", "unit", f"run {run.label}"]
    console.print(shell.table(head, rows))
    declared: list[list[Any]] = [
        [one.label, one.kind, one.frequency, one.time.size, 1 / one.time_step, one.role]
        for one in found.campaign.runs
    ]
    console.print()
    console.print(shell.table(["run", "kind", "Hz", "samples", "rate [Hz]", "role"], declared, 2))
    console.print()
    _tell_start(found, folder)


def _tell_start(found: Started, folder: Path) -> None:
    """What was left out, what is to be filled in, and what comes next."""
    for note in found.notes:
        shell.say(f"note      {note}")
    for question in found.questions:
        shell.say(f"fill in   {question}")
    for path in found.written:
        shell.say(f"written   {path}")
    for path in found.kept:
        shell.say(f"kept      {path} was there and is as it was")
    shell.say(f"next      bayesoleo check {folder} --model {folder / 'model.py'}:model")


SEEDS_HELP = "How many seeds, from --seed on, each a task of its own."
DEMO_SYSTEM = "f16n2d2"
FILES = {"report": "report.html", "result": "results.nc", "summary": "summary.json"}


def add_loop(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, PANEL, demo, init, close, each, check)


@options.of_settings("seed", "jobs", search=True)
def demo(
    out: Annotated[
        Path,
        options.option("--out -o", "DIR", "Folder to write to.", shown=True),
    ] = Path("bayesoleo-demo"),
    *,
    chosen: Settings,
    full: Annotated[
        bool,
        typer.Option(
            "--full",
            rich_help_panel=options.RUNNING,
            help="Draw to the effective size that close asks for; takes longer.",
        ),
    ] = False,
    as_json: options.Json = False,
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
    from bayesoleo._compiled import compilation_told
    from bayesoleo._workflow.model_files import load_model
    from bayesoleo._workflow.simulating import demo_campaign
    from bayesoleo.discovery._compile_ahead import begin_compiling, compile_meanwhile

    begin_compiling(chosen.jobs)
    chosen = replace(chosen, quick=not full)
    with shell.stoppable(out, quiet) as told, compilation_told(told["callback"]):
        compile_meanwhile(chosen.jobs)
        told["callback"]("simulating a shaker campaign of an oleo")
        campaign = _fresh_campaign(out, chosen.seed, demo_campaign)
        _closed(campaign, load_model(DEMO_SYSTEM), chosen, out, told, as_json)


def _fresh_campaign(out: Path, seed: int, make: Callable[[Path, int], Path]) -> Path:
    """Put a newly simulated campaign in the place of an older one of its kind, as a whole."""
    from bayesoleo._storage.files import only_writer, replacing, sweep

    target = out / "campaign"
    with only_writer(out), replacing(target) as draft:
        sweep(out, [target.name])
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


@options.of_settings(
    *options.SAMPLED, "max_effects", "effects", "without", *options.SOLVED,
    "nuisance", "disturbances", "error_model", "between_runs", "structure_prior", "next_run",
)  # fmt: skip
def close(
    campaign: options.CampaignPath,
    model: options.ModelText,
    out: options.Out = None,
    *,
    chosen: Settings,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
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
    from bayesoleo._workflow.model_files import load_model

    folder = shell.output_folder(out, campaign)
    with shell.stoppable(folder, quiet) as told:
        _closed(campaign, load_model(model), chosen, folder, told, as_json)


def _closed(
    campaign: Path,
    model: Model,
    chosen: Settings,
    folder: Path,
    told: Mapping[str, Any],
    as_json: bool,
) -> None:
    """Close the loop and print what came out, also where a late stage failed."""
    from bayesoleo import _workflow as workflow
    from bayesoleo._compiled import compilation_told

    try:
        with compilation_told(told["callback"]):
            tree = workflow.close(campaign, model, chosen, out=folder, **told)
    except UnfinishedError as error:
        _print_loop(error.tree, folder, as_json)
        raise
    _print_loop(tree, folder, as_json)


#: Exit status where tasks of ``each`` failed and others did not.
SOME_FAILED = 1


@options.of_settings(
    "quick", "seed", "effective_size", "sampler", "max_effects", "effects", "without",
    *options.SOLVED, "nuisance", "disturbances", "error_model", "between_runs", "structure_prior",
    "next_run",
)  # fmt: skip
def each(
    campaigns: Annotated[list[Path], options.argument("CAMPAIGN", "Folders with campaign.toml.")],
    models: Annotated[
        list[str], options.option("--model -m", "MODEL", f"{options.MODEL_HELP} Repeatable.", None)
    ],
    out: Annotated[Path, options.option("--out -o", "DIR", "Folder for all results.")],
    seeds: Annotated[
        int, typer.Option(min=1, metavar="N", rich_help_panel=options.RUNNING, help=SEEDS_HELP)
    ] = 1,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            rich_help_panel=options.RUNNING,
            show_default="all cores",
            help="Tasks at a time on this machine, each in a process of one thread.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        options.option(
            "--scheduler",
            "ADDRESS|local:N",
            "Instead, the workers of a Dask scheduler. Campaigns are sent to them, results come "
            "back.",
            options.RUNNING,
        ),
    ] = None,
    shared: Annotated[
        bool,
        typer.Option(
            "--shared",
            rich_help_panel=options.RUNNING,
            help="These workers see campaigns and DIR under the same paths, and use them there.",
        ),
    ] = False,
    retries: Annotated[
        int,
        typer.Option(
            min=0,
            metavar="N",
            rich_help_panel=options.RUNNING,
            help="Try a task again so often whose process or worker was lost.",
        ),
    ] = 2,
    *,
    chosen: Settings,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Close the loop for each campaign with each model and each seed, here or on a cluster.

    Each combination is a task with a folder of its own, which holds what close writes. A task that
    fails takes no other with it. The same command goes on where it was stopped or killed: a task
    that is done is not done again unless its campaign, model or settings have changed.

    \b
    Written to DIR:
      manifest.json                   every task, how far it is, and why it failed
      summary.csv                     a line for each task
      <campaign>/<model>/seed-<n>/    what close writes

    The exit status is 0 if all tasks are done and 1 if some failed.

    \b
    Examples:
      bayesoleo each shaker-* --model f16n2d2 --out all
      bayesoleo each shaker-* --model f16n2d1 --model mine.py:model --seeds 5 --out all --jobs 8
      bayesoleo each shaker-* --model f16n2d2 --out all --scheduler tcp://10.0.0.1:8786
    """
    from bayesoleo import _workflow as workflow

    try:
        found = workflow.close_each(
            campaigns,
            models,
            out=out.expanduser(),
            seeds=seeds,
            settings=chosen,
            jobs=jobs,
            scheduler=scheduler,
            shared=shared,
            retries=retries,
            callback=shell.teller(quiet),
            progress=shell.progress_shown(quiet),
        )
    except KeyboardInterrupt as stop:
        kept = f"tasks that are done are kept in {out}, and the same command does the others"
        raise shell.Stopped(f"stopped: {kept}") from stop
    if as_json:
        shell.print_json({"folder": str(found.folder), "tasks": found.table()})
    else:
        _print_tasks(found)
    if found.failed:
        raise typer.Exit(SOME_FAILED)


def _print_tasks(found: EachResult) -> None:
    """The table of all tasks, and what went wrong with which."""
    head = ["task", "status", "effect", "certainty", "probability", "error before", "after", "s"]
    keys = ["folder", "status", "effect", "certainty", "probability", "error_before"]
    keys += ["error_after", "seconds"]
    rows = [[row[key] for key in keys] for row in found.table()]
    shell.console().print(shell.table(head, rows, words=4))
    for task in found.failed:
        shell.say(f"failed    {task.folder}: {task.reason}")
    done = len(found.tasks) - len(found.failed)
    shell.say(
        f"{done} of {number_of(len(found.tasks), 'task')} {'is' if done == 1 else 'are'} done"
    )
    for name in ("manifest.json", "summary.csv"):
        shell.say(f"written   {found.folder / name}")


@options.of_settings(*options.SOLVED, "nuisance", "disturbances", "without")
def check(
    campaign: options.CampaignPath,
    model: options.ModelText,
    *,
    chosen: Settings,
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
    from bayesoleo import _workflow as workflow
    from bayesoleo._workflow.model_files import load_model

    plan = workflow.check(campaign, load_model(model), chosen)
    if as_json:
        shell.print_json(plan)
        return
    console = shell.console()
    sentences = plan.pop("data_warnings")
    plan.pop("start")
    shown = plan.pop(schema.FREQUENCY_RESPONSE, [])
    shell.print_mapping(plan, console)
    for sentence in shown:
        console.print(sentence, markup=False, soft_wrap=True)
    for sentence in sentences:
        console.print(sentence, style="dim", markup=False, soft_wrap=True)


def _print_loop(tree: xr.DataTree, folder: Path, as_json: bool) -> None:
    """The result in a few lines, or as in summary.json, and where it was written."""
    from bayesoleo._report.terminal import print_summary

    summary = json.loads(tree.attrs[schema.SUMMARY])
    written = {what: folder / name for what, name in FILES.items()}
    present = {what: str(path) for what, path in written.items() if path.exists()}
    if as_json:
        shell.print_json({**summary, "files": present})
        return
    print_summary({**summary, "files": present}, shell.console())
