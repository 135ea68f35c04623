"""Check of dimensions: summands that cannot be added, and units that equations determine.

Only declared units are checked. The unit of an undeclared name is unknown, and so is that of a bare
number that may carry one (``9.81*mass``, ``temperature - 293.15``); unknown units agree with all
others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import sympy as sp

from bayesoleo._units import Dimensions, dimensions, unit_of_dimensions
from bayesoleo.errors import ModelError
from bayesoleo.model._expressions import TIME, as_text, split_derivative
from bayesoleo.model._model import Model

#: None where nothing is known.
Known = Dimensions | None
#: Two summands, and their dimensions.
Unequal = tuple[tuple[sp.Expr, sp.Expr], tuple[Dimensions, Dimensions]]

# Bare numbers up to a dozen, their halves, thirds and quarters count something; others may be a
# constant of nature or of a unit.
_LARGEST_COUNT, _DENOMINATOR = 12, 12
_PASSING = (sp.Abs,)


@dataclass(frozen=True)
class Conflict:
    """Two things that are added and have different dimensions.

    Parameters
    ----------
    where : str
        The balance.
    first, second : str
        The terms.
    units : tuple of str
        Of both.
    remedy : str
        The unit that a parameter of the second would have to have; empty where it has none.
    """

    where: str
    first: str
    second: str
    units: tuple[str, str]
    remedy: str

    def __str__(self) -> str:
        one, two = (unit or "1" for unit in self.units)
        return f"{self.where}: {self.second} is in {two}, {self.first} in {one}"


def check_dimensions(model: Model) -> Model:
    """Refuse a model whose terms cannot be added, and fill in the units that its equations fix.

    Parameters
    ----------
    model : Model

    Returns
    -------
    Model
        Parameters without a unit have the one that follows, where one does.

    Raises
    ------
    ModelError
        With the terms and their units.
    """
    derived = _derived(model)
    if derived:
        model = model.with_parameters(
            **{k: replace(model.parameters[k], unit=unit) for k, unit in derived.items()}
        )
    found = next(_conflicts(model), None)
    if found is not None:
        more = f"{found.remedy}; " if found.remedy else ""
        raise ModelError(
            f"model {model.name!r}, {found}",
            hint=f"{more}correct the equation or a unit; one that is left out is not checked",
        )
    return model


def _balances(model: Model) -> Iterator[tuple[str, Mapping[str, sp.Expr], Known]]:
    """Name, terms and, of an output, its own dimensions."""
    for dof, terms in model.equations.items():
        yield f"equation {dof!r}", terms, None
    for name, output in model.outputs.items():
        yield f"output {name!r}", model.output_terms(name), _declared(output.unit)


def _conflicts(model: Model) -> Iterator[Conflict]:
    reader = _Reader(model)
    for where, terms, own in _balances(model):
        first, known = "the output", own
        for name, term in terms.items():
            inside, found = reader.read(term)
            if inside is not None:
                (a, b), (one, two) = inside
                units = unit_of_dimensions(one), unit_of_dimensions(two)
                yield Conflict(where, as_text(a), as_text(b), units, "")
            if found is None or _is_number(term):
                continue
            label = f"term {name!r} ({as_text(term)})"
            if known is not None and found != known:
                units = unit_of_dimensions(known), unit_of_dimensions(found)
                yield Conflict(where, first, label, units, _remedy(model, term, known, found))
            if known is None:
                first, known = label, found


def _remedy(model: Model, term: sp.Expr, wanted: Dimensions, found: Dimensions) -> str:
    """The unit that the first parameter of a product would have to have."""
    for factor in sp.Mul.make_args(term):
        if isinstance(factor, sp.Symbol) and factor.name in model.parameters:
            own = _declared(model.parameters[factor.name].unit) or {}
            needed = _sum(_sum(own, wanted), found, -1)
            return f"{factor.name} would have to be in {unit_of_dimensions(needed) or '1'}"
    return ""


def _derived(model: Model) -> dict[str, str]:
    """Units of parameters without one that stand alone in a term whose balance is known."""
    units: dict[str, str] = {}
    for _ in range(len(model.parameters)):
        reader = _Reader(model, units)
        before = dict(units)
        for _, terms, own in _balances(model):
            known = own if own is not None else _first(reader, terms)
            if known is None:
                continue
            for term in terms.values():
                name, unit = _unknown_factor(model, reader, term, known, units)
                if name:
                    units.setdefault(name, unit)
        if units == before:
            break
    return {name: unit for name, unit in units.items() if unit}


def _first(reader: _Reader, terms: Mapping[str, sp.Expr]) -> Known:
    found = (reader.read(term)[1] for term in terms.values() if not _is_number(term))
    return next((item for item in found if item is not None), None)


def _unknown_factor(
    model: Model, reader: _Reader, term: sp.Expr, whole: Dimensions, units: Mapping[str, str]
) -> tuple[str, str]:
    """The one parameter of unknown unit in a product, and its unit."""
    known: Dimensions = {}
    unknown: sp.Symbol | None = None
    for factor in sp.Mul.make_args(term):
        found = reader.read(factor)[1]
        if found is not None:
            known = _sum(known, found)
        elif unknown is None and isinstance(factor, sp.Symbol):
            unknown = factor
        else:
            return "", ""
    if unknown is None or unknown.name in units or unknown.name not in model.parameters:
        return "", ""
    return unknown.name, unit_of_dimensions(_sum(whole, known, -1))


class _Reader:
    """Dimensions of expressions over a model's names."""

    def __init__(self, model: Model, units: Mapping[str, str] | None = None) -> None:
        self.model, self.definitions = model, dict[str, Known]()
        declared = {**model.inputs, **{k: v.unit for k, v in model.dofs.items()}}
        declared |= {k: v.unit for k, v in model.conditions.items()}
        declared |= {k: v.unit for k, v in model.parameters.items()} | dict(units or {})
        self.known = {name: _declared(unit) for name, unit in declared.items()}

    def read(self, expression: sp.Expr) -> tuple[Unequal | None, Known]:
        """The first two summands that cannot be added, if any, and the dimensions."""
        self.found: Unequal | None = None
        own = self._of(expression)
        return self.found, own

    def _of(self, item: sp.Expr) -> Known:
        if isinstance(item, sp.Symbol):
            return self._of_symbol(item)
        if item.is_number:
            return {} if _is_count(item) else None
        if isinstance(item, sp.Add | sp.Max | sp.Min):
            return self._of_sum(item)
        if isinstance(item, sp.Mul):
            parts = [self._of(factor) for factor in item.args]
            total: Known = {}
            for part in parts:
                total = None if part is None or total is None else _sum(total, part)
            return total
        if isinstance(item, sp.Pow):
            return self._of_power(item)
        if isinstance(item, _PASSING):
            return self._of(item.args[0])
        if isinstance(item, sp.Function):
            for argument in item.args:
                self._of(argument)
            return {}
        return None

    def _of_symbol(self, item: sp.Symbol) -> Known:
        if item == TIME:
            return dimensions("s")
        name, order = split_derivative(item)
        if name in self.model.definitions:
            if name not in self.definitions:
                self.definitions[name] = self._of(self.model.definitions[name])
            own = self.definitions[name]
        else:
            own = self.known.get(name)
        return None if own is None else _sum(own, dimensions("s"), -order)

    def _of_sum(self, item: sp.Expr) -> Known:
        first: tuple[sp.Expr, Dimensions] | None = None
        for part in item.args:
            found = self._of(part)
            if found is None or _is_number(part):
                continue
            if first is None:
                first = part, found
            elif found != first[1] and self.found is None:
                self.found = (first[0], part), (first[1], found)
        return None if first is None else first[1]

    def _of_power(self, item: sp.Pow) -> Known:
        base, exponent = item.args
        found = self._of(base)
        if not found or not exponent.is_number:
            return found if found is not None and not found else None
        return {name: power * float(exponent) for name, power in found.items()}


def _declared(unit: str) -> Known:
    """Dimensions of a declared unit; those of a unit that is left out are not known."""
    return dimensions(unit) if unit else None


def _is_number(expression: sp.Expr) -> bool:
    return bool(expression.is_number)


def _is_count(number: sp.Expr) -> bool:
    """Whether a bare number counts, and carries no unit."""
    if number.has(sp.pi) or number.is_zero:
        return True
    scaled = float(abs(number)) * _DENOMINATOR
    return scaled == round(scaled) and scaled <= _LARGEST_COUNT * _DENOMINATOR


def _sum(one: Dimensions, other: Dimensions, times: float = 1.0) -> Dimensions:
    total = dict(one)
    for name, power in other.items():
        total[name] = round(total.get(name, 0.0) + times * power, 9)
    return {name: power for name, power in total.items() if power}
