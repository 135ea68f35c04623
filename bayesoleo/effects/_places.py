"""Places where effects can act, and units of expressions there.

A force-like effect acts in a balance of forces. The units at a place give the parameters of an
effect their units. The terms of a balance that already resist motion are found by their form.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from bayesoleo._units import TORQUE, base_unit, dimensions
from bayesoleo.errors import ModelError
from bayesoleo.model._drive_and_start import with_starts
from bayesoleo.model._expressions import TIME, WITHIN, derivative_symbol, split_derivative, symbol
from bayesoleo.model._kernels import Structured
from bayesoleo.model._model import Model, velocities_of
from bayesoleo.model._parameters import Coordinate

#: Names that a reader expects instead of base units.
_USUAL = ("N", "Pa", "W", "J", "V", "N*m", "V/s")


def parse_unit(text: str) -> Any:
    """Unit of a text as pint reads it, in base units; a number where the text is empty."""
    try:
        return base_unit(text)
    except Exception as error:
        hint = "write it as pint reads it, e.g. N*s/m"
        raise ModelError("unknown unit", value=text, hint=hint) from error


def unit_text(unit: Any) -> str:
    """Shortest usual text of a unit."""
    for name in _USUAL:
        if parse_unit(name) == unit:
            return name
    return f"{unit:~C}"


def unit_of(expression: sp.Expr, model: Model) -> Any:
    """Unit of an expression over a model's names, in base units.

    Raises
    ------
    ModelError
        If summands differ in unit, or an exponent or a function's argument has a unit.
    """
    if isinstance(expression, sp.Symbol):
        return _unit_of_symbol(expression, model)
    if expression.is_number:
        return parse_unit("")
    if isinstance(expression, sp.Add | sp.Max | sp.Min):
        return _common_unit(expression, model)
    if isinstance(expression, sp.Mul):
        product = parse_unit("")
        for factor in expression.args:
            product = product * unit_of(factor, model)
        return product
    if isinstance(expression, sp.Pow):
        return _unit_of_power(expression, model)
    if isinstance(expression, sp.Abs):
        return unit_of(expression.args[0], model)
    if not isinstance(expression, sp.sign | sp.Heaviside):
        _require_number(expression.args[0], model)
    return parse_unit("")


def _unit_of_symbol(item: sp.Symbol, model: Model) -> Any:
    if item == TIME:
        return parse_unit("s")
    name, order = split_derivative(item)
    if name in model.definitions:
        return unit_of(model.definitions[name], model)
    return parse_unit(_declared_units(model)[name]) / parse_unit("s") ** order


def _declared_units(model: Model) -> dict[str, str]:
    declared = model.dofs, model.parameters, model.conditions
    units = {name: item.unit for items in declared for name, item in items.items()}
    return {**model.inputs, **units}


def _common_unit(expression: sp.Expr, model: Model) -> Any:
    """Of a sum; zero fits every unit."""
    units = [unit_of(item, model) for item in expression.args if item != 0]
    if any(unit != units[0] for unit in units):
        raise ModelError("summands differ in unit", value=str(expression))
    return units[0]


def _unit_of_power(expression: sp.Pow, model: Model) -> Any:
    base, exponent = expression.args
    unit = unit_of(base, model)
    _require_number(exponent, model)
    if unit == parse_unit(""):
        return unit
    if not exponent.is_number:
        raise ModelError("the power of a unit must be a number", value=str(expression))
    return unit ** float(exponent)


def _require_number(expression: sp.Expr, model: Model) -> None:
    if unit_of(expression, model) != parse_unit(""):
        raise ModelError("argument must be a number", value=str(expression))


def balance_unit(model: Model, dof: str) -> str:
    """Unit of a dof's equation: that of the first of its terms whose unit is defined, or of a later
    one whose unit has a usual name: inertia times rad/s**2 is a torque, in N*m."""
    found = []
    for term in model.equations[dof].values():
        try:
            found.append(unit_text(unit_of(term, model)))
        except ModelError:
            continue  # a term with bare numbers in it says nothing; the next one may
    unit = next((unit for unit in found if unit in _USUAL), next(iter(found), ""))
    turns = "rad" in re.findall(r"\w+", model.dofs[dof].unit)
    return TORQUE if unit == "J" and turns else unit


@dataclass(frozen=True)
class TargetUnits:
    """Units at a place, under the words that effects use for them."""

    words: dict[str, str]

    def resolve(self, text: str) -> str:
        """Replace the words ``force``, ``position``, ``channel``, ``parameter``, ``quantity``."""

        def unit(match: re.Match[str]) -> str:
            word = self.words.get(match.group(), "") or "dimensionless"
            alone = word.isidentifier() or match.group() == text
            return word if alone else f"({word})"

        composed = re.sub(r"\b(force|position|channel|parameter|quantity)\b", unit, text)
        if parse_unit(composed) == parse_unit(""):
            return ""
        simple = unit_text(parse_unit(composed))
        # A unit that stands twice may cancel: a flow in V/s over a level in V is a rate.
        names = re.findall(r"[^\W\d]+", composed)
        cancels = len(set(names)) < len(names) and len(simple) < len(composed)
        return simple if cancels or "dimensionless" in composed else composed


def target_units(model: Model, target: str) -> TargetUnits:
    """Units at a target: of the balance and the position, of the channel, of the parameter, and of
    the quantity that a term of the balance follows."""
    words: dict[str, str] = {}
    between = between_places(model).get(balance_of(target)) if BETWEEN in target else None
    words |= _unit_of_quantity(model, target, between)
    target = balance_of(target) if between is None else between.target
    name, _, coordinate = target.partition("/")
    if name in model.dofs:
        words |= {"force": balance_unit(model, name), "position": position_unit(model, name)}
    if name in model.parameters:
        words |= {"parameter": model.parameters[name].unit}
    if name in model.conditions:
        words |= {"parameter": model.conditions[name].unit}
    if name in model.inputs:
        words |= {"channel": model.inputs[name]}
    if name in model.outputs:
        unit = model.outputs[name].unit
        words |= {"channel": unit}
        if name not in model.dofs:
            words |= {"force": unit, "position": _unit_of_motion(model, name, coordinate)}
    return TargetUnits(words)


def position_unit(model: Model, dof: str) -> str:
    """Unit of the position at a dof: where that is a velocity, of its integral."""
    unit = model.dofs[dof].unit
    if dof not in velocities_of(model).velocities:
        return unit
    return unit_text(parse_unit(unit) * parse_unit("s"))


def _unit_of_quantity(model: Model, target: str, between: Between | None) -> dict[str, str]:
    """Unit of the quantity of ``place.term.quantity`` under its word, where it is known."""
    name = target.rsplit(PART, 1)[1] if PART in target else ""
    if between is not None and name == between.position_name:
        return {"quantity": position_unit(model, between.dof)}
    if name in model.definitions:
        try:
            return {"quantity": unit_text(unit_of(symbol(name), model))}
        except ModelError:
            return {}  # bare numbers in a definition leave it without one
    declared = _declared_units(model)
    return {"quantity": declared[name]} if name in declared else {}


def _unit_of_motion(model: Model, output: str, coordinate: str) -> str:
    """Unit of the input that an output follows."""
    moving = {split_derivative(item)[0] for item in model.output(output).free_symbols}
    names = [coordinate] if coordinate else [name for name in model.inputs if name in moving]
    return unit_text(_unit_of_symbol(symbol(names[0]), model)) if names else ""


def force_places(model: Model) -> dict[str, Coordinate]:
    """Places of a force-like effect by target.

    A target is the name of the equation of a dof that is of second order or a velocity, or of an
    output that follows an input (a force law). Where an output follows several inputs the target is
    ``output/input``; an input that is no motion to the output's force, such as a pressure to a
    force, is no place.
    """
    # An input that goes with another one is no motion of its own.
    coordinates = [item for item in model.coordinates() if WITHIN not in item.name]
    second = [item for item in coordinates if item.kind == "equation" and item.velocity is not None]
    laws = [item for item in coordinates if item.kind == "output"]
    first = [item for item in coordinates if item.kind == "equation" and item.velocity is None]
    # Where a balance of forces exists the forces act there: an output that shows an input as well
    # (a compliant frame) is no second place, nor is the state of a memory, a temperature or the
    # current of a motor.
    chosen = second or laws or first
    shared = Counter((item.kind, item.target) for item in chosen)
    places = {}
    for item in chosen:
        alone = shared[item.kind, item.target] == 1
        if item.kind == "equation" or _is_motion(model, item):
            places[item.target if alone else f"{item.target}/{item.name}"] = item
    return places


#: In a target: between the names of two bodies.
BETWEEN = "-"
#: Between the parts of a target: a term of a balance, and the quantity that the term follows.
PART = "."


def balance_of(target: str) -> str:
    """The balance of a target, without the term of it that an effect changes."""
    return target.split(PART)[0]


@dataclass(frozen=True)
class Between(Coordinate):
    """A place between two bodies: a force acts on both, with opposite signs.

    Its position is the difference of two coordinates. A resisting force does the work that the
    difference's rate takes out, so that it enters the other balance with the opposite sign, scaled
    as that balance is.

    Parameters
    ----------
    dof, other : str
        The coordinates: the position is ``dof - other``, or the velocity is.
    share : sympy.Expr
        What is added to the balance of ``other`` for a unit force; zero where that is an input.
    ends : tuple of (sympy.Symbol, sympy.Symbol, sympy.Symbol)
        Position and velocity by symbols of their own, each with those of the two coordinates.
    """

    dof: str = ""
    other: str = ""
    share: sp.Expr = sp.S.Zero
    ends: tuple[tuple[sp.Symbol, sp.Symbol, sp.Symbol], ...] = ()

    def seen(self, expression: sp.Expr) -> sp.Expr:
        """An expression with ``dof`` in terms of the difference, which stands in its symbols."""
        return expression.xreplace({one: own + other for own, one, other in self.ends})


def own_velocity(place: Coordinate) -> sp.Symbol | None:
    """The velocity of a place by a symbol of its own, also of a difference."""
    return None if place.velocity is None else derivative_symbol(place.name, place.order)


#: Places between two dofs that no term of the model joins, at most.
UNJOINED = 3


def between_places(model: Model) -> dict[str, Between]:
    """Places between two dofs of second order or velocities, or between one and an input, by target
    ``dof-other``.

    They are the differences that the model's own terms follow; of two velocities the position is
    the difference of theirs, or the dof whose rate is that of the velocities (a twist). Where there
    are at most
    :data:`UNJOINED` of them, differences of any two dofs of one unit that have an inertia of their
    own follow, up to that number.
    Balances of two dofs that a term of the model joins may be scaled differently, as if each was
    divided by its mass: by reciprocity the ratio of the joining terms is that of the scales.
    Without such a term both must be in one unit, and in no unit of acceleration.
    """
    return dict(_between(SameModel(model)))


class SameModel:
    """A model as the key of a cache: equal where equations and coordinates are."""

    def __init__(self, model: Model):
        self.model = model
        self._places = model.coordinates()

    def __hash__(self) -> int:
        return hash(self.model.structure)

    def __eq__(self, other: object) -> bool:
        same = isinstance(other, SameModel) and self._places == other._places
        return same and self.model.structure == other.model.structure  # type: ignore[attr-defined]


@lru_cache(maxsize=256)
def _between(like: SameModel) -> tuple[tuple[str, Between], ...]:
    model = like.model
    bodies = {
        item.name: item
        for item in model.coordinates()
        if item.kind == "equation" and item.velocity is not None and WITHIN not in item.name
    }
    others = [*bodies, *(name for name in drives(model) if name not in bodies)]
    found: dict[str, Between] = {}
    apart: list[_Pair] = []
    for one in bodies.values():
        for other in others[others.index(one.name) + 1 :]:
            pair = _pair(model, one, bodies.get(other), other)
            if _joins(model, pair):
                found |= _made(model, pair)
            elif pair.second is not None and _alike(model, one, pair.second):
                apart.append(pair)
    for pair in apart[: max(UNJOINED - len(found), 0)]:
        found |= _made(model, pair)
    return tuple(found.items())


@dataclass(frozen=True)
class _Pair:
    """Two coordinates that a force may act between.

    Parameters
    ----------
    one : Coordinate
        Of a dof.
    second : Coordinate, optional
        Of the other one, if it is a dof too.
    other : str
        Its name.
    positions, velocities : tuple of sympy.Symbol
        Of both; positions are empty where they are not known.
    twist : str
        The dof whose rate is the difference of the velocities; empty without one.
    """

    one: Coordinate
    second: Coordinate | None
    other: str
    positions: tuple[sp.Symbol, ...]
    velocities: tuple[sp.Symbol, sp.Symbol]
    twist: str

    def joining(self, order: int) -> tuple[sp.Symbol, ...]:
        """The symbols of one order of the motion, if any."""
        return (self.positions, self.velocities)[order]


def _pair(model: Model, one: Coordinate, second: Coordinate | None, other: str) -> _Pair:
    """Two coordinates; where a twist is of the second less the first they change places."""
    twist = None
    if second is not None and one.order == second.order == 0:
        twist = velocities_of(model).position_of(one.name, other)
        turned = velocities_of(model).position_of(other, one.name)
        if twist is None and turned is not None:
            one, second, other, twist = second, one, one.name, turned
    if second is not None:
        position, velocity = second.position, second.velocity
    elif one.order == 0 and _is_of_unit(model.inputs[other], model.dofs[one.name].unit):
        position, velocity = None, symbol(other)
    else:
        position, velocity = symbol(other), derivative_symbol(other, 1)
    known = twist is None and one.position is not None and position is not None
    positions = (one.position, position) if known else ()
    return _Pair(one, second, other, positions, (one.velocity, velocity), twist or "")


def _is_of_unit(text: str, unit: str) -> bool:
    return bool(text) and parse_unit(text) == parse_unit(unit)


def _alike(model: Model, one: Coordinate, other: Coordinate) -> bool:
    """Whether two coordinates are of one kind: in one unit, each with an inertia of its own.

    Where the inertia of one body moves with both, one coordinate is a difference already.
    """
    mixed = model.expand(model.equation(one.target)).has(other.acceleration)
    mixed |= model.expand(model.equation(other.target)).has(one.acceleration)
    return not mixed and model.dofs[one.name].unit == model.dofs[other.name].unit


def _joins(model: Model, pair: _Pair) -> bool:
    """Whether a term of a balance follows the difference of two coordinates and neither alone."""
    parts = [
        part
        for term in model.equations[pair.one.target].values()
        for part in sp.Add.make_args(model.expand(term))
    ]
    if pair.twist and any(part.has(symbol(pair.twist)) for part in parts):
        return True
    for part in parts:
        pairs = [pair.joining(order) for order in range(2)]
        pairs = [both for both in pairs if both and part.has(*both)]
        if pairs and all(
            part.has(a) and part.has(b) and sp.expand(sp.diff(part, a) + sp.diff(part, b)) == 0
            for a, b in pairs
        ):
            return True
    return False


def _made(model: Model, pair: _Pair) -> dict[str, Between]:
    """The place between two coordinates; none where the scales of their balances are unknown."""
    share = sp.Integer(0) if pair.second is None else _share(model, pair)
    if share is None:
        return {}
    one, name = pair.one, f"{pair.one.name}{BETWEEN}{pair.other}"
    position, position_name = None, name
    ends = [(derivative_symbol(name, one.order), *pair.velocities)]
    if pair.twist:
        position, position_name = symbol(pair.twist), pair.twist
    elif pair.positions:
        here, there = pair.positions
        position = here - there
        if one.order == 0:
            position_name = f"{here}{BETWEEN}{there}"
        ends.append((symbol(position_name), here, there))
    velocity = pair.velocities[0] - pair.velocities[1]
    place = Between(
        name, position, velocity, "equation", one.target, one.sign, position_name, one.order,
        one.name, pair.other, share, tuple(ends),
    )  # fmt: skip
    return {name: place}


def _share(model: Model, pair: _Pair) -> sp.Expr | None:
    """What a unit force between two bodies adds to the second balance; None where unknown."""
    one, other = pair.one, pair.second
    assert other is not None
    here, there = (model.expand(model.equation(item.target)) for item in (one, other))
    joining = [both for both in map(pair.joining, range(2)) if both]
    slopes = [(sp.diff(here, b), sp.diff(there, a)) for a, b in joining]
    if pair.twist:
        slopes.append((-sp.diff(here, symbol(pair.twist)), sp.diff(there, symbol(pair.twist))))
    for forth, back in slopes:
        if forth != 0 and back != 0:
            ratio = sp.simplify(back / forth)
            if not _moving_names(model, ratio):
                return -one.sign * ratio
    units = [balance_unit(model, item.target) for item in (one, other)]
    alike = dimensions(units[0]) == dimensions(units[1])
    return None if not alike or _is_scaled(model, one) else sp.Integer(-other.sign)


def _is_scaled(model: Model, one: Coordinate) -> bool:
    """Whether the unit of a balance tells that it is divided by a mass; of one in a velocity, by a
    damping."""
    unit, moved = balance_unit(model, one.target), position_unit(model, one.name)
    if not unit or not moved:
        return False
    orders = (1, 2) if one.order == 0 else (2,)
    return any(dimensions(unit) == dimensions(f"({moved})/s**{n}") for n in orders)


def _moving_names(model: Model, expression: sp.Expr) -> set[str]:
    names = {split_derivative(item)[0] for item in expression.free_symbols}
    return names & {*model.dofs, *model.inputs}


def all_places(model: Model) -> dict[str, Coordinate]:
    """Those of :func:`force_places` and of :func:`between_places`."""
    return {**force_places(model), **between_places(model)}


def place_at(model: Model, target: str) -> Coordinate:
    """The place of a target, or of the balance whose term it is."""
    found = force_places(model)
    name = balance_of(target)
    return found[name] if name in found else between_places(model)[name]


def with_force(model: Model, place: Coordinate, name: str, force: sp.Expr) -> Model:
    """Add a resisting force at a place: in a balance, or with opposite signs in two."""
    model = model.with_term(place.kind, place.target, name, place.sign * force)
    if isinstance(place, Between) and place.share != 0:
        model = model.with_term("equation", place.other, name, place.share * force)
    return model


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


def positioned_places(model: Model) -> dict[str, Coordinate]:
    """Those of :func:`force_places` that have a position, unlike a free shaft."""
    return {k: item for k, item in force_places(model).items() if item.position is not None}


def balance_terms(model: Model, place: Coordinate) -> dict[str, sp.Expr]:
    """Named terms of the balance at a place."""
    if place.kind == "equation":
        return dict(model.equations[place.target])
    return dict(model.output_terms(place.target))


def damping_terms(model: Model, place: Coordinate) -> dict[str, sp.Expr]:
    """Terms of a balance that grow with velocity and vanish without it.

    Friction saturates and so is none: the test is whether doubling a large velocity raises the term
    by half or more.
    """
    return dict(_damping_terms(Structured(model), place, tuple(model.nominal().items())))


@lru_cache(maxsize=256)  # most effects of a search ask the same of one model
def _damping_terms(
    like: Structured, place: Coordinate, _: tuple[tuple[sp.Symbol, float], ...]
) -> tuple[tuple[str, sp.Expr], ...]:
    """The same of any model with these equations and nominal values."""
    model, found = like.model, []
    for name, term in balance_terms(model, place).items():
        whole = model.expand(term)
        if place.velocity is not None and whole.has(place.velocity):
            at_rest = whole.subs(place.velocity, 0)
            if at_rest == 0 and _grows(whole, place.velocity, model):
                found.append((name, term))
    return tuple(found)


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
    if place.position is None:
        return total
    others = {name for name in model.inputs if name != place.name}
    others |= velocities_of(model).velocities
    for term in balance_terms(model, place).values():
        whole = model.expand(term)
        free = {split_derivative(item) for item in whole.free_symbols}
        moving = any(order > 0 or name in others for name, order in free)
        if whole.has(place.position) and not moving:
            total += term
    return total


#: Constants that effects look for by name, whether or not a model's own equations hold them.
LOOKED_FOR = frozenset(
    {"ambient_temperature", "ambient_pressure", "initial_volume", "initial_pressure", "gravity"}
)


def storing_places(model: Model) -> dict[str, Coordinate]:
    """Those of :func:`force_places` where something is stored, such as the water of a tank: first
    order, no velocity, and what stands before the rate is no damping (a force over a velocity). A
    temperature stores heat, and has no level above which that runs over.

    Where units are not declared nobody knows, and the place counts.
    """
    found = {}
    for name, place in force_places(model).items():
        if place.kind != "equation" or place.velocity is not None:
            continue
        powers = dimensions(balance_unit(model, place.target))
        for base, power in dimensions(model.dofs[place.name].unit).items():
            powers[base] = powers.get(base, 0) - power
        damping = powers.get("[mass]", 0) == 1 and powers.get("[time]", 0) == -2
        warm = dimensions(model.dofs[place.name].unit) == dimensions("K")
        if not (damping or warm):
            found[name] = place
    return found


def is_quantity(model: Model, *names: str) -> bool:
    """Whether all names are declared in the model."""
    known = {*model.inputs, *model.dofs, *model.parameters, *model.conditions, *model.definitions}
    return known.issuperset(names)


def measures(model: Model, name: str, unit: str) -> bool:
    """Whether a declared quantity is in a unit of this kind, as far as units tell."""
    own = _declared_units(model).get(name, "")
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
