"""A faster Numba jit for functions with callers in compiled code only: translated to LLVM, optimised in the callers.

Numba optimises every function by itself, and makes machine code and a wrapper for callers in Python. For a function
that is linked into others this is unused or repeated work: three fifths of the compile time of the planner's search.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numba

from estimator.compilation.numba_internals import (
    CompilerBase,
    CPUDispatcher,
    DefaultPassBuilder,
    JITCodeLibrary,
    NativeLowering,
    register_pass,
)


class InnerDispatcher(CPUDispatcher):
    """A function for callers in compiled functions.

    Args:
        function: the function.
        options: options of Numba.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._options = options
        target_options = {"nopython": True, "no_cpython_wrapper": True, **options}
        super().__init__(function, targetoptions=target_options, pipeline_class=_InnerCompiler)

    def add_overload(self, cres: Any) -> None:
        """Store a compiled overload, without an entry for calls from Python."""
        self.overloads[tuple(cres.signature.args)] = cres

    def _compile_for_args(self, *args: Any, **kwargs: Any) -> Any:
        """The function for calls from Python, in tests and experiments."""
        return self._standalone

    @cached_property
    def _standalone(self) -> Any:
        return numba.njit(**self._options)(self.py_func)


class _InnerCompiler(CompilerBase):
    """Numba's passes, with another lowering."""

    def define_pipelines(self) -> list[Any]:
        """The pipeline for code without Python objects."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [(_InnerLowering if each is NativeLowering else each, name) for each, name in passes.passes]
        passes.finalize()
        return [passes]


@register_pass(mutates_CFG=True, analysis_only=False)
class _InnerLowering(NativeLowering):
    """Lowers a function, and registers it for linking."""

    _name = "inner_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower a function."""
        state.library = _UnoptimisedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        state["cr"] = state["cr"]._replace(cfunc=object())  # callers find it by this
        state.targetctx.insert_user_function(state["cr"].cfunc, state["cr"].fndesc, [state.library])
        return True


class _UnoptimisedLibrary(JITCodeLibrary):
    """Code for linking only, without optimisation and machine code."""

    def _optimize_final_module(self) -> None:
        """Left to the callers' library."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True
