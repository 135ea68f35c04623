"""Functions that evaluate a model at a block of points for many parameter vectors.

All arrays have the points last, so that a loop over points runs through memory: states ``z (L, nz,
N)``, inputs ``u (nu, N)`` shared by the lanes of a call, constants ``p (L, np)``. ``lanes`` lists
which of the ``L`` parameter vectors to evaluate. The same generated source serves two back ends:
NumPy (ready at once; for models evaluated a few times) and Numba (compiled, cached on disk by the
source's hash).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType

import sympy as sp

from bayesoleo.compiled import BLOCK, ArrayKernel, BlockKernel, Kernel, load
from bayesoleo.model.derive import Derived, derive
from bayesoleo.model.expressions import TIME, derivative_symbol, symbol
from bayesoleo.model.model import Model
from bayesoleo.model.printing import code


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
        The generated code.
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


@lru_cache(maxsize=128)
def _cached(digest: str, active: tuple[str, ...], backend: str, model: _Hashed) -> Kernels:
    derived = derive(model.model, active)
    results = _results(derived)
    source = generate(derived, backend)
    functions: dict[str, Kernel] = {}
    if backend == "numba":
        module = load(source)
        functions = {
            name: BlockKernel(getattr(module, name), len(items)) for name, items in results.items()
        }
    else:
        sizes = (len(derived.states), len(derived.inputs), len(derived.constants))
        module = ModuleType("kernels")
        exec(compile(source, "<kernels>", "exec"), module.__dict__)
        functions = {
            name: ArrayKernel(getattr(module, name), len(items), sizes)
            for name, items in results.items()
        }
    return Kernels(derived=derived, source=source, **functions)


@dataclass(frozen=True)
class _Hashed:
    """A model that compares by its digest, so that it can key a cache."""

    model: Model
    digest: str

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Hashed) and other.digest == self.digest

    def __hash__(self) -> int:
        return hash(self.digest)


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
    digest = model.digest()
    return _cached(digest, chosen, backend, _Hashed(model, digest))


def _results(derived: Derived) -> dict[str, list[sp.Expr]]:
    """What each kernel computes, row by row."""
    active, states = derived.active_symbols, derived.states
    g, y = derived.residual, derived.output
    rows = [
        TIME if name == "time" else derivative_symbol(name, order) for name, order in derived.inputs
    ]
    return {
        "residual": list(g),
        "jacobian": [*g, *derived.gradient(g, states)],
        "parameters": derived.gradient(g, active),
        "output": list(y),
        "output_jacobian": [*derived.gradient(y, states), *derived.gradient(y, active)],
        "admissible": list(derived.admissible),
        "inputs": derived.gradient(g, rows),
        "output_inputs": derived.gradient(y, rows),
    }


def generate(derived: Derived, backend: str) -> str:
    """Source of a module with all kernels of a model."""
    head = ["import numpy as np"]
    if backend == "numba":
        head += ["import numba", ARCTAN]
    parts = [_function(name, items, derived, backend) for name, items in _results(derived).items()]
    return "\n".join(head) + "\n\n\n" + "\n\n\n".join(parts) + "\n"


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


def _function(name: str, items: Sequence[sp.Expr], derived: Derived, backend: str) -> str:
    """One kernel: a loop over the points of a block (Numba) or operations on rows (NumPy)."""
    block = backend == "numba"
    names, loads_constant, loads_point = _names(derived, items, block)
    constants = {symbol(c) for c in derived.constants if symbol(c) in names}
    outside, inside, results = code(items, names, constants)
    if not block:
        lines = [f"out[{k}][...] = {result}" for k, result in enumerate(results)]
        body = [*loads_constant, *outside, *loads_point, *inside, *lines] or ["pass"]
        return "\n".join([f"def {name}(z, u, p, out):", *(f"    {line}" for line in body)])
    sizes = {
        "z": len(derived.states) * BLOCK,
        "u": len(derived.inputs) * BLOCK,
        "p": len(derived.constants),
        "out": len(items) * BLOCK,
    }
    lines = [f"{key} = numba.carray({key}, ({size},))" for key, size in sizes.items() if size]
    lines += [*loads_constant, *outside, "for i in range(count):"]
    stores = [f"out[{k * BLOCK} + i] = {result}" for k, result in enumerate(results)] or ["pass"]
    lines += [f"    {line}" for line in [*loads_point, *inside, *stores]]
    body = [line.replace("np.arctan(", "arctan(") for line in lines]
    return "\n".join([f"def {name}(z, u, p, out, count):", *(f"    {line}" for line in body)])


def _names(
    derived: Derived, expressions: Sequence[sp.Expr], block: bool
) -> tuple[dict[sp.Symbol, str], list[str], list[str]]:
    """Code names of the symbols that occur, with the lines that load them."""
    used = set().union(*(e.free_symbols for e in expressions)) if expressions else set()
    names: dict[sp.Symbol, str] = {}
    constant, point = [], []

    def row(array: str, k: int) -> str:
        return f"{array}{k} = {array}[{k * BLOCK} + i]" if block else f"{array}{k} = {array}[{k}]"

    for k, item in enumerate(derived.constants):
        if symbol(item) in used:
            names[symbol(item)] = f"p{k}"
            constant.append(f"p{k} = p[{k}]")
    for k, state in enumerate(derived.states):
        if state in used:
            names[state] = f"z{k}"
            point.append(row("z", k))
    for k, (channel, order) in enumerate(derived.inputs):
        if derivative_symbol(channel, order) in used:
            names[derivative_symbol(channel, order)] = f"u{k}"
            point.append(row("u", k))
    return names, constant, point
