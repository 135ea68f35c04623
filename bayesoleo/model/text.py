"""Expressions as the text that declares them."""

from __future__ import annotations

import sympy as sp
from sympy.printing.str import StrPrinter


class _Text(StrPrinter):  # type: ignore[misc] # SymPy has no types
    """Prints what :func:`bayesoleo.model.expressions.parse` reads."""

    def _print_Abs(self, expr: sp.Abs) -> str:
        return f"abs({self._print(expr.args[0])})"

    def _print_Heaviside(self, expr: sp.Heaviside) -> str:
        return f"step({self._print(expr.args[0])})"

    def _print_Max(self, expr: sp.Max) -> str:
        return f"max({', '.join(self._print(item) for item in expr.args)})"

    def _print_Min(self, expr: sp.Min) -> str:
        return f"min({', '.join(self._print(item) for item in expr.args)})"


def as_text(expression: sp.Expr) -> str:
    """Text of an expression, as it would be declared."""
    return str(_Text({"full_prec": True}).doprint(expression))
