"""SI values as an engineer reads them: 0.0123 m as 12.3 mm, 52 000 N as 52 kN."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

PREFIXES = {"n": 1e-9, "µ": 1e-6, "m": 1e-3, "c": 1e-2, "": 1.0, "k": 1e3, "M": 1e6, "G": 1e9}
SMALL = ("n", "µ", "m")
ALL = (*SMALL, "", "k", "M", "G")
# What is in use: nobody reads kilometres of stroke or kiloseconds, and centimetres only squared.
ALLOWED = {
    "m": (*SMALL, ""),
    "s": (*SMALL, ""),
    "K": ("m", ""),
    "mol": (*SMALL, ""),
    "rad": (*SMALL, ""),
} | dict.fromkeys(("N", "Pa", "V", "A", "W", "J", "Hz"), ALL)
ALLOWED_POWERS = {"m": (*SMALL, "c", "")}
LEADING = re.compile(
    r"^(mol|rad|Pa|Hz|[NmsVAWJK])(?![A-Za-zµ])\s*(?:(?:\*\*|\^)\s*)?([23²³])?(?=$|\D)(.*)$"
)
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
DIMENSIONLESS = ("", "1", "-", "dimensionless")


@dataclass(frozen=True)
class Scale:
    """How values of an SI unit are shown: ``shown = factor * value``, in ``unit``."""

    factor: float
    unit: str

    def label(self, name: str) -> str:
        """Text of an axis: ``force in kN``; of a dimensionless quantity its name alone."""
        return f"{name} in {self.unit}" if self.unit else name


def engineering(unit: str, magnitude: float) -> Scale:
    """Choose prefix or power of ten for values of about a magnitude.

    Parameters
    ----------
    unit : str
        SI unit as stored: ``N``, ``N/m``, ``m**2``, ``N*s/m``; empty or ``1`` if dimensionless.
    magnitude : float
        Typical absolute value, in ``unit``.

    Returns
    -------
    Scale
    """
    size = abs(magnitude)
    if not math.isfinite(size) or size == 0.0:
        return Scale(1.0, format_unit(unit))
    match = LEADING.match(unit.strip())
    return _power_of_ten(unit, size) if match is None else _prefixed(match, unit, size)


def format_unit(unit: str) -> str:
    """A unit for reading: ``N*s^2/m**2`` as ``N·s²/m²``, empty if dimensionless."""
    if unit.strip() in DIMENSIONLESS:
        return ""
    text = re.sub(r"(?:\*\*|\^)\s*(-?\d+)", lambda m: m[1].translate(SUPERSCRIPTS), unit.strip())
    text = re.sub(r"\s*\*\s*|(?<=\w)\s+(?=\w)", "·", text).replace(" / ", "/")
    return re.sub(r"^ln\(\((\w*)\)²\)$", r"ln \1²", text)


def format_value(value: float | None, unit: str = "", sd: float | None = None) -> str:
    """A value with its unit, in as many digits as its standard deviation leaves.

    Parameters
    ----------
    value : float or None
        In ``unit``; None gives a dash.
    unit : str
        SI unit as stored.
    sd : float, optional
        Two digits of it are kept; four significant digits of the value without it.

    Returns
    -------
    str
    """
    if value is None or not math.isfinite(value):
        return "–"
    scale = engineering(unit, max(abs(value), abs(sd or 0.0)))
    return f"{format_number(value * scale.factor, sd and sd * scale.factor)} {scale.unit}".strip()


def format_number(value: float | None, sd: float | None = None) -> str:
    """A number in as many digits as its standard deviation leaves (four without one)."""
    if value is None or not math.isfinite(value):
        return "–"
    if sd is None or not math.isfinite(sd) or sd <= 0.0:
        text = f"{value:#.4g}" if 1e-3 <= abs(value) < 1e4 else f"{value:.4g}"
        if 9999.5 <= abs(value) < 1e5:
            text = f"{float(text):.0f}"
        return text.rstrip(".").replace("-", "−")
    decimals = 1 - math.floor(math.log10(sd))
    rounded = round(value, decimals) + 0.0
    return f"{rounded:.{min(max(decimals, 0), 12)}f}".replace("-", "−")


def _prefixed(match: re.Match[str], unit: str, size: float) -> Scale:
    """The largest allowed prefix on the leading symbol that leaves a value of at least 1."""
    symbol, power_text, rest = match[1], match[2], match[3]
    power = {None: 1, "2": 2, "3": 3, "²": 2, "³": 3}[power_text]
    allowed = ALLOWED_POWERS.get(symbol, ALLOWED[symbol]) if power > 1 else ALLOWED[symbol]
    fitting = [prefix for prefix in allowed if size / PREFIXES[prefix] ** power >= 1.0]
    prefix = max(fitting or allowed[:1], key=lambda name: PREFIXES[name])
    factor = 1.0 / PREFIXES[prefix] ** power
    if not 1.0 <= size * factor < 1e5:
        return _power_of_ten(unit, size)
    return Scale(factor, prefix + format_unit(f"{symbol}{'' if power == 1 else f'^{power}'}{rest}"))


def _power_of_ten(unit: str, size: float) -> Scale:
    """For units that take no prefix: a power of ten in front of the unit."""
    exponent = 3 * math.floor(math.log10(size) / 3)
    if -3 <= exponent <= 3 and 1e-2 <= size < 1e5:
        return Scale(1.0, format_unit(unit))
    text = f"10{str(exponent).translate(SUPERSCRIPTS)} {format_unit(unit)}"
    return Scale(10.0**-exponent, text.strip())
