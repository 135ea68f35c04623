"""Functions that evaluate a model at a block of points for many parameter vectors.

All arrays have the points last, so that a loop over points runs through memory: states ``z (L, nz,
N)``, inputs ``u (nu, N)`` shared by the lanes of a call, constants ``p (L, np)``. ``lanes`` lists
which of the ``L`` parameter vectors to evaluate. The same generated source serves two back ends:
NumPy (ready at once; for models evaluated a few times) and Numba (compiled, cached on disk by the
source's hash).
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import platformdirs
import sympy as sp

from bayesoleo.model.derive import Derived, derive
from bayesoleo.model.expressions import TIME, derivative_symbol, symbol
from bayesoleo.model.model import Model
from bayesoleo.model.printing import code

Kernel = Callable[..., Any]


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
    source = generate(derived, backend)
    module = _load(source, backend)
    functions = {name: getattr(module, name) for name in KERNELS}
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


KERNELS = (
    "residual",
    "jacobian",
    "parameters",
    "output",
    "output_jacobian",
    "admissible",
    "inputs",
    "output_inputs",
)


def generate(derived: Derived, backend: str) -> str:
    """Source of a module with all kernels of a model."""
    active, states = derived.active_symbols, derived.states
    g, y = derived.residual, derived.output
    gz, gp = derived.gradient(g, states), derived.gradient(g, active)
    yz, yp = derived.gradient(y, states), derived.gradient(y, active)
    rows = [
        TIME if name == "time" else derivative_symbol(name, order) for name, order in derived.inputs
    ]
    gu, yu = derived.gradient(g, rows), derived.gradient(y, rows)
    nz, na, nu = len(states), len(active), len(rows)
    targets = {
        "residual": (("g",), [*_vector("g", g)]),
        "jacobian": (("g", "gz"), [*_vector("g", g), *_matrix("gz", gz, nz)]),
        "parameters": (("gp",), [*_matrix("gp", gp, na)]),
        "output": (("y",), [*_vector("y", y)]),
        "output_jacobian": (("yz", "yp"), [*_matrix("yz", yz, nz), *_matrix("yp", yp, na)]),
        "admissible": (("a",), [*_vector("a", derived.admissible)]),
        "inputs": (("gu",), [*_matrix("gu", gu, nu)]),
        "output_inputs": (("yu",), [*_matrix("yu", yu, nu)]),
    }
    head = ["import numpy as np"]
    if backend == "numba":
        head += [
            "import numba",
            "jit = numba.njit(nogil=True, cache=True, error_model='numpy')",
            ARCTAN,
        ]
    parts = [
        _function(name, outs, items, derived, backend) for name, (outs, items) in targets.items()
    ]
    return "\n".join(head) + "\n\n\n" + "\n\n\n".join(parts) + "\n"


#: Rational arctangent after Moshier (Cephes), good to 2e-16, without branches and calls, so that
#: loops over points become vector instructions: 20 times faster than the library's. In every
#: kernel's source, so that the hash it is cached under covers it.
ARCTAN = """

@jit
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


Item = tuple[str, sp.Expr]


def _vector(name: str, expressions: Sequence[sp.Expr]) -> list[Item]:
    return [(f"{name}[l, {j}, {{i}}]", e) for j, e in enumerate(expressions)]


def _matrix(name: str, expressions: Sequence[sp.Expr], columns: int) -> list[Item]:
    return [
        (f"{name}[l, {k // columns}, {k % columns}, {{i}}]", e) for k, e in enumerate(expressions)
    ]


#: Results that one compiled loop stores: with more of them the compiler gives up on proving that
#: they do not overlap, and with it on vector instructions; computing a shared arctangent twice
#: costs less.
STORES = 6


def _function(
    name: str, outs: Sequence[str], items: Sequence[Item], derived: Derived, backend: str
) -> str:
    """One kernel: lanes outside, points inside: loops of a few results (Numba) or rows (NumPy)."""
    lines = ["@jit"] if backend == "numba" else []
    lines += [f"def {name}(z, u, p, lanes, {', '.join(outs)}):", "    for l in lanes:"]
    if not items:
        return "\n".join([*lines, "        pass"])
    whole = backend == "numpy" or _calls_library([e for _, e in items])
    size = len(items) if whole else -(-len(items) // -(-len(items) // STORES))
    for first in range(0, len(items), size):
        part = items[first : first + size]
        names, loads_constant, loads_point = _names(derived, [e for _, e in part])
        constants = {symbol(c) for c in derived.constants if symbol(c) in names}
        outside, inside, results = code([e for _, e in part], names, constants)
        body = (
            loads_point
            + inside
            + [f"{target} = {result}" for (target, _), result in zip(part, results, strict=True)]
        )
        lines += ["        " + line for line in loads_constant + outside]
        if backend == "numpy":
            lines += ["        " + line.format(i=":") for line in body]
        else:
            lines.append(f"        for i in range({outs[0]}.shape[-1]):")
            lines += [
                "            " + line.format(i="i").replace("np.arctan(", "arctan(")
                for line in body
            ]
    return "\n".join(lines)


def _calls_library(expressions: Sequence[sp.Expr]) -> bool:
    """Whether calls occur that no vector instruction replaces; once is then better than split."""
    functions = (sp.exp, sp.log, sp.sin, sp.cos, sp.tan, sp.tanh)
    return any(
        e.has(*functions) or any(not power.exp.is_Rational for power in e.atoms(sp.Pow))
        for e in expressions
    )


def _names(
    derived: Derived, expressions: Sequence[sp.Expr]
) -> tuple[dict[sp.Symbol, str], list[str], list[str]]:
    """Code names of the symbols that occur, with the lines that load them."""
    used = set().union(*(e.free_symbols for e in expressions)) if expressions else set()
    names: dict[sp.Symbol, str] = {}
    constant, point = [], []
    for k, item in enumerate(derived.constants):
        if symbol(item) in used:
            names[symbol(item)] = f"p{k}"
            constant.append(f"p{k} = p[l, {k}]")
    for k, item in enumerate(derived.states):
        if item in used:
            names[item] = f"z{k}"
            point.append(f"z{k} = z[l, {k}, {{i}}]")
    for k, (channel, order) in enumerate(derived.inputs):
        if derivative_symbol(channel, order) in used:
            names[derivative_symbol(channel, order)] = f"u{k}"
            point.append(f"u{k} = u[{k}, {{i}}]")
    return names, constant, point


def _load(source: str, backend: str) -> ModuleType:
    """Import generated source; Numba needs it as a file, beside which it keeps compiled code."""
    name = "bayesoleo_kernels_" + hashlib.sha256(source.encode()).hexdigest()[:24]
    if backend == "numpy":
        module = ModuleType(name)
        exec(compile(source, f"<{name}>", "exec"), module.__dict__)
        return module
    path = cache_folder() / f"{name}.py"
    if not path.is_file():
        _write_atomically(path, source)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Numba finds a cached function's globals by its module's name
    spec.loader.exec_module(module)
    return module


def cache_folder() -> Path:
    """Where generated kernels are kept: ``BAYESOLEO_CACHE`` or the user's cache folder."""
    chosen = os.environ.get("BAYESOLEO_CACHE")
    folder = Path(chosen) if chosen else Path(platformdirs.user_cache_dir("bayesoleo"))
    folder = folder / "kernels"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a read-only home must not stop a computation; only the cache is lost
        folder = Path(tempfile.mkdtemp(prefix="bayesoleo-kernels-"))
    return folder


def _write_atomically(path: Path, text: str) -> None:
    """Two processes may generate the same kernel at once; neither may read half a file."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    with os.fdopen(handle, "w", encoding="utf-8") as stream:
        stream.write(text)
    os.replace(temporary, path)
