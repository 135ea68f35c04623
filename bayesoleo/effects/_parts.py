"""Parameters of effects: amplitudes, shapes, constants, and the grids that scan shapes.

Amplitudes switch an effect on. Shapes are scanned on grids that the sizes of the motion place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from bayesoleo.effects._places import place_at
from bayesoleo.errors import ModelError
from bayesoleo.model._model import Model


@dataclass(frozen=True)
class Scales:
    """Typical sizes along the estimated motion; they place the scan grids of shape parameters.

    Parameters
    ----------
    position : mapping of str to (float, float)
        Lowest and highest position over all runs, by coordinate, in the coordinate's unit; of a
        velocity, those of the way since the start of the run, in its unit times s.
    velocity : mapping of str to float
        Largest absolute velocity, by coordinate, in the coordinate's unit per second; of a
        velocity, its own in its unit.
    output : mapping of str to float
        Peak-to-peak value by output, in the output's unit.
    shortest_period, longest_period : float
        Of all runs, in seconds.
    output_range : mapping of str to (float, float)
        Lowest and highest value measured, by output, in the output's unit.
    kinds : frozenset of str
        Of the runs: ``periodic``, ``transient`` or both.
    dominant_frequency : float, optional
        Frequency of a spectral line in the residual of transients that no input has, Hz.
    conditions : mapping of str to float
        Mean over the runs, SI.
    """

    position: Mapping[str, tuple[float, float]]
    velocity: Mapping[str, float]
    output: Mapping[str, float]
    shortest_period: float
    longest_period: float
    output_range: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    kinds: frozenset[str] = frozenset({"periodic"})
    dominant_frequency: float | None = None
    conditions: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Amplitude:
    """A new parameter that switches an effect on.

    Parameters
    ----------
    name : str
        As the effect's expression calls it.
    unit : str
        May use the words ``force`` (of the balance), ``position``, ``channel`` and ``parameter``
        for the units of the place, e.g. ``force/position**3``.
    latex, description : str
        For reports.
    sign : int
        +1 or -1 where only that side of zero is physical.
    by_run : bool
        One value for every run.
    """

    name: str
    unit: str
    latex: str
    description: str
    sign: int = 0
    by_run: bool = False


#: Computes a number, or a grid of them, from the model, the target and the scales.
Grid = Callable[[Model, str, Scales], tuple[float, ...]]


def always(_: Model | Scales) -> bool:
    """The default of conditions."""
    return True


@dataclass(frozen=True)
class ShapeParameter:
    """A new parameter that is undefined at the null: a velocity, a length, a time constant.

    ``grid`` gives the values to scan; ``needed`` says whether a model needs this shape at all.
    """

    name: str
    unit: str
    latex: str
    description: str
    grid: Grid
    needed: Callable[[Model], bool] = always


@dataclass(frozen=True)
class Constant:
    """A new fixed parameter: a reference velocity, a property of nitrogen."""

    name: str
    unit: str
    description: str
    value: Callable[[Model, str, Scales], float]


@dataclass(frozen=True)
class Scan:
    """A scan grid that can be listed.

    Parameters
    ----------
    of : callable (model, target, scales) -> tuple of float
        The values.
    text : str
        Their description in words and numbers.
    """

    of: Grid
    text: str

    def __call__(self, model: Model, target: str, scales: Scales) -> tuple[float, ...]:
        """The values for a motion."""
        return self.of(model, target, scales)


def _line(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
    """The dominant frequency; without one, that of the shortest period, for models extended by
    hand."""
    return (scales.dominant_frequency or 1.0 / scales.shortest_period,)


HIGHEST_LINE = Scan(_line, "that of the highest line")


def geometric(low: float, high: float, ratio: float = 2.0) -> tuple[float, ...]:
    """Values from ``low`` to ``high`` whose neighbours are at most ``ratio`` apart."""
    if not 0 < low < high:
        raise ModelError("a scan needs 0 < low < high", value=(low, high))
    steps = int(np.ceil(np.log(high / low) / np.log(ratio) - 1e-9))
    return tuple(float(value) for value in np.geomspace(low, high, steps + 1))


def coordinate_of(model: Model, target: str) -> str:
    """Name of the coordinate at a target."""
    return place_at(model, target).name


def position_range(model: Model, target: str, scales: Scales) -> tuple[float, float]:
    """Lowest and highest position at a target."""
    return scales.position[place_at(model, target).position_name]


def stroke_range(model: Model, target: str, scales: Scales) -> float:
    """Peak-to-peak position at a target."""
    low, high = position_range(model, target, scales)
    return high - low


def velocity_grid(low: float, high: float) -> Scan:
    """Fractions of the largest velocity at the target."""

    def grid(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
        largest = scales.velocity[coordinate_of(model, target)]
        return geometric(low * largest, high * largest)

    return Scan(grid, _between(low, high, "of the largest velocity"))


def range_grid(low: float, high: float, power: int = 1) -> Scan:
    """Multiples of the stroke's range, or with ``power=-1`` of its reciprocal."""

    def grid(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
        unit = stroke_range(model, target, scales) ** power
        return geometric(low * unit, high * unit)

    what = "of the range of the stroke" if power == 1 else "over the range of the stroke"
    return Scan(grid, _between(low, high, what))


def period_grid(shortest: float, longest: float) -> Scan:
    """From a multiple of the shortest period to a multiple of the longest."""

    def grid(_: Model, __: str, scales: Scales) -> tuple[float, ...]:
        return geometric(shortest * scales.shortest_period, longest * scales.longest_period)

    low, high = _part(shortest), _part(longest)
    return Scan(grid, f"{low} of the shortest period to {high} times the longest")


def velocity_once(fraction: float) -> Scan:
    """One fraction of the largest velocity, which is estimated without a scan."""

    def grid(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
        return (fraction * scales.velocity[coordinate_of(model, target)],)

    return Scan(grid, f"{_part(fraction)} of the largest velocity, not scanned")


def range_once(fraction: float) -> Scan:
    """One fraction of the stroke's range, which is estimated without a scan."""

    def grid(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
        return (fraction * stroke_range(model, target, scales),)

    return Scan(grid, f"{_part(fraction)} of the range of the stroke, not scanned")


def values(*numbers: float) -> Scan:
    """The same values for every motion."""
    shown = ", ".join(f"{number:g}" for number in numbers)
    return Scan(lambda model, target, scales: numbers, shown)


def _between(low: float, high: float, what: str) -> str:
    return f"{_part(low)} to {_part(high)} {what}"


def _part(number: float) -> str:
    """A number as the fraction that it is."""
    return str(Fraction(number).limit_denominator(10_000))
