"""Stiffness: forces that follow position."""

from __future__ import annotations

from bayesoleo.effects.effect import Effect
from bayesoleo.effects.force_effect import force_effect
from bayesoleo.effects.parts import Amplitude

_SOURCES = {
    1: "Hooke (1678), De potentia restitutiva",
    2: "Nayfeh and Mook (1979), Nonlinear Oscillations, section 4.1",
    3: "Duffing (1918), Erzwungene Schwingungen bei veraenderlicher Eigenfrequenz",
    5: "Nayfeh and Mook (1979), Nonlinear Oscillations, section 4.1",
}


def _power(order: int, word: str) -> Effect:
    id_ = f"{word}_stiffness"
    unit = "force/position" if order == 1 else f"force/position**{order}"
    exponent = "" if order == 1 else f"^{order}"
    return force_effect(
        id_,
        "stiffness",
        f"{id_}*position**{order}",
        {id_: Amplitude(id_, unit, f"k_{order}", f"{word} stiffness")},
        formula=f"k_{order} q{exponent}",
        title=f"{word.capitalize()} stiffness",
        source=_SOURCES[order],
    )


LINEAR = _power(1, "linear")
QUADRATIC = _power(2, "quadratic")
CUBIC = _power(3, "cubic")
QUINTIC = _power(5, "quintic")

EFFECTS = (LINEAR, QUADRATIC, CUBIC, QUINTIC)
