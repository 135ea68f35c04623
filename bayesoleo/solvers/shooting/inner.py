"""How what is called from compiled code only is compiled, and how it calls a kernel.

Without wrappers for Python and for C, and with one number in place of a function for each kernel,
the integrator's functions compile in a fraction of the time: each of them takes many arrays.
"""

from __future__ import annotations

from typing import Any

import numba

from bayesoleo.compiled import call_kernel, pointer

#: Options that Numba has and its annotations lack.
_NO_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
inner = numba.njit(nogil=True, cache=True, error_model="numpy", **_NO_WRAPPERS)


@inner
def evaluate(kernel, z, u, p, out, count):
    """Call the kernel at an address for ``count`` points in rows of ``z``, ``u`` and ``out``."""
    call_kernel(kernel, (pointer(z, 0), pointer(u, 0), pointer(p, 0), pointer(out, 0), count))
