"""Atomic access to int64 array elements, and fences: what a thread may share with the servo loop.

A plain load in a loop is hoisted out of it, and plain stores may be reordered; on x86 the atomic forms
compile to the same instructions, so they cost nothing.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.cgutils import get_item_pointer
from numba.extending import intrinsic


def _element(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array_type = signature.args[0]
    array = context.make_array(array_type)(context, builder, args[0])
    return get_item_pointer(context, builder, array_type, array, [args[1]])


def _load(ordering: str) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(_element(context, builder, signature, args), ordering, 8)

    return generate


def _store(ordering: str) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store_atomic(args[2], _element(context, builder, signature, args), ordering, 8)
        return context.get_dummy_value()

    return generate


def _fence(ordering: str) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.fence(ordering)
        return context.get_dummy_value()

    return generate


@intrinsic
def load_acquire(typing_context, array, index):  # type: ignore[no-untyped-def]
    """array[index], int64: nothing after it in the program is read before it."""
    return types.int64(array, types.intp), _load("acquire")


@intrinsic
def load_relaxed(typing_context, array, index):  # type: ignore[no-untyped-def]
    """array[index], int64, read once from memory."""
    return types.int64(array, types.intp), _load("monotonic")


@intrinsic
def store_release(typing_context, array, index, value):  # type: ignore[no-untyped-def]
    """array[index] = value, int64: everything before it in the program is visible first."""
    return types.void(array, types.intp, types.int64), _store("release")


@intrinsic
def store_relaxed(typing_context, array, index, value):  # type: ignore[no-untyped-def]
    """array[index] = value, int64, written once to memory."""
    return types.void(array, types.intp, types.int64), _store("monotonic")


@intrinsic
def fence_acquire(typing_context):  # type: ignore[no-untyped-def]
    """No read or write after it moves before a read that stands before it."""
    return types.void(), _fence("acquire")


@intrinsic
def fence_release(typing_context):  # type: ignore[no-untyped-def]
    """No read or write before it moves after a write that stands after it."""
    return types.void(), _fence("release")


@intrinsic
def call_device(typing_context, address, handle, values):  # type: ignore[no-untyped-def]
    """Call `int64 f(int64 handle, double *values)` at `address`; `values` is a float64 array."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[2])(context, builder, args[2]).data
        word = ir.IntType(64)
        function = ir.FunctionType(word, [word, data.type])
        return builder.call(builder.inttoptr(args[0], ir.PointerType(function)), [args[1], data])

    return types.int64(types.int64, types.int64, values), generate
