"""What only compiled functions call: Numba only translates it, and what calls it is optimised as a whole.

For each function that it compiles Numba optimises what there is so far, makes machine code, and a wrapper for callers
in Python. Of a function that is linked into others all that is done for nothing, or again: three fifths of the time
that the planner's search takes to compile.
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
    """A function as other compiled functions call it.

    Args:
        function: to compile.
        options: of Numba.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._options = options
        target_options = {"nopython": True, "no_cpython_wrapper": True, **options}
        super().__init__(function, targetoptions=target_options, pipeline_class=_InnerCompiler)

    def add_overload(self, cres: Any) -> None:
        """Keep what is compiled for some types of arguments, where Python does not look for it."""
        self.overloads[tuple(cres.signature.args)] = cres

    def _compile_for_args(self, *args: Any, **kwargs: Any) -> Any:
        """What a call from Python goes to: for what is tried out or tested."""
        return self._standalone

    @cached_property
    def _standalone(self) -> Any:
        return numba.njit(**self._options)(self.py_func)


class _InnerCompiler(CompilerBase):
    """Numba's passes, but for how it makes code."""

    def define_pipelines(self) -> list[Any]:
        """The one for code without Python's objects."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [(_InnerLowering if each is NativeLowering else each, name) for each, name in passes.passes]
        passes.finalize()
        return [passes]


@register_pass(mutates_CFG=True, analysis_only=False)
class _InnerLowering(NativeLowering):
    """Makes code, and lets Numba know what calls are linked to."""

    _name = "inner_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower a function."""
        state.library = _UnoptimisedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        state["cr"] = state["cr"]._replace(cfunc=object())  # by which calls find it
        state.targetctx.insert_user_function(state["cr"].cfunc, state["cr"].fndesc, [state.library])
        return True


class _UnoptimisedLibrary(JITCodeLibrary):
    """Code to link, which goes to no optimiser and to no compiler of machine code."""

    def _optimize_final_module(self) -> None:
        """Left to what it is linked into."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True
