"""Compiled functions of which no machine code is made: their instructions become those of callers.

Numba optimises every function and makes machine code of it, and once more of all that calls it, in
which it is contained: a chain of calls costs a multiple. Where only compiled code calls a function,
its own machine code never runs. Such functions must not call each other in a circle.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from llvmlite import binding as llvm
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

#: Their annotations lack too much for them to be called in checked code.
_Library: Any = JITCodeLibrary
_Lowering: Any = NativeLowering
_Compiler: Any = CompilerBase


class _LinkedCodegen:
    """Numba's generator of code, for functions without machine code."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, name: str, env: Any) -> None:
        """Nothing: callers have the place for it (:func:`set_environments`)."""

    def unserialize_library(self, serialized: tuple[str, str, bytes]) -> LinkedCode:
        """Instructions that were kept on disk."""
        name, _, content = serialized
        library = LinkedCode(self._codegen, name)
        library._final_module = llvm.parse_bitcode(content)
        library._finalize_final_module()
        return library


class LinkedTarget:
    """Numba's target, for reading functions without machine code from disk."""

    def __init__(self, target: Any) -> None:
        self._target = target

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)

    def codegen(self) -> _LinkedCodegen:
        """Its generator of code."""
        return _LinkedCodegen(self._target.codegen())


class LinkedCode(_Library):  # type: ignore[misc]
    """Instructions of one function, to be linked into those of others."""

    @property
    def codegen(self) -> Any:
        """What generates code for this library."""
        return _LinkedCodegen(self._codegen)

    def _optimize_final_module(self) -> None:
        """Callers optimise what they contain."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Zero: there is none."""
        self._ensure_finalized()
        return 0

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """What is kept on disk: the instructions."""
        found: tuple[str, str, bytes] = self.serialize_using_bitcode()
        return found


def set_environments(compiled: Iterable[Any]) -> None:
    """Say to machine code what the functions within it need of Python, such as the text of an error
    with a value in it. Numba does so where code comes from disk.

    Parameters
    ----------
    compiled : iterable of CompileResult
    """
    for one in compiled:
        if not isinstance(one.library, LinkedCode):
            for environment in one._find_referenced_environments():
                one.library.codegen.set_env(environment.env_name, environment)


@register_pass(mutates_CFG=True, analysis_only=False)
class LinkedLowering(_Lowering):  # type: ignore[misc]
    """Lower a function to instructions that others take over."""

    _name = "linked_lowering"

    def run_pass(self, state: Any) -> Any:
        """Lower into a library of that kind."""
        if state.library is None:
            state.library = LinkedCode(state.targetctx.codegen(), state.func_id.func_qualname)
            state.library.enable_object_caching()
        return super().run_pass(state)


class LinkedCompiler(_Compiler):  # type: ignore[misc]
    """Numba's compiler, with the last step of :class:`LinkedLowering`."""

    def define_pipelines(self) -> list[Any]:
        """One, without Python's objects."""
        made = DefaultPassBuilder.define_nopython_pipeline(self.state)
        made.passes = [
            (LinkedLowering if one is _Lowering else one, text) for one, text in made.passes
        ]
        made._finalized = False
        made.finalize()
        return [made]
