"""How good an estimate is: ``assess`` tests its residuals, ``replicate`` repeats its experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bayesoleo import schema
from bayesoleo.cli import options, shell, tables

PANEL = "How good an estimate is"


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, PANEL, assess, replicate)


def assess(
    results: Annotated[
        Path,
        typer.Argument(
            metavar="RESULTS.nc", show_default=False, help="results.nc of close or trace."
        ),
    ],
    stage: Annotated[
        str | None,
        typer.Option(
            metavar="before|after",
            show_default="after, where there is one",
            help="The model as declared, or as extended.",
        ),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(
            "--figure",
            metavar="FILE.png",
            show_default=False,
            rich_help_panel=options.OUTPUT,
            help="Draw the assessment; one file an output, its name added.",
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Test the residuals of a result: signs, normality, phase, variables, outliers, lack of fit.

    One line for each output and run. A star marks what chance alone hardly gives. "over noise" is
    what repeats from period to period over the noise of that average, "same phase" the correlation
    of residuals of one phase in different periods, "memory" the number of samples that hold the
    information of one.

    \b
    Examples:
      bayesoleo assess bayesoleo-shaker/results.nc
      bayesoleo assess results.nc --stage before --figure before.png
    """
    from bayesoleo import plots
    from bayesoleo.assessment import assess as test_residuals
    from bayesoleo.storage import read_tree

    if figure is not None:
        shell.check_writable(figure.parent)
    found = test_residuals(read_tree(results), stage=stage)
    if as_json:
        numbers = found.data[[name for name, v in found.data.items() if v.ndim == 2]]
        shell.print_json(tables.plain(numbers.to_dict()))
    else:
        shell.console().print(str(found), markup=False, soft_wrap=True)
    if figure is not None:
        for output in found.data[schema.OUTPUT].values:
            path = figure.with_stem(f"{figure.stem}-{output}")
            plots.assessment(found.data, str(output)).savefig(path)


def replicate(
    campaign: options.CampaignPath,
    model: options.ModelText,
    out: options.Out = None,
    replications: Annotated[
        int,
        typer.Option(
            "--replications", "-n", min=2, metavar="N", help="Number of simulated experiments."
        ),
    ] = 1000,
    runs: Annotated[
        str | None,
        typer.Option(metavar="A,B,…", show_default="all to be fitted", help="Labels of the runs."),
    ] = None,
    true_inputs: Annotated[
        bool, typer.Option("--true-inputs", help="Leave the measured inputs as they are.")
    ] = False,
    seed: options.Seed = 0,
    jobs: options.Jobs = None,
    quiet: options.Quiet = False,
    drive: options.Drive = None,
    scheme: options.Scheme = "radau3",
    steps: options.Steps = None,
) -> None:
    """Repeat an experiment by simulation and compare the scatter of the estimates with theory.

    The model is estimated once; its predictions with new noise, of the size that the records show,
    are estimated again and again. Bias, standard deviation, what linearisation expects, and the
    least that is possible (Cramér and Rao) are printed. With --out finished blocks are kept, and
    the same command goes on where it was stopped.

    \b
    Examples:
      bayesoleo replicate shaker --model f16n2d2 --runs d -n 1000 --out scatter
    """
    from bayesoleo import workflow
    from bayesoleo.errors import CampaignError
    from bayesoleo.estimation import sampling_distribution
    from bayesoleo.modelfile import load_model
    from bayesoleo.tracing.fit import fit_model

    if out is not None:
        shell.check_writable(out)
    chosen = options.settings(seed=seed, jobs=jobs, drive=drive, scheme=scheme, steps=steps)
    task = workflow.prepare(campaign, load_model(model), chosen)
    records = list(task.roles.fitted)
    if runs is not None:
        wanted = [label.strip() for label in runs.split(",")]
        records = [task.reduced.record(label) for label in wanted]
    if not records:
        raise CampaignError("no run is left", key="--runs", value=runs)
    with shell.stoppable(out):
        fit = fit_model(
            task.assembly.model(), records, chosen.numerics, progress=shell.teller(quiet)
        )
        found = sampling_distribution(
            fit.problem,
            fit.point,
            replications=replications,
            input_noise=not true_inputs,
            seed=seed,
            out=out,
            jobs=jobs,
            progress=shell.progress_shown(quiet),
        )
    shell.console().print(str(found), markup=False, soft_wrap=True)
