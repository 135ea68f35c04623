"""Rows of inputs and their exact derivatives, at any phase of a record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import CampaignError
from bayesoleo.model.expressions import COSINE, SINE, WITHIN
from bayesoleo.prediction.records import Harmonics, Record, Signal


def harmonics_of(record: Record, channel: str) -> Harmonics:
    """A channel's periodic representation.

    Raises
    ------
    CampaignError
        If the record lacks the channel.
    """
    if channel not in record.harmonics:
        restricted = _restricted(record, channel)
        if isinstance(restricted, Harmonics):
            return restricted
        raise CampaignError(
            f"the model needs channel {channel!r}",
            run=record.label,
            hint=f"channels there are: {', '.join(record.harmonics) or 'none'}",
        )
    return record.harmonics[channel]


def signal_of(record: Record, channel: str, highest: int = 0) -> Signal:
    """What a channel is as an input, periodic or not.

    Parameters
    ----------
    record : Record
        A run.
    channel : str
        Of it.
    highest : int
        The highest derivative that is taken of the channel: noise grows with it, so that less of
        what is near the noise may stay.

    Raises
    ------
    CampaignError
        If the record lacks the channel.
    """
    if channel not in record.signals:
        restricted = _restricted(record, channel)
        if restricted is not None:
            return restricted.for_derivative(highest)
        raise CampaignError(
            f"the model needs channel {channel!r}",
            run=record.label,
            hint=f"channels there are: {', '.join(record.signals) or 'none'}",
        )
    return record.signals[channel].for_derivative(highest)


def highest_derivatives(rows: tuple[tuple[str, int], ...]) -> dict[str, int]:
    """The highest derivative that is taken of each channel of some rows."""
    highest: dict[str, int] = {}
    for channel, derivative in rows:
        highest[channel] = max(derivative, highest.get(channel, 0))
    return highest


def _restricted(record: Record, name: str) -> Signal | None:
    """One channel at the harmonics of another, as :func:`~bayesoleo.model.expressions.within`
    names it; of a transient, the channel itself."""
    channel, _, other = name.partition(WITHIN)
    if channel in (COSINE, SINE) and other in record.harmonics:
        return _turning(record.harmonics[other], channel)
    if channel not in record.signals or other not in record.signals:
        return None
    if not record.periodic:
        return record.signals[channel]
    item = record.harmonics[channel]
    like = record.harmonics[other]
    kept = np.isin(item.orders, like.orders)
    return replace(
        item,
        limits=like.limits,
        orders=item.orders[kept],
        coefficients=item.coefficients[kept],
        variances=item.variances[kept],
    )


def _turning(item: Harmonics, part: str) -> Harmonics | None:
    """The first harmonic with unit amplitude, or a quarter of a turn behind it."""
    first = np.flatnonzero(item.orders == 1)
    if first.size == 0 or item.coefficients[first[0]] == 0:
        return None
    c, variance = item.coefficients[first], item.variances[first]
    quarter = 1.0 if part == COSINE else -1j
    size = np.abs(c)
    return Harmonics(item.orders[first], quarter * c / size, variance / size**2)


#: Rows computed before, by grid, channel, derivative and the highest that the model takes; models
#: of the same run share them.
RowCache = dict[tuple[str, str, int, int], Array]


def input_rows(
    record: Record,
    rows: tuple[tuple[str, int], ...],
    phase: Array,
    grid: str = "",
    cache: RowCache | None = None,
) -> Array:
    """Values of input rows ``(channel, derivative)``, shape (nu, N).

    Parameters
    ----------
    record : Record
        A run.
    rows : tuple of (str, int)
        As in :class:`~bayesoleo.model.derive.Derived`; the channel ``time`` gives seconds since the
        first sample.
    phase : ndarray, shape (N,)
        Cycles since the first sample; of a transient, parts of its length.
    grid : str
        Names ``phase`` in the cache.
    cache : dict, optional
        Taken from and added to.
    """
    known = {} if cache is None else cache
    highest = highest_derivatives(rows)
    table = np.empty((len(rows), phase.size))
    for k, (channel, derivative) in enumerate(rows):
        if channel == "time":
            table[k] = phase / record.rate
        else:
            key = (grid, channel, derivative, highest[channel])
            if key not in known:
                item = signal_of(record, channel, highest[channel])
                known[key] = item.evaluate(phase, record.rate, derivative)
            table[k] = known[key]
    return table
