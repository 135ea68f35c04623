"""End stops and other contacts over part of the stroke, overflow, and series compliance.

The point of contact is stated as a depth below the extreme of the estimated motion: a positive
length for any zero of the position.

Compliance in series separates the measured position from that of the specimen. Where a force drives
the model, the measured position includes the displacement of the frame. Where the position drives
it, the position behind the frame is the measured one less compliance times the force *as measured*.
Solving for that position with the predicted force would need harmonics of the position that are
below its noise, because the displacement of the frame jumps with dry friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import sympy as sp

from bayesoleo.effects._effect import Effect, Names
from bayesoleo.effects._forces import HIGHEST, single_force
from bayesoleo.effects._parts import Amplitude, ShapeParameter, range_grid
from bayesoleo.effects._places import (
    balance_unit,
    force_places,
    resisting_places,
    storing_places,
    substitute,
)
from bayesoleo.model._drive_and_start import MAXIMUM_DERIVATIVE
from bayesoleo.model._expressions import derivative_symbol, split_derivative, symbol, within
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Coordinate
from bayesoleo.model._partial_derivatives import partial

_DEPTH = ShapeParameter(
    "depth",
    "position",
    "h",
    "how far the motion goes beyond the point of contact",
    range_grid(1 / 64, 1 / 2),
)


def _stop(side: str, power: str, word: str) -> Effect:
    lower = side == "lower"
    beyond = (
        "positive(lowest_position + depth - position)"
        if lower
        else "positive(position - highest_position + depth)"
    )
    id_ = f"{word}_{side}"
    exponent = {"": "", "**(3/2)": "^{3/2}"}[power]
    unit = "force/position" if not power else "force/position**1.5"
    inside = r"q_\mathrm{min} + h - q" if lower else r"q - q_\mathrm{max} + h"
    sign = "-" if lower else ""
    return single_force(
        Amplitude(id_, unit, "k_h", "contact stiffness", 1),
        "contact",
        f"{sign}{id_}*{beyond}{power}",
        shapes=(_DEPTH,),
        formula=rf"{sign} k_h \max({inside}, 0){exponent}",
        title=f"{'End stop' if not power else 'Hertzian contact'} at the {side} end",
        source="Verbeek (1993), section 4.3.3"
        if not power
        else "Hertz (1881), J. reine angew. Math. 92, 156-171",
    )


END_STOP_LOWER = _stop("lower", "", "end_stop")
END_STOP_UPPER = _stop("upper", "", "end_stop")
HERTZIAN_LOWER = _stop("lower", "**(3/2)", "hertzian_contact")
HERTZIAN_UPPER = _stop("upper", "**(3/2)", "hertzian_contact")

PLAY = single_force(
    Amplitude("play", "force/position", "k_g", "stiffness that acts beyond the gap only", 1),
    "contact",
    "-play*max(min(position - (lowest_position + highest_position)/2, gap), -gap)",
    shapes=(
        ShapeParameter(
            "gap", "position", "g", "half the gap about mid-stroke", range_grid(1 / 64, 1 / 4)
        ),
    ),
    formula=r"- k_g \operatorname{clip}(q - q_\mathrm{mid}, -g, g)",
    title="Play: no stiffness in a gap about mid-stroke",
    source="Nordin and Gutman (2002), Automatica 38(10), 1633-1649",
)

PRELOAD = single_force(
    Amplitude("preload", "force", "F_p", "force that a preloaded spring holds", 1),
    "contact",
    "preload*2/pi*atan((position - (lowest_position + highest_position)/2)/width)",
    shapes=(
        ShapeParameter(
            "width",
            "position",
            "w",
            "displacement at which the preload is half taken up",
            range_grid(1 / 256, 1 / 8),
        ),
    ),
    formula=r"F_p \, \frac{2}{\pi} \arctan((q - q_\mathrm{mid}) / w)",
    title="Preload: a spring that is held between stops about mid-stroke",
    source="Den Hartog and Mikina (1932), Forced vibrations with non-linear spring constants,"
    " Trans. ASME 54, 157-164",
)


def _of_motions(effect: Effect) -> Effect:
    """A contact where something moves; a tank has none."""

    def places(model: Model) -> Sequence[str]:
        stores = storing_places(model)
        return tuple(name for name in effect.places(model) if name not in stores)

    return replace(effect, places=places)


def _beyond_the_brim(model: Model, target: str, names: Names) -> sp.Expr:
    """How far the content of a tank is above its brim."""
    position = storing_places(model)[target].position
    return sp.Max(position - names["highest_position"] + names["depth"], 0)


def _overflow(model: Model, target: str, names: Names) -> Model:
    place = storing_places(model)[target]
    lost = names["overflow"] * _beyond_the_brim(model, target, names)
    return model.with_term("equation", target, "overflow", place.sign * lost)


def _below(model: Model, target: str) -> tuple[str, ...]:
    """Stores that a store feeds: their balances, in its unit, follow its content."""
    places, unit = storing_places(model), balance_unit(model, target)
    position = places[target].position
    return tuple(
        name
        for name, place in places.items()
        if name != target
        and model.expand(model.equation(place.target)).has(position)
        and balance_unit(model, place.target) == unit
    )


def _overflow_below(model: Model, target: str, names: Names) -> Model:
    places = storing_places(model)
    beyond = _beyond_the_brim(model, target, names)
    lost, caught = (names[name] * beyond for name in ("overflow_below", "caught"))
    (below, *_) = _below(model, target)
    model = model.with_term("equation", target, "overflow_below", places[target].sign * lost)
    return model.with_term("equation", below, "overflow_below", -places[below].sign * caught)


_BRIM = ShapeParameter(
    "depth", "position", "h", "how far the content rises above the brim", range_grid(1 / 64, 1 / 2)
)
_TANKS = "Schoukens and Noël (2017), IFAC-PapersOnLine 50(1), 446-451"

OVERFLOW = Effect(
    id="overflow",
    family="contact",
    title="Overflow",
    formula=r"\dot q + \dots + k_o \max(q - q_\mathrm{max} + h, 0)",
    amplitudes=(Amplitude("overflow", "force/position", "k_o", "rate of loss above the brim", 1),),
    places=lambda model: tuple(storing_places(model)),
    change=_overflow,
    shapes=(_BRIM,),
    constants=(HIGHEST,),
    source=_TANKS,
    applies_to="stores: dofs of first order that are no motion",
)

OVERFLOW_BELOW = Effect(
    id="overflow_below",
    family="contact",
    title="Overflow that partly falls into the next tank",
    formula=r"\dot q_1 + \dots + k_o o, \; \dot q_2 + \dots - k_b o, \;"
    r" o = \max(q_1 - q_\mathrm{max} + h, 0)",
    amplitudes=(
        Amplitude("overflow_below", "force/position", "k_o", "rate of loss above the brim", 1),
        Amplitude("caught", "force/position", "k_b", "the part that the next tank catches", 1),
    ),
    places=lambda model: tuple(name for name in storing_places(model) if _below(model, name)),
    change=_overflow_below,
    shapes=(_BRIM,),
    constants=(HIGHEST,),
    source=_TANKS,
    applies_to="stores that feed another one",
)

CONTACT_EFFECTS = (
    *map(
        _of_motions,
        (END_STOP_LOWER, END_STOP_UPPER, HERTZIAN_LOWER, HERTZIAN_UPPER, PLAY, PRELOAD),
    ),
    OVERFLOW,
    OVERFLOW_BELOW,
)


def _places(model: Model) -> Sequence[str]:
    return tuple(
        name
        for name, place in resisting_places(model).items()
        if place.kind == "output" or (_shown_at(model, place) and _external(model, place) != 0)
    )


def _shown_at(model: Model, place: Coordinate) -> dict[str, sp.Expr]:
    """Outputs that show the position itself, up to a constant factor, and that factor."""
    moving = {*model.dofs, *model.inputs}
    found: dict[str, sp.Expr] = {}
    if place.position is None:
        return found
    for name in model.outputs:
        slope = sp.diff(model.output(name), place.position)
        if slope != 0 and not any(split_derivative(i)[0] in moving for i in slope.free_symbols):
            found[name] = slope
    return found


def _external(model: Model, place: Coordinate) -> sp.Expr:
    """The force that inputs exert in the balance at a place."""
    equation = model.equation(place.target)
    inputs = (symbol(name) for name in model.inputs)
    return -place.sign * sp.Add(*(partial(equation, item) * item for item in inputs))


def _yield(model: Model, target: str, names: Names) -> Model:
    place = force_places(model)[target]
    if place.kind == "output":
        return _yield_in_law(model, place, names["frame_compliance"])
    give = names["frame_compliance"] * _external(model, place)
    for name, slope in _shown_at(model, place).items():
        model = model.with_term("output", name, "frame_compliance", slope * give)
    return model


def _yield_in_law(model: Model, place: Coordinate, compliance: sp.Symbol) -> Model:
    """A force law behind a spring: it feels x - c F, with F as measured."""
    measured = within(place.target, place.name)
    table = {
        derivative_symbol(place.name, n): derivative_symbol(place.name, n)
        - place.sign * compliance * derivative_symbol(measured, n)
        for n in range(MAXIMUM_DERIVATIVE)
    }
    unit = model.outputs[place.target].unit
    return replace(substitute(model, table), inputs={**model.inputs, measured: unit})


FRAME = Effect(
    id="frame_compliance",
    family="compliance",
    title="Frame that gives, in series",
    formula="x = q + c F",
    amplitudes=(
        Amplitude(
            "frame_compliance", "position/force", "c", "displacement of the frame a force", 1
        ),
    ),
    places=_places,
    change=_yield,
    source="Maxwell (1867), Phil. Trans. R. Soc. 157, 49-88: a spring in series",
    applies_to="force laws, and models that show a position that a force moves",
)

COMPLIANCE_EFFECTS = (FRAME,)
