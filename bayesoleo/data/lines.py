"""Lines between the harmonics: something periodic that the drive does not make, such as a pump, the
mains or a motor.

A periodic force at a harmonic of the drive cannot be told, in one run, from any other law that
repeats with it. At a foreign frequency it does not repeat, counts as noise, and shows as a line in
the spectrum of what the average over periods leaves. So it is no candidate effect but a finding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage, stats

from bayesoleo._types import Array
from bayesoleo.data.averaging import periodic_average
from bayesoleo.prediction.records import Record

#: Probability of naming a line in any channel of a run that has none.
FALSE_ALARM = 1e-3
#: Least amplitude, in standard deviations of a single sample, that is worth a word.
LEAST_AMPLITUDE = 0.2
#: And in ranges of the channel: what no converter resolves is rounding of a signal without noise.
LEAST_SHARE = 2.0**-24
#: Lines on either side from whose median the level of the noise is taken, and periods over the
#: record below which a line may be drift.
_BESIDE, _FEWEST = 50, 3


@dataclass(frozen=True)
class SpectralLine:
    """A line between the harmonics.

    Parameters
    ----------
    channel : str
    frequency : float
        Hz.
    amplitude : float
        SI.
    noise : float
        Standard deviation of a single sample about the average over periods, SI.
    p_value : float
        Probability of one as high anywhere in the spectrum of noise (Fisher 1929, Proc. R. Soc. A
        125, for a level that varies).
    """

    channel: str
    frequency: float
    amplitude: float
    noise: float
    p_value: float


def foreign_line(
    values: Array, time_step: float, frequency: float, channel: str = ""
) -> SpectralLine | None:
    """The highest line between the harmonics of a periodic signal.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Over two periods or more.
    time_step : float
        Sampling interval, s.
    frequency : float
        Fundamental frequency, Hz.
    channel : str, optional
        Name of the signal.

    Returns
    -------
    SpectralLine or None
        None where the record is too short for a line to stand out.
    """
    average = periodic_average(values, time_step, frequency)
    left = np.asarray(values) - average.values
    # Over whole periods the average takes the lines at harmonics, and no other ones.
    power = np.abs(np.fft.rfft(left)) ** 2
    place = np.arange(power.size) * (frequency * left.size * time_step) ** -1
    free = np.abs(place - np.round(place)) * frequency * left.size * time_step > 0.75
    free[:_FEWEST] = False
    lines = np.flatnonzero(free)
    if lines.size < 2 * _BESIDE or not power[lines].any():
        return None
    # Of exponential powers the median is ln 2 of the mean.
    level = ndimage.median_filter(power[lines], 2 * _BESIDE + 1, mode="reflect") / np.log(2.0)
    ratio = power[lines] / np.maximum(level, 1e-6 * power[lines].mean())
    best = int(np.argmax(ratio))
    k = int(lines[best])
    amplitude = 2.0 * float(np.sqrt(power[k])) / left.size
    # A median scatters as a mean of half as many would: the ratio has nearly an F distribution.
    p = float(-np.expm1(lines.size * np.log1p(-stats.f.sf(ratio[best], 2, _BESIDE))))
    return SpectralLine(
        channel, k / (left.size * time_step), amplitude, max(average.sigma, 1e-300), p
    )


def foreign_lines(record: Record) -> tuple[SpectralLine, ...]:
    """Channels of a periodic run with a line that is higher than chance makes it, and matters."""
    if not record.periodic:
        return ()
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    found = (
        foreign_line(values, step, record.frequency, name)
        for name, values in record.samples.items()
    )
    return tuple(
        line
        for line in found
        if line is not None
        and line.p_value * len(record.samples) < FALSE_ALARM
        and line.amplitude > LEAST_AMPLITUDE * line.noise
        and line.amplitude > LEAST_SHARE * np.ptp(record.samples[line.channel])
    )
