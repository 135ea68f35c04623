"""The campaign of a session, its computations with a model, and the line that shows progress.

Runs are reduced once, when they are first needed. The computations call the workflow's functions.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from tqdm.auto import tqdm

from bayesoleo import _schema as schema, _workflow as workflow, data
from bayesoleo._schema import LabelledResult, columns
from bayesoleo._session import display as figures
from bayesoleo._session.display import html
from bayesoleo._workflow.closing import draw_final, search, written
from bayesoleo._workflow.estimating import draw, drawn_groups, estimated
from bayesoleo._workflow.output import ResultFolder, Stages, finish
from bayesoleo._workflow.predicting import predict
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.simulating import demo_campaign, to_simulated_run
from bayesoleo._workflow.task import Source, Task, checked, reduce, silent
from bayesoleo.data._reduction import ReducedCampaign
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._loop import ClosedLoop
from bayesoleo.discovery._open_questions import Question
from bayesoleo.discovery._result_tree import fitted_groups, point_group, records_tree
from bayesoleo.errors import InputError, choose, number_of
from bayesoleo.estimation._problem import EstimationProblem
from bayesoleo.model._model import Model
from bayesoleo.plots._style import format_unit, format_value
from bayesoleo.prediction._simulate import RunPlan, simulate_run
from bayesoleo.systems._systems import equations

#: Seconds before anything is shown.
DELAY = 2.0


@contextmanager
def status_line(progress: bool) -> Iterator[Callable[[str], None]]:
    """A line that shows what is being done and for how long.

    Parameters
    ----------
    progress : bool
        Whether to show it.

    Yields
    ------
    callable
        Takes the text of the line.
    """
    form = "{desc} [{elapsed}]"
    options = {"delay": DELAY, "miniters": 1, "mininterval": 0.0}
    with tqdm(bar_format=form, leave=False, disable=not progress, **options) as bar:

        def say(text: str) -> None:
            bar.set_description_str(text, refresh=False)
            bar.update()

        yield say


class Campaign(data.CampaignData):
    """A measured campaign: runs, channels, frequencies and noise.

    Made by :func:`load_campaign`. Parameters are those of :class:`bayesoleo.data.CampaignData`.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> campaign = Campaign.demo(mkdtemp())
    >>> round(float(campaign.frequencies.sel(run="j")), 3)
    2.0
    """

    @classmethod
    def demo(cls, folder: str | os.PathLike[str], seed: int = 0) -> Campaign:
        """Simulate the campaign of ``bayesoleo demo``: six runs of an oleo with Stribeck friction.

        Parameters
        ----------
        folder : path-like
            Where it is written; must be empty.
        seed : int
            Of the noise and of the scatter between runs.

        Returns
        -------
        Campaign
        """
        return load_campaign(demo_campaign(folder, seed))

    @classmethod
    def simulate(
        cls,
        folder: str | os.PathLike[str],
        model: Model,
        plans: Sequence[RunPlan],
        values: Mapping[str, float] | None = None,
        *,
        noise: Mapping[str, float] | None = None,
        seed: int = 0,
    ) -> Campaign:
        """Simulate periodic runs with a model and write them as a campaign.

        Parameters
        ----------
        folder : path-like
            Where it is written; must be empty.
        model : Model
            Its first input becomes the controlled channel.
        plans : sequence of RunPlan
            One for each run.
        values : mapping of str to float, optional
            Parameters that are not at their nominal value, SI.
        noise : mapping of str to float, optional
            Standard deviation of the measurement noise by channel, SI.
        seed : int
            Of the noise.

        Returns
        -------
        Campaign

        Examples
        --------
        >>> from tempfile import mkdtemp
        >>> from bayesoleo import system
        >>> from bayesoleo.prediction import RunPlan, motion
        >>> plan = RunPlan("a", 1.0, {"force": motion(0.0, [2.0])})
        >>> [run.label for run in Campaign.simulate(mkdtemp(), system("duffing"), [plan]).runs]
        ['a']
        """
        units = {name: item.unit for name, item in model.conditions.items()}
        streams = np.random.default_rng(seed).spawn(len(plans))
        runs = [
            to_simulated_run(simulate_run(model, plan, values, noise=noise, rng=rng), units)
            for plan, rng in zip(plans, streams, strict=True)
        ]
        channels = {**model.inputs, **{name: item.unit for name, item in model.outputs.items()}}
        data.write_campaign(
            folder,
            name=f"{model.name} simulated",
            controlled=next(iter(model.inputs), None),
            channels={name: (name, unit) for name, unit in channels.items()},
            runs=runs,
        )
        return load_campaign(folder)

    @cached_property
    def reduced(self) -> ReducedCampaign:
        """Runs reduced to whole periods, with harmonics and noise."""
        return workflow.reduce(self, progress=DELAY)

    @cached_property
    def _groups(self) -> dict[str, xr.Dataset]:
        return records_tree(self.reduced.records, self)

    @property
    def frequencies(self) -> xr.DataArray:
        """Fundamental frequency of each run, Hz, with its standard deviation as a coordinate."""
        found = self._groups[schema.CONSTANT_DATA]
        return found[schema.FREQUENCY].assign_coords(sd=found[schema.FREQUENCY_SD])

    @property
    def noise(self) -> xr.Dataset:
        """Standard deviation of a single sample of each channel, by run, SI."""
        return self._groups[schema.NOISE]

    def plot(self) -> Figure:
        """Noise of each channel by run."""
        return figures.noise_and_frequency(self.noise)

    def __repr__(self) -> str:
        noise, units = self.noise, self.units
        head = ["run", "role", "group", "frequency", "periods", "samples"]
        head += [f"noise of {name}" for name in noise.data_vars]
        rows = []
        for record in self.reduced.records:
            row = [record.label, record.role, record.group]
            row += [f"{record.frequency:.5g} Hz" if record.periodic else "transient"]
            row += [str(record.periods) if record.periodic else "–", str(record.time.size)]
            values = (record.signal_noise[str(name)] for name in noise.data_vars)
            names = (str(name) for name in noise.data_vars)
            row += [format_value(v, units[n]) for n, v in zip(names, values, strict=True)]
            rows.append(row)
        control = f", {self.controlled} controlled" if self.controlled else ""
        return (
            f"campaign {self.name}: {number_of(len(rows), 'run')}{control}\n{columns(head, rows)}"
        )

    def _repr_html_(self) -> str:
        return html(repr(self), self.plot)


def load_campaign(path: str | os.PathLike[str], *, progress: bool = True) -> Campaign:
    """Load a campaign and check it.

    Parameters
    ----------
    path : path-like
        The campaign's folder, or its ``campaign.toml``.
    progress : bool, optional
        Whether to show a bar for a file that takes more than two seconds to read.

    Returns
    -------
    Campaign
        All runs, in SI. Frequencies and noise are measured when they are first asked for.

    Raises
    ------
    CampaignError
        If anything in it cannot be used; one line that says where, what, and what to write instead.

    Examples
    --------
    >>> campaign = load_campaign("shaker")  # doctest: +SKIP
    """
    found = data.load_campaign(path, progress=progress)
    return Campaign(**{item.name: getattr(found, item.name) for item in fields(found)})


#: Settings that may still be changed when the posterior is sampled, and in a search.
SAMPLING = ("seed", "jobs", "quick", "effective_size", "sampler", "scheduler")
SEARCHING = (
    "seed", "jobs", "quick", "scheduler", "max_effects", "effects", "without", "structure_prior",
)  # fmt: skip


def changed(
    settings: Settings, keywords: Mapping[str, Any], allowed: Sequence[str] | None = None
) -> Settings:
    """Settings with some of them changed.

    Parameters
    ----------
    settings : Settings
    keywords : mapping of str to object
        New values.
    allowed : sequence of str, optional
        Names that may be changed; by default all.

    Raises
    ------
    InputError
        If there is no such setting, or it belongs to an earlier step.
    """
    known = [item.name for item in fields(Settings)]
    for name, value in keywords.items():
        if name not in known:
            hint = choose(name, allowed or known)
            raise InputError("there is no such setting", key=name, value=value, hint=hint)
        if allowed is not None and name not in allowed:
            raise InputError(
                "cannot be changed at this step", key=name, value=value,
                hint=f"give it to the problem: bo.Problem(…, {name}={value!r})",
            )  # fmt: skip
    return replace(settings, **keywords)


Say = Callable[[str], None]


@dataclass(frozen=True)
class CampaignWork:
    """A campaign and a model that were brought together.

    Parameters
    ----------
    task : Task
    """

    task: Task

    @property
    def settings(self) -> Settings:
        """Seed, threads, drive and so on."""
        return self.task.settings

    def with_settings(self, settings: Settings) -> CampaignWork:
        """The same with other settings of later steps."""
        return CampaignWork(replace(self.task, settings=settings))

    def text(self) -> str:
        """Model, runs and parameters, as text."""
        about, model = self.task.about(), self.task.assembly.model()
        roles = self.task.roles
        lines = [f"model {about['model']}, driven by {about['drive']}"]
        lines += [f"  {text}" for text in equations(model).values()]
        held = [record.label for record in roles.held_out]
        lines.append(f"campaign {about['campaign']}: {roles.description}")
        lines.append(f"  fitted: {', '.join(record.label for record in roles.fitted)}")
        lines += [f"  held out: {', '.join(held)}"] if held else []
        rows = [
            [name, f"{item.value:.6g}", f"{item.prior.sd:.3g}", format_unit(item.unit) or "1"]
            for name, item in model.parameters.items()
            if item.prior is not None and name in model.estimated()
        ]
        return "\n".join([*lines, columns(["parameter", "start", "sd of prior", "unit"], rows)])

    def check(self) -> dict[str, Any]:
        """Facts as the command ``check`` prints them."""
        return checked(self.task)

    def fit(self, method: str, callback: Say) -> tuple[ModelFit, xr.DataTree]:
        """The estimate, and its tree."""
        stages = Stages(callback)
        fit, more = estimated(self.task, stages, method)
        tree = self.tree(fit, more)
        stages.finish(tree, None)
        return fit, tree

    def tree(self, fit: ModelFit, more: Mapping[str, xr.Dataset]) -> xr.DataTree:
        """The groups of the records, of the estimate and of what it leaves."""
        return finish(
            self.task, {schema.POINT: point_group(fit), **fitted_groups(fit), **more}, fit
        )

    def problem(self, fit: ModelFit) -> EstimationProblem:
        """The problem of the fitted runs; questions start from the estimate."""
        fit.problem.freeze(fit.point.theta)
        return fit.problem

    def sample(
        self, fit: ModelFit, tree: xr.DataTree, out: Path | None, progress: float
    ) -> xr.DataTree:
        """The tree with the posterior."""
        stages = Stages()
        drawn = draw(self.task, fit, out, silent, progress)
        groups = {name: tree[name].to_dataset() for name in tree.children}
        groups |= drawn_groups(fit, drawn, self.settings.seed, groups, stages)
        found = finish(self.task, groups, fit)
        return stages.finish(found, None)

    def predict(self, tree: xr.DataTree, data: Source | None, **options: Any) -> LabelledResult:
        """Runs of this or another campaign, foreseen by a result."""
        reduced = self.task.reduced if data is None else reduce(data, jobs=self.settings.jobs)
        given = {"jobs": self.settings.jobs, "scheme": self.settings.scheme, **options}
        return predict(tree, reduced, **given)

    def explain(self, out: Any, callback: Say) -> tuple[CampaignSearch, xr.DataTree]:
        """The closed loop without its posterior; it begins with an estimate that was made."""
        output, stages = ResultFolder.checked(out), Stages(callback)
        with output.alone():
            loop, questions = search(
                self.task, self.settings.max_effects, stages, output, resume=True
            )
            found = CampaignSearch(self, loop, questions)
            return found, written(self.task, loop, None, output, stages, questions)


@dataclass(frozen=True)
class CampaignSearch:
    """A finished search for missing effects.

    Parameters
    ----------
    before : CampaignWork
        With the model as declared.
    loop : ClosedLoop
    questions : tuple of Question
        What it left to be told apart.
    """

    before: CampaignWork
    loop: ClosedLoop
    questions: tuple[Question, ...]

    @property
    def work(self) -> CampaignWork:
        """With the model as extended."""
        return CampaignWork(replace(self.before.task, assembly=self.loop.final.assembly))

    @property
    def fit(self) -> tuple[ModelFit, xr.DataTree]:
        """Estimate of the extended model, and its tree."""
        fit = self.loop.final.fit
        return fit, self.work.tree(fit, {})

    def sample(self, settings: Settings, out: Path | None, progress: float) -> xr.DataTree:
        """The whole result, with the posterior of the extended model."""
        task, stages = replace(self.before.task, settings=settings), Stages()
        drawn = draw_final(task, self.loop, out, silent, progress)
        return written(task, self.loop, drawn, ResultFolder(None), stages, self.questions)


def check_text(facts: Mapping[str, Any]) -> str:
    """The facts of a check, one a line."""
    lines = []
    for key, value in facts.items():
        if key == "start":
            rows = [
                [one["output"], one["run"], one["status"], *map(_number, (one[c] for c in _START))]
                for one in value
            ]
            head = ["output", "run", "solution", "correlation", "predicted over measured"]
            lines += ["at the nominal values:", columns(head, rows)] if rows else []
        elif key == "data_warnings":
            lines += [f"note: {text}" for text in value]
        elif key == schema.FREQUENCY_RESPONSE:
            lines += value
        elif key != "format":
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            lines.append(f"{key.replace('_', ' ')}: {text}")
    return "\n".join(lines)


_START = ("correlation", "ratio")


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
