"""Trends over a record: does the mean or the amplitude of a channel move from period to period.

A record that drifts is no periodic equilibrium. Its average over periods is then of a motion that
never was, and the drift counts as noise (Verbeek 1993 notes the slow drift of the gas pressure).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, stats

from bayesoleo._types import Array
from bayesoleo.data.averaging import periodic_average
from bayesoleo.prediction.records import Record

#: Probability of flagging any channel of a run without drift.
FALSE_ALARM = 1e-3
#: Least change over the record, in standard deviations of a single sample, that is worth a word.
LEAST_CHANGE = 0.2
_BINS = 24


@dataclass(frozen=True)
class Drift:
    """Trend of one channel over a record.

    Parameters
    ----------
    channel : str
    mean, mean_sd : float
        Change of the mean from the beginning to the end of the record, and its standard deviation,
        SI.
    amplitude, amplitude_sd : float
        Relative change of the amplitude of the periodic part, and its standard deviation.
    noise : float
        Standard deviation of a single sample about the average over periods, SI.
    swing : float
        Root mean square of the periodic part about its mean, SI.
    """

    channel: str
    mean: float
    mean_sd: float
    amplitude: float
    amplitude_sd: float
    noise: float
    swing: float

    @property
    def p_value(self) -> float:
        """Probability of a trend as large, of mean or amplitude, in a record without one."""
        scores = abs(self.mean) / self.mean_sd, abs(self.amplitude) / self.amplitude_sd
        return min(1.0, float(2 * 2 * stats.norm.sf(max(scores))))

    @property
    def change(self) -> float:
        """Larger change of the two, in standard deviations of a single sample."""
        return max(abs(self.mean), abs(self.amplitude) * self.swing) / self.noise


def drift(values: Array, time_step: float, frequency: float, channel: str = "") -> Drift:
    """Fit a linear trend to the mean and to the amplitude of a periodic signal.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Over two periods or more.
    time_step : float
        Sampling interval, s.
    frequency : float
        Hz.
    channel : str, optional
        Name of the signal.

    Returns
    -------
    Drift
        Standard deviations allow for the colour of the noise.
    """
    signal = np.asarray(values, dtype=float)
    average = periodic_average(signal, time_step, frequency)
    swing = average.values - average.values.mean()
    rms = float(np.sqrt(np.mean(swing**2)))
    time = (np.arange(signal.size) - 0.5 * (signal.size - 1)) / signal.size
    shapes = np.stack((time, time * swing))
    # What the average can absorb of a trend is not left in the residual.
    columns = np.stack([s - periodic_average(s, time_step, frequency).values for s in shapes])
    rest = signal - average.values
    # In units of their own, or the amplitude's column vanishes beside that of the mean.
    length = np.sqrt(np.mean(columns**2, axis=1, keepdims=True))
    length[length == 0] = 1.0
    inverse = np.linalg.pinv(columns / length).T
    found = inverse @ rest
    noise = rest - found @ (columns / length)
    sd = np.array([_coloured_sd(row, noise) for row in inverse])
    change, error = found / length[:, 0], np.maximum(sd / length[:, 0], 1e-300)
    return Drift(
        channel=channel,
        mean=float(change[0]),
        mean_sd=float(error[0]),
        amplitude=float(change[1]),
        amplitude_sd=float(error[1]),
        noise=max(average.sigma, 1e-300),
        swing=rms,
    )


def record_drifts(record: Record) -> tuple[Drift, ...]:
    """Trend of every channel of a periodic run; none for a transient."""
    if not record.periodic:
        return ()
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    return tuple(
        drift(values, step, record.frequency, name) for name, values in record.samples.items()
    )


def drifting(record: Record) -> tuple[Drift, ...]:
    """Channels whose trend is larger than chance makes it, and large enough to matter."""
    found = record_drifts(record)
    return tuple(
        item
        for item in found
        if item.p_value * len(found) < FALSE_ALARM and item.change > LEAST_CHANGE
    )


def _coloured_sd(weights: Array, noise: Array) -> float:
    """Standard deviation of ``weights @ noise`` by the noise's own smoothed spectrum."""
    samples = noise.size
    transfer = np.abs(fft.rfft(weights)) ** 2
    spectrum = np.abs(fft.rfft(noise)) ** 2 / samples
    width = np.ones(min(2 * _BINS + 1, spectrum.size))
    smooth = np.convolve(spectrum, width, "same")
    # Bins on the harmonics are empty: the average over periods has taken them.
    used = np.convolve((spectrum > 1e-12 * spectrum.max(initial=0.0)).astype(float), width, "same")
    double = np.full(transfer.size, 2.0)
    double[0] = 1.0
    if samples % 2 == 0:
        double[-1] = 1.0
    return float(np.sqrt(np.sum(double * transfer * smooth / np.maximum(used, 1.0)) / samples))
