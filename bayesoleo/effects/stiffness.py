"""Stiffness: forces that follow position."""

from __future__ import annotations

from bayesoleo.effects.effect import Amplitude, Effect
from bayesoleo.effects.force_effect import force_effect


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
        source="Duffing (1918)" if order == 3 else "",
    )


LINEAR = _power(1, "linear")
QUADRATIC = _power(2, "quadratic")
CUBIC = _power(3, "cubic")
QUINTIC = _power(5, "quintic")

EFFECTS = (LINEAR, QUADRATIC, CUBIC, QUINTIC)
