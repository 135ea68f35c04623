"""The campaign of a session, and the line that shows progress.

Runs are reduced once, when they are first needed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import cached_property

import xarray as xr
from matplotlib.figure import Figure
from tqdm.auto import tqdm

from bayesoleo import _schema as schema, _workflow as workflow, data
from bayesoleo._display import columns
from bayesoleo._session import display as figures
from bayesoleo._session.display import html
from bayesoleo.data._reduction import ReducedCampaign
from bayesoleo.discovery._result_tree import records_tree
from bayesoleo.plots._style import format_value

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
    >>> from bayesoleo._workflow.simulating import demo_campaign
    >>> campaign = load_campaign(demo_campaign(mkdtemp()))
    >>> round(float(campaign.frequencies.sel(run="j")), 3)
    2.0
    """

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
