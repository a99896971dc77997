"""Compilation of functions that only kernels call: they are optimised and translated to machine code as parts of kernels.

Numba optimises and translates each function when it is compiled, and again in each function that calls it.  An exception that
such a function raises can only have constant arguments.
"""

from __future__ import annotations

from typing import Any

from numba.core import ir, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.ir_utils import build_definitions
from numba.core.typed_passes import NativeLowering
from numba.core.untyped_passes import IRProcessing


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


@register_pass(mutates_CFG=True, analysis_only=False)
class _LiteralArguments(FunctionPass):
    """Literal booleans as constants, so that the branches that they exclude are not compiled, nor what only these call."""

    _name = "literal_arguments"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> Any:
        found = False
        for block in state.func_ir.blocks.values():
            for assigned in block.find_insts(ir.Assign):
                given = state.args[assigned.value.index] if isinstance(assigned.value, ir.Arg) else None
                if isinstance(given, types.BooleanLiteral):
                    assigned.value, found = ir.Const(given.literal_value, assigned.loc), True
        if found:
            state.func_ir._definitions = build_definitions(state.func_ir.blocks)
        return found


class InlinedCompiler(CompilerBase):
    """The compiler of `helper`."""

    def define_pipelines(self) -> Any:
        """Return the default pipeline with literal booleans as constants, and with another last step."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_LiteralArguments, IRProcessing)
        passes.passes = [(_InlinedLowering if p is NativeLowering else p, text) for p, text in passes.passes]
        passes._finalized = False
        passes.finalize()
        return [passes]
