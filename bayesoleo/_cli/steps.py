"""The commands ``estimate``, ``sample`` and ``trace``: the steps of the loop one by one.

``estimate --each`` estimates the parameters from each run by itself and compares the runs.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from bayesoleo import _schema as schema
from bayesoleo._cli import options, shell
from bayesoleo._cli.records import RECORDS_PANEL
from bayesoleo._workflow.settings import Settings

if TYPE_CHECKING:
    import xarray as xr
    from rich.console import Console

    from bayesoleo.model._model import Model


Each = Annotated[
    bool,
    typer.Option(
        "--each",
        rich_help_panel=options.RUNNING,
        help="From each run by itself, held-out ones too, and how much the runs differ.",
    ),
]
FILE = "each.nc"


def estimate_each(
    campaign: Path, model: Model, chosen: Settings, out: Path | None, quiet: bool, as_json: bool
) -> None:
    """Estimate, print, and write ``each.nc`` where a folder is given."""
    from bayesoleo import _workflow as workflow
    from bayesoleo.errors import InputError
    from bayesoleo.estimation._between_runs import between_runs

    found = workflow.estimate_each(campaign, model, chosen, callback=shell.teller(quiet))
    view, reason = None, ""
    try:
        view = between_runs(found)
    except InputError as error:  # the runs' own estimates stand without a comparison
        reason = str(error)
    if out is not None:
        groups = {"each": found} | ({} if view is None else {"between_runs": view.to_dataset()})
        about = {schema.COMMAND: chosen.command, schema.MODEL: model.name}
        shell.write_groups(groups, out / FILE, None, **about)
    if as_json:
        facts = {"each": found.to_dict()}
        facts |= {} if view is None else {"between_runs": view.to_dataset().to_dict()}
        shell.print_json(facts)
        return
    console = shell.console()
    console.print(shell.table(*_rows(found)))
    console.print()
    said = f"runs not compared: {reason}" if view is None else str(view)
    console.print(said, markup=False, highlight=False, soft_wrap=True)
    if out is not None:
        shell.say(f"result    {out / FILE}")


def _rows(found: xr.Dataset) -> tuple[list[str], list[list[str]]]:
    """One line a run: estimates with their standard deviations, residuals, outcome."""
    names = [str(name) for name in found[schema.PARAMETER].values]
    outputs = [str(output) for output in found[schema.OUTPUT].values]
    units = [str(unit) for unit in found[schema.UNIT].values]
    head = ["run"]
    head += [f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True)]
    head += [f"rms of {output}" for output in outputs] + ["largest", "status"]
    rows = []
    for run in found[schema.RUN].values:
        one = found.sel({schema.RUN: run})
        pairs = zip(one[schema.ESTIMATE].values, one[schema.SD].values, strict=True)
        cells = [f"{value:.5g} ± {sd:.1g}" for value, sd in pairs]
        cells += [f"{float(value):.3g}" for value in one[schema.RMS].values]
        largest = ", ".join(f"{float(value):.3g}" for value in one["largest"].values)
        status, limit = str(one["status"].values).replace("_", " "), str(one["on_limit"].values)
        status += f", on a limit: {limit}" if limit else ""
        rows.append([str(run), *cells, largest, status])
    return head, rows


#: Candidates that ``trace`` shows in the terminal.
SHOWN = 12


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, RECORDS_PANEL, estimate, sample, trace)


@options.of_settings(
    "jobs", *options.SOLVED, "nuisance", "disturbances", "error_model", "between_runs"
)
def estimate(
    campaign: options.CampaignPath,
    model: options.ModelText,
    out: options.Out = None,
    *,
    chosen: Settings,
    quiet: options.Quiet = False,
    each: Each = False,
    as_json: options.Json = False,
) -> None:
    """Estimate the parameters from the runs with role fit: MBE, then the mode of the posterior.

    Prints start, MBE point, mode and linearised standard deviation. Writes nothing without --out;
    with it, results.nc in that folder; with --each, each.nc. A transient is predicted from its
    start: for chaotic records use bayesoleo.estimation.multiple_shooting in Python.

    \b
    Examples:
      bayesoleo estimate shaker --model f16n2d2
      bayesoleo estimate shaker --model model.py:model --drive model --out point
      bayesoleo estimate shaker --model f16n2d2 --each
    """
    from bayesoleo import _workflow as workflow
    from bayesoleo._workflow.model_files import load_model

    if out is not None:
        out = shell.output_folder(out, campaign)
    declared = load_model(model)
    if each:
        estimate_each(campaign, declared, chosen, out, quiet, as_json)
        return
    with shell.stoppable(out):
        tree = workflow.estimate(campaign, declared, chosen, out=out, callback=shell.teller(quiet))
    quantities = _error_quantities(tree)
    if as_json:
        facts = {"parameters": _point(tree), "status": _status(tree)}
        facts |= {"error_model": quantities} if quantities else {}
        shell.print_json(facts)
        return
    console = shell.console()
    names = ("unit", "start", "mbe", "estimate", "sd")
    rows = [[name, *(row[key] for key in names)] for name, row in _point(tree).items()]
    console.print(shell.table(["parameter", *names], rows, words=2))
    if quantities:
        rows = [[name, row["estimate"], row["sd"]] for name, row in quantities.items()]
        console.print(shell.table(["of the errors and runs", "mode", "sd"], rows, words=1))
    for line in _residuals(tree):
        console.print(line, markup=False, highlight=False)
    for line in _how_it_went(_status(tree)):
        console.print(line, style="dim", markup=False, highlight=False)
    _print_written(out, console)


def _residuals(tree: xr.DataTree) -> list[str]:
    """The residual of each output, beside the noise of a sample of the fitted runs."""
    import numpy as np

    point, found = tree[schema.POINT].to_dataset(), []
    noise = tree[schema.NOISE].to_dataset()
    for name, variance in zip(
        point[schema.OUTPUT].values, point[schema.VARIANCE].values, strict=True
    ):
        sd, sizes = float(np.sqrt(variance)), noise[str(name)]
        size = float(np.sqrt(np.nanmean(sizes.values**2)))
        more = f", {sd / size:.3g} times the noise of a sample ({size:.4g})" if size > 0 else ""
        found.append(f"{name}: residual standard deviation {sd:.4g}{more}")
    return found


def _point(tree: xr.DataTree) -> dict[str, dict[str, Any]]:
    point = tree[schema.POINT].to_dataset()
    keys = (schema.START, schema.MBE, schema.ESTIMATE, schema.SD)
    return {
        str(name): {"unit": str(point[schema.UNIT].values[k])}
        | {key: float(point[key].values[k]) for key in keys}
        for k, name in enumerate(point[schema.PARAMETER].values)
    }


def _error_quantities(tree: xr.DataTree) -> dict[str, dict[str, float]]:
    """Mode and standard deviation of what is not a parameter of the model; empty if nothing is."""
    if schema.ERROR_MODEL not in tree.children:
        return {}
    found = tree[schema.ERROR_MODEL].to_dataset()
    return {
        str(name): {key: float(found[key].values[k]) for key in (schema.ESTIMATE, schema.SD)}
        for k, name in enumerate(found[schema.QUANTITY].values)
    }


def _status(tree: xr.DataTree) -> dict[str, Any]:
    return dict(tree[schema.POINT].attrs)


def _how_it_went(status: dict[str, Any]) -> list[str]:
    """How the estimate ended, which trials failed on the way, and how fine the mesh was."""
    from bayesoleo.discovery._policy import SearchPolicy
    from bayesoleo.solvers._orbit import counted

    lines = [status["status_message"]]
    failures = counted(json.loads(status["failures"]))
    if failures:
        lines.append(f"trials that failed: {failures}")
    if "steps" in status:
        mesh = f"{status['scheme']} with {status['steps']} steps in a period or transient"
        if status["mesh_shift"] <= SearchPolicy().mesh_shift:
            mesh += (
                f": half as long, they would move no parameter by more than"
                f" {status['mesh_shift']:.2g} sd"
            )
        if status["solver"] == "collocation":
            lines.append(mesh)  # of another mesh the notes speak
        else:
            lines.append(
                f"solved by {status['solver']}: motions err by {status['motion_error']:.2g} of "
                "their swing at most, by estimate"
            )
    return cast(list[str], lines + json.loads(status["notes"]))


@options.of_settings(
    *options.SAMPLED, *options.SOLVED, "nuisance", "disturbances", "error_model", "between_runs"
)
def sample(
    campaign: options.CampaignPath,
    model: options.ModelText,
    out: options.Out = None,
    *,
    chosen: Settings,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Sample the posterior from the estimate until the effective size asked for is reached.

    No effect is looked for. Draws are saved as they are made: the same command goes on where it was
    stopped.

    \b
    Written to DIR, by default bayesoleo-<name of the campaign>-sample in the current folder:
      results.nc      records, point estimate and posterior

    \b
    Examples:
      bayesoleo sample shaker --model f16n2d2 --quick
      bayesoleo sample shaker --model model.py:model --effective-size 4000
      bayesoleo sample shaker --model f16n2d2 --error-model discrepancy
    """
    from bayesoleo import _workflow as workflow
    from bayesoleo._session.results import Posterior
    from bayesoleo._workflow.model_files import load_model

    folder = shell.output_folder(out, campaign, "-sample")
    with shell.stoppable(folder, quiet) as told:
        tree = workflow.sample(campaign, load_model(model), chosen, out=folder, **told)
    console = shell.console()
    summary = Posterior(tree).summary()
    if as_json:
        written = str(folder / shell.RESULTS)
        shell.print_json({**summary.data.to_dict(), "files": {"result": written}})
        return
    shell.say(summary)
    if summary.data.attrs["warning"]:
        shell.complain(f"warning: {summary.data.attrs['warning']}")
    _print_written(folder, console)


@options.of_settings(
    "seed",
    "jobs",
    "effects",
    "without",
    *options.SOLVED,
    "nuisance",
    "disturbances",
    "structure_prior",
)
def trace(
    campaign: options.CampaignPath,
    model: options.ModelText,
    out: options.Out = None,
    *,
    chosen: Settings,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Hold the residual against its noise and rank what may be missing; add nothing.

    One round of the loop: the model is fitted, its residual is averaged over the periods and
    compared with the noise of that average, and every effect of the catalogue is scored without
    being fitted. Writes nothing without --out; with it, results.nc, report.html and summary.json in
    that folder.

    \b
    Examples:
      bayesoleo trace shaker --model f16n1d2
      bayesoleo trace shaker --model f16n1d2 --out ranking
    """
    from bayesoleo import _workflow as workflow
    from bayesoleo._report.tables import candidates
    from bayesoleo._report.terminal import print_summary
    from bayesoleo._workflow.model_files import load_model

    if out is not None:
        out = shell.output_folder(out, campaign)
    with shell.stoppable(out, quiet) as told:
        tree = workflow.trace(campaign, load_model(model), chosen, out=out, **told)
    summary = json.loads(tree.attrs[schema.SUMMARY])
    if as_json:
        written = {} if out is None else {"result": str(out / shell.RESULTS)}
        shell.print_json({**summary, "files": written})
        return
    console = shell.console()
    first = summary["rounds"][0]
    if first["candidates"]:
        ranking = candidates(first, summary.get("titles"))
        console.print(shell.table(ranking.head, ranking.rows[:SHOWN], words=ranking.words))
        if len(ranking.rows) > SHOWN:
            console.print(f"and {len(ranking.rows) - SHOWN} more", style="dim")
    print_summary({**summary, "files": {}}, console)
    _print_written(out, console)


def _print_written(out: Path | None, console: Console) -> None:
    """Say where the result is."""
    if out is not None and (out / shell.RESULTS).exists():
        console.print()
        shell.say(f"result    {out / shell.RESULTS}")
