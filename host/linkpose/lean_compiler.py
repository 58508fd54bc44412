"""A short way through numba for small functions over numbers, tuples, records and arrays.

Numba's own pipeline serves any Python function. It runs 28 passes over each function, prepares machine code for each,
and optimises each callee again in every caller. Cold, that took two thirds of the time until the first estimate
appeared. These two pipelines keep the passes that such functions need. `Inner` functions stay unoptimised LLVM code;
`Outer` links all that it calls and optimises it once.

Not supported here: closures, comprehensions, generators, `with`, exceptions with computed messages. Array expressions
work, but are not fused.

Source: numba's developer manual, "Customizing the compiler" (pipelines), and numba.core.codegen (libraries).
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

from numba.core import typed_passes, untyped_passes
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager

_PASSES = (
    untyped_passes.TranslateByteCode,
    untyped_passes.FixupArgs,
    untyped_passes.IRProcessing,
    untyped_passes.DeadBranchPrune,  # of arguments that are None
    untyped_passes.GenericRewrites,  # constant indices of tuples
    untyped_passes.ReconstructSSA,
    typed_passes.NopythonTypeInference,
    typed_passes.PreLowerStripPhis,
    typed_passes.IRLegalization,
    typed_passes.AnnotateTypes,
    typed_passes.NativeLowering,
    typed_passes.NoPythonBackend,
)
# LLVM's level. Level 3 unrolls the loops over 34 states: twice the time to compile, and no faster.
_OPTIMISATION = 2


class _Library(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code that is optimised once, as a whole, when the outermost function is complete."""

    def _optimize_functions(self, module: Any) -> None:
        """Nothing to do for one function alone."""
        module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        manager, builder = self._codegen._module_pass_manager(opt=_OPTIMISATION)
        manager.run(self._final_module, builder)


class _PartLibrary(_Library):
    """LLVM code that only serves to be linked into its callers."""

    def finalize(self) -> None:
        """Link what this function calls."""
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """No machine code: null, as for each function without a wrapper for Python."""
        return 0

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, env_name: str, env: Any) -> None:
        """Nothing to do: an environment serves Python objects and computed exceptions."""


class Outer(CompilerBase):  # type: ignore[misc]
    """Pipeline of functions that Python calls."""

    library: type[JITCodeLibrary] = _Library

    def compile_extra(self, func: Callable[..., Any]) -> Any:
        """Compile without searches for cyclic garbage, which took 9 % of the time: what numba makes is kept."""
        searches = gc.isenabled()
        gc.disable()
        try:
            return super().compile_extra(func)
        finally:
            if searches:
                gc.enable()

    def define_pipelines(self) -> list[PassManager]:
        """The passes, with a library of this class."""
        state = self.state
        state.library = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        passes = PassManager("lean")
        for each in _PASSES:
            passes.add_pass(each, each._name)
        passes.finalize()
        return [passes]


class Inner(Outer):
    """Pipeline of functions that only compiled code calls."""

    library = _PartLibrary
