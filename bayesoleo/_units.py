"""Conversion of units in files to SI.

Any unit that pint reads is allowed, and those that test rigs write and pint does not: ``psia`` and
``bara`` (absolute), ``psig`` and ``barg`` (above ambient). All become pascal with no offset,
because the ambient pressure is not in the unit: a gauge pressure remains one.
"""

from __future__ import annotations

import difflib
import re
import threading
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo._types import Array
from bayesoleo.errors import CampaignError

#: Pint's base units, by the SI name that a reader expects.
_SI_NAMES = {
    "kilogram / meter / second ** 2": "Pa",
    "kilogram * meter / second ** 2": "N",
    "kilogram * meter ** 2 / second ** 2": "J",
    "kilogram * meter ** 2 / second ** 3": "W",
    "kilogram * meter ** 2 / ampere / second ** 3": "V",
    "kilogram * meter ** 2 / ampere ** 2 / second ** 3": "ohm",
    "ampere * second": "C",
    "1 / second": "Hz",
    "dimensionless": "1",
    "kelvin": "K",
    "meter": "m",
    "meter / second": "m/s",
    "meter / second ** 2": "m/s²",
    "radian": "rad",
    "radian / second": "rad/s",
    "second": "s",
    "ampere": "A",
    "kilogram": "kg",
}

#: A torque has the base units of an energy; which one is meant shows in how it is written.
_ENERGY, TORQUE = "J", "N*m"

#: Second meanings of units as rigs write them: standard gravity, degree Celsius.
SECOND_MEANINGS = {"g": "g_0", "mg": "mg_0", "C": "degC"}

#: Words at the end of a channel's or a condition's name that fix its SI unit.
_EXPECTED = {
    "pressure": ("Pa", "bar"),
    "force": ("N", "kN (a pound of force is lbf)"),
    "temperature": ("K", "degC"),
}

# Units that are told by their letters whatever their case.
_COMMON = (
    *("mm", "N", "kN", "Pa", "kPa", "MPa", "bar", "mbar", "psi", "rad", "deg", "rpm"),
    *("Hz", "kHz", "V", "mV", "A", "mA", "W", "kW", "kg", "K", "degC"),
    *("psia", "psig", "bara", "barg"),
)

#: Absolute and gauge pressure as rigs write them besides: bar(a), psi (g), bar abs.
_PRESSURE = re.compile(r"(bar|psi)\s*(?:\(\s*([ag])\s*\)|\s(a)bs|\s(g)auge)\.?", re.IGNORECASE)

#: Units of events in a time, as those of turns and of radians.
_OF_EVENTS = {
    "1/min": ("rpm", "rad/min"),
    "min**-1": ("rpm", "rad/min"),
    "Hz": ("rev/s", "rad/s"),
    "1/s": ("rev/s", "rad/s"),
}

_lock = threading.Lock()


@dataclass(frozen=True)
class Unit:
    """A unit as an affine map to SI: ``si = factor * value + shift``.

    Parameters
    ----------
    name, si_name : str
        As written, and its SI unit.
    factor, shift : float
        SI units a unit; SI value at zero (only temperatures have one).
    """

    name: str
    si_name: str
    factor: float
    shift: float = 0.0

    def to_si(self, value: ArrayLike) -> Array:
        """SI values of ``value``, any shape."""
        return np.asarray(value, dtype=float) * self.factor + self.shift

    def from_si(self, value: ArrayLike) -> Array:
        """Inverse of :meth:`to_si`."""
        return (np.asarray(value, dtype=float) - self.shift) / self.factor


@cache
def _registry() -> Any:
    import pint

    registry = pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
    for pressure in ("psi", "bar"):
        registry.define(f"{pressure}a = {pressure}")
        registry.define(f"{pressure}g = {pressure}")
    registry.define("rev = revolution")
    return registry


@cache
def base_unit(text: str) -> Any:
    """Unit of a text as pint reads it, in base units, to calculate with; a number where empty.

    Pint raises errors of many types on bad input.
    """
    with _lock:
        return _registry().Quantity(1.0, text or "dimensionless").to_base_units().units


@cache
def parse_unit(name: str) -> Unit:
    """Read a unit.

    Parameters
    ----------
    name : str
        ``mm``, ``kN``, ``bar``, ``psig``, ``m/s**2``, ``degC``, ``1`` ...

    Returns
    -------
    Unit
        Its map to SI.

    Raises
    ------
    CampaignError
        If pint does not know it.
    """
    with _lock:  # pint fills its caches on reading; threads must not do so together
        try:
            registry = _registry()
            unit = registry.Unit(_as_pint_writes(name))
            zero = registry.Quantity(0.0, unit).to_base_units()
            one = registry.Quantity(1.0, unit).to_base_units()
        except Exception as error:  # pint raises half a dozen unrelated types on bad input
            raise _unknown(name) from error
    base = str(one.units)
    shift = float(zero.magnitude)
    # kN is 1000 N exactly; pint's base units go through grams and may miss it by one rounding.
    factor = float(f"{float(one.magnitude) - shift:.15g}")
    si_name = _SI_NAMES.get(base, f"{one.units:~C}")
    if si_name == _ENERGY and _holds_force(unit):
        si_name = TORQUE
    return Unit(name, si_name, factor, shift)


#: Powers of base dimensions, without zeros.
type Dimensions = dict[str, float]

_BASE = {
    "[length]": "m",
    "[mass]": "kg",
    "[time]": "s",
    "[temperature]": "K",
    "[current]": "A",
    "[substance]": "mol",
    "[luminosity]": "cd",
}


# Composed units that a reader expects instead of powers of base units.
_USUAL = (
    *("N/m", "N*s/m", "N*s**2/m**2", "N/m**3", "N*s/m**2", "N/s", "W/K", "J/K", "K/W"),
    *("W/K**4", "Pa/m", "Pa*s", "N*m/A", "N*m*s", "N*s/(m*A)", "H", "F", "V*s", "1/s", "m/s**2"),
)


@cache
def _dimensions(name: str) -> tuple[tuple[str, float], ...]:
    with _lock:
        found = _registry().Unit(_as_pint_writes(name)).dimensionality
        return tuple((base, float(power)) for base, power in found.items() if power)


def dimensions(name: str) -> Dimensions:
    """Powers of the base dimensions of a unit; of a number and an angle there are none.

    Parameters
    ----------
    name : str
        A unit that is known.
    """
    return dict(_dimensions(name))


def unit_of_dimensions(powers: Dimensions) -> str:
    """The SI unit of these powers of base dimensions; empty for a number."""
    powers = {base: power for base, power in powers.items() if power}
    usual = next((name for name in _USUAL if dimensions(name) == powers), "")
    if usual:
        return usual
    parts = [
        _BASE[base] if power == 1 else f"{_BASE[base]}**{power:g}"
        for base, power in sorted(powers.items())
    ]
    return parse_unit("*".join(parts)).si_name if parts else ""


def in_si(name: str) -> str:
    """The SI unit of the same kind, written as the unit is: ``N/m`` of ``N/mm``.

    Parameters
    ----------
    name : str
        A unit that is known.
    """

    def of_word(match: re.Match[str]) -> str:
        return parse_unit(match.group()).si_name if _is_known(match.group()) else match.group()

    unit = parse_unit(name)
    text = re.sub(r"[A-Za-zµ°]+", of_word, name).replace("²", "**2")
    try:
        found = parse_unit(text)
    except CampaignError:
        return unit.si_name
    good = found.si_name == unit.si_name and found.factor == 1.0 and found.shift == 0.0
    return text if good else unit.si_name


def _as_pint_writes(name: str) -> str:
    if name.strip() in ("", "1", "-"):
        return "dimensionless"
    pressure = _PRESSURE.fullmatch(name.strip())
    if pressure:  # pint would take bar(a) for a bar times a year
        return "".join(part for part in pressure.groups() if part).lower()
    return name


def _unknown(name: str) -> CampaignError:
    """The error for what pint does not read as a unit, with what to write instead."""
    try:
        quantity = _registry().Quantity(name)
        factor, unit = float(quantity.magnitude), f"{quantity.units:~C}" or "1"
    except Exception:  # as above
        hint = _suggestion(name) + "one that pint reads, such as mm, kN, N*m, m/s**2, psig"
        return CampaignError("unknown unit", value=name, hint=hint)
    hint = f"write scale = {factor:g} and unit = {unit!r}"
    return CampaignError("a unit has no factor", value=name, hint=hint)


def _suggestion(wrong: str) -> str:
    """What an unknown unit was meant to be: another case, powers without ``**``, products without
    ``*``."""
    case = next((unit for unit in _COMMON if unit.lower() == wrong.lower()), wrong)
    wrong = re.sub(r"^ms(?=\^?-\d)", "m*s", wrong)  # no test rig counts per millisecond squared
    powers = re.sub(r"(?<=[A-Za-z])\^?(-?\d)", r"**\1", wrong)
    words = re.split(r"([A-Za-zµ]+)", powers)
    split = "".join(_split_product(word) for word in words)
    # A slip inside a word, as degrC; of a short word another unit is as likely to be meant.
    close = difflib.get_close_matches(wrong, _COMMON, 1, cutoff=0.8) if len(wrong) > 3 else []
    slip = next((unit for unit in close if (unit[0], unit[-1]) == (wrong[0], wrong[-1])), wrong)
    for trial in (case, powers, slip, split, wrong.lower()):
        if trial != wrong and _is_known(trial):
            return f"did you mean {trial}? or write "
    return "write "


def _split_product(word: str) -> str:
    """Two units written as one word, with the star between them."""
    if not word.isalpha() or _is_known(word):
        return word
    cuts = (f"{word[:k]}*{word[k:]}" for k in range(len(word) - 1, 0, -1))
    return next((cut for cut in cuts if _is_known(cut)), word)


def _is_known(text: str) -> bool:
    try:
        _registry().Unit(text)
    except Exception:  # as above
        return False
    return True


def _holds_force(unit: Any) -> bool:
    """Whether a unit is written as a force times something."""
    force = _registry().Unit("N").dimensionality
    parts = _registry().Quantity(1.0, unit).unit_items()
    return any(_registry().Unit(part).dimensionality == force for part, _ in parts)


def same_quantity(first: str, second: str) -> bool:
    """Whether two SI units measure the same, as far as units tell: a torque may be called J."""
    return first == second or {first, second} == {_ENERGY, TORQUE}


def angle_hint(given: str, wanted: str) -> str:
    """What to write where one unit is an angle in a time and the other one events in a time.

    ``1/min`` does not say whether its events are turns, of ``2*pi`` rad each.

    Parameters
    ----------
    given, wanted : str
        Units that are known: of a channel and of what a model takes.

    Returns
    -------
    str
        Empty where the units differ by something else.
    """
    kinds = parse_unit(given).si_name, parse_unit(wanted).si_name
    if kinds == ("Hz", "rad/s"):
        unit = given.replace(" ", "")
        turns, radians = _OF_EVENTS.get(unit, (f"rev*({unit})", f"rad*({unit})"))
        return (
            f"{given} counts events, {wanted} measures an angle: write unit = {turns!r} if each"
            f" event is a turn of 2*pi rad, {radians!r} if it is a radian"
        )
    if kinds == ("rad/s", "Hz"):
        return (
            f"{given} measures an angle, {wanted} counts events: declare the model in rad/s, and"
            " divide by 2*pi in its equations where they count turns"
        )
    return ""


def check_kind(name: str, unit: Unit) -> None:
    """Raise if a channel or condition is named after a quantity that its unit does not measure.

    Parameters
    ----------
    name : str
        Such as ``initial_pressure``.
    unit : Unit
        What it is said to be in.

    Raises
    ------
    CampaignError
        With a unit that would do.
    """
    for word, (si_name, example) in _EXPECTED.items():
        if name.endswith(word) and unit.si_name != si_name:
            raise CampaignError(
                f"unit does not measure {word}",
                value=unit.name,
                hint=f"write one such as {example}, or rename {name!r}",
            )
