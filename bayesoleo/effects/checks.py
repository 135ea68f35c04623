"""What can be wrong with a declared effect before any model is there: names, null, units, grids."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import sympy as sp

from bayesoleo.effects.parts import Amplitude, ShapeParameter
from bayesoleo.effects.units import parse_unit, unit_of, unit_text
from bayesoleo.errors import InputError, ModelError
from bayesoleo.model.expressions import FUNCTIONS, derivative_symbol, parse, symbol

OF_THE_PLACE = ("position", "velocity", "acceleration", "direction", "spring_force", "pressure")
OF_THE_MOTION = ("largest_velocity", "lowest_position", "highest_position")
#: Units at a place where a force acts on a length, to try an expression's units with.
_UNITS = {
    "position": "m", "velocity": "m/s", "acceleration": "m/s**2", "direction": "",
    "spring_force": "N", "pressure": "Pa", "largest_velocity": "m/s", "lowest_position": "m",
    "highest_position": "m",
}  # fmt: skip


def check_names(used: Collection[str], own: Collection[str], allowed: set[str], id_: str) -> None:
    """Every name is declared, every parameter is used, and none hides a word of the place."""
    taken = sorted({*OF_THE_PLACE, *OF_THE_MOTION, "pi"} & set(own))
    if taken:
        hint = "this name stands for a quantity of the place; call the parameter something else"
        raise InputError(f"effect {id_}: a name that is taken", value=taken[0], hint=hint)
    known = {*own, *allowed, *OF_THE_PLACE, *OF_THE_MOTION, "pi"}
    for name in sorted(set(used) - known):
        close = difflib.get_close_matches(name, [*known, *FUNCTIONS], 1)
        hint = f"did you mean {close[0]}?" if close else "list names of the model in requires"
        raise InputError(f"effect {id_}: unknown name", value=name, hint=hint)
    idle = sorted(set(own) - set(used))
    if idle:
        hint = "use it in the expression, or leave it out"
        raise InputError(f"effect {id_}: nothing follows {idle[0]!r}", hint=hint)


def check_null(
    expression: str, used: Iterable[str], amplitudes: Sequence[Amplitude], id_: str
) -> None:
    """Where its amplitudes are zero the force is none, and no division by one of them."""
    force = _parsed(expression, used, id_)
    at_null = force.subs({symbol(item.name): sp.Integer(0) for item in amplitudes})
    if amplitudes and at_null != 0 and sp.simplify(at_null) != 0:
        raise InputError(
            f"effect {id_}: is not zero where its amplitudes are",
            value=expression,
            hint="multiply by an amplitude whatever shall be absent without it",
        )


def check_unit(
    expression: str,
    used: Iterable[str],
    amplitudes: Sequence[Amplitude],
    shapes: Sequence[ShapeParameter],
    states: Mapping[str, Any],
    id_: str,
) -> None:
    """The expression is a force, if its units are stated in words of the place.

    Bare numbers in it, or units that are not in these words, say nothing, and are let pass.
    """
    units = {item.name: item.unit for item in amplitudes}
    units |= {shape.name: shape.unit for shape in shapes}
    if not any("force" in item.unit for item in amplitudes):
        return
    words = {"force": "N", "position": "m"}
    for name, unit in units.items():
        for word, short in words.items():
            unit = unit.replace(word, f"({short})")
        units[name] = unit
    units |= _UNITS | {name: state.unit for name, state in states.items()}
    quantities = {name: SimpleNamespace(unit=unit) for name, unit in units.items()}
    stub: Any = SimpleNamespace(
        definitions={}, inputs={}, dofs={}, parameters=quantities, conditions={}
    )
    try:
        found = unit_of(_parsed(expression, used, id_), stub)
    except (ModelError, KeyError):
        return
    if found == parse_unit("N"):
        return
    problem = (
        f"effect {id_}: is not in the unit of a force, but of {unit_text(found) or 'a number'}"
    )
    hint = "where positions are in m and forces in N"
    if len(amplitudes) == 1:
        (item,) = amplitudes
        right = _over(found / parse_unit(units[item.name]))
        hint = f"state {item.name} in {right}" if right else hint
    raise InputError(problem, value=expression, hint=hint)


def _over(unit: Any) -> str:
    """The unit of a factor of this unit that makes a force of it, in words of the place."""
    powers = {str(name): power for name, power in unit._units.items()}
    known = {"meter": "position", "second": "s"}
    if not set(powers) <= set(known):
        return ""
    parts = [f"{word}**{-powers[n]:g}" for n, word in known.items() if powers.get(n)]
    return "*".join(["force", *parts])


def check_states(states: Mapping[str, Any], used: Iterable[str], id_: str) -> None:
    """Each state's equation has its rate."""
    for name, state in states.items():
        equation = _parsed(state.equation, used, id_)
        if not equation.has(derivative_symbol(name, 1)):
            hint = f"write its equation with dot({name})"
            problem = f"effect {id_}: state {name!r} has no rate"
            raise InputError(problem, value=state.equation, hint=hint)


def check_grid(values: tuple[float, ...], shape: str, id_: str) -> None:
    """A scan grid is ascending and positive: shapes have log-normal priors."""
    grid = np.asarray(values, dtype=float)
    if grid.size == 0 or not (
        np.isfinite(grid).all() and grid[0] > 0 and (np.diff(grid) > 0).all()
    ):
        raise InputError(
            f"effect {id_}: the scan of {shape!r} is not ascending and positive",
            value=values,
            hint="state the shape as a positive length, velocity or time",
        )


def _parsed(expression: str, used: Iterable[str], id_: str) -> sp.Expr:
    known = {name: symbol(name) for name in used}
    return parse(expression, known, tuple(known), f"effect {id_}")
