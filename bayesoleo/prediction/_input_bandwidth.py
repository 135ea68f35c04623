"""Bandwidth of inputs: harmonics that are noise, and content that does not reach the model.

A model that takes derivatives of an input multiplies its harmonics by powers of their frequency. An
encoder shows vibrations of a nanometre at hundreds of hertz; a rigid mass turns them into newtons
that the measured force does not contain. Predicted and measured power are therefore compared by
frequency band, from the highest down, and an input is used up to the frequency where its outputs
respond to it.

An input loses content in three ways: it is cut off where its spectrum has fallen to a floor; in a
periodic run only its harmonics count; in a transient it is a straight line over masked stretches.
The lost part is noise only if its spectrum is flat, if no output responds to it, or if it is small
beside noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from bayesoleo._types import Array
from bayesoleo.model._model import Model
from bayesoleo.prediction._band_limited import Smoothed, answered, declared
from bayesoleo.prediction._inputs import highest_derivatives, signal_of
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.solvers._orbit import Status

#: Bands in an octave, and the number of octaves below half the sampling rate.
_PER_OCTAVE, _OCTAVES = 3, 12
#: Predicted over measured power from which on a band is invented: an effect that the model lacks
#: may well account for ten times the amplitude near a resonance, but seldom for more. Bands below
#: it are cut off as well if they are this far off at least.
_INVENTED, _OFF = 100.0, 10.0
#: Parts of an output's power: what an invented band has at least (a hundredth of the amplitude),
#: and what is none.
_MATTERS, _NONE = 1e-4, 1e-6
#: Part of the frequency over which a transient's input fades out: less than a band.
_FADE = 0.15
#: Part of what was invented that may be left by the cut.
_LEFT = 0.1
#: Part of what an input holds, as root mean squares, that is worth a word.
_PART = 0.05
#: Noise levels that a straight line has to miss the signal by.
_MISSED = 3.0
#: Windows of a masked stretch's length that are looked at elsewhere.
_WINDOWS = 64


@dataclass(frozen=True)
class Invented:
    """Part of an input that an output does not answer to.

    Parameters
    ----------
    run, channel, output : str
    derivative : int
        The highest that the model takes of the channel.
    low, high : float
        Hz; the channel does not count in between and above.
    held : float
        Root mean square of the channel there, SI.
    predicted, measured : float
        Root mean square of the output there, SI; predicted at the parameters' start.
    """

    run: str
    channel: str
    output: str
    derivative: int
    low: float
    high: float
    held: float
    predicted: float
    measured: float


def without_invented(
    model: Model, records: Sequence[Record], declared_channels: Iterable[str] = ()
) -> tuple[tuple[Record, ...], tuple[Invented, ...]]:
    """Cut inputs off where the outputs do not answer to them.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved, with its parameters at their start.
    records : sequence of Record
        All runs.
    declared_channels : iterable of str
        Those with a declared bandwidth, which stay as they are.

    Returns
    -------
    records : tuple of Record
        With channels cut off for the derivatives that the model takes.
    invented : tuple of Invented
        What was cut off.
    """
    layout = Predictor(model, records, steps=8, backend="numpy", jobs=1)
    highest = highest_derivatives(layout.runs[0].kernels.derived.inputs)
    taken = {
        name: order
        for name, order in highest.items()
        if order > 0 and name not in set(declared_channels)
    }
    found, kept = [], []
    for number, record in enumerate(records):
        channels = {name: order for name, order in taken.items() if name in record.signals}
        item = None
        if any(_suspicious(record, model, *pair) for pair in channels.items()):
            theta = layout.layout.start(model)[layout.layout.columns[number]]
            record, item = _without(model, record, channels, theta)
        kept.append(record)
        found += [] if item is None else [item]
    return tuple(kept), tuple(found)


def _suspicious(record: Record, model: Model, channel: str, order: int) -> bool:
    """Whether a derivative has power in a band where no output has any to speak of."""
    rows = signal_of(record, channel, order).evaluate(record.position, record.rate, order)
    _, inside = _by_band(rows, record)
    outside = np.max([_shares(record.samples[name], record) for name in model.outputs], axis=0)
    share = inside / max(inside.sum(), 1e-300)
    return bool(((share > _MATTERS) & (share > _INVENTED * outside)).any())


def _shares(values: Array, record: Record) -> Array:
    power = _by_band(values, record)[1]
    return np.asarray(power / max(power.sum(), 1e-300))


def _without(
    model: Model, record: Record, channels: dict[str, int], theta: Array
) -> tuple[Record, Invented | None]:
    """A record cut off where its outputs are invented, by the first channel that does it alone."""
    predicted = _predicted(model, record, theta)
    if predicted is None:
        return record, None
    for row, output in enumerate(model.outputs):
        edges, measured = _by_band(record.samples[output], record)
        _, made = _by_band(predicted[row], record)
        # A start that is wrong as a whole is no matter of bands.
        scale = min(1.0, measured.sum() / max(made.sum(), 1e-300))
        first = _first_invented(scale * made, measured)
        if first is None:
            continue
        for channel, order in channels.items():
            cut = cut_off(record, channel, float(edges[first]), order)
            again = _predicted(model, cut, theta)
            if again is None:
                continue
            _, left = _by_band(again[row], record)
            if left[first:].sum() < _LEFT * made[first:].sum():
                _, held = _by_band(_values(record, channel, order), record)
                return cut, Invented(
                    record.label, channel, output, order, float(edges[first]), float(edges[-1]),
                    *(float(np.sqrt(x[first:].sum())) for x in (held, made, measured)),
                )  # fmt: skip
    return record, None


def _values(record: Record, channel: str, order: int) -> Array:
    return signal_of(record, channel, order).evaluate(record.position, record.rate)


def _first_invented(made: Array, measured: Array) -> int | None:
    """First band from which on an output is invented, all the way up."""
    total = measured.sum()
    bad = (made > _INVENTED * measured) & (made > _MATTERS * total)
    if not bad.any():
        return None
    off = (made > _OFF * measured) | (made + measured < _NONE * total)
    good = np.flatnonzero(~off)
    first = int(good[-1]) + 1 if good.size else 0
    if first == 0 or not bad[first:].any():
        return None
    # Empty bands below stay: there is nothing in them to cut off.
    return first + int(np.argmax(made[first:] > max(_NONE * total, 0.0)))


def cut_off(record: Record, channel: str, frequency: float, order: int) -> Record:
    """A record whose channel ends at a frequency in Hz where derivatives are taken of it."""
    item = record.signals[channel]
    if isinstance(item, Harmonics):
        limit = frequency / record.frequency
        limits = (np.inf, *(min(limit, known) for known in (*item.limits[1:], np.inf, np.inf)[:2]))
        return replace(
            record, harmonics={**record.harmonics, channel: replace(item, limits=limits)}
        )
    if not isinstance(item, Smoothed):
        return record
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    values = item.for_derivative(order).at(record.time - record.time[0])
    lower = replace(declared(values, step, frequency, fade=_FADE), noise=item.noise)
    return replace(
        record,
        smoothed={**record.smoothed, channel: replace(item, derivatives=(lower, lower))},
    )


def _predicted(model: Model, record: Record, theta: Array) -> Array | None:
    """Outputs ``(ny, N)`` at the samples; None where the run could not be solved."""
    predictor = Predictor(model, [record], backend="numpy", jobs=1)
    if predictor.set_anchor(theta) != [Status.CONVERGED]:
        return None
    samples = predictor.simulate(theta[None], 0)
    return samples.y[0] if np.isfinite(samples.y).all() else None


def _by_band(values: Array, record: Record) -> tuple[Array, Array]:
    """Edges of bands in Hz, shape (B + 1,), and power in each, shape (B,)."""
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    window = np.kaiser(values.size + 1, 14.0)[:-1]  # of a transform: its first sample follows again
    size = fft.next_fast_len(values.size, real=True)
    amplitude = fft.rfft(window * (values - np.mean(values)), size)
    power = 2.0 * np.abs(amplitude) ** 2 / (size * np.sum(window**2))
    frequency = fft.rfftfreq(size, step)
    highest = 0.5 / step
    edges = highest * 2.0 ** (-np.arange(_PER_OCTAVE * _OCTAVES, -1, -1) / _PER_OCTAVE)
    edges[0] = 0.0
    place = np.clip(np.searchsorted(edges, frequency) - 1, 0, edges.size - 2)
    return edges, np.bincount(place, power, edges.size - 1)


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
    """Parts of the inputs that are left out, by run.

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
    if size > np.fmax(_MISSED * noise, _PART * held):
        step = (record.time[-1] - record.time[0]) / (record.time.size - 1)
        yield Lost(record.label, channel, "masked", 0, size, held, float(longest * step))
