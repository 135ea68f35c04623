"""Residuals and partial derivatives of a model, by computer algebra (Verbeek 1993, section 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp

from bayesoleo.errors import ModelError
from bayesoleo.model.expressions import TIME, derivative_symbol, partial, split_derivative, symbol
from bayesoleo.model.model import Model


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
    def highest(self) -> tuple[sp.Symbol, ...]:
        """The highest derivative of each dof."""
        last = np.cumsum([order + 1 for order in self.orders]) - 1
        return tuple(self.states[k] for k in last)

    @property
    def affine(self) -> bool:
        """Whether the equations are linear in the highest derivatives, whose factors hold none."""
        factors = self.gradient(self.residual, self.highest)
        return not any(factor.free_symbols.intersection(self.highest) for factor in factors)

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
    occurring = {item for e in (*residual, *output, *admissible) for item in e.free_symbols}
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
