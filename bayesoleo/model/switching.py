"""Analytic pieces of a model whose equations have kinks or jumps.

``abs``, ``sign``, ``step``, ``min`` and ``max`` change their formula where an argument - a
*switching function* - changes sign. Replacing each by the formula of one side, chosen by a constant
called its *mode* (one where the switching function is positive, zero where it is negative), leaves
equations that are analytic while modes are held: what an integrator needs to keep its order, and to
find the switch on a smooth continuation of the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import sympy as sp

from bayesoleo.model.expressions import split_derivative, symbol
from bayesoleo.model.model import Model
from bayesoleo.model.parameter import Condition

_SWITCHES = (sp.Abs, sp.sign, sp.Heaviside, sp.Min, sp.Max)


@dataclass(frozen=True)
class Pieces:
    """A model in analytic pieces.

    Parameters
    ----------
    model : Model
        Its outputs are the switching functions, its last conditions their modes, in that order.
        Where nothing switches, the model as it was.
    switches : int
        Number of switching functions.
    """

    model: Model
    switches: int


def analytic_pieces(model: Model) -> Pieces:
    """Replace what switches in a model's equations by modes.

    Switches that depend on parameters and conditions alone stay as they are: along a motion they do
    not change.

    Parameters
    ----------
    model : Model
        In the drive in which it is to be solved.

    Returns
    -------
    Pieces
    """
    modes: dict[sp.Expr, sp.Symbol] = {}
    equations = {
        dof: {name: _smooth(model.expand(term), modes, model) for name, term in terms.items()}
        for dof, terms in model.equations.items()
    }
    if not modes:
        return Pieces(model, 0)
    admissible = [model.expand(item) for item in model.admissible]
    conditions = {item.name: Condition("", 1.0) for item in modes.values()}
    outputs = {f"switching_{k}": function for k, function in enumerate(modes)}
    pieces = replace(
        model,
        equations=equations,
        outputs=outputs,
        admissible=admissible,
        definitions={},
        conditions={**model.conditions, **conditions},
    )
    return Pieces(pieces, len(modes))


def _smooth(expression: sp.Expr, modes: dict[sp.Expr, sp.Symbol], model: Model) -> sp.Expr:
    """An expression with its switches, innermost first, replaced by their modes."""
    if not expression.has(*_SWITCHES):
        return expression
    arguments = [_smooth(item, modes, model) for item in expression.args]
    if not isinstance(expression, _SWITCHES):
        return expression.func(*arguments)
    if isinstance(expression, sp.Min | sp.Max):
        return _extremum(expression.func, arguments, modes, model)
    inner = arguments[0]
    if not _moves(inner, model):
        return expression.func(*arguments)
    mode = _mode(inner, modes)
    if isinstance(expression, sp.Abs):
        return (2 * mode - 1) * inner
    return mode if isinstance(expression, sp.Heaviside) else 2 * mode - 1


def _extremum(
    kind: type[sp.Expr], arguments: list[sp.Expr], modes: dict[sp.Expr, sp.Symbol], model: Model
) -> sp.Expr:
    """The largest or smallest of several expressions, two at a time."""
    result = arguments[0]
    for other in arguments[1:]:
        difference = result - other if kind is sp.Max else other - result
        if _moves(difference, model):
            mode = _mode(difference, modes)
            result = mode * result + (1 - mode) * other
        else:
            result = kind(result, other)
    return result


def _moves(expression: sp.Expr, model: Model) -> bool:
    """Whether an expression changes along a motion."""
    moving = {*model.dofs, *model.inputs}
    return any(split_derivative(item)[0] in moving for item in expression.free_symbols)


def _mode(function: sp.Expr, modes: dict[sp.Expr, sp.Symbol]) -> sp.Expr:
    """The mode of a switching function; that of its negative is the opposite one."""
    if -function in modes:
        return 1 - modes[-function]
    if function not in modes:
        modes[function] = symbol(f"switching_mode_{len(modes)}")
    return modes[function]
