"""The commands that say how good an estimate is.

``assess`` tests its residuals, ``predict`` scores its predictions, ``replicate`` repeats its
experiment by simulation.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bayesoleo import _schema as schema
from bayesoleo._cli import options, shell
from bayesoleo._workflow.settings import Settings, words

if TYPE_CHECKING:
    import xarray as xr

    from bayesoleo.assessment._residual_breakdown import Series


PANEL = "How good an estimate is"
REPLICATIONS = "replications.nc"


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, PANEL, assess, predict, replicate)


def assess(
    results: options.ResultPath,
    stage: Annotated[
        str | None,
        options.option(
            "--stage",
            "before|after",
            "The model as declared, or as extended.",
            None,
            "after, where there is one",
        ),
    ] = None,
    figure: Annotated[
        Path | None, options.figure("Draw the assessment; one file an output, its name added.")
    ] = None,
    run: Annotated[
        str | None,
        options.option(
            "--run",
            "LABEL",
            "Draw the tests of this run instead, with the residual against every variable.",
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Test the residuals of a result: signs, normality, phase, variables, outliers, lack of fit.

    One line for each output and run. A star marks what chance alone hardly gives. "over noise" is
    what repeats from period to period over the noise of that average, "intraclass" the intraclass
    correlation of one phase in different periods, "corr. time" the autocorrelation time of what
    does not repeat, in samples.

    \b
    Examples:
      bayesoleo assess bayesoleo-shaker/results.nc
      bayesoleo assess results.nc --stage before --figure before.png
      bayesoleo assess results.nc --figure tests.png --run a
    """
    from bayesoleo._storage.result_files import read_tree
    from bayesoleo.assessment._assess import assess as test_residuals
    from bayesoleo.assessment._residual_breakdown import series_of_tree

    if figure is not None:
        shell.check_writable(figure.parent)
    series = series_of_tree(read_tree(results), stage)
    drawn = _drawn(series, figure, run)
    found = test_residuals(series)
    if as_json:
        shell.print_json(_numbers(found.data).to_dict())
    else:
        shell.say(found)
    if figure is not None:
        _draw(found.data, drawn, figure)


def _numbers(data: xr.Dataset) -> xr.Dataset:
    """The variables with one number for each output and run, and offsets of outputs."""
    offsets = ("offset", "offset_sd")
    return data[[name for name, item in data.items() if item.ndim == 2 or name in offsets]]


def _drawn(series: list[Series], figure: Path | None, run: str | None) -> list[Series]:
    """The series whose tests are to be drawn one by one; none for all runs together."""
    from bayesoleo.errors import ResultsError

    if run is None:
        return []
    labels = list(dict.fromkeys(one.run for one in series))
    if run not in labels:
        raise ResultsError(
            "there is no such run", key="--run", value=run, hint=f"there are {', '.join(labels)}"
        )
    if figure is None:
        raise ResultsError("nothing to draw it to", key="--run", hint="give --figure FILE.png")
    return [one for one in series if one.run == run]


def _draw(data: xr.Dataset, drawn: list[Series], figure: Path) -> None:
    """One file an output."""
    from bayesoleo import plots

    figures = {one.output: plots.residual_tests(one) for one in drawn}
    if not figures:
        outputs = [str(output) for output in data[schema.OUTPUT].values]
        figures = {output: plots.assessment(data, output) for output in outputs}
    for output, made in figures.items():
        shell.write_figure(made, _file_of(figure, str(output)))


def _file_of(figure: Path, output: str) -> Path:
    """The file of an output's figure; a name of a file cannot hold a slash."""
    return figure.with_stem(f"{figure.stem}-{schema.variable_name(output)}")


@options.of_settings("seed", "jobs", "disturbances")
def predict(
    results: Annotated[
        Path, options.argument("RESULTS.nc", "results.nc of estimate, sample or close.")
    ],
    campaign: options.CampaignPath,
    model: Annotated[
        str | None,
        options.option(
            "--model -m",
            "MODEL",
            "Another model with parameters of the same names, e.g. the specimen on another "
            "rig. A file is code, and is run.",
            None,
            "that of the result",
        ),
    ] = None,
    runs: Annotated[str | None, options.runs("all")] = None,
    draws: Annotated[int, typer.Option(min=2, metavar="N", help="Draws of the parameters.")] = 200,
    figure: Annotated[
        Path | None,
        options.figure("Draw bands and transforms; one file an output, its name added."),
    ] = None,
    common_offset: Annotated[
        bool,
        typer.Option(
            "--common-offset",
            help="Add to outputs that drift the offset that the fitted runs have in common.",
        ),
    ] = False,
    *,
    chosen: Settings,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Predict runs that were not used, with intervals, and score the prediction.

    Parameters are drawn from the posterior of the result, or from the normal distribution about its
    estimate; what it does not know, such as a parameter of a new run, from its prior. "rms"
    is what came, "expected" what the prediction thought would; the part of the samples within the
    interval, and the distance of their probability integral transform from uniform, say whether the
    prediction knew how good it was.

    \b
    Examples:
      bayesoleo predict point/results.nc shaker --runs c,h
      bayesoleo predict point/results.nc drops --model drop.py:model --figure drops.png
    """
    from bayesoleo import _workflow as workflow
    from bayesoleo._session.results import load_result
    from bayesoleo._workflow.model_files import load_model

    if figure is not None:
        shell.check_writable(figure.parent)
    found = load_result(results).predict(
        workflow.reduce(campaign, jobs=chosen.jobs, progress=shell.progress_shown(quiet)),
        model=None if model is None else load_model(model),
        runs=None if runs is None else words(runs),
        draws=draws,
        seed=chosen.seed,
        jobs=chosen.jobs,
        common_offset=common_offset,
        disturbances=chosen.disturbances,
    )
    if as_json:
        shell.print_json(_numbers(found.data).drop_vars(schema.TIME).to_dict())
    else:
        shell.say(found)
    if figure is not None:
        for output in found.data[schema.OUTPUT].values:
            shell.write_figure(found.plot(output=str(output)), _file_of(figure, str(output)))


@options.of_settings("seed", "jobs", "scheduler", *options.SOLVED)
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
    runs: Annotated[str | None, options.runs("all to be fitted")] = None,
    true_inputs: Annotated[
        bool, typer.Option("--true-inputs", help="Leave the measured inputs as they are.")
    ] = False,
    *,
    chosen: Settings,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Repeat an experiment by simulation and compare the scatter of the estimates with theory.

    The model is estimated once; its predictions with new noise, of the size that the records show,
    are estimated again and again. Bias, standard deviation, what linearisation expects, and the
    least that is possible (Cramér and Rao) are printed. With --out finished blocks are kept, from
    which the same command goes on where it was stopped, and all of it is in replications.nc.

    \b
    Examples:
      bayesoleo replicate shaker --model f16n2d2 --runs d -n 1000 --out scatter
      bayesoleo replicate shaker --model f16n2d2 --out scatter --scheduler tcp://10.0.0.1:8786
    """
    from bayesoleo import _workflow as workflow
    from bayesoleo._workflow.model_files import load_model
    from bayesoleo.discovery._fit import fit_model
    from bayesoleo.errors import CampaignError
    from bayesoleo.estimation._sampling_distribution import sampling_distribution

    if out is not None:
        shell.check_writable(out)
    task = workflow.prepare(campaign, load_model(model), chosen)
    records = list(task.roles.fitted)
    if runs is not None:
        records = [task.reduced.record(label) for label in words(runs)]
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
            seed=chosen.seed,
            out=out,
            jobs=chosen.jobs,
            scheduler=chosen.scheduler,
            progress=shell.progress_shown(quiet),
        )
    if as_json:
        shell.print_json(found.data.drop_dims("replication", errors="ignore").to_dict())
    else:
        shell.say(found)
    if out is not None:
        groups = {schema.SAMPLING_DISTRIBUTION: found.data}
        about = {schema.COMMAND: chosen.command, schema.MODEL: fit.model.name}
        shell.write_groups(groups, out / REPLICATIONS, chosen.seed, **about)
        if not as_json:
            shell.say(f"result    {out / REPLICATIONS}")
