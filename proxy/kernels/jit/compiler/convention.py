"""Calling convention of kernels that are compiled into their callers.

numba passes each number of a tuple as a separate argument, which any caller can do on any processor. The arguments of
our kernels are trees of up to several hundred numbers: taking them apart at each call, and putting them together in the
callee, was two thirds of the code that LLVM parses and optimises. Only kernels call these kernels, and no such call is
left in machine code, so here a tuple is one argument.

`numba_internals.py` uses this module and lists the undocumented parts of numba.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from typing import Any

from llvmlite import ir as llvm_ir
from llvmlite.ir.instructions import Ret
from numba import types
from numba.core import cgutils, ir
from numba.core.callconv import RETCODE_OK, CPUCallConv
from numba.core.compiler import _LowerResult
from numba.core.compiler_machinery import LoweringPass, register_pass
from numba.core.datamodel import ArgPacker
from numba.core.errors import NumbaTypeError
from numba.core.funcdesc import PythonFunctionDescriptor
from numba.core.lowering import Lower


def _is_whole(kind: Any) -> bool:
    """Return whether values of a numba type are one argument: tuples, except those that numba makes of `*rest`.

    numba makes them structures, even if their model is an array.
    """
    return isinstance(kind, types.BaseTuple) and not isinstance(kind, types.StarArgTuple | types.StarArgUniTuple)


class _TupleModel:
    """Data model of a tuple as one argument."""

    def __init__(self, model: Any) -> None:
        self._type = model.get_value_type()

    def get_argument_type(self) -> Any:
        return self._type

    def as_argument(self, builder: Any, value: Any) -> Any:
        return value

    def from_argument(self, builder: Any, value: Any) -> Any:
        return value


class _Models:
    """Data models of arguments by numba type."""

    def __init__(self, models: Any) -> None:
        self._models = models

    def lookup(self, kind: Any) -> Any:
        model = self._models.lookup(kind)
        return _TupleModel(model) if _is_whole(kind) else model


class InlinedConvention(CPUCallConv):  # type: ignore[misc]
    """Convention with a tuple as one argument, and as one result.

    Tuples are not converted to their form in memory, which would copy them number by number.
    """

    def _get_arg_packer(self, kinds: Any) -> ArgPacker:
        return ArgPacker(_Models(self.context.data_model_manager), kinds)

    def get_return_type(self, kind: Any) -> Any:
        if _is_whole(kind):
            return self.context.get_value_type(kind).as_pointer()
        return super().get_return_type(kind)


def declare(context: Any, module: Any, described: Any) -> Any:
    """Return the declaration of a kernel in an LLVM module."""
    convention = InlinedConvention(context)
    kind = convention.get_function_type(described.restype, described.argtypes)
    function = cgutils.get_or_insert_function(module, kind, described.mangled_name)
    convention.decorate_function(function, described.args, described.argtypes)
    function.attributes.add("alwaysinline")
    return function


def _make_call(described: Any, library: Any) -> Any:
    """Return the generator of calls of a kernel, for numba's table of implementations.

    A kernel that fails ends its caller with the same error, since no kernel contains `try`.
    """

    def call(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        convention, result = InlinedConvention(context), described.restype
        function = declare(context, builder.module, described)
        result_slot = cgutils.alloca_once(builder, function.args[0].type.pointee)
        packed = convention._get_arg_packer(described.argtypes).as_arguments(builder, arguments)
        code = builder.call(function, [result_slot, builder.function.args[1], *packed])
        if described.fails:
            with cgutils.if_unlikely(builder, builder.icmp_signed("!=", code, RETCODE_OK)):
                builder.ret(code)
        value = builder.load(result_slot)
        return value if _is_whole(result) else context.get_returned_value(builder, result, value)

    call.signature = described.argtypes  # type: ignore[attr-defined]
    call.libs = (library,)  # type: ignore[attr-defined]
    return call


def insert_inlined(context: Any, entry_point: Any, described: Any, library: Any) -> None:
    """Add a kernel to numba's table of implementations."""
    context._defns[entry_point].append(_make_call(described, library), described.argtypes)


class KernelDescriptor(PythonFunctionDescriptor):  # type: ignore[misc]
    """Descriptor of a kernel; `fails` if it may return an error."""

    __slots__ = ("fails",)


class _InlinedLower(Lower):  # type: ignore[misc]
    """Generator of the LLVM code of a kernel.

    A variable with one assignment is a value. numba stores each variable of several blocks in memory, but after its
    pass `ReconstructSSA` the only assignment precedes all uses.
    """

    def _find_singly_assigned_variable(self) -> None:
        assigned = Counter(each.target.name for block in self.blocks.values() for each in block.find_insts(ir.Assign))
        self._singly_assigned_vars = {name for name, count in assigned.items() if count == 1}
        self._blk_local_varmap: dict[str, Any] = {}

    def pre_block(self, block: Any) -> None:
        self._cur_ir_block = block

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        if name in self._singly_assigned_vars:
            self._blk_local_varmap[name] = value
        else:
            self.builder.store(value, self.getvar(name))

    @property
    def call_conv(self) -> InlinedConvention:
        return InlinedConvention(self.context)

    def setup_function(self, described: Any) -> None:
        self.function = declare(self.context, self.module, described)
        self.entry_block = self.function.append_basic_block("entry")
        self.builder = llvm_ir.IRBuilder(self.entry_block)
        self.call_helper = self.call_conv.init_call_helper(self.builder)

    def lower_binop(self, result: Any, expression: Any, operation: Any) -> Any:
        """Generate an operation by its signature from type inference; numba infers it again."""
        if expression.op != "binop" or not (expression.static_lhs is expression.static_rhs is ir.UNDEFINED):
            return super().lower_binop(result, expression, operation)
        context, builder, signature = self.context, self.builder, self.fndesc.calltypes[expression]
        operands = [
            context.cast(builder, self.loadvar(each.name), self.typeof(each.name), kind)
            for each, kind in zip((expression.lhs, expression.rhs), signature.args, strict=True)
        ]
        code = context.get_function(context.typing_context.resolve_value_type(operation), signature)
        return context.cast(builder, code(builder, operands), signature.return_type, result)

    def lower_inst(self, inst: Any) -> None:
        if isinstance(inst, ir.Return) and _is_whole(self.fndesc.restype):
            self.call_conv.return_value(self.builder, self.loadvar(inst.value.name))
        else:
            super().lower_inst(inst)


def _make_symbol(name: str, kinds: Any, *, abi_tags: Any = (), uid: Any = None) -> str:
    """Return a symbol of a kernel: its mangled name and a hash.

    In place of the hash, numba's symbol has the names of all types, in hundreds of characters.
    """
    parts = [re.sub(r"\W", "_", part) for part in name.split(".")]
    unique = hashlib.sha256(repr((name, kinds, uid)).encode()).hexdigest()[:32]
    return f"_ZN{''.join(f'{len(part)}{part}' for part in parts)}_{unique}"


@register_pass(mutates_CFG=True, analysis_only=False)
class InlinedLowering(LoweringPass):  # type: ignore[misc]
    """Pass that generates the LLVM code of a kernel."""

    _name = "softfinger_inlined_lowering"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        context, library = state.targetctx, state.library
        if isinstance(state.return_type, types.Optional):
            raise NumbaTypeError(f"{state.func_id.func_qualname} returns a value or None: return a flag and a value")
        described = KernelDescriptor.from_specialized_function(
            state.func_ir,
            state.typemap,
            state.return_type,
            state.calltypes,
            mangler=_make_symbol,
            inline=True,
            noalias=False,
            abi_tags=(),
        )
        with context.push_code_library(library):
            lower = _InlinedLower(context, library, described, state.func_ir, metadata=state.metadata)
            lower.lower()
        returns = (each.terminator for each in lower.function.blocks)
        described.fails = any(isinstance(each, Ret) and each.return_value is not RETCODE_OK for each in returns)
        entry_point = context.get_executable(library, described, lower.env)
        insert_inlined(context, entry_point, described, library)
        state["cr"] = _LowerResult(described, lower.call_helper, cfunc=entry_point, env=lower.env)
        return True
