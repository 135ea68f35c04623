"""Variations of runs that were measured: transients, and runs with several inputs.

A few numbers do not describe a new transient or how several inputs move together. A run that was
measured does, and so does each run that changes it in one way or two: the amplitude of an input,
the phase of one input against the others, the duration of a transient, or how far from its rest it
starts. No amplitude, duration or start leaves the range of those measured by more than the factor
:data:`REACH`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from bayesoleo._types import Array
from bayesoleo.discovery._predicted_experiment import GRID_POINTS, POINTS
from bayesoleo.errors import CampaignError
from bayesoleo.model._drive_and_start import START, start_of
from bayesoleo.model._model import Model
from bayesoleo.prediction._band_limited import Smoothed
from bayesoleo.prediction._records import Harmonics, Record

#: Factor by which a variation may leave the range of the runs.
REACH = 1.25
#: Values tried of each amplitude, duration and start; of phases, in parts of a cycle.
VALUES, PHASES = 3, 4
#: Runs that are varied at most, and variations of them all.
BASES, MOST = 4, 240
#: An input that changes by less than this part of its size is held constant.
CONSTANT = 1e-3
#: Factors that are nearer to one than this change nothing.
SAME = 0.02
#: Part of a transient at its end that shows where it comes to rest.
REST = 0.1


@dataclass(frozen=True)
class Variation:
    """A run that varies a measured one.

    Parameters
    ----------
    make : callable
        Makes its record, with inputs and without outputs: those of some dozen long records would
        fill the memory.
    like : str
        Label of the run that it varies.
    change : str
        What is changed, in words, as multiples of what the run has; empty for a repetition.
    start : float
        Factor of the estimated start of a transient.
    """

    make: Callable[[], Record]
    like: str
    change: str = ""
    start: float = 1.0

    @property
    def record(self) -> Record:
        """Its record, made anew."""
        return self.make()


def varied_runs(records: Sequence[Record], model: Model, outputs: Sequence[str]) -> list[Variation]:
    """Variations of the runs.

    Parameters
    ----------
    records : sequence of Record
        Periodic runs, transients, or both.
    model : Model
        Of which the inputs are varied.
    outputs : sequence of str
        Channels that are predicted.

    Raises
    ------
    CampaignError
        If there is nothing that can be varied.
    """
    found = _periodic([r for r in records if r.periodic], model, outputs)
    found += _transient([r for r in records if not r.periodic], model, outputs)
    if not found:
        raise CampaignError(
            "no run can be proposed: no input moves, and no start is known, in the present runs",
            run=records[0].label,
            hint="measure a run in which an input moves",
        )
    step = -(-len(found) // MOST)
    return found[::step]


def repeated(record: Record, outputs: Sequence[str]) -> Variation:
    """A measured run once more."""
    if record.periodic:
        blank = partial(_blank_period, record, record.frequency, {}, outputs)
        return Variation(blank, record.label)
    return Variation(partial(_blank_transient, record, {}, 1.0, 1.0, outputs), record.label)


def moving_inputs(
    records: Sequence[Record], model: Model, outputs: Sequence[str]
) -> tuple[str, ...]:
    """Measured inputs of a model that change during the runs."""
    names = [name for name in model.inputs if name in records[0].samples and name not in outputs]
    return tuple(name for name in names if _moves(records, name))


def _moves(records: Sequence[Record], name: str) -> bool:
    values = [record.samples[name] for record in records]
    size = max(float(np.abs(one).max()) for one in values)
    noise = float(np.fmax.reduce([0.0, *(r.signal_noise.get(name, 0.0) for r in records)]))
    swing = max(float(np.std(one)) for one in values)
    return swing > max(CONSTANT * size, 2.0 * noise)


def _targets(values: Sequence[float]) -> Array:
    """Values over the range of the runs and a little beyond, a constant factor apart."""
    return np.geomspace(min(values) / REACH, max(values) * REACH, VALUES)


def _spread(records: Sequence[Record], key: Mapping[str, float]) -> list[Record]:
    """A few runs with values of a key as different as can be."""
    ordered = sorted(records, key=lambda record: key[record.label])
    chosen = np.unique(np.linspace(0, len(ordered) - 1, min(BASES, len(ordered))).round())
    return [ordered[int(k)] for k in chosen]


# -- periodic runs with several inputs -------------------------------------------------------------


def _periodic(records: Sequence[Record], model: Model, outputs: Sequence[str]) -> list[Variation]:
    inputs = moving_inputs(records, model, outputs) if records else ()
    if not inputs:
        return []
    amplitudes = {name: [_swing(record, name) for record in records] for name in inputs}
    bases = _spread(records, {record.label: record.frequency for record in records})
    wanted = [_targets([size for size in amplitudes[name] if size > 0]) for name in inputs]
    # The phase of all inputs together changes nothing.
    turns = [[0.0], *([k / PHASES for k in range(PHASES)] for _ in inputs[1:])]
    found = []
    for record in bases:
        for sizes, phases in product(product(*wanted), product(*turns)):
            factors = {
                name: size / _swing(record, name) if _swing(record, name) > 0 else 1.0
                for name, size in zip(inputs, sizes, strict=True)
            }
            turned = dict(zip(inputs, phases, strict=True))
            words = [_times(f"amplitude of {name}", factors[name]) for name in inputs]
            words += [
                f"{name} {p:g} cycles ahead of where it was" for name, p in turned.items() if p
            ]
            change = ", ".join(word for word in words if word)
            if change:
                moved = {
                    name: _scaled(record.harmonics[name], factors[name], turned[name])
                    for name in inputs
                }
                blank = partial(_blank_period, record, record.frequency, moved, outputs)
                found.append(Variation(blank, record.label, change))
    return found


def _times(name: str, factor: float) -> str:
    """What is changed of the run that is varied; empty where it stays the same."""
    return f"{factor:.3g} times its {name}" if abs(factor - 1.0) > SAME else ""


def _swing(record: Record, name: str) -> float:
    """Half of the peak-to-peak value of a channel."""
    phase = np.arange(GRID_POINTS) / GRID_POINTS
    return float(np.ptp(record.harmonics[name].evaluate(phase, record.frequency)) / 2)


def _scaled(item: Harmonics, factor: float, cycles: float) -> Harmonics:
    """A signal with its alternating part scaled and moved ahead by a part of its period."""
    turn = factor * np.exp(2j * np.pi * item.orders * cycles)
    turn[item.orders == 0] = 1.0
    return replace(item, coefficients=item.coefficients * turn)


def _blank_period(
    record: Record, frequency: float, changed: Mapping[str, Harmonics], outputs: Sequence[str]
) -> Record:
    """One period of a run with other inputs and without outputs."""
    phase = np.arange(POINTS) / POINTS
    harmonics = {name: item for name, item in record.harmonics.items() if name not in outputs}
    harmonics |= changed
    samples = {name: item.evaluate(phase, frequency) for name, item in harmonics.items()}
    samples |= {name: np.zeros(POINTS) for name in outputs}
    return replace(
        record, label="any", frequency=frequency, frequency_sd=0.0, periods=1,
        time=phase / frequency, samples=samples, harmonics=harmonics, kept=None,
    )  # fmt: skip


# -- transients ------------------------------------------------------------------------------------


def _transient(records: Sequence[Record], model: Model, outputs: Sequence[str]) -> list[Variation]:
    if not records:
        return []
    inputs = moving_inputs(records, model, outputs)
    bases = _spread(records, {record.label: record.span for record in records})
    sizes = {name: [_travel(record, name) for record in records] for name in inputs}
    spans = [record.span for record in records]
    starts = _start_sizes(records, model)
    found = []
    for record in bases:
        own = [_targets(sizes[name]) / _travel(record, name) for name in inputs]
        lasts = _targets(spans) / record.span if inputs else ()
        begins = _targets(list(starts.values())) / starts[record.label] if starts else ()
        for factors, last, begin in product(product(*own), _and_one(lasts), _and_one(begins)):
            scale = dict(zip(inputs, map(float, factors), strict=True))
            words = [
                _times(f"change of {name} since the first sample", factor)
                for name, factor in scale.items()
            ]
            words += [_times("duration", last), _times("distance from rest at the start", begin)]
            change = ", ".join(word for word in words if word)
            if change:
                blank = partial(
                    _blank_transient, record, scale, float(last), float(begin), outputs, model
                )
                found.append(Variation(blank, record.label, change, float(begin)))
    return found


def _and_one(factors: Iterable[float]) -> list[float]:
    """One, and the factors that change anything: others would be the same run once more."""
    return [1.0, *(float(factor) for factor in factors if abs(factor - 1.0) > SAME)]


def _travel(record: Record, name: str) -> float:
    """Largest change of a channel since the first sample."""
    curve = record.smoothed[name].at(record.time - record.time[0])
    return max(float(np.abs(curve - curve[0]).max()), 1e-300)


def _begins_with(model: Model) -> tuple[set[str], bool]:
    """Conditions and channels that starts are declared by, and whether starts are estimated."""
    found: set[str] = set()
    for dof in model.dofs:
        start = start_of(model, dof)
        found |= {str(one) for one in (*start.value.free_symbols, *start.rate.free_symbols)}
    return found, any(name.startswith(START) for name in (*model.parameters, *found))


def _start_sizes(records: Sequence[Record], model: Model) -> dict[str, float]:
    """How far from its rest each transient starts; empty where that is not known."""
    if not model.dofs:
        return {}
    names, estimated = _begins_with(model)
    measured = [name for name in model.outputs if name in names]
    given = [name for name in model.conditions if name in names]
    sizes: dict[str, float] = {}
    for record in records:
        parts = [abs(_from_rest(record, name)) for name in measured]
        parts += [abs(record.conditions.get(name, 0.0)) for name in given]
        sizes[record.label] = float(parts[0]) if parts else float(estimated)
    return sizes if all(size > 0 for size in sizes.values()) else {}


def _from_rest(record: Record, name: str) -> float:
    values = record.samples[name]
    return float(values[0] - np.mean(values[-max(int(REST * values.size), 1) :]))


def _blank_transient(
    record: Record,
    scale: Mapping[str, float],
    last: float,
    begin: float,
    outputs: Sequence[str],
    model: Model | None = None,
) -> Record:
    """A transient with other inputs, as long as wanted, and without outputs."""
    smoothed = {}
    for name, curve in record.smoothed.items():
        if name in outputs:
            factor = begin
            about = float(record.samples[name][0]) - _from_rest(record, name)
        else:
            factor, about = scale.get(name, 1.0), float(curve.states[0, 0])
        smoothed[name] = stretched(curve, factor, about, last)
    conditions = dict(record.conditions)
    if model is not None and begin != 1.0:
        names, _ = _begins_with(model)
        conditions |= {n: begin * v for n, v in conditions.items() if n in names}
    time = record.time[0] + last * (record.time - record.time[0])
    samples = {name: curve.at(time - time[0]) for name, curve in smoothed.items()}
    samples |= {name: np.zeros(time.size) for name in outputs}
    return replace(
        record, label="any", time=time, samples=samples, smoothed=smoothed, conditions=conditions,
        kept=None,
    )  # fmt: skip


def stretched(curve: Smoothed, factor: float, about: float, last: float) -> Smoothed:
    """A curve whose distance from a value is scaled, and whose time is stretched.

    Parameters
    ----------
    curve : Smoothed
    factor : float
        Of the distance.
    about : float
        The value, SI.
    last : float
        Factor of the time.
    """
    states = curve.states * factor / last ** np.arange(3)
    states[:, 0] += (1.0 - factor) * about
    band = curve.band
    if band is not None:
        band = replace(band, cut=band.cut / last, upper=band.upper / last)
    return replace(
        curve,
        step=curve.step * last,
        states=states,
        band=band,
        derivatives=tuple(stretched(one, factor, about, last) for one in curve.derivatives),
    )
