"""What a rig can do: amplitude, frequency and mean of the motion that it imposes, and how far it
and the specimen may go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.prediction.records import Harmonics, Record
from bayesoleo.prediction.simulate import motion

Range = tuple[float, float]

#: Points of a period at which a motion is looked at.
POINTS = 256
#: A mean below this part of the amplitude is none.
ROUND_OFF = 1e-9
#: A mean of the runs below this part of the amplitude is not proposed: no rig is set that finely.
NO_MEAN = 1e-3
#: Part of a motion's power that its fundamental must hold to be taken as a sine.
NEARLY_A_SINE = 0.9
#: Values tried of frequency and amplitude, each a constant factor apart, and of the mean.
FREQUENCIES, AMPLITUDES, MEANS = 6, 6, 3
#: Travel, rate and outputs may go beyond those of the runs by this part of their range: the motion
#: tried is not the measured one to the last harmonic.
BEYOND = 0.1
#: What limits can be given of the motion; any other name is an output.
MOTION = ("amplitude", "frequency", "mean", "travel", "rate")


@dataclass(frozen=True)
class Limits:
    """What a rig can do with the channel that drives the model.

    Parameters
    ----------
    amplitude : (float, float)
        Half of what lies between the largest and the smallest value, SI.
    frequency : (float, float)
        Fundamental, Hz.
    mean : (float, float)
        Mean value over a period, SI.
    travel : (float, float)
        What the motion must stay within, SI.
    rate : (float, float)
        What its largest rate of change must stay within, SI per second.
    outputs : mapping of str to (float, float)
        What each output is foreseen to stay within, SI.
    """

    amplitude: Range
    frequency: Range
    mean: Range
    travel: Range
    rate: Range
    outputs: Mapping[str, Range] = field(default_factory=dict)

    @classmethod
    def of(cls, records: Sequence[Record], drive: str, outputs: Sequence[str]) -> Limits:
        """What the rig did in the runs that there are.

        Parameters
        ----------
        records : sequence of Record
            Periodic runs.
        drive : str
            The channel that drives the model.
        outputs : sequence of str
            Channels that the model predicts.
        """
        moves = [Motion.of(record, drive) for record in records]
        seen = {
            name: _about([float(f(r.samples[name])) for r in records for f in (np.min, np.max)])
            for name in outputs
        }
        return cls(
            _between([move.amplitude for move in moves]),
            _between([record.frequency for record in records]),
            _between([move.mean for move in moves]),
            _about([edge for move in moves for edge in (move.lowest, move.highest)]),
            (0.0, (1 + BEYOND) * max(move.rate for move in moves)),
            seen,
        )

    def given(self, limits: Mapping[str, Range]) -> Limits:
        """With limits of the user's in the place of those that the runs suggest.

        ``travel`` and ``rate`` follow from amplitude, mean and frequency: where one of these is
        given, they no longer hold by themselves.

        Parameters
        ----------
        limits : mapping of str to (float, float)
            ``amplitude``, ``frequency``, ``mean``, ``travel``, ``rate`` or an output, SI; infinite
            where there is no limit.

        Raises
        ------
        InputError
            If a name or a range makes no sense.
        """
        for name, (low, high) in limits.items():
            known = (*MOTION, *self.outputs)
            if name not in known:
                hint = f"write one of: {', '.join(known)}"
                raise InputError("no such limit", key=name, hint=hint)
            if not low <= high:
                hint = "write low = …, high = … with low below high"
                raise InputError("limits are the wrong way round", key=name, value=[low, high],
                                 hint=hint)  # fmt: skip
        chosen = {name: _within(limits[name], getattr(self, name)) for name in MOTION[:3]
                  if name in limits}  # fmt: skip
        if {"amplitude", "mean"} & limits.keys():
            chosen["travel"] = (-np.inf, np.inf)
        if {"amplitude", "frequency"} & limits.keys():
            chosen["rate"] = (0.0, np.inf)
        chosen |= {name: limits[name] for name in MOTION[3:] if name in limits}
        outputs = {name: limits.get(name, own) for name, own in self.outputs.items()}
        return replace(self, outputs=outputs, **chosen)


def _between(values: Sequence[float]) -> Range:
    return min(values), max(values)


def _about(values: Sequence[float]) -> Range:
    low, high = _between(values)
    return low - BEYOND * (high - low), high + BEYOND * (high - low)


def _within(wanted: Range, own: Range) -> Range:
    """A side that is left open is that of the runs, if it does not contradict the other."""
    low, high = wanted
    low = low if np.isfinite(low) else min(own[0], high)
    return low, high if np.isfinite(high) else max(own[1], low)


@dataclass(frozen=True)
class Motion:
    """Amplitude, mean, extremes and largest rate of one periodic motion, SI."""

    amplitude: float
    mean: float
    lowest: float
    highest: float
    rate: float

    @classmethod
    def of(cls, record: Record, channel: str) -> Motion:
        """Of a channel of a run, by its significant harmonics."""
        return cls.of_signal(record.harmonics[channel], record.frequency)

    @classmethod
    def of_signal(cls, item: Harmonics, frequency: float) -> Motion:
        """Of a periodic signal."""
        phase = np.arange(POINTS) / POINTS
        x, v = (item.evaluate(phase, frequency, n) for n in (0, 1))
        low, high = float(x.min()), float(x.max())
        mean, half = float(item.coefficients[item.orders == 0].real.sum()), (high - low) / 2
        mean = mean if abs(mean) > ROUND_OFF * half else 0.0
        return cls(half, mean, low, high, float(np.abs(v).max()))

    def possible(self, limits: Limits) -> bool:
        """Whether a rig can do it; a rounding error is no obstacle."""
        slack = 1e-6 * self.amplitude
        low, high = limits.travel
        return (
            low - slack <= self.lowest
            and self.highest <= high + slack
            and self.rate <= limits.rate[1] * (1 + 1e-6)
            and self.rate >= limits.rate[0] * (1 - 1e-6)
        )


@dataclass(frozen=True)
class Planned:
    """A run that could be made.

    Parameters
    ----------
    frequency : float
        Hz.
    mean, amplitude : float
        Of the driving channel, SI.
    waveform : Harmonics
        Of that channel.
    """

    frequency: float
    mean: float
    amplitude: float
    waveform: Harmonics


def planned_runs(limits: Limits, records: Sequence[Record], drive: str) -> list[Planned]:
    """Runs over the whole range of what a rig can do.

    Parameters
    ----------
    limits : Limits
    records : sequence of Record
        Give the shape of the motion: a sine if theirs is nearly one, else that of the run nearest
        in frequency.
    drive : str
        The channel that drives the model.

    Returns
    -------
    list of Planned
        By mean, amplitude and frequency, without those that leave the limits.
    """
    found = []
    for mean in _even(limits.mean, MEANS, limits.amplitude[1]):
        for amplitude in _factors(limits.amplitude, AMPLITUDES):
            for frequency in _factors(limits.frequency, FREQUENCIES):
                shape = _shape(records, drive, frequency)
                item = replace(shape, coefficients=amplitude * shape.coefficients)
                item.coefficients[item.orders == 0] = mean
                run = Planned(float(frequency), float(mean), float(amplitude), item)
                if Motion.of_signal(item, run.frequency).possible(limits):
                    found.append(run)
    return found


def _shape(records: Sequence[Record], drive: str, frequency: float) -> Harmonics:
    """Waveform without mean and of unit amplitude."""
    if all(_nearly_a_sine(record.harmonics[drive]) for record in records):
        return motion(0.0, [1.0])
    near = min(records, key=lambda record: abs(np.log(record.frequency / frequency)))
    item, own = near.harmonics[drive], Motion.of(near, drive)
    orders = np.union1d([0], item.orders)
    coefficients = np.zeros(orders.size, dtype=complex)
    coefficients[np.searchsorted(orders, item.orders)] = item.coefficients / own.amplitude
    coefficients[0] = 0.0
    return Harmonics(orders, coefficients, np.zeros(orders.size))


def _nearly_a_sine(item: Harmonics) -> bool:
    power = np.abs(item.coefficients[item.orders > 0]) ** 2
    first = power[item.orders[item.orders > 0] == 1].sum()
    return bool(first >= NEARLY_A_SINE * power.sum())


def _factors(limits: Range, count: int) -> Array:
    """Values a constant factor apart; one where there is nothing to choose."""
    low, high = max(limits[0], 1e-3 * limits[1]), limits[1]
    return np.array([high]) if high <= low * 1.001 else np.geomspace(low, high, count)


def _even(limits: Range, count: int, size: float) -> Array:
    """Values an equal step apart; one where the limits are closer than a motion's size matters."""
    low, high = limits
    if high - low >= 0.05 * size:
        return np.linspace(low, high, count)
    # Of a motion about zero the means of the runs are noise, which nobody would ask a rig for.
    middle = 0.0 if low <= 0.0 <= high else (low + high) / 2
    return np.array([0.0 if abs(middle) < NO_MEAN * size else middle])
