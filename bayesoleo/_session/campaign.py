"""The campaign of a session, and the line that shows progress.

Runs are reduced once, when they are first needed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import cached_property

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from tqdm.auto import tqdm

from bayesoleo import _schema as schema, _workflow as workflow, data
from bayesoleo._display import columns
from bayesoleo._session import display as figures
from bayesoleo._session.display import html
from bayesoleo._workflow.simulating import demo_campaign, to_simulated_run
from bayesoleo.data._reduction import ReducedCampaign
from bayesoleo.discovery._result_tree import records_tree
from bayesoleo.model._model import Model
from bayesoleo.plots._style import format_value
from bayesoleo.prediction._simulate import RunPlan, simulate_run

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
        return f"campaign {self.name}: {len(rows)} runs{control}\n{columns(head, rows)}"

    def _repr_html_(self) -> str:
        return html(repr(self), self.plot)


def load_campaign(path: str | os.PathLike[str]) -> Campaign:
    """Load a campaign and check it.

    Parameters
    ----------
    path : path-like
        The campaign's folder, or its ``campaign.toml``.

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
    found = data.load_campaign(path)
    return Campaign(**{item.name: getattr(found, item.name) for item in fields(found)})
