"""Units of expressions, so that an effect's parameters carry the right ones wherever it sits."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from typing import Any

import sympy as sp

from bayesoleo.errors import ModelError
from bayesoleo.model import Model
from bayesoleo.model.expressions import TIME, split_derivative, symbol

#: Names that a reader expects instead of base units.
_USUAL = ("N", "Pa", "W", "J", "V", "N*m")


@cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


def parse_unit(text: str) -> Any:
    """Unit of a text as pint reads it, in base units; a number where the text is empty."""
    try:
        return _registry().Quantity(1.0, text or "dimensionless").to_base_units().units
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
    declared = {**model.inputs, **{k: v.unit for k, v in model.dofs.items()}}
    declared |= {k: v.unit for k, v in model.parameters.items()}
    declared |= {k: v.unit for k, v in model.conditions.items()}
    return parse_unit(declared[name]) / parse_unit("s") ** order


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
    """Unit of a dof's equation: that of the first of its terms whose unit is defined."""
    for term in model.equations[dof].values():
        try:
            return unit_text(unit_of(term, model))
        except ModelError:
            continue  # a term with bare numbers in it says nothing; the next one may
    return ""


@dataclass(frozen=True)
class TargetUnits:
    """Units at a place, under the words that effects use for them."""

    words: dict[str, str]

    def resolve(self, text: str) -> str:
        """Replace the words ``force``, ``position``, ``channel`` and ``parameter``."""

        def unit(match: re.Match[str]) -> str:
            word = self.words.get(match.group(), "") or "dimensionless"
            alone = word.isidentifier() or match.group() == text
            return word if alone else f"({word})"

        composed = re.sub(r"\b(force|position|channel|parameter)\b", unit, text)
        if parse_unit(composed) == parse_unit(""):
            return ""
        if "dimensionless" in composed:
            return unit_text(parse_unit(composed))
        return composed


def target_units(model: Model, target: str) -> TargetUnits:
    """Units at a target: of the balance and the position, of the channel, of the parameter."""
    words: dict[str, str] = {}
    name, _, coordinate = target.partition("/")
    if name in model.dofs:
        words |= {"force": balance_unit(model, name), "position": model.dofs[name].unit}
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


def _unit_of_motion(model: Model, output: str, coordinate: str) -> str:
    """Unit of the input that an output follows."""
    moving = {split_derivative(item)[0] for item in model.output(output).free_symbols}
    names = [coordinate] if coordinate else [name for name in model.inputs if name in moving]
    return unit_text(_unit_of_symbol(symbol(names[0]), model)) if names else ""
