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


@intrinsic
def load_acquire(typing_context, array, index):  # type: ignore[no-untyped-def]
    """array[index], int64: nothing after it in the program is read before it."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.load_atomic(_element(context, builder, signature, args), "acquire", 8)

    return types.int64(array, types.intp), generate


@intrinsic
def load_relaxed(typing_context, array, index):  # type: ignore[no-untyped-def]
    """array[index], int64, read once from memory."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.load_atomic(_element(context, builder, signature, args), "monotonic", 8)

    return types.int64(array, types.intp), generate


@intrinsic
def store_release(typing_context, array, index, value):  # type: ignore[no-untyped-def]
    """array[index] = value, int64: everything before it in the program is visible first."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        builder.store_atomic(args[2], _element(context, builder, signature, args), "release", 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), generate


@intrinsic
def store_relaxed(typing_context, array, index, value):  # type: ignore[no-untyped-def]
    """array[index] = value, int64, written once to memory."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        builder.store_atomic(args[2], _element(context, builder, signature, args), "monotonic", 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), generate


@intrinsic
def fence_acquire(typing_context):  # type: ignore[no-untyped-def]
    """No read or write after it moves before a read that stands before it."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        builder.fence("acquire")
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def fence_release(typing_context):  # type: ignore[no-untyped-def]
    """No read or write before it moves after a write that stands after it."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        builder.fence("release")
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def call_device(typing_context, address, handle, values):  # type: ignore[no-untyped-def]
    """Call `int64 f(int64 handle, double *values)` at `address`; `values` is a float64 array."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[2])(context, builder, args[2]).data
        word = ir.IntType(64)
        function = ir.FunctionType(word, [word, data.type])
        return builder.call(builder.inttoptr(args[0], ir.PointerType(function)), [args[1], data])

    return types.int64(types.int64, types.int64, values), generate
