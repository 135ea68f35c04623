"""Where force-like effects can act, and which terms of a balance already resist motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import sympy as sp

from bayesoleo.model import Coordinate, Model
from bayesoleo.model.expressions import WITHIN, derivative_symbol, split_derivative
from bayesoleo.model.initial import with_starts
from bayesoleo.units import dimensions


def force_places(model: Model) -> dict[str, Coordinate]:
    """Places of a force-like effect by target.

    A target is the name of a second-order dof's equation, or of an output that follows an input (a
    force law). Where an output follows several inputs the target is ``output/input``; an input that
    is no motion to the output's force, such as a pressure to a force, is no place.
    """
    # An input that goes with another one is no motion of its own.
    coordinates = [item for item in model.coordinates() if WITHIN not in item.name]
    second = [item for item in coordinates if item.kind == "equation" and item.velocity is not None]
    laws = [item for item in coordinates if item.kind == "output"]
    first = [item for item in coordinates if item.kind == "equation" and item.velocity is None]
    # Where a balance of forces exists the forces act there: an output that shows an input as well
    # (a compliant frame) is no second place, nor is the state of a memory or a temperature.
    chosen = second or laws or first
    shared = Counter((item.kind, item.target) for item in chosen)
    places = {}
    for item in chosen:
        alone = shared[item.kind, item.target] == 1
        if item.kind == "equation" or _is_motion(model, item):
            places[item.target if alone else f"{item.target}/{item.name}"] = item
    return places


def _is_motion(model: Model, place: Coordinate) -> bool:
    """Whether an input is to an output what a motion is to its force: together they do work.

    A pressure or a stress does work over a length, a volume or a strain. Where a unit is not
    declared nobody knows; two channels in one unit, such as volts, may be raw readings of a pair.
    """
    force, motion = model.outputs[place.target].unit, model.inputs[place.name]
    if not force or not motion:
        return True
    powers, moved = dimensions(force), dimensions(motion)
    if powers == moved:
        return True
    if not (set(moved) <= {"[length]"} or moved == dimensions("C")):
        return False
    for base, power in moved.items():
        powers[base] = powers.get(base, 0) + power
    for base, power in dimensions("J").items():
        powers[base] = powers.get(base, 0) - power
    # Work; or that by length, area or volume; or by mass, where a law is of accelerations.
    by_length, by_mass = powers.pop("[length]", 0), powers.pop("[mass]", 0)
    return -3 <= by_length <= 0 and by_mass in (0, -1) and not any(powers.values())


def drives(model: Model) -> tuple[str, ...]:
    """Inputs that are channels of their own, the one that gives the clock first."""
    return tuple(name for name in model.inputs if WITHIN not in name)


def resisting_places(model: Model) -> dict[str, Coordinate]:
    """Those of :func:`force_places` whose balance resists motion: a pressure that is measured
    beside a force is no second force."""
    found = force_places(model)
    laws = {name: place for name, place in found.items() if place.kind == "output"}
    resisting = {
        name: place
        for name, place in laws.items()
        if place.velocity is not None and model.output(place.target).has(place.velocity)
    }
    return {k: item for k, item in found.items() if k not in laws} | (resisting or laws)


def moving_places(model: Model) -> dict[str, Coordinate]:
    """Those of :func:`force_places` that have a velocity."""
    return {k: item for k, item in force_places(model).items() if item.velocity is not None}


def balance_terms(model: Model, place: Coordinate) -> dict[str, sp.Expr]:
    """Named terms of the balance at a place."""
    if place.kind == "equation":
        return dict(model.equations[place.target])
    return dict(model.output_terms(place.target))


def acceleration(place: Coordinate) -> sp.Expr:
    """Symbol of the second derivative of the position."""
    return derivative_symbol(place.name, 2)


def damping_terms(model: Model, place: Coordinate) -> dict[str, sp.Expr]:
    """Terms of a balance that grow with velocity and vanish without it.

    Friction saturates and so is none: the test is whether doubling a large velocity raises the term
    by half or more.
    """
    found = {}
    for name, term in balance_terms(model, place).items():
        whole = model.expand(term)
        if place.velocity is not None and whole.has(place.velocity):
            at_rest = whole.subs(place.velocity, 0)
            if at_rest == 0 and _grows(whole, place.velocity, model):
                found[name] = term
    return found


def resistance_sense(model: Model, place: Coordinate) -> int:
    """Sense in which a balance's damping grows with velocity, +1 or -1; 0 where it has none, or
    its terms disagree."""
    values = {
        float(np.sign(_at_velocity(model.expand(term), place.velocity, model, 1.0).real))
        for term in damping_terms(model, place).values()
    }
    return int(values.pop()) if len(values) == 1 else 0


def _grows(term: sp.Expr, velocity: sp.Expr, model: Model) -> bool:
    """Whether the term at twice a velocity is at least 1.5 times itself, at a mid-range state."""
    once, twice = (abs(_at_velocity(term, velocity, model, value)) for value in (1.0, 2.0))
    return twice >= 1.5 * once > 0


def _at_velocity(term: sp.Expr, velocity: sp.Expr, model: Model, value: float) -> complex:
    numbers = model.nominal()
    # Any state will do that is off every zero; one half is inside a volume ratio of zero to one.
    others = {item: 0.5 for item in term.free_symbols if item not in numbers and item != velocity}
    return complex(term.subs(numbers).subs(others).subs(velocity, value))


def spring_force(model: Model, place: Coordinate) -> sp.Expr:
    """Sum of the terms of a balance that follow the position and neither velocity nor an input."""
    total = sp.Integer(0)
    for term in balance_terms(model, place).values():
        whole = model.expand(term)
        inputs = {name for name in model.inputs if name != place.name}
        free = {split_derivative(item) for item in whole.free_symbols}
        moving = any(order > 0 or name in inputs for name, order in free)
        if whole.has(place.position) and not moving:
            total += term
    return total


#: Constants that effects look for by name, whether or not a model's own equations hold them.
LOOKED_FOR = frozenset(
    {"ambient_temperature", "ambient_pressure", "initial_volume", "initial_pressure", "gravity"}
)


def is_quantity(model: Model, *names: str) -> bool:
    """Whether all names are declared in the model."""
    known = {*model.inputs, *model.dofs, *model.parameters, *model.conditions, *model.definitions}
    return known.issuperset(names)


def measures(model: Model, name: str, unit: str) -> bool:
    """Whether a declared quantity is in a unit of this kind, as far as units tell."""
    declared = {**model.inputs, **{key: item.unit for key, item in model.dofs.items()}}
    declared |= {key: item.unit for key, item in model.parameters.items()}
    declared |= {key: item.unit for key, item in model.conditions.items()}
    own = declared.get(name, "")
    return not own or dimensions(own) == dimensions(unit)


def substitute(model: Model, table: Mapping[sp.Symbol, sp.Expr]) -> Model:
    """Replace symbols everywhere in a model: definitions, equations, outputs, admissible region."""

    def swap(expression: sp.Expr) -> sp.Expr:
        return expression.xreplace(table)

    return replace(
        model,
        dofs=with_starts(model, swap),
        definitions={name: swap(e) for name, e in model.definitions.items()},
        equations={
            name: {term: swap(e) for term, e in terms.items()}
            for name, terms in model.equations.items()
        },
        outputs={
            name: replace(
                output, terms={term: swap(e) for term, e in model.output_terms(name).items()}
            )
            for name, output in model.outputs.items()
        },
        admissible=[swap(e) for e in model.admissible],
    )
