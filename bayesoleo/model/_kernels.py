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
from typing import Any

import sympy as sp

from bayesoleo._compiled import BLOCK, ArrayKernel, BlockKernel, Kernel, load
from bayesoleo.model._code_printing import code, statements
from bayesoleo.model._derivatives import Derived, derive
from bayesoleo.model._expressions import TIME, derivative_symbol, symbol
from bayesoleo.model._model import Model

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
    later: dict[str, Kernel] = {
        name: ArrayKernel(_Later(derived, name), rows, sizes)
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
