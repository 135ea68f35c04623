"""Parser of the equation language: text to symbolic expressions, and back to text.

The names are those that a model declares; ``dot(q)`` is a time derivative (``ddot(q)`` the second),
also of an expression. Text is parsed against a closed list of names, so a misspelt one is an error
rather than a new symbol.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from functools import cache, lru_cache
from typing import Any, cast

import sympy as sp
from sympy.printing.str import StrPrinter

from bayesoleo.errors import ModelError, choose
from bayesoleo.model._partial_derivatives import partial, symbols_of

#: Seconds since the first sample; for outputs and for transients, a periodic state cannot depend
#: on it.
TIME = sp.Symbol("time", real=True)
_DERIVATIVE = re.compile(r"^(d+)ot\((.+)\)$")
#: Between the names of two channels: the first one's measured signal at the second one's harmonics.
WITHIN = "_within_"
#: First parts of the names of inputs that turn with a channel: the cosine and the sine of the phase
#: of its first harmonic. Polynomials in both are the harmonics of the drive.
COSINE, SINE = "drive_cosine", "drive_sine"


class bspline(sp.Function):  # type: ignore[misc] # noqa: N801 - its name in expressions
    r"""The cardinal cubic B-spline: a bump on -2 to 2, twice continuously differentiable.

    :math:`B(t) = \frac{1}{6}[(2 - |t|)_+^3 - 4 (1 - |t|)_+^3]` (de Boor 1978). Shifted by whole
    numbers and weighted, it makes up any smooth curve; unlike the powers that it is made of it has
    no switch that an integrator would have to stop at.
    """

    nargs = 1

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """Slope."""
        return bspline_slope(self.args[0])

    def _eval_evalf(self, prec: int) -> sp.Expr:
        far, near = _reaches(self.args[0])
        return ((far**3 - 4 * near**3) / 6)._eval_evalf(prec)

    def _eval_is_real(self) -> bool:
        return True

    def _latex(self, printer: sp.printing.latex.LatexPrinter) -> str:
        return rf"B\left({printer.doprint(self.args[0])}\right)"


class bspline_slope(sp.Function):  # type: ignore[misc] # noqa: N801
    """First derivative of :class:`bspline`.

    A function of its own: written with powers of maxima it takes computer algebra minutes to see
    that nothing simplifies.
    """

    nargs = 1

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """Curvature of the B-spline, in the powers that it consists of."""
        far, near = _reaches(self.args[0])
        return far - 4 * near

    def _eval_evalf(self, prec: int) -> sp.Expr:
        far, near = _reaches(self.args[0])
        return (-sp.sign(self.args[0]) * (far**2 - 4 * near**2) / 2)._eval_evalf(prec)

    def _eval_is_real(self) -> bool:
        return True


def _reaches(t: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """How far inside two and inside one a B-spline's argument lies."""
    size = sp.Abs(t)
    return sp.Max(2 - size, 0), sp.Max(1 - size, 0)


#: Functions an expression may use. The derivative at a kink is the mean of those on its two sides.
FUNCTIONS: dict[str, object] = {
    "abs": sp.Abs,
    "sign": sp.sign,
    "sqrt": sp.sqrt,
    "exp": sp.exp,
    "log": sp.log,
    "sin": sp.sin,
    "cos": sp.cos,
    "tan": sp.tan,
    "atan": sp.atan,
    "arctan": sp.atan,
    "tanh": sp.tanh,
    "min": sp.Min,
    "max": sp.Max,
    "positive": lambda x: extreme(sp.Max, x, sp.Integer(0)),
    "bspline": bspline,
    "bspline_slope": bspline_slope,
    "step": lambda x: sp.Heaviside(x, sp.Rational(1, 2)),
}


_AS_IN_PYTHON = "write it as in Python, e.g. k*q**3"


@cache
def symbol(name: str) -> sp.Symbol:
    """The symbol of a declared name; every quantity is real."""
    return sp.Symbol(name, real=True)


def within(channel: str, other: str) -> str:
    """Name of an input that is a measured channel, at those harmonics that another one has.

    What is measured of two channels together, such as the motion behind a frame that gives, must be
    cut off alike in both.
    """
    return f"{channel}{WITHIN}{other}"


def derivative_symbol(name: str, order: int) -> sp.Symbol:
    """The symbol of a time derivative: ``dot(q)``, ``ddot(q)``, ``dddot(q)`` …"""
    return symbol(name) if order == 0 else symbol(f"{'d' * order}ot({name})")


def split_derivative(item: sp.Symbol) -> tuple[str, int]:
    """Name and order of derivative of a symbol: the inverse of :func:`derivative_symbol`."""
    match = _DERIVATIVE.match(item.name)
    return (match.group(2), len(match.group(1))) if match else (item.name, 0)


def total_derivative(expression: sp.Expr, dynamic: Iterable[str]) -> sp.Expr:
    """Time derivative along a trajectory, by the chain rule over the names that vary in time."""
    varying = set(dynamic)
    result = sp.Integer(0)
    for item in symbols_of(expression):
        name, order = split_derivative(item)
        if name in varying:
            result += partial(expression, item) * derivative_symbol(name, order + 1)
    return result


def with_symbol_as(expression: sp.Expr, item: sp.Symbol, body: sp.Expr) -> sp.Expr:
    """The expression with one symbol replaced. What was made of a term is kept."""
    if item not in symbols_of(expression):
        return expression
    if expression.is_Add:
        return sp.Add(*(_with_symbol(term, item, body) for term in expression.args))
    return _with_symbol(expression, item, body)


@lru_cache(maxsize=20_000)
def _with_symbol(expression: sp.Expr, item: sp.Symbol, body: sp.Expr) -> sp.Expr:
    return _rebuilt(expression, {item: body}, extreme)


def with_symbols_as(expression: sp.Expr, table: Mapping[sp.Symbol, sp.Expr]) -> sp.Expr:
    """The expression with symbols replaced, where no argument of a maximum becomes another one.

    Structures of a search share most of their expressions: what was made is kept.
    """
    return _with_symbols(expression, frozenset(table.items()))


@lru_cache(maxsize=2_000)
def _with_symbols(expression: sp.Expr, items: frozenset[tuple[sp.Symbol, sp.Expr]]) -> sp.Expr:
    return _rebuilt(expression, dict(items), _as_different)


def extreme(kind: Any, *arguments: sp.Expr) -> sp.Expr:
    """The largest or the smallest of several.

    SymPy compares them in their factored form as well, which takes longer than all else that is
    done to most effects. That is left out beside zero, where the sign of the other one is unknown
    and it is not zero in other words.

    Parameters
    ----------
    kind : {sympy.Max, sympy.Min}
    *arguments : Expr
    """
    others = [one for one in arguments if not one.is_zero]
    unknown = len(others) == 1 and len(arguments) == 2 and _has_no_sign(others[0])
    return cast(sp.Expr, kind(*arguments, evaluate=not unknown))


@lru_cache(maxsize=2_000)
def _has_no_sign(expression: sp.Expr) -> bool:
    """Whether SymPy knows no sign of an expression, which is not itself an extreme."""
    above, below = expression.is_extended_nonnegative, expression.is_extended_nonpositive
    if above is not None or below is not None or isinstance(expression, sp.Max | sp.Min):
        return False
    return bool(sp.expand(expression) != 0)


def _as_different(kind: Any, *arguments: sp.Expr) -> sp.Expr:
    """The largest or the smallest of several, which are not compared: that takes most of the time
    of SymPy's own replacement."""
    return cast(sp.Expr, kind(*arguments, evaluate=False))


def _rebuilt(
    expression: sp.Expr,
    table: Mapping[sp.Symbol, sp.Expr],
    extreme_of: Callable[..., sp.Expr],
) -> sp.Expr:
    """The expression with symbols replaced."""
    done: dict[sp.Basic, sp.Basic] = {}

    def made(part: sp.Basic) -> sp.Basic:
        if part.is_Atom:
            return table.get(part, part)
        if part not in done:
            arguments = [made(argument) for argument in part.args]
            same = all(map(operator.is_, arguments, part.args))
            if same:
                done[part] = part
            elif isinstance(part, sp.Max | sp.Min):
                done[part] = extreme_of(part.func, *arguments)
            else:
                done[part] = part.func(*arguments)
        return done[part]

    return cast(sp.Expr, made(expression))


def parse(
    text: str | float | sp.Expr,
    known: Mapping[str, sp.Expr],
    dynamic: Iterable[str],
    where: str,
    whole: Mapping[str, sp.Expr] | None = None,
) -> sp.Expr:
    """Turn text into an expression over known names.

    Parameters
    ----------
    text : str, number or sympy.Expr
        An expression passes through unchanged.
    known : mapping of str to sympy.Expr
        Every name that may occur.
    dynamic : iterable of str
        The names that have time derivatives: dofs and inputs.
    where : str
        Shown in errors: ``equation 'stroke', term 'damping'``.
    whole : mapping of str to sympy.Expr, optional
        What stands behind names of definitions; used inside time derivatives only, so that
        elsewhere a name stays a name and follows when it is redefined.

    Raises
    ------
    ModelError
        If the text is not an expression, or a name is unknown.
    """
    if isinstance(text, sp.Expr):
        return text
    if isinstance(text, int | float) and not isinstance(text, bool):
        return sp.sympify(text)
    if not isinstance(text, str):
        raise ModelError(f"{where}: not an expression", value=text, hint=_AS_IN_PYTHON)
    behind = tuple((whole or {}).items())
    return _built(text, tuple(known.items()), tuple(dynamic), where, behind)


@lru_cache(maxsize=4096)  # each round of a search writes its effects into the model anew
def _built(
    text: str,
    known: tuple[tuple[str, sp.Expr], ...],
    dynamic: tuple[str, ...],
    where: str,
    whole: tuple[tuple[str, sp.Expr], ...],
) -> sp.Expr:
    """The expression of a text."""
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except SyntaxError as error:
        raise ModelError(f"{where}: not an expression", value=text, hint=_slip(text)) from error
    builder = _Builder(dict(known), {**dict(known), **dict(whole)}, dynamic, where, text)
    built = sp.sympify(builder.visit(tree.body))
    if built.has(sp.nan, sp.zoo, sp.oo, -sp.oo, sp.I):
        raise ModelError(f"{where}: not a finite real number", value=text, hint="mind 1/0 and 0/0")
    return built


_OPERATORS: dict[type[ast.operator], Callable[[sp.Expr, sp.Expr], sp.Expr]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: lambda a, b: a**b,
}


_USE = "use + - * / **, numbers, declared names, and functions such as abs or dot"
_SWITCHED = "write step(x), which is 1 where x > 0 and 0 elsewhere, as a factor"
_MAY_NOT: dict[type[ast.AST], tuple[str, str]] = {
    ast.Compare: ("a comparison", _SWITCHED),
    ast.IfExp: ("if … else", _SWITCHED),
    ast.BoolOp: ("and, or", _SWITCHED),
    ast.Not: ("not", _SWITCHED),
    ast.Mod: ("% (a remainder)", _USE),
    ast.FloorDiv: ("// (a whole quotient)", "write / for a quotient"),
    ast.MatMult: ("@", "write * for a product"),
    ast.BitOr: ("|", "write abs(x) for the modulus of x"),
    ast.Subscript: ("an index in brackets", "name each quantity by itself"),
    ast.Attribute: ("a dot between names", "write the name alone, such as sin(x)"),
    ast.Tuple: ("a comma", "write a decimal point, 0.5, and one expression"),
    ast.List: ("a list", _USE),
    ast.Lambda: ("lambda", _USE),
}


def _foreign(node: ast.AST, text: str) -> tuple[str, str]:
    """What a part of an expression is called that may not stand there, and what to write."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor):
        return "^", f"write ** for a power: {text.strip().replace('^', '**')}"
    if isinstance(node, ast.Constant):
        return f"{node.value!r}", _USE
    inner = getattr(node, "op", node)
    found = _MAY_NOT.get(type(inner), _MAY_NOT.get(type(node)))
    return found or (f"{ast.unparse(node)}", _USE)


def _slip(text: str) -> str:
    """What to write in place of text that is no Python."""
    if re.search(r"(?<![=<>!])=(?!=)", text):
        return "write all of it on one side: the expression is what is zero, k*q - F for k*q = F"
    power = re.search(r"([\w)]+)([²³])", text)
    if power:
        return f"write {power[1]}**{'23'['²³'.index(power[2])]} for {power[0]}"
    if "|" in text:
        return "write abs(x) for the modulus of x"
    missing = re.search(r"(\d)\s*([A-Za-z_]\w*)|([A-Za-z_]\w*|\))\s+([A-Za-z_]\w*|\()", text)
    if missing:
        left, right = missing[1] or missing[3], missing[2] or missing[4]
        return f"a product needs *: write {left}*{right} for {missing[0]}"
    if text.count("(") != text.count(")"):
        return f"there are {text.count('(')} ( and {text.count(')')} )"
    return _AS_IN_PYTHON


class _Builder(ast.NodeVisitor):
    """Builds an expression from a syntax tree; nothing is evaluated as Python."""

    def __init__(
        self,
        known: Mapping[str, sp.Expr],
        whole: Mapping[str, sp.Expr],
        dynamic: tuple[str, ...],
        where: str,
        text: str,
    ):
        self.known, self.whole, self.dynamic = known, whole, dynamic
        self.where, self.text = where, text

    def generic_visit(self, node: ast.AST) -> sp.Expr:
        what, hint = _foreign(node, self.text)
        raise ModelError(
            f"{self.where}: {what} has no place in an expression",
            value=self.text,
            hint=hint,
        )

    def visit_Constant(self, node: ast.Constant) -> sp.Expr:
        if isinstance(node.value, bool) or not isinstance(node.value, int | float):
            return self.generic_visit(node)
        return sp.Integer(node.value) if isinstance(node.value, int) else sp.Float(node.value)

    def visit_Name(self, node: ast.Name) -> sp.Expr:
        if node.id in self.known:
            return self.known[node.id]
        if node.id == "pi":
            return sp.pi
        if node.id == "time":
            return TIME
        hint = f"{choose(node.id, sorted(self.known))}; or declare it in parameters"
        raise ModelError(f"{self.where}: unknown name {node.id}", value=self.text, hint=hint)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> sp.Expr:
        value = self.visit(node.operand)
        if isinstance(node.op, ast.USub):
            return -value
        return value if isinstance(node.op, ast.UAdd) else self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> sp.Expr:
        operator = _OPERATORS.get(type(node.op))
        if operator is None:
            return self.generic_visit(node)
        return operator(self.visit(node.left), self.visit(node.right))

    def visit_Call(self, node: ast.Call) -> sp.Expr:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if re.fullmatch("d+ot", name) and len(node.args) == 1:
            return self._time_derivative(node.args[0], len(name) - 2)
        arguments = [sp.sympify(self.visit(argument)) for argument in node.args]
        function = FUNCTIONS.get(name)
        if function is None or not callable(function) or node.keywords:
            allowed = ", ".join(sorted(FUNCTIONS))
            raise ModelError(
                f"{self.where}: unknown function {name or ast.unparse(node.func)}",
                value=self.text,
                hint=f"there are dot, ddot, {allowed}",
            )
        least = 2 if name in ("min", "max") else 1
        if len(arguments) < least or (least == 1 and len(arguments) > 1):
            wanted = "two arguments or more" if least == 2 else "one argument"
            raise ModelError(f"{self.where}: {name} takes {wanted}", value=self.text)
        if function in (sp.Max, sp.Min):
            return extreme(function, *arguments)
        return function(*arguments)

    def _time_derivative(self, argument: ast.expr, order: int) -> sp.Expr:
        inside = _Builder(self.whole, self.whole, self.dynamic, self.where, self.text)
        expression = sp.sympify(inside.visit(argument))
        for _ in range(order):
            expression = total_derivative(expression, self.dynamic)
        return expression


class _Text(StrPrinter):  # type: ignore[misc] # SymPy has no types
    """Prints what :func:`bayesoleo.model._expressions.parse` reads."""

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
