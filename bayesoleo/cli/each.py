"""``estimate --each``: the parameters from each run by itself, and how much the runs differ."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bayesoleo import schema
from bayesoleo.cli import options, shell, tables

if TYPE_CHECKING:
    import xarray as xr

    from bayesoleo.model import Model
    from bayesoleo.workflow import Settings

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
    import xarray as xr

    from bayesoleo import workflow
    from bayesoleo.errors import InputError
    from bayesoleo.estimation import between_runs
    from bayesoleo.storage import provenance, write_tree

    found = workflow.estimate_each(campaign, model, chosen, callback=shell.teller(quiet))
    view, reason = None, ""
    try:
        view = between_runs(found)
    except InputError as error:  # the runs' own estimates stand without a comparison
        reason = str(error)
    if out is not None:
        groups = {"each": found} | ({} if view is None else {"between_runs": view.to_dataset()})
        tree = xr.DataTree.from_dict(groups)
        tree.attrs.update(provenance(None, command=chosen.command, model=model.name))
        write_tree(tree, out / FILE)
    if as_json:
        facts = {"each": found.to_dict()}
        facts |= {} if view is None else {"between_runs": view.to_dataset().to_dict()}
        shell.print_json(tables.plain(facts))
        return
    console = shell.console()
    console.print(tables.table(*_rows(found)))
    console.print()
    said = f"runs not compared: {reason}" if view is None else str(view)
    console.print(said, markup=False, highlight=False, soft_wrap=True)
    if out is not None:
        console.print(f"result    {out / FILE}", markup=False, soft_wrap=True)


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
