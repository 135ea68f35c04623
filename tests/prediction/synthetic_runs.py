"""Records of oleo runs made in memory: a displacement in a few harmonics, a model's answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import make_interp_spline

from bayesoleo.model import Model
from bayesoleo.prediction._band_limited import Smoothed
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record

CONDITIONS = {"initial_pressure": 4.9e5, "ambient_temperature": 293.0}
PERIODS, PER_PERIOD = 3, 127.4


def harmonics(orders, coefficients) -> Harmonics:
    orders = np.asarray(orders)
    return Harmonics(orders, np.asarray(coefficients, dtype=complex), np.zeros(orders.size))


def run(
    label: str,
    channels: dict[str, Harmonics],
    frequency: float = 1.0,
    conditions: dict[str, float] | None = None,
    others: tuple[str, ...] = (),
) -> Record:
    """A noise-free record of given channels; ``others`` are present but zero."""
    time = np.arange(int(PERIODS * PER_PERIOD)) / (PER_PERIOD * frequency)
    phase = frequency * time
    samples = {name: item.evaluate(phase, frequency) for name, item in channels.items()}
    samples |= {name: np.zeros(time.size) for name in others}
    return Record(
        label=label,
        group="",
        role="fit",
        kind="periodic",
        frequency=frequency,
        frequency_sd=0.0,
        periods=PERIODS,
        time=time,
        samples=samples,
        harmonics=channels,
        signal_noise=dict.fromkeys(samples, 0.0),
        conditions=CONDITIONS if conditions is None else conditions,
    )


def stroke(mean: float, amplitude: float) -> Harmonics:
    """A shaker's displacement, m: a sine with a little of its second and third harmonic."""
    return harmonics([0, 1, 2, 3], [mean, amplitude, 0.01j * amplitude, -0.006 * amplitude])


def oleo_runs(others: tuple[str, ...] = ("force", "pressure")) -> list[Record]:
    """Five runs over stroke and frequency like those of Verbeek (1993), table 5.1."""
    table = [
        ("b", 0.133, 0.115, 0.1),
        ("d", 0.219, 0.032, 0.5),
        ("h", 0.133, 0.034, 0.5),
        ("i", 0.133, 0.021, 1.0),
        ("n", 0.014, 0.010, 2.0),
    ]
    return [
        run(label, {"displacement": stroke(mean, amplitude)}, frequency, others=others)
        for label, mean, amplitude, frequency in table
    ]


def answered(model: Model, records: list[Record], noise: float = 0.0, **options) -> list[Record]:
    """The records with the model's outputs as samples, plus noise in parts of their spread."""
    predictor = Predictor(model, records, **options)
    theta = predictor.layout.start(model)
    predictor.set_anchor(theta)
    rng = np.random.default_rng(7)
    made = []
    for record, prediction in zip(records, predictor.predict(theta), strict=True):
        y = prediction.y
        y = y + noise * np.std(y, axis=1, keepdims=True) * rng.standard_normal(y.shape)
        samples = {**record.samples, **dict(zip(predictor.outputs, y, strict=True))}
        made.append(replace(record, samples=samples))
    return made


def exact_signal(values: np.ndarray, step: float) -> Smoothed:
    """The curve through samples without noise: the quintic interpolating spline."""
    time = step * np.arange(values.size)
    spline = make_interp_spline(time, values, k=5)
    return Smoothed(step, np.stack([spline(time, nu=k) for k in range(3)], axis=1))
