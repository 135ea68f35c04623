"""Channels of transients that show nothing but the noise of their sensor.

A free decay is recorded with its force channel, which then holds the noise of the load cell alone.
Its spectrum is flat, as that of a random excitation is, so that the record itself cannot say which
of the two it is; taken for a force it would move the model. Other runs of the campaign can: the
noise of a sensor is what does not repeat in its periodic runs, or the floor of its spectrum where a
transient's signal lies below it in frequency.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayesoleo.prediction._band_limited import band_limited_channels
from bayesoleo.prediction._records import Record

#: Part of a channel's deviation that the floor of its spectrum is, from which the spectrum is flat:
#: floors are estimated from the lowest part, and lie a tenth or two too low for short records.
FLAT = 0.7
#: Deviation over that of the sensor's noise up to which there is nothing else: with a signal of the
#: same size it would be 1.4, and a floor may be a tenth or two too low.
NOTHING_ELSE = 1.25
#: Part of a run's signal below which what does not repeat in it counts as noise of the sensor.
LITTLE = 0.1


def noise_of_channels(records: Sequence[Record]) -> dict[str, float]:
    """Standard deviation of a sample by channel, as far as some run tells it, SI.

    The smallest counts: what does not repeat in a run may be more than its sensor's noise, and a
    sensor with a wider range may be noisier. Where it is not small against the signal it may be a
    motion that does not repeat.

    Parameters
    ----------
    records : sequence of Record
    """
    found: dict[str, list[float]] = {}
    for record in records:
        for channel, noise in record.signal_noise.items():
            curve = record.smoothed.get(channel)
            told = record.periodic or (curve is not None and curve.noise > 0.0)
            size = float(np.std(record.samples[channel]))
            if told and 0.0 < noise < LITTLE * size:
                found.setdefault(channel, []).append(float(noise))
    return {channel: min(values) for channel, values in found.items()}


def quiet_channels(record: Record, noise: Mapping[str, float]) -> dict[str, float]:
    """Channels of a transient that show nothing but noise, with its standard deviation.

    Parameters
    ----------
    record : Record
    noise : mapping of str to float
        Of :func:`noise_of_channels`.
    """
    if record.periodic:
        return {}
    counts = slice(None) if record.kept is None else record.kept
    found = {}
    for channel, known in noise.items():
        if channel not in record.samples:
            continue
        size = float(np.std(record.samples[channel][counts]))
        flat = record.signal_noise.get(channel, 0.0) > FLAT * size
        if flat and size <= NOTHING_ELSE * known:
            found[channel] = known
    return found


def with_quiet_channels(records: Sequence[Record]) -> tuple[Record, ...]:
    """The records, with constants for channels that show nothing but noise."""
    noise = noise_of_channels(records)
    return tuple(_at_rest(one, quiet_channels(one, noise)) for one in records)


def _at_rest(record: Record, quiet: Mapping[str, float]) -> Record:
    if not quiet:
        return record
    counts = slice(None) if record.kept is None else record.kept
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    means = {name: float(np.mean(record.samples[name][counts])) for name in quiet}
    level = {name: np.full(record.time.size, value) for name, value in means.items()}
    curves = {**record.smoothed, **band_limited_channels(level, step)}
    return replace(record, smoothed=curves, signal_noise={**record.signal_noise, **quiet})
