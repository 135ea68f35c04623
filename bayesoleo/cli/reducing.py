"""What the records of a campaign hold: the command ``reduce``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bayesoleo import schema
from bayesoleo.cli import options, shell, tables

if TYPE_CHECKING:
    from rich.console import Console

    from bayesoleo.data import ReducedCampaign

PANEL = "Single steps"


def add_to(app: typer.Typer) -> None:
    """Add the command of this module."""
    shell.add(app, PANEL, reduce)


def reduce(
    campaign: options.CampaignPath,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE.nc",
            show_default=False,
            rich_help_panel=options.OUTPUT,
            help="Write samples, constants and noise to a netCDF file as well.",
        ),
    ] = None,
    as_json: options.Json = False,
    jobs: options.Jobs = None,
    quiet: options.Quiet = False,
) -> None:
    """Show what the records of a campaign hold: frequencies, whole periods, harmonics and noise.

    Frequencies are refined from the declared ones; leading periods that have not settled are left
    out. Of each channel the significant harmonics are counted; its noise is the standard deviation
    of a single sample about the periodic mean. A channel that drifts and a frequency that is half
    the true one are warned of. Writes nothing without --out.

    \b
    Examples:
      bayesoleo reduce shaker
      bayesoleo reduce shaker --json > runs.json
    """
    from bayesoleo import workflow
    from bayesoleo.data import data_warnings, frequency_warnings

    if out is not None:
        shell.check_writable(out.parent)
    found = workflow.reduce(campaign, jobs=jobs, progress=shell.progress_shown(quiet))
    if out is not None:
        _write_records(found, out)
    if as_json:
        units = found.campaign.units
        facts = {"campaign": found.campaign.name, "units": units, "runs": _runs(found)}
        facts["data_warnings"] = data_warnings(found.records, units)
        shell.print_json(tables.plain(facts))
    else:
        _print_records(found, shell.console())
        told = frequency_warnings(found.records)
        for sentence in data_warnings(found.records, found.campaign.units):
            if sentence not in told:
                shell.complain(f"warning: {sentence}")


def _runs(reduced: ReducedCampaign) -> list[dict[str, Any]]:
    """What there is to say of every run, SI."""
    return [
        {
            "run": record.label,
            "role": record.role,
            "group": record.group,
            "kind": record.kind,
            "frequency": record.frequency,
            "frequency_sd": record.frequency_sd,
            "periods": record.periods,
            "dropped_periods": record.dropped_periods,
            "samples": record.time.size,
            "conditions": dict(record.conditions),
            "channels": {
                name: {
                    "harmonics": _orders(record.harmonics.get(name)),
                    "noise": record.signal_noise[name],
                }
                for name in record.samples
            },
        }
        for record in reduced.records
    ]


def _orders(harmonics: Any) -> int | None:
    """Number of significant harmonics, the mean not counted."""
    return None if harmonics is None else int((harmonics.orders > 0).sum())


def _print_records(reduced: ReducedCampaign, console: Console) -> None:
    """Two tables, for one of everything is wider than a terminal."""
    runs = _runs(reduced)
    head = ["run", "role", "frequency [Hz]", "± sd", "periods", "left out", "samples"]
    cells: list[list[Any]] = [
        [
            run["run"],
            run["role"],
            f"{run['frequency']:.6g}" if run["kind"] == "periodic" else None,
            float(f"{run['frequency_sd']:.2g}"),
            run["periods"] or None,
            run["dropped_periods"],
            run["samples"],
        ]
        for run in runs
    ]
    console.print(tables.table(head, cells, words=2))
    head, cells = _channels(reduced, runs)
    console.print()
    console.print("noise of a single sample; in brackets, harmonics above it", style="bold")
    console.print(tables.table(head, cells, words=1))


def _channels(
    reduced: ReducedCampaign, runs: list[dict[str, Any]]
) -> tuple[list[str], list[list[Any]]]:
    """Head and rows of the table of channels."""
    from bayesoleo.plots.units import engineering

    head: list[str] = ["run"]
    cells: list[list[Any]] = [[run["run"]] for run in runs]
    for name, channel in reduced.campaign.channels.items():
        noise = [run["channels"][name]["noise"] for run in runs]
        scale = engineering(channel.si_unit, sorted(noise)[len(noise) // 2])
        head.append(f"{name} [{scale.unit or '1'}]")
        for row, run, level in zip(cells, runs, noise, strict=True):
            harmonics = run["channels"][name]["harmonics"]
            counted = "" if harmonics is None else f" ({harmonics})"
            row.append(f"{_three_digits(scale.factor * level)}{counted}")
    return head, cells


def _three_digits(value: float) -> str:
    """Three digits or a few more, but no power of ten beside numbers without one."""
    return f"{value:.0f}" if 999 < value < 1e5 else f"{value:.3g}"


def _write_records(reduced: ReducedCampaign, out: Path) -> None:
    import xarray as xr

    from bayesoleo.storage import provenance, write_tree
    from bayesoleo.tracing.outcome.result import records_tree

    campaign = reduced.campaign
    tree = xr.DataTree.from_dict(records_tree(list(reduced.records), campaign))
    about = {
        schema.CAMPAIGN: campaign.name,
        schema.CAMPAIGN_DESCRIPTION: campaign.description,
        schema.CAMPAIGN_SHA256: campaign.sha256,
    }
    tree.attrs.update(provenance(None, **about))
    write_tree(tree, out)
