"""Numerical kernels of a model: evaluation at a block of points for many parameter vectors.

All arrays have the points last, so that a loop over points runs through memory: states ``z (L, nz,
N)``, inputs ``u (nu, N)`` shared by the lanes of a call, constants ``p (L, np)``. ``lanes`` lists
the parameter vectors, of the ``L``, that are evaluated. The same expressions serve two back ends:
NumPy (ready at once; for models evaluated a few times) and machine code for the loops that Numba
compiles, which is kept on disk.

Kernels are kept by a key that is equal for all models of the same expressions, whatever the values
of their parameters. Computer algebra is the slowest part of a search that tries a hundred models on
each campaign, and its results hold for every campaign.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial, reduce
from typing import Any, NamedTuple, cast

import numpy as np
import sympy as sp
from sympy.printing.pycode import PythonCodePrinter

from bayesoleo._compiled import BLOCK, ArrayKernel, BlockKernel, Kernel
from bayesoleo._machine_code import C_FUNCTIONS, number
from bayesoleo.errors import ModelError
from bayesoleo.model._derivatives import Derived, derive
from bayesoleo.model._expressions import FUNCTIONS, TIME, derivative_symbol, symbol
from bayesoleo.model._model import Model

#: What a base that is never negative, such as ``positive(x)``, is at least in a negative power. The
#: slope of its root would be infinite at zero, and no number beyond, where it is zero.
_LEAST_BASE = sp.Float(1e-100)

#: Rows of a result above which those that are the same at all points are written one after the
#: other. All rows at one point lie so many cache lines apart that they share eight places in the
#: nearest cache, of eight lines each: more rows push each other out before a line is full.
MANY_ROWS = 64

_CALLS = {name: name for name in ("exp", "log", "sin", "cos", "tan", "tanh")} | {"atan": "arctan"}


def _defined(expression: sp.Expr) -> sp.Expr:
    """An expression whose slopes of roots are numbers where the root has ended."""
    if not expression.has(sp.Abs, sp.Max):
        return expression
    table = {
        power: sp.Pow(sp.Max(power.base, _LEAST_BASE), power.exp)
        for power in expression.atoms(sp.Pow)
        if power.exp.is_negative and not power.exp.is_integer
        if isinstance(power.base, sp.Abs | sp.Max) and power.base.is_nonnegative
    }
    return expression.xreplace(table)


class _Printer(PythonCodePrinter):  # type: ignore[misc] # SymPy has no types
    """Prints NumPy functions, and small powers as products."""

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


def statements(
    expressions: Sequence[sp.Expr], names: Mapping[sp.Symbol, str]
) -> tuple[set[sp.Symbol], list[str], list[str]]:
    """Statements that evaluate expressions, each subexpression in one of its own.

    Common factors of products are not looked for: that pays only where a kernel is called often.

    Parameters
    ----------
    expressions : sequence of sympy.Expr
        What to evaluate.
    names : mapping of sympy.Symbol to str
        What each symbol is called in the code.

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
    results = [printer._print(_defined(sp.sympify(expression))) for expression in expressions]
    return printer.used, printer.lines, results


class _Instructions:
    """Instructions of a kernel's machine code, each value made once.

    Parameters
    ----------
    rows : mapping of sympy.Symbol to (str, int)
        Array and row of each symbol.
    """

    def __init__(self, rows: Mapping[sp.Symbol, tuple[str, int]]):
        self._rows = rows
        self._values: dict[sp.Basic, _Value] = {}
        self._operations: dict[tuple[str, ...], _Value] = {}
        #: What depends on constants alone is computed once, outside the loop over points.
        self.outside: list[str] = []
        self.inside: list[str] = []

    def define(self, name: sp.Symbol, expression: sp.Expr) -> None:
        """Let a symbol stand for an expression."""
        self._values[name] = self.value(expression)

    def value(self, expression: sp.Basic) -> _Value:
        """Where an expression's value stands."""
        if expression not in self._values:
            self._values[expression] = self._new_value(expression)
        return self._values[expression]

    def store(self, row: int, value: _Value) -> None:
        """Write a value to a row of the result."""
        self.inside.append(f"store double {value.name}, ptr {self._place('out', row)}")

    def _new_value(self, expression: sp.Basic) -> _Value:
        if expression.is_Symbol:
            return self._loaded(*self._rows[expression])
        if expression.is_Number or expression.is_NumberSymbol:
            return _number(float(expression))
        if expression.is_Pow:
            return self._power(*expression.as_base_exp())
        if expression.is_Mul:
            return self._product(expression)
        kind = type(expression).__name__
        if not (kind in _FOLDED or kind in _CALLED or hasattr(self, f"_{kind}")):
            raise ModelError(
                f"{expression} cannot be compiled: {kind} is not a function of equations",
                hint=f"use {', '.join(FUNCTIONS)}",
            )
        arguments = [self.value(item) for item in expression.args]
        if kind in _FOLDED:
            return self._folded(_FOLDED[kind], arguments)
        if kind in _CALLED:
            return self._do(_CALLED[kind], *arguments)
        return cast(_Value, getattr(self, f"_{kind}")(*arguments))

    def _product(self, expression: sp.Mul) -> _Value:
        """Numerator over denominator: a factor's inverse may be beyond all numbers where the ratio
        is not."""
        above, below = [], []
        for factor in expression.args:
            base, exponent = factor.as_base_exp()
            if exponent.is_Number and exponent.is_negative:
                below.append(self.value(sp.Pow(base, -exponent)))
            else:
                above.append(self.value(factor))
        numerator = self._folded("fmul", above or [_number(1.0)])
        return self._do("fdiv", numerator, self._folded("fmul", below)) if below else numerator

    def _folded(self, operation: str, values: Sequence[_Value]) -> _Value:
        return reduce(lambda one, other: self._do(operation, one, other), values)

    def _power(self, base: sp.Expr, exponent: sp.Expr) -> _Value:
        if base is sp.E:
            return self._do("c_exp", self.value(exponent))
        value = self.value(base)
        if exponent == sp.Rational(1, 2):
            return self._do("llvm.sqrt.f64", value)
        if exponent.is_Integer and 1 <= abs(int(exponent)) <= 4:
            product = value
            for _ in range(abs(int(exponent)) - 1):
                product = self._do("fmul", product, value)
            return product if exponent > 0 else self._do("fdiv", _number(1.0), product)
        return self._do("c_pow", value, self.value(exponent))

    def _Heaviside(self, value: _Value, *_: _Value) -> _Value:
        half = _number(0.5)
        return self._do("fadd", half, self._do("fmul", half, self._do("sign", value)))

    # Computer algebra writes a tangent that is shifted by a quarter of a turn so.
    def _cot(self, value: _Value) -> _Value:
        return self._do("fdiv", _number(1.0), self._do("c_tan", value))

    # Every quantity is real, but a power of what might be negative is not known to be: the slope of
    # its absolute value is then written with both parts.
    def _re(self, value: _Value) -> _Value:
        return value

    _conjugate = _re

    def _im(self, _: _Value) -> _Value:
        return _number(0.0)

    def _bspline(self, place: _Value) -> _Value:
        far, near = self._reaches(place)
        far = self._do("fmul", self._do("fmul", far, far), far)
        near = self._do("fmul", self._do("fmul", near, near), near)
        over = self._do("fsub", far, self._do("fmul", _number(4.0), near))
        # A division takes several times as long, and a curve has one for each of its splines.
        return self._do("fmul", over, _number(1.0 / 6.0))

    def _bspline_slope(self, place: _Value) -> _Value:
        far, near = (self._do("fmul", one, one) for one in self._reaches(place))
        over = self._do("fsub", far, self._do("fmul", _number(4.0), near))
        side = self._do("fmul", _number(-0.5), self._do("sign", place))
        return self._do("fmul", side, over)

    def _reaches(self, place: _Value) -> tuple[_Value, _Value]:
        """How far inside its supports of two and of one a B-spline's argument lies."""
        size = self._do("llvm.fabs.f64", place)
        far, near = (
            self._do("maximum", self._do("fsub", _number(edge), size), _number(0.0))
            for edge in (2.0, 1.0)
        )
        return far, near

    def _do(self, operation: str, *arguments: _Value) -> _Value:
        key = (operation, *(item.name for item in arguments))
        if key not in self._operations:
            given = ", ".join(f"double {item.name}" for item in arguments)
            text = f"call double @{operation}({given})"
            if operation in _ARITHMETIC:
                text = f"{operation} double {', '.join(item.name for item in arguments)}"
            fixed = all(item.fixed for item in arguments)
            self._operations[key] = _Value(self._add(text, fixed), fixed)
        return self._operations[key]

    def _loaded(self, array: str, row: int) -> _Value:
        fixed = array == "p"
        return _Value(self._add(f"load double, ptr {self._place(array, row)}", fixed), fixed)

    def _place(self, array: str, row: int) -> str:
        """Pointer to a constant, or to a row's present point."""
        if array == "p":
            return self._add(f"getelementptr double, ptr %p, i64 {row}", True)
        at = self._add(f"add nuw nsw i64 %i, {row * BLOCK}", False)
        return self._add(f"getelementptr double, ptr %{array}, i64 {at}", False)

    def _add(self, text: str, fixed: bool) -> str:
        name = f"%v{len(self.outside) + len(self.inside)}"
        (self.outside if fixed else self.inside).append(f"{name} = {text}")
        return name


class _Value(NamedTuple):
    """A value in machine code, and whether it is the same at all points."""

    name: str
    fixed: bool


def _number(value: float) -> _Value:
    return _Value(number(value), True)


_ARITHMETIC = frozenset({"fadd", "fsub", "fmul", "fdiv"})
#: Of several arguments, one after the other; and of one.
_FOLDED = {"Add": "fadd", "Max": "maximum", "Min": "minimum"}
_CALLED = {name: f"c_{name}" for name in C_FUNCTIONS} | {
    "Abs": "llvm.fabs.f64", "atan": "arctan", "sign": "sign"
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Structured:
    """A model that compares by :attr:`~bayesoleo.model.Model.structure`, to key a cache.

    Parameters
    ----------
    model : Model
    """

    model: Model

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Structured):
            return NotImplemented
        return self.model is other.model or self.model.structure == other.model.structure

    def __hash__(self) -> int:
        return hash(self.model.structure)


@dataclass(frozen=True)
class Kernels:
    """Compiled functions of one model; each fills its last arguments.

    Parameters
    ----------
    derived : Derived
        The rows' meaning.
    residual : callable
        ``(z, u, p, lanes, g)`` with ``g (L, d, N)``.
    jacobian : callable
        ``(z, u, p, lanes, g, gz)`` with ``gz (L, d, nz, N)``.
    parameters : callable
        ``(z, u, p, lanes, gp)`` with ``gp (L, d, na, N)``.
    output : callable
        ``(z, u, p, lanes, y)`` with ``y (L, ny, N)``.
    output_jacobian : callable
        ``(z, u, p, lanes, yz, yp)`` with ``yz (L, ny, nz, N)`` and ``yp (L, ny, na, N)``.
    admissible : callable
        ``(z, u, p, lanes, a)`` with ``a (L, nc, N)``, positive inside the admissible region.
    inputs : callable
        ``(z, u, p, lanes, gu)`` with ``gu (L, d, nu, N)``: how the equations depend on the input
        rows.
    output_inputs : callable
        ``(z, u, p, lanes, yu)`` with ``yu (L, ny, nu, N)``.
    """

    derived: Derived
    residual: Kernel
    jacobian: Kernel
    parameters: Kernel
    output: Kernel
    output_jacobian: Kernel
    admissible: Kernel
    inputs: Kernel
    output_inputs: Kernel


@lru_cache(maxsize=512)  # a search over the catalogue makes some two hundred
def _cached(like: Structured, active: tuple[str, ...], backend: str) -> Kernels:
    derived = derive(like.model, active)
    if backend == "numba":
        blocks: dict[str, Kernel] = {
            name: BlockKernel(partial(_machine_code_of, derived, name), rows)
            for name, rows in _counts(derived).items()
        }
        return Kernels(derived, **blocks)
    # A search evaluates many models once, and few of their kernels: each is made when it is asked.
    sizes = (len(derived.states), len(derived.inputs), len(derived.constants))
    made = {name: _Later(derived, name) for name in _counts(derived)}
    later: dict[str, Kernel] = {
        name: ArrayKernel(made[name], rows, sizes, made[name].compiled)
        for name, rows in _counts(derived).items()
    }
    return Kernels(derived, **later)


class _Later:
    """A kernel's function for NumPy, generated by its first call.

    Two threads that call it first at once both make it, to the same effect.
    """

    def __init__(self, derived: Derived, name: str) -> None:
        self._derived, self._name = derived, name

    @cached_property
    def _made(self) -> Callable[..., None]:
        items = _results(self._derived)[self._name]()
        scope: dict[str, Any] = {"np": np}
        body = "\n    ".join(_on_rows(items, self._derived))
        exec(compile(f"def made(z, u, p, out):\n    {body}\n", "<kernels>", "exec"), scope)
        return cast(Callable[..., None], scope["made"])

    def __call__(self, *arguments: Any) -> None:
        self._made(*arguments)

    def compiled(self) -> BlockKernel:
        """The same kernel for blocks of points, by itself."""
        rows = _counts(self._derived)[self._name]
        return BlockKernel(partial(_machine_code_of, self._derived, self._name), rows)


def _counts(derived: Derived) -> dict[str, int]:
    """Rows that each kernel fills."""
    d, ny = len(derived.residual), len(derived.output)
    nz, nu, na = len(derived.states), len(derived.inputs), len(derived.active)
    return {
        "residual": d,
        "jacobian": d * (1 + nz),
        "parameters": d * na,
        "output": ny,
        "output_jacobian": ny * (nz + na),
        "admissible": len(derived.admissible),
        "inputs": d * nu,
        "output_inputs": ny * nu,
    }


def kernels(model: Model, active: Sequence[str] | None = None, backend: str = "numba") -> Kernels:
    """Generate (or fetch) the kernels of a model.

    Parameters
    ----------
    model : Model
        In the drive in which it is to be solved.
    active : sequence of str, optional
        Parameters to differentiate by; by default those that are estimated.
    backend : {"numba", "numpy"}
        ``numba`` stands for machine code, which pays when a model is evaluated often.

    Returns
    -------
    Kernels
    """
    chosen = tuple(model.estimated() if active is None else active)
    return _cached(Structured(model), chosen, backend)


def _results(derived: Derived) -> dict[str, Callable[[], list[sp.Expr]]]:
    """What each kernel computes, row by row, once it is asked for."""
    active, states = derived.active_symbols, derived.states
    g, y = derived.residual, derived.output
    rows = [
        TIME if name == "time" else derivative_symbol(name, order) for name, order in derived.inputs
    ]
    return {
        "residual": lambda: list(g),
        "jacobian": lambda: [*g, *derived.gradient(g, states)],
        "parameters": lambda: derived.gradient(g, active),
        "output": lambda: list(y),
        "output_jacobian": lambda: [*derived.gradient(y, states), *derived.gradient(y, active)],
        "admissible": lambda: list(derived.admissible),
        "inputs": lambda: derived.gradient(g, rows),
        "output_inputs": lambda: derived.gradient(y, rows),
    }


def _on_rows(items: Sequence[sp.Expr], derived: Derived) -> list[str]:
    rows = _rows(derived)
    used, lines, results = statements(items, {item: f"{a}{k}" for item, (a, k) in rows.items()})
    loads = [f"{a}{k} = {a}[{k}]" for item, (a, k) in rows.items() if item in used]
    stores = [f"out[{k}][...] = {result}" for k, result in enumerate(results)] or ["pass"]
    return [*loads, *lines, *stores]


def _machine_code_of(derived: Derived, name: str) -> str:
    return machine_code(_results(derived)[name](), derived)


def machine_code(items: Sequence[sp.Expr], derived: Derived) -> str:
    """Source of a kernel for blocks of points (:func:`~bayesoleo._machine_code.address_of`), with
    common factors shared."""
    whole = [_defined(sp.sympify(item)) for item in items]
    names = sp.numbered_symbols("w", real=True, exclude=_rows(derived))
    shared, reduced = sp.cse(whole, symbols=names, order="none")
    made = _Instructions(_rows(derived))
    for name, body in shared:
        made.define(name, body)
    constant: dict[str, list[int]] = {}
    for row, expression in enumerate(reduced):
        value = made.value(expression)
        if value.fixed and len(reduced) > MANY_ROWS:
            constant.setdefault(value.name, []).append(row)
        else:
            made.store(row, value)
    places = [
        f"@places{k} = internal constant [{len(rows)} x i64] "
        f"[{', '.join(f'i64 {row * BLOCK}' for row in rows)}]"
        for k, rows in enumerate(constant.values())
    ]
    fills = [
        _FILL.format(k=k, after=k + 1, value=value, rows=len(rows))
        for k, (value, rows) in enumerate(constant.items())
    ]
    return _KERNEL.format(
        places="\n".join(places),
        outside="\n  ".join(made.outside),
        fills="".join(fills),
        last=len(fills),
        inside="\n  ".join(made.inside),
    )


#: The arrays of a call do not overlap. Loops stay loops: a function of the C library, which the
#: compiler would call to write zeros, may be unknown where the code is loaded.
_KERNEL = """
{places}
define void @kernel(ptr noalias readonly %z, ptr noalias readonly %u, ptr noalias readonly %p,
                    ptr noalias %out, i64 %count) "no-builtin-memset" {{
entry:
  {outside}
  %any = icmp sgt i64 %count, 0
  br i1 %any, label %fill0, label %end
{fills}
fill{last}:
  br label %loop
loop:
  %i = phi i64 [ 0, %fill{last} ], [ %next, %loop ]
  {inside}
  %next = add nuw nsw i64 %i, 1
  %more = icmp slt i64 %next, %count
  br i1 %more, label %loop, label %end
end:
  ret void
}}
"""
#: Rows of one value that is the same at all points.
_FILL = """
fill{k}:
  br label %row{k}
row{k}:
  %at{k} = phi i64 [ 0, %fill{k} ], [ %following{k}, %row{k}_end ]
  %entry{k} = getelementptr i64, ptr @places{k}, i64 %at{k}
  %place{k} = load i64, ptr %entry{k}
  %row{k}_out = getelementptr double, ptr %out, i64 %place{k}
  br label %point{k}
point{k}:
  %i{k} = phi i64 [ 0, %row{k} ], [ %next{k}, %point{k} ]
  %to{k} = getelementptr double, ptr %row{k}_out, i64 %i{k}
  store double {value}, ptr %to{k}
  %next{k} = add nuw nsw i64 %i{k}, 1
  %more{k} = icmp slt i64 %next{k}, %count
  br i1 %more{k}, label %point{k}, label %row{k}_end
row{k}_end:
  %following{k} = add nuw nsw i64 %at{k}, 1
  %others{k} = icmp slt i64 %following{k}, {rows}
  br i1 %others{k}, label %row{k}, label %fill{after}
"""


def _rows(derived: Derived) -> dict[sp.Symbol, tuple[str, int]]:
    """Array and row of every symbol: constants, states, inputs."""
    found = {symbol(name): ("p", k) for k, name in enumerate(derived.constants)}
    found |= {state: ("z", k) for k, state in enumerate(derived.states)}
    for k, (channel, order) in enumerate(derived.inputs):
        found[derivative_symbol(channel, order)] = "u", k
    return found
