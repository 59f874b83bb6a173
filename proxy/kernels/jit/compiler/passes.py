"""Passes that compile a kernel which is called only by kernels: those of numba, less what has no effect in it.

`numba_internals.py` uses this module and lists the undocumented parts of numba.
"""

from __future__ import annotations

from types import CodeType
from typing import Any, ClassVar, Final

from numba import types
from numba.core import ir
from numba.core.compiler import DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.errors import NumbaWarning, TypingError, WarningsFixer  # type: ignore[attr-defined]
from numba.core.typed_passes import (
    AnnotateTypes,
    InlineOverloads,
    IRLegalization,
    NativeLowering,
    NopythonRewrites,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.typeinfer import TypeInferer
from numba.core.untyped_passes import (
    DeadBranchPrune,
    InlineClosureLikes,
    InlineInlinables,
    IRProcessing,
    ReconstructSSA,
)

from softfinger.proxy.kernels.jit.compiler.convention import InlinedLowering

IDLE: Final = (InlineInlinables, InlineOverloads, NopythonRewrites, AnnotateTypes, IRLegalization)
"""Passes without effect in a kernel: functions that numba inlines in its own form of code, array expressions, an
annotated listing, which would be cached, too, and the deletion of variables, which have no reference counts."""

IDLE_WITHOUT_BRANCHES: Final = (IRProcessing, DeadBranchPrune, ReconstructSSA, PreLowerStripPhis)
"""Passes without effect in a kernel that `is_straight`."""

SCALARS: Final = (types.Number, types.Boolean)


def is_straight(code: Any) -> bool:
    """Return True if a kernel has no branch, and assigns each variable once."""
    if code is None or len(code.blocks) > 1:
        return False
    (block,) = code.blocks.values()
    names = [each.target.name for each in block.find_insts(ir.Assign)]
    return len(names) == len(set(names))


class UncheckedPasses(PassManager):  # type: ignore[misc]
    """Pass manager that neither times nor checks the passes, and skips those without effect."""

    def _runPass(self, index: int, each: Any, state: Any) -> None:
        if isinstance(each, IDLE_WITHOUT_BRANCHES) and is_straight(state.func_ir):
            return
        each.analysis = self._analysis
        each.run_initialization(state)
        each.run_pass(state)
        each.run_finalizer(state)


class ScalarSignatures:
    """Typing context that resolves a function of scalars once.

    numba tries all implementations at each of hundreds of additions.
    """

    _known: ClassVar[dict[Any, Any]] = {}

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def resolve_function_type(self, function: Any, args: Any, kws: Any) -> Any:
        if kws or not isinstance(function, types.Function) or not all(isinstance(each, SCALARS) for each in args):
            return self._context.resolve_function_type(function, args, kws)
        key = function, args
        if key not in self._known:
            self._known[key] = self._context.resolve_function_type(function, args, kws)
        return self._known[key]


class OneRoundInferer(TypeInferer):  # type: ignore[misc]
    """Type inference that types each statement once, if all values precede their uses.

    numba types all statements in rounds until no type changes, so at least twice. Without loops, and with one
    assignment to each variable, the first round is final.
    """

    def _is_ordered(self) -> bool:
        names = [each.target.name for block in self.blocks.values() for each in block.find_insts(ir.Assign)]
        return len(names) == len(set(names)) and all(
            target > label for label, block in self.blocks.items() for target in block.terminator.get_targets()
        )

    def propagate(self, raise_errors: bool = True) -> Any:
        if self._is_ordered():
            try:
                for constraint in self.constraints.constraints:
                    constraint(self)
            except TypingError:  # reported with its place by the rounds of numba
                pass
            else:
                return None
        return super().propagate(raise_errors)


@register_pass(mutates_CFG=True, analysis_only=False)
class KernelTypeInference(NopythonTypeInference):  # type: ignore[misc]
    """Pass that finds the types of a kernel's variables."""

    _name = "softfinger_type_inference"

    def run_pass(self, state: Any) -> bool:
        warnings, context, code = WarningsFixer(NumbaWarning), state.typingctx, state.func_ir
        inferer = OneRoundInferer(context, code, warnings)
        with context.callstack.register(state.targetctx.target, inferer, code.func_id, state.args), warnings:
            for index, (name, kind) in enumerate(zip(code.arg_names, state.args, strict=True)):
                inferer.seed_argument(name, index, kind)
            inferer.build_constraint()
            inferer.propagate()
            state.typemap, state.return_type, state.calltypes = inferer.unify()
        return True


@register_pass(mutates_CFG=False, analysis_only=False)
class StripPhis(PreLowerStripPhis):  # type: ignore[misc]
    """Pass that replaces phi nodes by assignments, without numba's analysis of the result."""

    _name = "softfinger_strip_phis"

    def run_pass(self, state: Any) -> bool:
        state.func_ir = self._strip_phi_nodes(state.func_ir)
        return True


REPLACED: Final = {
    NativeLowering: InlinedLowering,
    NopythonTypeInference: KernelTypeInference,
    PreLowerStripPhis: StripPhis,
}


def make_passes(state: Any) -> UncheckedPasses:
    """Return the passes for a kernel, from numba's state of its compilation."""
    state.typingctx = ScalarSignatures(state.typingctx)
    has_functions = any(isinstance(each, CodeType) for each in state.func_id.code.co_consts)
    idle = IDLE if has_functions else (*IDLE, InlineClosureLikes)
    passes = UncheckedPasses("softfinger_inlined")
    passes.passes = [
        (REPLACED.get(each, each), text)
        for each, text in DefaultPassBuilder.define_nopython_pipeline(state).passes
        if each not in idle
    ]
    passes.finalize()
    return passes
