"""Of what effects are made: amplitudes that switch them on, shapes that are scanned, constants, and
the sizes of the motion that place the scans."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from bayesoleo.model import Model


@dataclass(frozen=True)
class Scales:
    """Typical sizes along the estimated motion; they place the scan grids of shape parameters.

    Parameters
    ----------
    position : mapping of str to (float, float)
        Lowest and highest position over all runs, by coordinate, in the coordinate's unit.
    velocity : mapping of str to float
        Largest absolute velocity, by coordinate, in the coordinate's unit per second.
    output : mapping of str to float
        Peak-to-peak value by output, in the output's unit.
    shortest_period, longest_period : float
        Of all runs, in seconds.
    output_range : mapping of str to (float, float)
        Lowest and highest value measured, by output, in the output's unit.
    kinds : frozenset of str
        Of the runs: ``periodic``, ``transient`` or both.
    hum : float, optional
        Frequency of a line in what transients leave that no input has, Hz.
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
        for the units of the place, e.g.
        ``force/position**3``.
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
    """A new parameter that the null leaves undefined: a velocity, a length, a time constant.

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
