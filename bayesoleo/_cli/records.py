"""The commands ``reduce``, ``report`` and ``simulate``.

``reduce`` shows the records of a campaign; ``report`` writes the page of a result again;
``simulate`` makes new data from a model or a result.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bayesoleo import _schema as schema
from bayesoleo._cli import options, shell
from bayesoleo._workflow.settings import Settings
from bayesoleo.errors import InputError

if TYPE_CHECKING:
    import xarray as xr
    from rich.console import Console

    from bayesoleo.data._reduction import ReducedCampaign


RECORDS_PANEL = "Single steps"


def add_reduce(app: typer.Typer) -> None:
    """Add the command of this module."""
    shell.add(app, RECORDS_PANEL, reduce)


@options.of_settings("jobs")
def reduce(
    campaign: options.CampaignPath,
    out: Annotated[
        Path | None,
        options.option(
            "--out -o", "FILE.nc", "Write samples, constants and noise to a netCDF file as well."
        ),
    ] = None,
    as_json: options.Json = False,
    *,
    chosen: Settings,
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
    from bayesoleo import _workflow as workflow
    from bayesoleo.data._data_warnings import data_warnings, frequency_warnings

    if out is not None:
        shell.check_writable(out.parent)
    found = workflow.reduce(campaign, jobs=chosen.jobs, progress=shell.progress_shown(quiet))
    if out is not None:
        _write_records(found, out)
    if as_json:
        units = found.campaign.units
        facts = {"campaign": found.campaign.name, "units": units, "runs": _runs(found)}
        facts["data_warnings"] = data_warnings(found.records, units)
        shell.print_json(facts)
    else:
        _print_records(found, shell.console())
        told = frequency_warnings(found.records)
        for sentence in data_warnings(found.records, found.campaign.units):
            if sentence not in told:
                shell.complain(f"warning: {sentence}")


def _runs(reduced: ReducedCampaign) -> list[dict[str, Any]]:
    """Facts about every run, SI."""
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
    console.print(shell.table(head, cells, words=2))
    head, cells = _channels(reduced, runs)
    console.print()
    console.print("noise of a single sample; in brackets, harmonics above it", style="bold")
    console.print(shell.table(head, cells, words=1))


def _channels(
    reduced: ReducedCampaign, runs: list[dict[str, Any]]
) -> tuple[list[str], list[list[Any]]]:
    """Head and rows of the table of channels."""
    from bayesoleo.plots._style import engineering

    head: list[str] = ["run"]
    cells: list[list[Any]] = [[run["run"]] for run in runs]
    for name, channel in reduced.campaign.channels.items():
        noise = [run["channels"][name]["noise"] for run in runs]
        known = sorted(level for level in noise if math.isfinite(level)) or [math.nan]
        scale = engineering(channel.si_unit, known[len(known) // 2])
        head.append(f"{name} [{scale.unit or '1'}]")
        for row, run, level in zip(cells, runs, noise, strict=True):
            harmonics = run["channels"][name]["harmonics"]
            counted = "" if harmonics is None else f" ({harmonics})"
            row.append(f"{_three_digits(scale.factor * level)}{counted}")
    return head, cells


def _three_digits(value: float) -> str:
    """Three digits or a few more, but no power of ten beside numbers without one; a dash where
    there is no number."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.0f}" if 999 < value < 1e5 else f"{value:.3g}"


def _write_records(reduced: ReducedCampaign, out: Path) -> None:
    from bayesoleo.discovery._result_tree import records_tree

    campaign = reduced.campaign
    about = {
        schema.CAMPAIGN: campaign.name,
        schema.CAMPAIGN_DESCRIPTION: campaign.description,
        schema.CAMPAIGN_SHA256: campaign.sha256,
    }
    shell.write_groups(records_tree(list(reduced.records), campaign), out, None, **about)


RESULTS_PANEL = "From results and models"
RESULT_SUFFIXES = (".nc", ".zarr")
PAGE, PAGE_SUFFIXES = "report.html", (".html", ".htm")


def add_results(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, RESULTS_PANEL, report, simulate)


def report(
    results: options.ResultPath,
    out: Annotated[
        Path | None,
        options.option(
            "--out -o",
            "FILE.html|DIR",
            "Page to write, or folder for report.html; an older page is replaced as a whole.",
            shown="report.html beside the result",
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Write the report of a result of close or trace again: one self-contained page.

    \b
    Examples:
      bayesoleo report bayesoleo-shaker/results.nc
      bayesoleo report results.nc --out for-colleagues.html
    """
    from bayesoleo._storage.result_files import read_tree

    page = results.parent / PAGE if out is None else out.expanduser()
    if page.suffix.lower() not in PAGE_SUFFIXES or page.is_dir():
        page /= PAGE
    tree = read_tree(results)
    if page.is_dir():
        raise InputError("is a folder", file=page, hint="give another file or folder with --out")
    shell.check_writable(page.parent)
    _write_page(tree, page, page.parent.resolve() == results.parent.resolve())
    _say_written("report", page, as_json)


def _write_page(tree: xr.DataTree, page: Path, beside: bool) -> None:
    """Write the page; beside its result it is one of the files whose checksums are noted."""
    from bayesoleo._report.page import write_report
    from bayesoleo._storage.files import only_writer, read_sums, settle, sweep, together

    with only_writer(page.parent):
        settle(page.parent)
        sweep(page.parent, [page.name])
        if beside and page.name == PAGE and read_sums(page.parent):
            with together(page.parent, [PAGE], keep=True) as draft:
                write_report(tree, draft / PAGE)
        else:
            write_report(tree, page)


@options.of_settings("seed", "jobs", *options.SOLVED)
def simulate(
    source: Annotated[
        str,
        options.argument(
            "MODEL|RESULTS.nc", "Built-in system, file.py:object, or a result with its posterior."
        ),
    ],
    like: Annotated[
        Path,
        options.option(
            "--like",
            "CAMPAIGN",
            "Campaign whose runs, inputs, conditions and channels the new one has.",
            None,
        ),
    ],
    out: Annotated[
        Path,
        options.option("--out -o", "DIR", "Folder of the new campaign; must not hold files."),
    ],
    values: Annotated[
        list[str] | None,
        options.option("--set", "NAME=VALUE", "Parameter value in SI; may be repeated.", None),
    ] = None,
    noise: Annotated[
        list[str] | None,
        options.option(
            "--noise",
            "CHANNEL=VALUE",
            "Standard deviation of the noise of a channel in SI; may be repeated.",
            None,
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
    common_offset: Annotated[
        bool,
        typer.Option(
            "--common-offset",
            help="Add to outputs that drift the offset common to the runs fitted by the result.",
        ),
    ] = False,
    *,
    chosen: Settings,
    as_json: options.Json = False,
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
    from bayesoleo import _workflow as workflow
    from bayesoleo._storage.files import only_writer
    from bayesoleo._storage.result_files import read_tree
    from bayesoleo._workflow.model_files import load_model
    from bayesoleo.data._campaign import is_vacant

    if out.is_dir() and not is_vacant(out):
        raise InputError("folder is not empty", file=out, hint="choose another with --out")
    shell.check_writable(out)
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
    more: dict[str, Any] = {"noise": amounts} if amounts else {}
    if common_offset:
        more["common_offset"] = True
    with only_writer(out):
        folder = workflow.simulate(
            made_from, like, chosen, out=out, values=changed, draws=draws, **more
        )
    _say_written("campaign", folder, as_json)


def _say_written(what: str, path: Path, as_json: bool) -> None:
    if as_json:
        shell.print_json({what: path})
    else:
        shell.say(f"{what:<10}{path}")


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
