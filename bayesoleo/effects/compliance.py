"""Compliance in series: the frame gives, so what is measured is not what moves.

Where a force drives the model, the measured position shows what the frame gives as well. Where the
position drives it, the position behind the frame is what is measured less compliance times the
force *as measured*. Solving for that position with the predicted force instead would need harmonics
of the position that are below its noise: dry friction jumps, and so does what the frame gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import sympy as sp

from bayesoleo.effects.effect import Effect, Names
from bayesoleo.effects.parts import Amplitude
from bayesoleo.effects.places import force_places, resisting_places, substitute
from bayesoleo.model import Coordinate, Model
from bayesoleo.model.drive import MAXIMUM_DERIVATIVE
from bayesoleo.model.expressions import (
    derivative_symbol,
    partial,
    split_derivative,
    symbol,
    within,
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
    found = {}
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
        - compliance * derivative_symbol(measured, n)
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

EFFECTS = (FRAME,)
