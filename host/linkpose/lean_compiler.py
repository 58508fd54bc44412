"""A short way through numba for small functions over numbers, tuples, records and arrays.

Numba's own pipeline serves any Python function. It runs 28 passes over each function, prepares machine code for each,
and optimises each callee again in every caller. Cold, that took two thirds of the time until the first estimate
appeared. These two pipelines keep the passes that such functions need. `Inner` functions stay unoptimised LLVM code;
`Outer` links all that it calls and optimises it once. Numba's answers to questions that recur are remembered.
`lean_lowering` writes the LLVM code.

Not supported here: closures, comprehensions, generators, `with`, `try`, exceptions with computed messages. Array
expressions work, but are not fused.

Source: numba's developer manual, "Customizing the compiler" (pipelines), and numba.core.codegen (libraries).
"""

from __future__ import annotations

import contextlib
import functools
import gc
import sys
from collections.abc import Callable, Iterator
from typing import Any

from llvmlite.binding import Linkage, executionengine
from numba.core import base, interpreter, typed_passes, types, untyped_passes
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.ir_utils import build_definitions
from numba.core.rewrites.static_binop import DetectStaticBinops
from numba.core.rewrites.static_getitem import RewriteConstGetitems, RewriteConstSetitems
from numba.core.rewrites.static_raise import RewriteConstRaises
from numba.core.ssa import reconstruct_ssa

from linkpose.lean_lowering import Lower


class _Interpreter(interpreter.Interpreter):  # type: ignore[misc]
    """Byte code as numba's statements, without the searches for what is not supported here, such as `with`."""

    def post_process(self, peepholes: list[Any], func_ir: Any) -> Any:
        return func_ir


@register_pass(mutates_CFG=True, analysis_only=False)
class _Translate(untyped_passes.TranslateByteCode):  # type: ignore[misc]
    """Translates byte code to numba's statements."""

    _name = "lean_translate_bytecode"

    def run_pass(self, state: Any) -> bool:
        state.func_ir = _Interpreter(state.func_id).interpret(state.bc)
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class _MarkConstants(untyped_passes.GenericRewrites):  # type: ignore[misc]
    """Marks constant indices, powers and exceptions. Lifetimes, which numba's pass finds too, serve generators."""

    _name = "lean_mark_constants"

    def run_pass(self, state: Any) -> bool:
        blocks = state.func_ir.blocks
        for kind in (RewriteConstGetitems, RewriteConstSetitems, RewriteConstRaises, DetectStaticBinops):
            rewrite = kind(state)
            for key in blocks:
                while rewrite.match(state.func_ir, blocks[key], None, None):
                    blocks[key] = rewrite.apply()
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class _Prune(untyped_passes.DeadBranchPrune):  # type: ignore[misc]
    """Drops the branches that an argument which is None excludes."""

    _name = "lean_dead_branch_prune"

    def run_pass(self, state: Any) -> bool:
        return types.none in state.args and super().run_pass(state)


@register_pass(mutates_CFG=False, analysis_only=False)
class _AssignOnce(untyped_passes.ReconstructSSA):  # type: ignore[misc]
    """Gives each assignment a variable of its own. Numba's pass finds lifetimes again."""

    _name = "lean_reconstruct_ssa"

    def run_pass(self, state: Any) -> bool:
        state.func_ir = reconstruct_ssa(state.func_ir)
        self._patch_locals(state)
        state.func_ir._definitions = build_definitions(state.func_ir.blocks)
        return True


@register_pass(mutates_CFG=False, analysis_only=False)
class _StripPhis(typed_passes.PreLowerStripPhis):  # type: ignore[misc]
    """Replaces phi nodes by assignments."""

    _name = "lean_strip_phis"

    def run_pass(self, state: Any) -> bool:
        state.func_ir = self._strip_phi_nodes(state.func_ir)
        state.func_ir._definitions = build_definitions(state.func_ir.blocks)
        return True


@register_pass(mutates_CFG=False, analysis_only=False)
class _Release(typed_passes.IRLegalization):  # type: ignore[misc]
    """Marks where a variable ends, which only reference counts need."""

    _name = "lean_release"

    def run_pass(self, state: Any) -> bool:
        return bool(state.flags.nrt) and super().run_pass(state)


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(typed_passes.NativeLowering):  # type: ignore[misc]
    """The step to LLVM code."""

    _name = "lean_native_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        return Lower


_PASSES = (
    _Translate,
    untyped_passes.FixupArgs,
    _Prune,
    _MarkConstants,
    _AssignOnce,
    typed_passes.NopythonTypeInference,
    _StripPhis,
    _Release,
    _Lowering,
    typed_passes.NoPythonBackend,
)
# LLVM's level. Level 3 unrolls the loops over 34 states: twice the time to compile, and no faster.
_OPTIMISATION = {"opt": 2}
# For functions that decide more than they compute, whose loops are short: 30 % less time to compile, and no slower.
_LIGHT_OPTIMISATION = {"opt": 1, "loop_vectorize": False}
_SCALARS = (types.Float, types.Integer, types.Boolean)

_functions: Any = types.Function  # the class of numba's built-in functions, such as operators
_resolve = _functions.get_call_type
_known_calls: dict[tuple[Any, ...], Any] = {}  # (function, types of its arguments) -> signature


def _remembered_call_type(function: Any, context: Any, args: tuple[Any, ...], kws: Any) -> Any:
    """The signature of a built-in function, such as an operator, for these types of numbers.

    Numba tries a dozen templates for each operation, although the types of numbers decide.
    """
    if kws or not all(isinstance(each, _SCALARS) for each in args):
        return _resolve(function, context, args, kws)
    key = function, args
    found = _known_calls.get(key)
    if found is None:
        found = _known_calls[key] = _resolve(function, context, args, kws)
    return found


_records: Any = types.Record
_describe = _records.__repr__
_descriptions: dict[int, tuple[Any, str]] = {}  # by id: the record's type, which is kept, and its text


def _remembered_description(kind: Any) -> str:
    """The text of a record's type, with all its fields, which numba writes into messages of each pass."""
    if id(kind) not in _descriptions:
        _descriptions[id(kind)] = kind, _describe(kind)
    return _descriptions[id(kind)][1]


_has_loc = functools.cache(base._has_loc)  # whether a function of numba has a parameter: inspecting it takes 0.1 ms


@contextlib.contextmanager
def _remembering() -> Iterator[None]:
    """Within this context, numba remembers what depends on nothing that changes. Numba's lock admits one thread."""
    # A callee is compiled within its caller's context, which goes on afterwards.
    before = _functions.get_call_type, base._has_loc, _records.__repr__
    _functions.get_call_type, base._has_loc = _remembered_call_type, _has_loc
    _records.__repr__ = _remembered_description
    try:
        yield
    finally:
        _functions.get_call_type, base._has_loc, _records.__repr__ = before


_make_usable = JITCodeLibrary._finalize_specific


def _make_usable_or_raise(library: Any) -> None:
    """Numba's last step to machine code. Raises what the handler of a signal raised meanwhile, such as Ctrl-C's.

    LLVM hands the machine code to a function in Python, or asks it for the stored one. A signal that came before is
    handled there, and ctypes drops the exception: Ctrl-C was lost, and what was missing then made numba fail ("no
    compiled object yet") or the process crash.
    """
    lost: list[BaseException] = []

    def keep(unraisable: Any) -> None:
        trace, error = unraisable.exc_traceback, unraisable.exc_value
        if trace is not None and error is not None and trace.tb_frame.f_globals is vars(executionengine):
            lost.append(error)
        else:
            before(unraisable)

    before, sys.unraisablehook = sys.unraisablehook, keep
    try:
        _make_usable(library)
    finally:
        sys.unraisablehook = before
    if lost:
        raise lost[0]


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Within this context, Ctrl-C while numba loads or compiles raises KeyboardInterrupt."""
    before, JITCodeLibrary._finalize_specific = JITCodeLibrary._finalize_specific, _make_usable_or_raise
    try:
        yield
    finally:
        JITCodeLibrary._finalize_specific = before


class _Library(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code that is optimised once, as a whole, when the outermost function is complete."""

    _linking_libraries: list[Any]
    _optimisation: dict[str, int] = _OPTIMISATION

    def _optimize_functions(self, module: Any) -> None:
        """Nothing to do for one function alone."""
        module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        """Optimise the module as a whole, with all that it contains of other functions private to it.

        LLVM then moves a function with one caller into that caller, whose state stays in registers: the filters take
        10 to 35 % less time. A private function has no symbol in the machine code. One with a symbol, as linkage
        "internal" leaves it, can take the place of another module's function of the same name and crash the process.
        """
        for function in self._final_module.functions:
            if function.linkage == Linkage.linkonce_odr:
                function.linkage = Linkage.private
        manager, builder = self._codegen._module_pass_manager(**self._optimisation)
        manager.run(self._final_module, builder)

    def finalize(self) -> None:
        """Link all that is called, directly or not, and optimise it."""
        called: dict[Any, None] = dict.fromkeys(self._linking_libraries)
        for library in (waiting := list(called)):
            if isinstance(library, _PartLibrary):
                new = [each for each in dict.fromkeys(library._linking_libraries) if each not in called]
                called |= dict.fromkeys(new)
                waiting += new
        self._linking_libraries = list(called)
        super().finalize()


class _LightLibrary(_Library):
    """LLVM code that is optimised lightly."""

    _optimisation = _LIGHT_OPTIMISATION


class _PartLibrary(_Library):
    """LLVM code that only serves to be linked into its outermost caller."""

    def finalize(self) -> None:
        """Nothing to link yet."""
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
            with _remembering(), interruptible():
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


class OuterOfRules(Outer):
    """Pipeline of functions that Python calls and that decide more than they compute."""

    library = _LightLibrary


class Inner(Outer):
    """Pipeline of functions that only compiled code calls."""

    library = _PartLibrary
