"""Kernels as machine code: instructions to an address, and their place on disk.

A generated kernel is straight-line arithmetic in one loop over points. Numba takes half a second
for each, nearly all of it to find the types of what are all floating-point numbers. Here LLVM, the
compiler behind Numba, is given its instructions as they are, which takes a tenth of that.

The source is LLVM's text. It may call the functions of :data:`LIBRARY`; those of the C library have
the prefix ``c_``. Machine code is kept on disk under the hash of the source and of the processor.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import struct
import sys
import tempfile
import threading
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
from llvmlite import binding as llvm
from numba import config

from bayesoleo._cache_folder import user_cache

#: What a source calls the one function that it defines.
ENTRY = "@kernel("
#: Held while a function is compiled or loaded: threads that solve different runs ask for the same.
COMPILING = threading.RLock()

#: Functions of one number in the C library, and ``pow``.
C_FUNCTIONS = ("exp", "log", "sin", "cos", "tan", "tanh")

#: Coefficients of a rational arctangent after Moshier (Cephes), good to 2e-16, without branches and
#: calls, so that loops over points become vector instructions: 20 times faster than the library's.
_TOP = (
    -8.750608600031904e-1, -1.615753718733365e1, -7.500855792314705e1, -1.2288666844901361e2,
    -6.485021904942025e1,
)  # fmt: skip
_BOTTOM = (
    1.0, 2.485846490142306e1, 1.650270098316988e2, 4.328810604912903e2, 4.853903996359137e2,
    1.945506571482614e2,
)  # fmt: skip


def number(value: float) -> str:
    """A number in LLVM's text, to its last bit."""
    return "0x" + struct.pack(">d", value).hex().upper()


def _polynomial(name: str, coefficients: tuple[float, ...]) -> str:
    """Instructions of Horner's rule in ``%s``; the result is called ``%name``."""
    last = len(coefficients) - 1
    lines = [f"%{name}0 = fadd double 0.0, {number(coefficients[0])}"]
    for k, coefficient in enumerate(coefficients[1:], 1):
        result = name if k == last else f"{name}{k}"
        lines += [
            f"%{name}_{k} = fmul double %{name}{k - 1}, %s",
            f"%{result} = fadd double %{name}_{k}, {number(coefficient)}",
        ]
    return "\n  ".join(lines)


def _extremum(name: str, comparison: str) -> str:
    """The larger or smaller of two numbers; what is no number stays none."""
    return f"""
define internal double @{name}(double %a, double %b) #1 {{
  %beyond = fcmp {comparison} double %a, %b
  %none = fcmp uno double %a, %a
  %first = or i1 %beyond, %none
  %result = select i1 %first, double %a, double %b
  ret double %result
}}"""


#: What every source begins with.
LIBRARY = (
    "\n".join(f"declare double @c_{name}(double) #0" for name in C_FUNCTIONS)
    + f"""
declare double @c_pow(double, double) #0
declare double @llvm.sqrt.f64(double)
declare double @llvm.fabs.f64(double)
attributes #0 = {{ nounwind willreturn memory(none) }}
attributes #1 = {{ alwaysinline nounwind }}
{_extremum("maximum", "ogt")}
{_extremum("minimum", "olt")}

define internal double @sign(double %x) #1 {{
  %below = fcmp olt double %x, 0.0
  %above = fcmp ogt double %x, 0.0
  %first = select i1 %below, double -1.0, double %x
  %result = select i1 %above, double 1.0, double %first
  ret double %result
}}

define internal double @arctan(double %x) #1 {{
  %size = call double @llvm.fabs.f64(double %x)
  %far = fcmp ogt double %size, {number(2.414213562373095)}
  %middle = fcmp ogt double %size, {number(0.66)}
  %less = fsub double %size, 1.0
  %more = fadd double %size, 1.0
  %above0 = select i1 %middle, double %less, double %size
  %above = select i1 %far, double -1.0, double %above0
  %below0 = select i1 %middle, double %more, double 1.0
  %below = select i1 %far, double %size, double %below0
  %base0 = select i1 %middle, double {number(0.7853981633974483)}, double 0.0
  %base = select i1 %far, double {number(1.5707963267948966)}, double %base0
  %rest0 = select i1 %middle, double {number(3.061616997868383e-17)}, double 0.0
  %rest = select i1 %far, double {number(6.123233995736766e-17)}, double %rest0
  %t = fdiv double %above, %below
  %s = fmul double %t, %t
  {_polynomial("top", _TOP)}
  {_polynomial("bottom", _BOTTOM)}
  %numerator = fmul double %s, %top
  %ratio = fdiv double %numerator, %bottom
  %small = fmul double %t, %ratio
  %corrected = fadd double %small, %rest
  %turned = fadd double %t, %corrected
  %value = fadd double %base, %turned
  %opposite = fneg double %value
  %negative = fcmp olt double %x, 0.0
  %result = select i1 %negative, double %opposite, double %value
  ret double %result
}}
"""
)

#: Of what is loaded, by name.
_ADDRESSES: dict[str, int] = {}
#: To be raised with every change of how a source is compiled.
_WAY = 1
#: Numba's settings, which are made at run time.
_SETTINGS: Any = config


def _target() -> tuple[str, str, str]:
    """Triple, processor and its features; Numba's settings of them hold here too."""
    features = _SETTINGS.CPU_FEATURES
    if features is None:
        features = llvm.get_host_cpu_features().flatten()
    return llvm.get_process_triple(), _SETTINGS.CPU_NAME or llvm.get_host_cpu_name(), features


def has_wide_registers() -> bool:
    """Whether eight numbers fill one register (AVX-512), of which there are 32."""
    return "+avx512f" in _target()[2].split(",")


def _target_machine() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    triple, name, features = _target()
    target = llvm.Target.from_triple(triple)
    return target.create_target_machine(cpu=name, features=features, opt=3, jit=True)


@cache
def _engine() -> Any:
    """Where all machine code is loaded: it stays there for as long as the process lives."""
    # A Python that is linked statically has no such symbols that LLVM would find by itself.
    library = ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None)
    for name in (*C_FUNCTIONS, "pow"):
        address = ctypes.cast(getattr(library, name), ctypes.c_void_p).value
        llvm.add_symbol(f"c_{name}", address)
    # An engine owns its target machine, which can serve nobody else.
    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target_machine())


@cache
def _compiler() -> Any:
    """The processor that code is made for."""
    return _target_machine()


@cache
def _processor() -> str:
    """What machine code depends on besides its source."""
    versions = f"{_WAY} {llvmlite.__version__} {llvm.llvm_version_info}"
    return f"{versions} {' '.join(_target())}"


def address_of(source: str) -> int:
    """Address of the function that a source defines, compiled where it is not known yet.

    Parameters
    ----------
    source : str
        LLVM's text after :data:`LIBRARY`, with one function called :data:`ENTRY`.
    """
    content = f"{_processor()}\n{LIBRARY}\n{source}"
    name = f"kernel_{hashlib.sha256(content.encode()).hexdigest()[:32]}"
    with COMPILING:
        if name not in _ADDRESSES:
            path = cache_folder() / f"{name}.o"
            code = unsealed(path)
            if code is None:
                code = _compiled(source.replace(ENTRY, f"@{name}("))
                with suppress(OSError):  # a full disk costs only the cache
                    write_durably(path, sealed(code))
            _engine().add_object_file(llvm.ObjectFileRef.from_data(code))
            _engine().finalize_object()
            _ADDRESSES[name] = int(_engine().get_function_address(name))
        return _ADDRESSES[name]


def _compiled(source: str) -> bytes:
    """Machine code of a source."""
    module = llvm.parse_assembly(LIBRARY + source)
    module.triple = _target()[0]
    module.data_layout = str(_compiler().target_data)
    module.verify()
    tuning = llvm.create_pipeline_tuning_options(speed_level=3)
    tuning.loop_vectorization = tuning.slp_vectorization = True
    builder = llvm.create_pass_builder(_compiler(), tuning)
    builder.getModulePassManager().run(module, builder)
    return bytes(_compiler().emit_object(module))


# -- files of the cache -------------------------------------------------------------------


def cache_folder() -> Path:
    """Where generated kernels are kept: ``BAYESOLEO_CACHE`` or the user's cache folder."""
    folder = user_cache() / "kernels"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a read-only home must not stop a computation; only the cache is lost
        return _another_folder()
    return folder


@cache
def _another_folder() -> Path:
    """Where kernels are kept by a process that may not write to the cache."""
    return Path(tempfile.mkdtemp(prefix="bayesoleo-kernels-"))


def sealed(content: bytes) -> bytes:
    """Content of a file with its checksum before it; see :func:`unsealed`."""
    return hashlib.sha256(content).digest() + content


def unsealed(path: str | os.PathLike[str]) -> bytes | None:
    """Content of a file that was written by :func:`sealed`; None if it is not whole, or not there.

    Code and pickles are read from the cache: a byte that is wrong there crashes or gives wrong
    numbers.
    """
    try:
        whole = Path(path).read_bytes()
    except OSError:
        return None
    content = whole[_DIGEST:]
    return content if sealed(content) == whole else None


_DIGEST = hashlib.sha256().digest_size


def write_durably(path: Path, content: bytes) -> None:
    """Write a file of the cache as a whole: two processes may make the same at once."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise
