"""Scan grids of shape parameters, placed by the sizes of the motion."""

from __future__ import annotations

import numpy as np

from bayesoleo.effects.effect import Grid, Scales
from bayesoleo.effects.places import force_places
from bayesoleo.errors import ModelError
from bayesoleo.model import Model


def geometric(low: float, high: float, ratio: float = 2.0) -> tuple[float, ...]:
    """Values from ``low`` to ``high`` whose neighbours are at most ``ratio`` apart."""
    if not 0 < low < high:
        raise ModelError("a scan needs 0 < low < high", value=(low, high))
    steps = int(np.ceil(np.log(high / low) / np.log(ratio) - 1e-9))
    return tuple(float(value) for value in np.geomspace(low, high, steps + 1))


def coordinate_of(model: Model, target: str) -> str:
    """Name of the coordinate at a target."""
    return force_places(model)[target].name


def stroke_range(model: Model, target: str, scales: Scales) -> float:
    """Peak-to-peak position at a target."""
    low, high = scales.position[coordinate_of(model, target)]
    return high - low


def velocity_grid(low: float, high: float) -> Grid:
    """Fractions of the largest velocity at the target."""

    def grid(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
        largest = scales.velocity[coordinate_of(model, target)]
        return geometric(low * largest, high * largest)

    return grid


def range_grid(low: float, high: float, power: int = 1) -> Grid:
    """Multiples of the stroke's range, or with ``power=-1`` of its reciprocal."""

    def grid(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
        unit = stroke_range(model, target, scales) ** power
        return geometric(low * unit, high * unit)

    return grid


def period_grid(shortest: float, longest: float) -> Grid:
    """From a multiple of the shortest period to a multiple of the longest."""

    def grid(_: Model, __: str, scales: Scales) -> tuple[float, ...]:
        return geometric(shortest * scales.shortest_period, longest * scales.longest_period)

    return grid


def velocity_once(fraction: float) -> Grid:
    """One fraction of the largest velocity: not scanned, estimated once the effect is in."""

    def grid(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
        return (fraction * scales.velocity[coordinate_of(model, target)],)

    return grid


def values(*numbers: float) -> Grid:
    """The same values for every motion."""
    return lambda model, target, scales: numbers
