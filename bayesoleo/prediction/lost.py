"""What of its inputs a model does not get, beyond noise.

An input is cut off where its spectrum has fallen to a floor. In a periodic run it counts by its
harmonics. In a transient it is a straight line over stretches that are masked. Each of these leaves
something out, which is noise only if it is flat, if no output answers to it, or if it is small
beside noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo.prediction.band_limited import answered
from bayesoleo.prediction.inputs import highest_derivatives
from bayesoleo.prediction.records import Harmonics, Record
from bayesoleo.prediction.smoothing import Smoothed

#: Part of what an input holds, as root mean squares, that is worth a word.
_PART = 0.05
#: Noise levels that a straight line has to miss the signal by.
_MISSED = 3.0
#: Windows of a masked stretch's length that are looked at elsewhere.
_WINDOWS = 64


@dataclass(frozen=True)
class Lost:
    """Part of an input that a model does not get.

    Parameters
    ----------
    run, channel : str
    why : str
        ``floor``, ``repeating`` or ``masked``.
    derivative : int
        Of which the figures are.
    lost, held : float
        Root mean square of what is left out and of what stays, SI.
    where : float
        Frequency in Hz from which on it is left out; of a masked stretch its length, s.
    """

    run: str
    channel: str
    why: str
    derivative: int
    lost: float
    held: float
    where: float


def lost_inputs(
    rows: tuple[tuple[str, int], ...], outputs: Sequence[str], records: Sequence[Record]
) -> tuple[Lost, ...]:
    """What of the inputs is left out, by run.

    Parameters
    ----------
    rows : tuple of (str, int)
        Input rows of the model.
    outputs : sequence of str
        Channels that may answer.
    records : sequence of Record
    """
    return tuple(
        item
        for record in records
        for channel, order in highest_derivatives(rows).items()
        if channel in record.signals
        for item in _of_channel(record, channel, order, outputs)
    )


def _of_channel(record: Record, channel: str, order: int, outputs: Sequence[str]) -> Iterator[Lost]:
    item = record.signals[channel]
    if isinstance(item, Harmonics):
        yield from _not_repeating(record, channel, item, outputs)
    elif isinstance(item, Smoothed):
        band = item.for_derivative(order).band
        if band is not None and band.lost > _PART * band.held:
            yield Lost(record.label, channel, "floor", order, band.lost, band.held, band.cut)
        yield from _masked(record, channel, item)


def _not_repeating(
    record: Record, channel: str, item: Harmonics, outputs: Sequence[str]
) -> Iterator[Lost]:
    """What differs between the periods, where an output differs with it."""
    if record.kept is not None:
        return
    mean = item.evaluate(record.phase, record.frequency)
    rest = record.samples[channel] - mean
    if np.std(rest) <= _PART * np.std(mean):
        return
    step = (record.time[-1] - record.time[0]) / (record.time.size - 1)
    others = [
        record.samples[name] - record.harmonics[name].evaluate(record.phase, record.frequency)
        for name in outputs
        if name in record.harmonics and name != channel
    ]
    if answered(rest, others, float(step), 0.0):
        yield Lost(
            record.label, channel, "repeating", 0, float(np.std(rest)), float(np.std(mean)), 0.0
        )


def _masked(record: Record, channel: str, item: Smoothed) -> Iterator[Lost]:
    """How far straight lines miss the signal where nothing is masked, over the longest stretch."""
    if record.kept is None:
        return
    edges = np.flatnonzero(np.diff(np.concatenate([[1], record.kept.astype(np.int8), [1]])))
    longest = int((edges[1::2] - edges[::2]).max()) + 1
    starts = np.linspace(0, record.time.size - longest - 1, _WINDOWS).astype(int)
    place = np.arange(longest + 1)
    missed = [
        values - np.interp(place, [0, longest], values[[0, -1]])
        for start in starts
        if record.kept[start : start + longest + 1].all()
        for values in [record.samples[channel][start : start + longest + 1]]
    ]
    if not missed:
        return
    size, noise = float(np.sqrt(np.mean(np.square(missed)))), record.signal_noise[channel]
    held = float(np.std(record.samples[channel][record.kept]))
    if size > max(_MISSED * noise, _PART * held):
        step = (record.time[-1] - record.time[0]) / (record.time.size - 1)
        yield Lost(record.label, channel, "masked", 0, size, held, float(longest * step))
