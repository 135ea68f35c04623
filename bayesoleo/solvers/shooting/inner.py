"""How what is called from compiled code only is compiled, and how it calls a kernel.

Without wrappers for Python and for C, and with one number in place of a function for each kernel,
the integrator's functions compile in a fraction of the time: each of them takes many arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numba

from bayesoleo._types import Array
from bayesoleo.compiled import call_kernel, pointer

#: Options that Numba has and its annotations lack.
_NO_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def inner[F: Callable[..., Any]](function: F) -> F:
    """Compile a function that only compiled code calls."""
    options = {"nogil": True, "cache": True, "error_model": "numpy", **_NO_WRAPPERS}
    return cast(F, numba.njit(**options)(function))


@inner
def evaluate(kernel: int, z: Array, u: Array, p: Array, out: Array, count: int) -> None:
    """Call the kernel at an address for ``count`` points in rows of ``z``, ``u`` and ``out``."""
    call_kernel(kernel, (pointer(z, 0), pointer(u, 0), pointer(p, 0), pointer(out, 0), count))
