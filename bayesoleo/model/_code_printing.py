"""Print code with shared subexpressions, for NumPy arrays and for Numba scalars in a loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

import sympy as sp
from sympy.printing.pycode import PythonCodePrinter

_CALLS = {name: name for name in ("exp", "log", "sin", "cos", "tan", "tanh")} | {"atan": "arctan"}


class _Printer(PythonCodePrinter):  # type: ignore[misc] # SymPy has no types
    """Prints NumPy functions, which Numba compiles for scalars, and small powers as products."""

    def _print_Pow(self, expr: sp.Pow, rational: bool = False) -> str:
        base, exponent = expr.as_base_exp()
        text = self._parenthesised(base)
        if exponent == sp.Rational(1, 2):
            return f"np.sqrt({self._print(base)})"
        if exponent.is_Integer and 1 <= abs(int(exponent)) <= 4:
            product = "*".join([text] * abs(int(exponent)))
            return f"(1.0/({product}))" if exponent < 0 else f"({product})"
        return f"({text}**{self._parenthesised(exponent)})"

    def _parenthesised(self, expr: sp.Expr) -> str:
        text = self._print(expr)
        return text if expr.is_Symbol else f"({text})"

    def _print_Rational(self, expr: sp.Rational) -> str:
        return repr(float(expr))

    def _print_Integer(self, expr: sp.Integer) -> str:
        return f"{int(expr)}.0"

    def _print_Float(self, expr: sp.Float) -> str:
        return repr(float(expr))

    def _print_NumberSymbol(self, expr: sp.NumberSymbol) -> str:
        return repr(float(expr))

    _print_Pi = _print_NumberSymbol  # noqa: N815 - the printer's own convention
    _print_Exp1 = _print_NumberSymbol  # noqa: N815

    def _print_Heaviside(self, expr: sp.Heaviside) -> str:
        return f"(0.5 + 0.5*np.sign({self._print(expr.args[0])}))"

    def _print_sign(self, expr: sp.Expr) -> str:
        return f"np.sign({self._print(expr.args[0])})"

    def _print_Abs(self, expr: sp.Abs) -> str:
        return f"np.abs({self._print(expr.args[0])})"

    # Every quantity is real, but a power of what might be negative is not known to be: the slope of
    # its absolute value is then written with both parts.
    def _print_re(self, expr: sp.re) -> str:
        return str(self._print(expr.args[0]))

    def _print_im(self, expr: sp.im) -> str:
        return "0.0"

    def _print_conjugate(self, expr: sp.conjugate) -> str:
        return str(self._print(expr.args[0]))

    def _print_bspline(self, expr: sp.Expr) -> str:
        far, near, _ = self._reaches(expr)
        return f"(({far}**3 - 4.0*{near}**3)/6.0)"

    def _print_bspline_slope(self, expr: sp.Expr) -> str:
        far, near, place = self._reaches(expr)
        return f"(-0.5*np.sign({place})*({far}**2 - 4.0*{near}**2))"

    def _reaches(self, expr: sp.Expr) -> tuple[str, str, str]:
        """How far inside its supports of two and of one a B-spline's argument lies, and that."""
        place = self._print(expr.args[0])
        far, near = (f"np.maximum({edge} - np.abs({place}), 0.0)" for edge in (2.0, 1.0))
        return far, near, place

    def _extremum(self, name: str, arguments: Sequence[sp.Expr]) -> str:
        text = self._print(arguments[0])
        for argument in arguments[1:]:
            text = f"np.{name}({text}, {self._print(argument)})"
        return cast(str, text)

    def _print_Max(self, expr: sp.Max) -> str:
        return self._extremum("maximum", expr.args)

    def _print_Min(self, expr: sp.Min) -> str:
        return self._extremum("minimum", expr.args)


class _Statements(_Printer):
    """Prints every subexpression once, as a statement of its own.

    Parameters
    ----------
    names : mapping of sympy.Symbol to str
        What each symbol is called in the code.
    """

    def __init__(self, names: Mapping[sp.Symbol, str]):
        super().__init__({"fully_qualified_modules": False})
        self._names = names
        self._known: dict[sp.Basic, str] = {}
        self.lines: list[str] = []
        self.used: set[sp.Symbol] = set()

    def _print(self, expr: sp.Basic, **kwargs: object) -> str:
        if expr.is_Symbol:
            self.used.add(expr)
            return self._names[expr]
        if expr.is_Atom:
            return str(super()._print(expr, **kwargs))
        if expr not in self._known:
            text = super()._print(expr, **kwargs)
            self._known[expr] = f"w{len(self.lines)}"
            self.lines.append(f"{self._known[expr]} = {text}")
        return self._known[expr]

    def _print_Add(self, expr: sp.Add) -> str:
        return " + ".join(self._print(item) for item in expr.args)

    def _print_Mul(self, expr: sp.Mul) -> str:
        return "*".join(self._print(item) for item in expr.args)


for _name, _target in _CALLS.items():

    def _print_function(self: _Printer, expr: sp.Expr, target: str = _target) -> str:
        return f"np.{target}({self._print(expr.args[0])})"

    setattr(_Printer, f"_print_{_name}", _print_function)


def code(
    expressions: Sequence[sp.Expr],
    names: Mapping[sp.Symbol, str],
    constant: set[sp.Symbol],
) -> tuple[list[str], list[str], list[str]]:
    """Statements that evaluate expressions with common subexpressions shared.

    Parameters
    ----------
    expressions : sequence of sympy.Expr
        What to evaluate.
    names : mapping of sympy.Symbol to str
        What each symbol is called in the code.
    constant : set of sympy.Symbol
        Symbols that do not vary from node to node: what depends on them alone is computed once.

    Returns
    -------
    outside, inside : list of str
        Assignments for before and inside the loop over nodes.
    results : list of str
        One Python expression for each entry of ``expressions``.
    """
    renamed = [
        expression.xreplace({s: sp.Symbol(n, real=True) for s, n in names.items()})
        for expression in expressions
    ]
    fixed = {sp.Symbol(names[item], real=True) for item in constant}
    counter = sp.numbered_symbols("w", real=True)
    shared, reduced = sp.cse(renamed, symbols=counter, order="none")
    printer = _Printer({"fully_qualified_modules": False})
    outside, inside = [], []
    for name, body in shared:
        line = f"{name} = {printer.doprint(body)}"
        if body.free_symbols <= fixed:
            fixed.add(name)
            outside.append(line)
        else:
            inside.append(line)
    return outside, inside, [printer.doprint(expression) for expression in reduced]


def statements(
    expressions: Sequence[sp.Expr], names: Mapping[sp.Symbol, str]
) -> tuple[set[sp.Symbol], list[str], list[str]]:
    """Statements that evaluate expressions, each subexpression in one of its own.

    A third of the time of :func:`code`, which looks for common factors and for what is constant;
    that pays where a kernel is compiled and called often.

    Parameters
    ----------
    expressions, names
        As for :func:`code`.

    Returns
    -------
    used : set of sympy.Symbol
        Symbols that occur.
    inside : list of str
        Assignments.
    results : list of str
        One Python expression for each entry of ``expressions``.
    """
    printer = _Statements(names)
    results = [printer._print(sp.sympify(expression)) for expression in expressions]
    return printer.used, printer.lines, results
