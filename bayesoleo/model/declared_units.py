"""Declared units: all are read, and all are of SI, because nothing in a model is converted."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from bayesoleo.errors import InputError, ModelError
from bayesoleo.units import Unit, in_si, parse_unit

if TYPE_CHECKING:
    from bayesoleo.model.model import Model


def check_units(model: Model) -> None:
    """Refuse units that are not known, and those that would have to be converted.

    Parameters
    ----------
    model : Model

    Raises
    ------
    ModelError
        With the unit in which to write the value.
    """
    for kind, name, text, value in _declared(model):
        where = f"model {model.name!r}: {kind} {name!r}"
        try:
            unit = parse_unit(text)
        except InputError as error:
            raise ModelError(
                f"{where} has a unit that is not known", value=text, hint=error.hint
            ) from error
        if unit.factor != 1.0 or unit.shift != 0.0:
            raise ModelError(
                f"{where} is in {text}, but the numbers of a model are in SI",
                value=text,
                hint=_in_si(unit, value),
            )


def _declared(model: Model) -> Iterator[tuple[str, str, str, float | None]]:
    """Kind, name, unit and value of all that has a unit."""
    for name, unit in model.inputs.items():
        yield "input", name, unit, None
    for name, dof in model.dofs.items():
        yield "dof", name, dof.unit, None
    for name, condition in model.conditions.items():
        yield "condition", name, condition.unit, condition.default
    for name, output in model.outputs.items():
        yield "output", name, getattr(output, "unit", ""), None
    for name, parameter in model.parameters.items():
        yield "parameter", name, parameter.unit, parameter.value


def _in_si(unit: Unit, value: float | None) -> str:
    """What to write instead."""
    wanted = in_si(unit.name)
    if value is None:
        return f"declare it in {wanted}"
    converted = float(unit.to_si(value))
    if unit.shift:
        return f"write {converted:.10g} in {wanted}; differences keep their size"
    more = f", and its prior times {unit.factor:.10g}" if value else ""
    return f"write {converted:.10g} in {wanted}{more}"
