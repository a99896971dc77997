"""Compilation of functions that only kernels call: they are optimised and translated to machine code as parts of kernels.

Numba optimises and translates each function when it is compiled, and again in each function that calls it.  An exception that
such a function raises can only have constant arguments.
"""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering


class _WithoutEnvironment:
    """Code whose environment, which only exceptions with values need, has no address."""

    def set_env(self, name: str, environment: object) -> None:
        """Do nothing."""


class _InlinedLibrary(JITCodeLibrary):
    """Code that is only linked into other code."""

    @property
    def codegen(self) -> Any:
        return _WithoutEnvironment()

    def _optimize_final_module(self) -> None:
        """Leave the optimisation to the kernel."""

    def _finalize_final_module(self) -> None:
        """Leave the translation to the kernel."""
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return that there is no such function."""
        self._ensure_finalized()
        return 0


@register_pass(mutates_CFG=True, analysis_only=False)
class _InlinedLowering(NativeLowering):
    """Lowering into an `_InlinedLibrary`."""

    _name = "inlined_lowering"

    def run_pass(self, state: Any) -> Any:
        state.library = _InlinedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_cpython_wrapper = True
        return super().run_pass(state)


class InlinedCompiler(CompilerBase):
    """The compiler of `helper`."""

    def define_pipelines(self) -> Any:
        """Return the default pipeline with another last step."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [(_InlinedLowering if p is NativeLowering else p, text) for p, text in passes.passes]
        passes._finalized = False
        passes.finalize()
        return [passes]
