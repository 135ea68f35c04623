"""Compiled functions and their files, and the call of compiled kernels.

A kernel evaluates a block of points that are adjacent in memory: ``kernel(z, u, p, out, count)``
with pointers to rows of :data:`BLOCK` numbers. All kernels share this signature, so their callers -
a Newton iteration, an integrator - are compiled once, not once for every model, and a call costs
nanoseconds. The compiler can prove that rows at known distances do not overlap, and so turns the
loop over points into vector instructions.
"""

from __future__ import annotations

import ctypes
import glob
import hashlib
import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import cached_property, lru_cache, wraps
from math import prod
from pathlib import Path
from typing import Any, Protocol, cast

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import config as numba_config
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import intrinsic

from bayesoleo._compiled_sources import stamp_of
from bayesoleo._linked_code import LinkedCompiler, LinkedTarget, set_environments
from bayesoleo._machine_code import COMPILING, address_of, sealed, unsealed, write_durably
from bayesoleo._one_compilation import in_one_process, is_elsewhere
from bayesoleo._types import Array, Integers

#: Their annotations lack too much for them to be called in checked code.
_CacheFile: Any = IndexDataCacheFile
_FunctionCache: Any = FunctionCache
_config: Any = numba_config


class _CheckedFile(_CacheFile):  # type: ignore[misc]
    """Files in which Numba keeps what it compiled of a function; those that are not whole are not
    there.

    Their names say what the code follows from: an index never stands beside data of other sources,
    and what was compiled of one branch is there when it comes back.
    """

    def __init__(self, cache_path: str, base: str, function: Callable[..., Any], options: str):
        # Not as Numba's files are named, which have no checksums and which others may read.
        self._cache_path, self._base, self._version = cache_path, base, numba.__version__
        self._function, self._options = function, options

    @cached_property
    def _stamp(self) -> str:
        # Not when the function is made: it may call what its module makes later.
        whole = f"{stamp_of(self._function)} {self._options} {self._version}"
        return hashlib.sha256(whole.encode()).hexdigest()[:16]

    @property
    def _index_path(self) -> str:
        return str(self._data_path(f"{self._base}.{self._stamp}.sha256.nbi"))

    def _data_name(self, number: int) -> str:
        return f"{self._base}.{self._stamp}.sha256.{number}.nbc"

    def _load_index(self) -> dict[Any, str]:
        content = unsealed(self._index_path)
        if content is None:
            return {}
        return cast(dict[Any, str], pickle.loads(content))

    def _save_index(self, overloads: dict[Any, str]) -> None:
        path = Path(self._index_path)
        if not path.exists():
            self._drop_oldest()
        write_durably(path, sealed(self._dump(overloads)))

    def _drop_oldest(self) -> None:
        """Keep what was compiled of the last few versions of the sources."""
        folder = Path(self._cache_path)
        with suppress(OSError):  # another process drops them too
            known = list(folder.glob(f"{glob.escape(self._base)}.*.sha256.nbi"))
            known.sort(key=lambda path: path.stat().st_mtime_ns, reverse=True)
            for path in known[VERSIONS - 1 :]:
                path.unlink()
                for data in folder.glob(f"{glob.escape(path.stem)}.*.nbc"):
                    data.unlink()

    def _load_data(self, name: str) -> Any:
        content = unsealed(self._data_path(name))
        if content is None:
            raise FileNotFoundError(name)  # it is compiled again
        return pickle.loads(content)

    def _save_data(self, name: str, data: Any) -> None:
        write_durably(Path(self._data_path(name)), sealed(self._dump(data)))


#: Versions of its sources of which what was compiled of a function is kept.
VERSIONS = 4
#: Told once that something is compiled, and who is or was told.
_listeners: list[Callable[[str], object]] = []
_telling: list[Callable[[str], object]] = []
COMPILED_ONCE = "compile the solvers for this processor: done once, it may take half a minute"


@contextmanager
def compilation_told(callback: Callable[[str], object]) -> Iterator[None]:
    """Tell a callback, once, where functions have to be compiled that a user waits for. Within
    another one that tells, nothing is told again."""
    if _telling:
        yield
        return
    _telling.append(callback)
    _listeners.append(callback)
    try:
        yield
    finally:
        _telling.clear()
        with suppress(ValueError):
            _listeners.remove(callback)


def _tell() -> None:
    if _listeners:
        _listeners.pop()(COMPILED_ONCE)


def is_compiled(function: Any) -> bool:
    """Whether a function of :func:`cached` is on disk, for some arguments."""
    cache = getattr(function, "_cache", None)
    return not isinstance(cache, _CheckedCache) or not cache.is_empty


class _CheckedCache(_FunctionCache):  # type: ignore[misc]
    """Numba's cache of a function, compiled with some options, in files with checksums."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        super().__init__(function)
        self._is_linked = options.get("pipeline_class") is LinkedCompiler
        self._cache_file = _CheckedFile(
            cache_path=self._cache_path,
            base=self._impl.filename_base,
            function=function,
            options=f"{sorted(options.items())}, level {LEVEL}",
        )

    @property
    def is_empty(self) -> bool:
        """Whether nothing was compiled of the function, as it is now, on this machine."""
        return not self._cache_file._load_index()

    def holds(self, signature: Any, target: Any) -> bool:
        """Whether something was compiled before for these arguments."""
        key = self._index_key(signature, target.codegen())
        return key in self._cache_file._load_index()

    def load_overload(self, signature: Any, target: Any) -> Any:
        """What was compiled before; that something has to be compiled now is told once."""
        if not self._is_linked:
            found = super().load_overload(signature, target)
        else:
            found = super().load_overload(signature, LinkedTarget(target))
            found = found and found._replace(target_context=target)
        if found is None:
            _tell()
        return found

    def _save_overload(self, signature: Any, data: Any) -> None:
        with suppress(OSError):  # a full disk must not stop a computation; only the cache is lost
            super()._save_overload(signature, data)


def is_compiled_elsewhere(function: Any) -> bool:
    """Whether another process compiles a function of :func:`cached` now."""
    return is_elsewhere(_name_of(function))


def _name_of(function: Any) -> str:
    return f"{function.__module__}.{function.__name__}"


#: Level of LLVM's optimisation. At the usual one, three, the same functions take longer to compile
#: and are no faster: their loops over points are in kernels, which are compiled apart.
LEVEL = 1
#: Functions that this process is compiling; those within others are not waited for.
_compiling: list[str] = []


def _compiler_of(dispatcher: Any) -> Callable[[Any], Any]:
    """A dispatcher's method that compiles, at :data:`LEVEL`, and in one process at a time."""
    function, compile_one = dispatcher.py_func, dispatcher.compile

    @wraps(compile_one)
    def compiled(signature: Any) -> Any:
        # Numba reads the level while it compiles, which it does under this lock.
        with global_compiler_lock, ExitStack() as stack:
            if not _compiling and not dispatcher._cache.holds(signature, dispatcher.targetctx):
                stack.enter_context(in_one_process(_name_of(function), _tell))
            before = _config.OPT
            _config.OPT = type(before)(min(before, LEVEL))
            _compiling.append(function.__name__)
            try:
                made = compile_one(signature)
                set_environments(dispatcher.overloads.values())
                return made
            finally:
                _compiling.pop()
                _config.OPT = before

    return compiled


def cached[F: Callable[..., Any]](**options: Any) -> Callable[[F], F]:
    """Decorator that compiles a function without the interpreter lock, and keeps the code on disk.

    Parameters
    ----------
    **options
        As ``numba.njit`` takes them.
    """

    def decorate(function: F) -> F:
        made: Any = numba.njit(nogil=True, **options)(function)
        if hasattr(made, "enable_caching"):  # it is plain Python where NUMBA_DISABLE_JIT is set
            made._cache = _CheckedCache(function, options)
            made.compile = _compiler_of(made)
        return cast(F, made)

    return decorate


#: Compiles a function for other compiled code and for Python, without the interpreter lock. C calls
#: none of them.
jit = cached(error_model="numpy", no_cfunc_wrapper=True)
#: The same for a function that only compiled code calls: its instructions become those of callers.
#: A wrapper unpacks every argument that Python may give; where these are arrays it can take longer
#: to compile than what it wraps. Without one, a call by Python ends the process.
inner = cached(
    error_model="numpy",
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
    pipeline_class=LinkedCompiler,
)

#: Points in a block, and the distance between rows.
BLOCK = 64

_POINTER = types.CPointer(types.float64)
#: ``kernel(z (nz, BLOCK), u (nu, BLOCK), p (np,), out (rows, BLOCK), count)``.
SIGNATURE = types.void(_POINTER, _POINTER, _POINTER, _POINTER, types.intp)


class BlockKernel:
    """A generated kernel, compiled when it is first needed.

    Parameters
    ----------
    source : str or callable
        Its instructions, see :func:`~bayesoleo._machine_code.address_of`, or what makes them.
    rows : int
        Rows that it fills.
    """

    def __init__(self, source: str | Callable[[], str], rows: int):
        self._given, self.rows = source, rows

    def __getstate__(self) -> dict[str, Any]:
        """Without the address, which is of this process."""
        return {"_given": self.source, "rows": self.rows}

    @cached_property
    def source(self) -> str:
        """Its instructions."""
        return self._given if isinstance(self._given, str) else self._given()

    @cached_property
    def address(self) -> int:
        """Address of the compiled function, for :func:`caller`."""
        with COMPILING:  # threads that ask for it at once do not all make its source
            return address_of(self.source)

    @property
    def compiled(self) -> BlockKernel:
        """This one; see :attr:`ArrayKernel.compiled`."""
        return self

    def __call__(self, z: Array, u: Array, p: Array, lanes: Integers, *results: Array) -> None:
        """Evaluate lanes of ``z (L, nz, N)``, ``u (nu, N)``, ``p (L, np)`` into one or two arrays
        of shape (L, …, N)."""
        if self.rows:
            first, second = (*results, results[0][:, :0])[:2]
            _fill(self.address, z, u, p, lanes, _flat(first), _flat(second))


class ArrayKernel:
    """A generated kernel of whole-array operations: slower, but ready at once.

    Parameters
    ----------
    function : callable
        ``(z, u, p, out)`` with ``out`` a list of rows.
    rows : int
        Rows that it fills.
    sizes : tuple of int
        Numbers of rows of ``z`` and ``u`` and of constants.
    block : callable
        Makes the same kernel for blocks of points.
    """

    def __init__(
        self,
        function: Callable[..., None],
        rows: int,
        sizes: tuple[int, int, int],
        block: Callable[[], BlockKernel],
    ):
        self.function, self.rows, self.sizes, self._block_kernel = function, rows, sizes, block

    @cached_property
    def compiled(self) -> BlockKernel:
        """The same kernel, compiled: for callers that ask for a few points thousands of times."""
        with COMPILING:
            return self._block_kernel()

    def __call__(self, z: Array, u: Array, p: Array, lanes: Integers, *results: Array) -> None:
        """As :meth:`BlockKernel.__call__`."""
        flat = [_flat(result) for result in results]
        for lane in lanes:
            self.function(z[lane], u, p[lane], [row for result in flat for row in result[lane]])

    @cached_property
    def _callback(self) -> Any:
        """A callback into Python that compiled code takes for a compiled kernel."""
        return _Callback(self._block)

    @property
    def address(self) -> int:
        """Address of that callback."""
        return ctypes.cast(self._callback, ctypes.c_void_p).value or 0

    def _block(self, z: int, u: int, p: int, out: int, count: int) -> None:
        nz, nu, constants = self.sizes
        with np.errstate(all="ignore"):
            self.function(
                _numbers_at(z, nz * BLOCK).reshape(nz, BLOCK)[:, :count],
                _numbers_at(u, nu * BLOCK).reshape(nu, BLOCK)[:, :count],
                _numbers_at(p, constants),
                list(_numbers_at(out, self.rows * BLOCK).reshape(-1, BLOCK)[:, :count]),
            )


Kernel = BlockKernel | ArrayKernel


class ImplicitEquations(Protocol):
    """Kernels of implicit equations ``g(z, u, p) = 0`` (``bayesoleo.model._kernels.Kernels``)."""

    @property
    def residual(self) -> Any: ...
    @property
    def jacobian(self) -> Any: ...
    @property
    def parameters(self) -> Any: ...
    @property
    def admissible(self) -> Any: ...


class PiecewiseEquations(ImplicitEquations, Protocol):
    """Kernels of equations whose outputs are their switching functions."""

    @property
    def output(self) -> Any: ...
    @property
    def output_jacobian(self) -> Any: ...


#: A Python function of the kernels' signature at an address; it takes the interpreter lock.
_Callback = ctypes.CFUNCTYPE(None, *[ctypes.c_size_t] * 4, ctypes.c_ssize_t)


def _numbers_at(address: int, count: int) -> Array:
    if count == 0:
        return np.empty(0)
    return np.frombuffer((ctypes.c_double * count).from_address(address))


def _flat(result: Array) -> Array:
    """All rows of a result in one dimension, as a view."""
    rows = prod(result.shape[1:-1])
    flat = result.reshape(result.shape[0], rows, result.shape[-1])
    contiguous = result.flags.c_contiguous
    if not contiguous and not np.shares_memory(flat, result) and flat.size:
        raise ValueError("results must be contiguous")
    return flat


def _pointer(typing: Any, array: Any, offset: Any) -> tuple[Any, Any]:
    """Pointer to the element of a contiguous array that lies ``offset`` elements behind its first.

    Unlike ``array[k].ctypes`` it counts no references: that costs more than a kernel's call.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        structure = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.gep(structure.data, [arguments[1]])

    return _POINTER(array, types.intp), generate


pointer: Any = intrinsic(_pointer)


def _after(typing: Any, start: Any, offset: Any) -> tuple[Any, Any]:
    """Address ``offset`` numbers behind another.

    An array passed instead has its references counted, which costs more than a short loop.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.gep(values[0], [values[1]])

    return _POINTER(_POINTER, types.intp), generate


after: Any = intrinsic(_after)


def _numbers(typing: Any, address: Any) -> tuple[Any, Any]:
    """Pointer to the numbers at an address.

    An array is seven values, and counts references wherever it is passed: a function of twenty
    arrays takes seconds to compile, one of their addresses a fraction.
    """
    return _POINTER(types.intp), _to_pointer


def _integers(typing: Any, address: Any) -> tuple[Any, Any]:
    """Pointer to the whole numbers at an address."""
    return types.CPointer(types.int64)(types.intp), _to_pointer


def _to_pointer(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.inttoptr(values[0], context.get_value_type(signature.return_type))


numbers: Any = intrinsic(_numbers)
integers: Any = intrinsic(_integers)


def record[T: tuple[int, ...]](values: T) -> T:
    """Named whole numbers as one record, which compiled functions hand on by its address.

    They read it as the tuple that is given; sixty numbers would be sixty arguments.
    """
    names = cast(Any, values)._fields
    return cast(T, _record(names, tuple(values)))


@lru_cache(maxsize=1024)
def _record(names: tuple[str, ...], values: tuple[int, ...]) -> Any:
    return np.array([values], dtype=[(name, np.int64) for name in names])[0]


def caller(signature: Any) -> Any:
    """Make ``call(address, arguments)``, by which compiled code calls a function at an address.

    An address is a number. Passing the function itself costs the interpreter ten microseconds, more
    than many a block takes.
    """

    def call(typing: Any, address: Any, arguments: Any) -> tuple[Any, Any]:
        def generate(context: Any, builder: Any, types_: Any, values: Any) -> Any:
            kinds = [context.get_value_type(kind) for kind in signature.args]
            returned = signature.return_type
            result = ir.VoidType() if returned == types.void else context.get_value_type(returned)
            function = ir.FunctionType(result, kinds).as_pointer()
            parts = [builder.extract_value(values[1], k) for k in range(len(kinds))]
            outcome = builder.call(builder.inttoptr(values[0], function), parts)
            return context.get_dummy_value() if returned == types.void else outcome

        given = types.Tuple(signature.args)
        return signature.return_type(types.intp, given), generate

    return intrinsic(call)


call_kernel: Any = caller(SIGNATURE)


@jit
def _fill(
    kernel: int, z: Array, u: Array, p: Array, lanes: Integers, first: Array, second: Array
) -> None:
    nz, nu, points = z.shape[1], u.shape[0], first.shape[2]
    rows, more = first.shape[1], second.shape[1]
    # At least one row: a pointer must point to something.
    z_block, u_block = np.zeros((max(nz, 1), BLOCK)), np.zeros((max(nu, 1), BLOCK))
    p_lane, out = np.zeros(max(p.shape[1], 1)), np.empty((rows + more, BLOCK))
    for begin in range(0, points, BLOCK):
        count = min(BLOCK, points - begin)
        for k in range(nu):
            for i in range(count):
                u_block[k, i] = u[k, begin + i]
        for lane in lanes:
            for k in range(p.shape[1]):
                p_lane[k] = p[lane, k]
            for k in range(nz):
                for i in range(count):
                    z_block[k, i] = z[lane, k, begin + i]
            to = pointer(z_block, 0), pointer(u_block, 0), pointer(p_lane, 0), pointer(out, 0)
            call_kernel(kernel, (*to, count))
            for k in range(rows):
                for i in range(count):
                    first[lane, k, begin + i] = out[k, i]
            for k in range(more):
                for i in range(count):
                    second[lane, k, begin + i] = out[rows + k, i]
