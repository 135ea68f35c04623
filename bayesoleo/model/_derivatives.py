"""Symbolic residuals, partial derivatives and switching functions of a model.

Partial derivatives come from computer algebra (Verbeek 1993, section 4.3).

``abs``, ``sign``, ``step``, ``min`` and ``max`` change their formula where an argument - a
*switching function* - changes sign. Each is replaced by the formula of one side, chosen by a
constant called its *mode* (one where the switching function is positive, zero where it is
negative). With modes held, the equations are analytic, so that an integrator keeps its order and
finds the switch on a smooth continuation of the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import sympy as sp

from bayesoleo.errors import ModelError
from bayesoleo.model._expressions import TIME, derivative_symbol, split_derivative, symbol
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Condition
from bayesoleo.model._partial_derivatives import partial, symbols_of

_SWITCHES = (sp.Abs, sp.sign, sp.Heaviside, sp.Min, sp.Max)


@dataclass(frozen=True)
class Derived:
    """A model's expressions over three rows of symbols: states, inputs and constants.

    Parameters
    ----------
    dofs, orders : tuple
        Names and orders (1 or 2) of the dofs.
    states : tuple of sympy.Symbol
        For each dof its value and derivatives up to its order.
    inputs : tuple of (str, int)
        Input name and order of derivative of every row that occurs; ``("time", 0)`` is the time
        itself.
    constants : tuple of str
        Parameters, then conditions.
    active : tuple of str
        Parameters with respect to which there are derivatives.
    outputs : tuple of str
        Names of outputs.
    residual, output, admissible : tuple of sympy.Expr
        One each dof, output and condition on the admissible region.
    """

    dofs: tuple[str, ...]
    orders: tuple[int, ...]
    states: tuple[sp.Symbol, ...]
    inputs: tuple[tuple[str, int], ...]
    constants: tuple[str, ...]
    active: tuple[str, ...]
    outputs: tuple[str, ...]
    residual: tuple[sp.Expr, ...]
    output: tuple[sp.Expr, ...]
    admissible: tuple[sp.Expr, ...]

    def gradient(self, expressions: Sequence[sp.Expr], of: Sequence[sp.Symbol]) -> list[sp.Expr]:
        """Partial derivatives, expression by expression, symbol by symbol."""
        return [partial(expression, item) for expression in expressions for item in of]

    @property
    def active_symbols(self) -> tuple[sp.Symbol, ...]:
        """Symbols of the active parameters."""
        return tuple(symbol(name) for name in self.active)


def derive(model: Model, active: Sequence[str] | None = None) -> Derived:
    """Expand a model's definitions and order its symbols.

    Parameters
    ----------
    model : Model
        In the drive in which it is to be solved.
    active : sequence of str, optional
        Parameters to differentiate by; by default those that are estimated.

    Raises
    ------
    ModelError
        If a dof has an order above two.
    """
    orders = tuple(model.order(dof) for dof in model.dofs)
    for dof, order in zip(model.dofs, orders, strict=True):
        if order > 2:
            raise ModelError(
                f"model {model.name!r}: the derivative of order {order} of {dof!r} occurs",
                hint="write the system with dofs of first and second order",
            )
    residual = tuple(model.equation(dof) for dof in model.dofs)
    output = tuple(model.output(name) for name in model.outputs)
    admissible = tuple(model.expand(expression) for expression in model.admissible)
    states = tuple(
        derivative_symbol(dof, k)
        for dof, order in zip(model.dofs, orders, strict=True)
        for k in range(order + 1)
    )
    occurring = frozenset().union(*map(symbols_of, (*residual, *output, *admissible)))
    rows = sorted(
        split_derivative(item) for item in occurring if split_derivative(item)[0] in model.inputs
    )
    if TIME in occurring:
        rows.append(("time", 0))
    return Derived(
        dofs=tuple(model.dofs),
        orders=orders,
        states=states,
        inputs=tuple(rows),
        constants=(*model.parameters, *model.conditions),
        active=tuple(model.estimated() if active is None else active),
        outputs=tuple(model.outputs),
        residual=residual,
        output=output,
        admissible=admissible,
    )


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
