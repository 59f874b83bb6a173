"""Passes that compile a kernel which is called only by kernels: those of numba that have an effect in it.

`numba_internals.py` uses this module and lists the undocumented parts of numba.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator
from types import CodeType
from typing import Any, ClassVar, Final

from numba import types
from numba.core import ir, postproc
from numba.core.compiler import DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, PassManager, register_pass
from numba.core.errors import NumbaWarning, TypingError, WarningsFixer  # type: ignore[attr-defined]
from numba.core.interpreter import Interpreter, peep_hole_delete_with_exit, peep_hole_fuse_dict_add_updates
from numba.core.ir_utils import build_definitions, compute_cfg_from_blocks, simplify_CFG
from numba.core.postproc import PostProcessor
from numba.core.transforms import canonicalize_cfg
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
    FindLiterallyCalls,
    FixupArgs,
    GenericRewrites,
    InlineClosureLikes,
    InlineInlinables,
    IRProcessing,
    LiteralPropagationSubPipelinePass,
    LiteralUnroll,
    ReconstructSSA,
    RewriteSemanticConstants,
    TranslateByteCode,
    WithLifting,
)

from softfinger.proxy.kernels.jit.compiler.convention import InlinedLowering

UNUSED_PASSES: Final = (
    WithLifting,
    FindLiterallyCalls,
    LiteralUnroll,
    LiteralPropagationSubPipelinePass,
    InlineInlinables,
    InlineOverloads,
    NopythonRewrites,
    AnnotateTypes,
    IRLegalization,
)
"""Passes without effect in a kernel: `with`, literals, functions that numba inlines in its own form of code, array
expressions, an annotated listing, which would be cached, too, and the deletion of variables, which have no reference
counts."""

UNUSED_STRAIGHT_PASSES: Final = (IRProcessing, DeadBranchPrune, ReconstructSSA, PreLowerStripPhis)
"""Passes without effect in a kernel that `is_straight`."""

POSTPROCESSED_PASSES: Final = (IRProcessing, GenericRewrites, ReconstructSSA, PreLowerStripPhis)
"""Passes that end with numba's PostProcessor, and compile no other function."""

SCALARS: Final = (types.Number, types.Boolean)


def is_straight(code: Any) -> bool:
    """Return True if a kernel has no branch, and assigns each variable once."""
    if code is None or len(code.blocks) > 1:
        return False
    (block,) = code.blocks.values()
    names = [each.target.name for each in block.find_insts(ir.Assign)]
    return len(names) == len(set(names))


class BriefPostProcessor(PostProcessor):  # type: ignore[misc]
    """Post-processor without the lifetimes of variables: a kernel is no generator, and deletes no variables."""

    def run(self, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        self.func_ir.blocks = canonicalize_cfg(self.func_ir.blocks)
        self.func_ir.generator_info = None


class UncheckedPasses(PassManager):  # type: ignore[misc]
    """Pass manager that neither times nor checks the passes, and skips passes without effect."""

    def _runPass(self, index: int, each: Any, state: Any) -> None:
        if isinstance(each, UNUSED_STRAIGHT_PASSES) and is_straight(state.func_ir):
            return
        each.analysis = self._analysis
        each.run_initialization(state)
        brief = isinstance(each, POSTPROCESSED_PASSES)
        postproc.PostProcessor = BriefPostProcessor if brief else PostProcessor  # under numba's global lock
        try:
            each.run_pass(state)
        finally:
            postproc.PostProcessor = PostProcessor
        each.run_finalizer(state)


def class_of(kind: Any) -> type | None:
    """Return the class of the values of a numba type, None for None."""
    # A named tuple with fields of one type is a NamedUniTuple, not a NamedTuple: compare its class.
    return None if isinstance(kind, types.NoneType) else getattr(kind, "instance_class", None) or type(kind)


class KernelInterpreter(Interpreter):  # type: ignore[misc]
    """Translator of bytecode without the corrections of `with` and dict displays, which no kernel contains."""

    def post_process(self, peepholes: Any, code: Any) -> Any:
        unused = peep_hole_delete_with_exit, peep_hole_fuse_dict_add_updates
        return super().post_process([each for each in peepholes if each not in unused], code)


@register_pass(mutates_CFG=True, analysis_only=False)
class KernelTranslation(TranslateByteCode):  # type: ignore[misc]
    """Pass that translates the bytecode of a kernel."""

    _name = "softfinger_translation"

    def run_pass(self, state: Any) -> bool:
        state.func_ir = KernelInterpreter(state.func_id).interpret(state.bc)
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class StaticConditions(FunctionPass):  # type: ignore[misc]
    """Pass that evaluates `is None` and `isinstance` of arguments and of their fields, and removes unreached code.

    So a scene compiles only the code of the parts it has. numba itself removes only branches for arguments that are
    None, and cannot compile `isinstance` of a named tuple.
    """

    _name = "softfinger_static_conditions"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        code, unused = state.func_ir, set[str]()
        for block in code.blocks.values():
            for each in block.find_insts(ir.Assign):
                if isinstance(each.value, ir.Expr) and each.value.op in ("binop", "call"):
                    value = _condition(code, state.args, each.value)
                    if value is not None:
                        unused.update(name for operand in each.value.list_vars() for name in _stack(code, operand))
                        each.value = ir.Const(value, each.loc)
                        code._definitions[each.target.name] = [each.value]
        if unused or any(isinstance(_condition_of(code, each), ir.Global) for each in code.blocks.values()):
            _remove_branches(code, unused)
        return True


def _condition(code: Any, arguments: Any, expression: Any) -> bool | None:
    """Return the value of an expression if it is a condition on the types of arguments, otherwise None."""
    if expression.op == "binop":
        if expression.fn not in (operator.is_, operator.is_not) or not _is_none(_only(code, expression.rhs)):
            return None
        kind = _static_type(code, arguments, expression.lhs)
        return None if kind is None else isinstance(kind, types.NoneType) == (expression.fn is operator.is_)
    function = _only(code, expression.func)
    if not isinstance(function, ir.Global) or function.value is not isinstance:
        return None
    kind, classes = _static_type(code, arguments, expression.args[0]), _only(code, expression.args[1])
    is_tuple = isinstance(classes, ir.Expr) and classes.op == "build_tuple"
    names = [_only(code, each) for each in classes.items] if is_tuple else [classes]
    if kind is None or not all(isinstance(each, ir.Global | ir.FreeVar) for each in names):
        return None
    own = class_of(kind)
    return own is not None and issubclass(own, tuple(each.value for each in names))


def _only(code: Any, variable: Any) -> Any:
    """Return the value assigned to a variable; None if there are several assignments."""
    made = code._definitions[variable.name]
    return made[0] if len(made) == 1 else None


def _is_none(made: Any) -> bool:
    return isinstance(made, ir.Const | ir.Global) and made.value is None


def _static_type(code: Any, arguments: Any, variable: Any) -> Any:
    """Return the numba type of an argument that is not reassigned, or of a field of it; None if it is unknown."""
    made = _only(code, variable)
    if isinstance(made, ir.Arg):
        kind = arguments[made.index]
        return None if isinstance(kind, types.Omitted | types.Optional) else kind
    if not isinstance(made, ir.Expr) or made.op != "getattr":
        return None
    kind = _static_type(code, arguments, made.value)
    has_field = isinstance(kind, types.BaseNamedTuple) and made.attr in kind.fields  # not in code that is never reached
    return kind[kind.fields.index(made.attr)] if has_field else None


def _condition_of(code: Any, block: Any) -> Any:
    """Return the value assigned to the condition of the branch at the end of a block; None without one."""
    if not isinstance(block.terminator, ir.Branch):
        return None
    called = _only(code, block.terminator.cond)  # bool(condition)
    return _only(code, called.args[0]) if isinstance(called, ir.Expr) and called.op == "call" else None


def _stack(code: Any, variable: Any) -> Iterator[str]:
    """Yield the names of the values on Python's stack, each used once, of which a variable is computed."""
    if variable.name.startswith("$"):
        yield variable.name
        made = _only(code, variable)
        for operand in made.list_vars() if isinstance(made, ir.Expr) else ():
            yield from _stack(code, operand)


def _remove_branches(code: Any, unused: set[str]) -> None:
    """Remove branches on constants, the blocks that are not reached, and unused values."""
    for block in code.blocks.values():
        condition = _condition_of(code, block)
        if isinstance(condition, ir.Const | ir.Global):
            branch = block.terminator
            block.body[-1] = ir.Jump(branch.truebr if condition.value else branch.falsebr, branch.loc)
            unused |= {branch.cond.name, _only(code, branch.cond).func.name}
    for label in compute_cfg_from_blocks(code.blocks).dead_nodes():
        del code.blocks[label]
    for block in code.blocks.values():
        block.body = [each for each in block.body if not (isinstance(each, ir.Assign) and each.target.name in unused)]
    code.blocks = simplify_CFG(code.blocks)
    code._definitions = build_definitions(code.blocks)


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


REPLACED_PASSES: Final = {
    TranslateByteCode: KernelTranslation,
    NativeLowering: InlinedLowering,
    NopythonTypeInference: KernelTypeInference,
}


def add_static_conditions(passes: PassManager) -> None:
    passes.add_pass_after(StaticConditions, FixupArgs)
    passes.finalize()


def make_passes(state: Any) -> UncheckedPasses:
    """Return the passes for a kernel, from numba's state of its compilation."""
    state.typingctx = ScalarSignatures(state.typingctx)
    code, idle = state.func_id.code, set(UNUSED_PASSES)
    if not any(isinstance(each, CodeType) for each in code.co_consts):  # functions in it
        idle.add(InlineClosureLikes)
    if "len" not in code.co_names:  # numba evaluates that of a tuple
        idle |= {RewriteSemanticConstants, DeadBranchPrune}
    passes = UncheckedPasses("softfinger_inlined")
    passes.passes = [
        (REPLACED_PASSES.get(each, each), text)
        for each, text in DefaultPassBuilder.define_nopython_pipeline(state).passes
        if each not in idle
    ]
    add_static_conditions(passes)
    return passes
