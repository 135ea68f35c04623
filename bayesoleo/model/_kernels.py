"""Numerical kernels of a model: evaluation at a block of points for many parameter vectors.

All arrays have the points last, so that a loop over points runs through memory: states ``z (L, nz,
N)``, inputs ``u (nu, N)`` shared by the lanes of a call, constants ``p (L, np)``. ``lanes`` lists
the parameter vectors, of the ``L``, that are evaluated. The same generated source serves two back
ends: NumPy (ready at once; for models evaluated a few times) and Numba (compiled, cached on disk by
the source's hash).

Kernels are kept by a key that is equal for all models of the same expressions, whatever the values
of their parameters. Computer algebra is the slowest part of a search that tries a hundred models on
each campaign, and its results hold for every campaign.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import ModuleType
from typing import Any, cast

import sympy as sp
from sympy.printing.pycode import PythonCodePrinter

from bayesoleo._compiled import BLOCK, ArrayKernel, BlockKernel, Kernel, load
from bayesoleo.model._derivatives import Derived, derive
from bayesoleo.model._expressions import TIME, derivative_symbol, symbol
from bayesoleo.model._model import Model

#: What a base that is never negative, such as ``positive(x)``, is at least in a negative power. The
#: slope of its root would be infinite at zero, and no number beyond, where it is zero.
_LEAST_BASE = sp.Float(1e-100)

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
        _defined(expression).xreplace({s: sp.Symbol(n, real=True) for s, n in names.items()})
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
    results = [printer._print(_defined(sp.sympify(expression))) for expression in expressions]
    return printer.used, printer.lines, results


#: Rational arctangent after Moshier (Cephes), good to 2e-16, without branches and calls, so that
#: loops over points become vector instructions: 20 times faster than the library's. In every
#: kernel's source, so that the hash it is cached under covers it.
ARCTAN = """

@numba.njit(error_model="numpy")
def arctan(x):
    size = abs(x)
    far = size > 2.414213562373095
    middle = size > 0.66
    above = -1.0 if far else (size - 1.0 if middle else size)
    below = size if far else (size + 1.0 if middle else 1.0)
    base = 1.5707963267948966 if far else (0.7853981633974483 if middle else 0.0)
    rest = 6.123233995736766e-17 if far else (3.061616997868383e-17 if middle else 0.0)
    t = above / below
    s = t * t
    top = (-8.750608600031904e-1 * s - 1.615753718733365e1) * s - 7.500855792314705e1
    top = (top * s - 1.2288666844901361e2) * s - 6.485021904942025e1
    bottom = ((s + 2.485846490142306e1) * s + 1.650270098316988e2) * s + 4.328810604912903e2
    bottom = (bottom * s + 4.853903996359137e2) * s + 1.945506571482614e2
    value = base + (t + (t * (s * top / bottom) + rest))
    return -value if x < 0.0 else value"""


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
    source : str
        The generated code; empty where kernels are generated one by one when they are called.
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
    source: str


@lru_cache(maxsize=512)  # a search over the catalogue makes some two hundred
def _cached(like: Structured, active: tuple[str, ...], backend: str) -> Kernels:
    derived = derive(like.model, active)
    if backend == "numba":
        results = {name: make() for name, make in _results(derived).items()}
        source = _module(results, derived, backend)
        module = load(source)
        functions: dict[str, Kernel] = {
            name: BlockKernel(getattr(module, name), len(items)) for name, items in results.items()
        }
        return Kernels(derived, source=source, **functions)
    # A search evaluates many models once, and few of their kernels: each is made when it is asked.
    sizes = (len(derived.states), len(derived.inputs), len(derived.constants))
    made = {name: _Later(derived, name) for name in _counts(derived)}
    later: dict[str, Kernel] = {
        name: ArrayKernel(made[name], rows, sizes, made[name].compiled)
        for name, rows in _counts(derived).items()
    }
    return Kernels(derived, source="", **later)


class _Later:
    """A kernel's function for NumPy, generated by its first call.

    Two threads that call it first at once both make it, to the same effect.
    """

    def __init__(self, derived: Derived, name: str) -> None:
        self._derived, self._name = derived, name

    @cached_property
    def _made(self) -> Callable[..., None]:
        items = _results(self._derived)[self._name]()
        module = ModuleType("kernels")
        source = _module({self._name: items}, self._derived, "numpy")
        exec(compile(source, "<kernels>", "exec"), module.__dict__)
        made: Callable[..., None] = getattr(module, self._name)
        return made

    def __call__(self, *arguments: Any) -> None:
        self._made(*arguments)

    def compiled(self) -> BlockKernel:
        """The same kernel for blocks of points, by itself."""
        items = _results(self._derived)[self._name]()
        module = load(_module({self._name: items}, self._derived, "numba"))
        return BlockKernel(getattr(module, self._name), len(items))


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
        Numba pays when a model is evaluated often.

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


def generate(derived: Derived, backend: str) -> str:
    """Source of a module with all kernels of a model."""
    return _module({name: make() for name, make in _results(derived).items()}, derived, backend)


def _module(results: Mapping[str, Sequence[sp.Expr]], derived: Derived, backend: str) -> str:
    head = ["import numpy as np"]
    if backend == "numba":
        head += ["import numba", ARCTAN]
    parts = [_function(name, items, derived, backend) for name, items in results.items()]
    return "\n".join(head) + "\n\n\n" + "\n\n\n".join(parts) + "\n"


def _function(name: str, items: Sequence[sp.Expr], derived: Derived, backend: str) -> str:
    """One kernel: a loop over the points of a block (Numba) or operations on rows (NumPy)."""
    body = (_looped if backend == "numba" else _on_rows)(items, derived)
    count = ", count" if backend == "numba" else ""
    return "\n".join([f"def {name}(z, u, p, out{count}):", *(f"    {line}" for line in body)])


def _on_rows(items: Sequence[sp.Expr], derived: Derived) -> list[str]:
    rows = _rows(derived)
    used, lines, results = statements(items, {item: f"{a}{k}" for item, (a, k) in rows.items()})
    loads = [f"{a}{k} = {a}[{k}]" for item, (a, k) in rows.items() if item in used]
    stores = [f"out[{k}][...] = {result}" for k, result in enumerate(results)] or ["pass"]
    return [*loads, *lines, *stores]


def _looped(items: Sequence[sp.Expr], derived: Derived) -> list[str]:
    free = set().union(*(e.free_symbols for e in items)) if items else set()
    rows = {item: place for item, place in _rows(derived).items() if item in free}
    names = {item: f"{array}{k}" for item, (array, k) in rows.items()}
    constants = {item for item, (array, _) in rows.items() if array == "p"}
    outside, inside, results = code(items, names, constants)
    sizes = {
        "z": len(derived.states) * BLOCK,
        "u": len(derived.inputs) * BLOCK,
        "p": len(derived.constants),
        "out": len(items) * BLOCK,
    }
    lines = [f"{key} = numba.carray({key}, ({size},))" for key, size in sizes.items() if size]
    lines += [f"p{k} = p[{k}]" for array, k in rows.values() if array == "p"]
    lines += [*outside, "for i in range(count):"]
    loads = [f"{a}{k} = {a}[{k * BLOCK} + i]" for a, k in rows.values() if a != "p"]
    stores = [f"out[{k * BLOCK} + i] = {result}" for k, result in enumerate(results)] or ["pass"]
    lines += [f"    {line}" for line in [*loads, *inside, *stores]]
    return [line.replace("np.arctan(", "arctan(") for line in lines]


def _rows(derived: Derived) -> dict[sp.Symbol, tuple[str, int]]:
    """Array and row of every symbol: constants, states, inputs."""
    found = {symbol(name): ("p", k) for k, name in enumerate(derived.constants)}
    found |= {state: ("z", k) for k, state in enumerate(derived.states)}
    for k, (channel, order) in enumerate(derived.inputs):
        found[derivative_symbol(channel, order)] = "u", k
    return found
