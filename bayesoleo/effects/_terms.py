r"""Terms of a model that depend on a further quantity, or on the direction of the motion.

A named term :math:`F` of a balance of forces becomes :math:`F (1 + a x)`, where :math:`x` is a
quantity that it does not follow yet, or :math:`F (1 + a \operatorname{sign} \dot q)`. A force
between two bodies is changed in both balances.

Terms are those that follow the motion at a place and are no inertia: a constant has no law, and an
excitation is measured. A term that is a definition is taken apart into the summands of that
definition. The number of candidates is bounded: quantities are the position, a pressure, absolute
temperatures and inputs that are neither motions nor forces, and each effect takes :data:`MOST`
terms at most, in the order of the model. Left out is what another effect says already: the gas's
own force, of which the families ``gas`` and ``thermal`` are, and the only damping term of a
balance, which the effects of the family ``damping`` scale.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import sympy as sp

from bayesoleo._units import dimensions
from bayesoleo.effects._effect import Effect, Names
from bayesoleo.effects._parts import Amplitude, Constant, Scales
from bayesoleo.effects._places import (
    PART,
    Between,
    SameModel,
    all_places,
    balance_terms,
    balance_unit,
    damping_terms,
    force_places,
    is_quantity,
    own_velocity,
)
from bayesoleo.errors import ModelError
from bayesoleo.model._expressions import WITHIN, split_derivative, symbol
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Coordinate

FAMILY = "dependence"
#: Terms that one effect is tried on at most.
MOST = 8
#: Names of the pressure that a gas or a fluid exerts, of which a term may be the force itself.
PRESSURES = ("gas_pressure", "pressure")
_AMBIENT = "ambient_temperature"
#: Where neither model nor runs state an ambient temperature, K.
_ROOM = 293.15


@dataclass(frozen=True)
class ModelTerm:
    """A part of a balance that follows the motion at a place.

    Parameters
    ----------
    place : Coordinate
        Whose motion it follows.
    name : str
        Of the term, or of the summand of a definition.
    whole : sympy.Expr
        All definitions inserted; between two bodies in terms of their difference.
    followed : frozenset of str
        Quantities that it follows directly: not by way of a pressure.
    balances : tuple of (str, str)
        Where it stands: ``(dof, name)``, in two balances of a force between bodies. Empty for a
        summand of a definition.
    definition : str
        That definition, else empty.
    summand : sympy.Expr
        Of the definition.
    """

    place: Coordinate
    name: str
    whole: sp.Expr
    followed: frozenset[str]
    balances: tuple[tuple[str, str], ...] = ()
    definition: str = ""
    summand: sp.Expr = sp.S.Zero

    @property
    def velocity(self) -> sp.Expr | None:
        """As it stands in ``whole``."""
        return own_velocity(self.place)

    @property
    def vanishes_at_rest(self) -> bool:
        """Whether it is a friction or a damping force."""
        velocity = self.velocity
        if velocity is None or not self.whole.has(velocity):
            return False
        return bool(self.whole.subs(velocity, 0) == 0)

    def scaled(self, model: Model, factor: sp.Expr) -> Model:
        """The model with the term times a factor, wherever it stands."""
        if self.definition:
            body = model.definitions[self.definition]
            return model.with_definition(self.definition, body + self.summand * (factor - 1))
        if self.place.kind == "output":
            term = model.output_terms(self.place.target)[self.name]
            return model.with_term("output", self.place.target, self.name, term * factor)
        for dof, name in self.balances:
            term = model.equations[dof][name]
            model = model.with_term("equation", dof, name, term * factor)
        return model


def terms_of(model: Model) -> dict[str, ModelTerm]:
    """Terms that follow the motion at a place, by ``place.term``."""
    return dict(_terms(SameModel(model)))


@lru_cache(maxsize=256)
def _terms(like: SameModel) -> tuple[tuple[str, ModelTerm], ...]:
    model = like.model
    bodies = {
        name for place in force_places(model).values() for name in (place.name, place.position_name)
    }
    found: dict[str, ModelTerm] = {}
    for target, place in all_places(model).items():
        for term in _at(model, place, bodies):
            word = "_".join(term.name.split())
            found[f"{target}{PART}{word}"] = term
    return tuple(found.items())


def _at(model: Model, place: Coordinate, bodies: set[str]) -> Iterator[ModelTerm]:
    """Terms of one place's balance."""
    for name, term in balance_terms(model, place).items():
        definition = _bare(model, term)
        if definition:
            for k, part in enumerate(sp.Add.make_args(model.definitions[definition]), start=1):
                own = part.name if isinstance(part, sp.Symbol) else f"{definition}_{k}"
                whole = _own_motion(model, place, part, bodies)
                if whole is not None:
                    followed = _followed(model, part)
                    yield ModelTerm(place, own, whole, followed, (), definition, part)
            continue
        whole = _own_motion(model, place, term, bodies)
        balances = None if whole is None else _balances(model, place, name, term)
        if whole is not None and balances is not None:
            yield ModelTerm(place, name, whole, _followed(model, term), balances)


def _bare(model: Model, term: sp.Expr) -> str:
    """The definition that a term is, up to a sign, if it is a sum; else empty."""
    _, rest = term.as_coeff_Mul()
    name = rest.name if isinstance(rest, sp.Symbol) else ""
    return name if isinstance(model.definitions.get(name), sp.Add) else ""


def _own_motion(model: Model, place: Coordinate, term: sp.Expr, bodies: set[str]) -> sp.Expr | None:
    """A term with all definitions inserted; None where it does not follow this motion alone."""
    whole = model.expand(term)
    if isinstance(place, Between):
        whole = place.seen(whole)
    own = {place.name: place.order if place.velocity is not None else 0}
    if place.position is not None:
        own.setdefault(place.position_name, 1)
    found = [split_derivative(item) for item in whole.free_symbols]
    ends = _ends(place)
    others = (bodies | ends) - own.keys()
    if not any(name in own for name, _ in found) or any(name in others for name, _ in found):
        return None
    return None if any(order > own[name] for name, order in found if name in own) else whole


def _ends(place: Coordinate) -> set[str]:
    """Names of the coordinates whose difference a place is."""
    if not isinstance(place, Between):
        return set()
    return {split_derivative(item)[0] for _, *pair in place.ends for item in pair}


def _balances(
    model: Model, place: Coordinate, name: str, term: sp.Expr
) -> tuple[tuple[str, str], ...] | None:
    """Where a force stands; None where its counterpart on the other body is not found."""
    if place.kind == "output":
        return ()
    here = (place.target, name)
    if not isinstance(place, Between) or place.share == 0:
        return (here,)
    whole = model.expand(term)
    for other, opposite in model.equations[place.other].items():
        left = model.expand(opposite) - whole * place.share / place.sign
        if sp.simplify(left) == 0:
            return (here, (place.other, other))
    return None


def _followed(model: Model, term: sp.Expr) -> frozenset[str]:
    """Names that an expression holds, by way of definitions that are no pressure."""
    found, left = set[str](), {term}
    while left:
        for item in left.pop().free_symbols:
            name, order = split_derivative(item)
            if order == 0 and name not in found:
                found.add(name)
                if name in model.definitions and name not in PRESSURES:
                    left.add(model.definitions[name])
    return frozenset(found)


# -- quantities ------------------------------------------------------------------------------------


def _positions(model: Model, term: ModelTerm) -> tuple[str, ...]:
    place = term.place
    return () if place.velocity is None or place.position is None else (place.position_name,)


def _pressures(model: Model, term: ModelTerm) -> tuple[str, ...]:
    declared = next((name for name in PRESSURES if name in model.definitions), None)
    if declared is not None:
        return (declared,)
    return _of_unit(model, term, "Pa")


def _temperatures(model: Model, term: ModelTerm) -> tuple[str, ...]:
    """Absolute temperatures: an excess, whose guess is zero, has no ratio."""
    found = _of_unit(model, term, "K")
    excess = {name for name, dof in model.dofs.items() if sp.sympify(dof.guess).is_zero}
    stated = (n for n, item in model.conditions.items() if _is_of(item.unit, "K"))
    own = (term.place.name,) if _is_heat_flow(model, term) else ()
    return (*(name for name in (*own, *found) if name not in excess), *stated)


def _is_heat_flow(model: Model, term: ModelTerm) -> bool:
    """Whether a term follows the temperature whose balance it stands in: its coefficient may vary
    with that too, as of radiation or of a free flow of air."""
    place = term.place
    if place.kind != "equation" or place.velocity is not None or place.name not in model.dofs:
        return False
    return _is_of(model.dofs[place.name].unit, "K")


def _others(model: Model, term: ModelTerm) -> tuple[str, ...]:
    """Inputs that are no motion, force, pressure or temperature at a place, such as a current."""
    moving = {place.name for place in force_places(model).values()}
    balance = _unit_of_balance(model, term.place)
    return tuple(
        name
        for name, unit in model.inputs.items()
        if WITHIN not in name
        and name not in moving
        and unit
        and not _is_of(unit, "Pa")
        and not _is_of(unit, "K")
        and not _is_of(unit, "m")
        and not (balance and _is_of(unit, balance))
    )


def _unit_of_balance(model: Model, place: Coordinate) -> str:
    if place.kind == "output":
        return model.outputs[place.target].unit
    return balance_unit(model, place.target)


def _of_unit(model: Model, term: ModelTerm, unit: str) -> tuple[str, ...]:
    """Dofs of first order and inputs in a unit, that are no motion at the place."""
    declared = {name: item.unit for name, item in model.dofs.items() if model.order(name) == 1}
    declared |= {name: text for name, text in model.inputs.items() if WITHIN not in name}
    balance = _unit_of_balance(model, term.place)
    return tuple(
        name
        for name, text in declared.items()
        if name != term.place.name and _is_of(text, unit) and not (balance and balance == text)
    )


def _is_of(text: str, unit: str) -> bool:
    try:
        return bool(text) and dimensions(text) == dimensions(unit)
    except ModelError:
        return False


_QUANTITIES = {
    "stroke": _positions,
    "pressure": _pressures,
    "temperature": _temperatures,
    "input": _others,
}


def _is_told_otherwise(model: Model, term: ModelTerm, kind: str, quantity: str) -> bool:
    """Whether the term follows a quantity already, or another effect says the same."""
    if kind == "temperature" and quantity == term.place.name:
        return False
    position = term.place.position if kind == "stroke" else None
    names = {quantity} if position is None else {item.name for item in position.free_symbols}
    if names <= term.followed:
        return True
    if not term.vanishes_at_rest and term.followed & set(PRESSURES):
        return True  # the force of a gas
    alone = damping_terms(model, term.place)
    if isinstance(term.place, Between) or set(alone) != {term.name}:
        return False
    if kind == "temperature":
        return quantity == kind and is_quantity(model, "temperature_ratio")
    return kind in ("stroke", "direction")


def _places(model: Model, kind: str) -> tuple[str, ...]:
    """Targets ``place.term.quantity``, and ``place.term`` of the direction."""
    found = []
    for target, term in terms_of(model).items():
        if kind == "direction":
            if term.vanishes_at_rest and not _is_told_otherwise(model, term, kind, ""):
                found.append(target)
            continue
        for name in _QUANTITIES[kind](model, term):
            if not _is_told_otherwise(model, term, kind, name):
                found.append(f"{target}{PART}{name}")
    return tuple(found[:MOST])


def _reference(model: Model, target: str, scales: Scales) -> float:
    """The ambient temperature; else where the quantity starts, or the middle of its range."""
    name = target.rsplit(PART, 1)[1]
    if name in scales.conditions:
        return scales.conditions[name]
    nominal = {item.name: value for item, value in model.nominal().items()}
    stated = {**nominal, **scales.conditions}
    guess = sp.sympify(model.dofs[name].guess) if name in model.dofs else sp.Integer(0)
    guess = guess.subs({item: stated.get(str(item), item) for item in guess.free_symbols})
    if _AMBIENT in stated:
        return float(stated[_AMBIENT])
    if guess.is_number and guess > 0:
        return float(guess)
    return float(sum(scales.position.get(name, (_ROOM, _ROOM))) / 2)


def _dependent(kind: str, title: str, formula: str, amplitude: Amplitude, source: str) -> Effect:
    """An effect that multiplies a term by one plus its amplitude times a quantity."""
    relative = kind == "temperature"

    def change(model: Model, target: str, names: Names) -> Model:
        if kind == "direction":
            term = terms_of(model)[target]
            assert term.place.velocity is not None
            return term.scaled(model, 1 + names[amplitude.name] * sp.sign(term.place.velocity))
        where, quantity = target.rsplit(PART, 1)
        term = terms_of(model)[where]
        x = term.place.position if kind == "stroke" else symbol(quantity)
        x = x / names["reference"] - 1 if relative else x
        return term.scaled(model, 1 + names[amplitude.name] * x)

    reference = Constant("reference", "K", "temperature at which the term is as stated", _reference)
    return Effect(
        id=amplitude.name,
        family=FAMILY,
        title=title,
        formula=formula,
        amplitudes=(amplitude,),
        places=lambda model: _places(model, kind),
        change=change,
        constants=(reference,) if relative else (),
        source=source,
        applies_to="terms of a balance of forces that follow the motion, one by one"
        + ("" if kind != "direction" else ", and vanish at rest"),
        own_name_per_target=True,
    )


_MODULATED = "the first term of a Taylor series of a term's coefficient"

DIRECTION = _dependent(
    "direction",
    "Term that differs between the two directions",
    r"F(\dot q) \, (1 + a \operatorname{sign} \dot q)",
    Amplitude(
        "direction_dependent_term", "", "a", "half the difference over the mean of directions"
    ),
    "Armstrong-Helouvry, Dupont and Canudas de Wit (1994), Automatica 30(7), 1083-1138",
)
STROKE = _dependent(
    "stroke",
    "Term that changes along the stroke",
    r"F \, (1 + a q)",
    Amplitude("stroke_dependent_term", "1/quantity", "a", "relative change a stroke"),
    _MODULATED,
)
PRESSURE = _dependent(
    "pressure",
    "Term that changes with pressure",
    r"F \, (1 + a p)",
    Amplitude("pressure_dependent_term", "1/quantity", "a", "relative change a pressure"),
    _MODULATED,
)
TEMPERATURE = _dependent(
    "temperature",
    "Term that changes with temperature",
    r"F \, (1 + a (T/T_0 - 1))",
    Amplitude("temperature_dependent_term", "", "a", "relative change with T/T_0"),
    _MODULATED,
)
INPUT = _dependent(
    "input",
    "Term that changes with another input",
    r"F \, (1 + a u)",
    Amplitude("input_dependent_term", "1/quantity", "a", "relative change an input"),
    _MODULATED,
)

EFFECTS = (DIRECTION, STROKE, PRESSURE, TEMPERATURE, INPUT)
