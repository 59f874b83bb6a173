"""Atomic access to int64 array elements, and fences: for memory shared between the servo loop and other threads.

The compiler hoists a plain load out of a loop, and may reorder plain stores. On x86 the atomic forms compile to the
same instructions, so they are free.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from softfinger.proxy.kernels.jit.memory import element_pointer


def _load(ordering: str) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(element_pointer(context, builder, signature, args), ordering, 8)

    return generate


def _store(ordering: str) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store_atomic(args[2], element_pointer(context, builder, signature, args), ordering, 8)
        return context.get_dummy_value()

    return generate


def _fence(ordering: str) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.fence(ordering)
        return context.get_dummy_value()

    return generate


@intrinsic
def load_acquire(typing_context, array, index):  # type: ignore[no-untyped-def]
    """Return array[index], int64; later reads and writes are not moved before it."""
    return types.int64(array, types.intp), _load("acquire")


@intrinsic
def load_relaxed(typing_context, array, index):  # type: ignore[no-untyped-def]
    """Return array[index], int64, loaded from memory exactly once."""
    return types.int64(array, types.intp), _load("monotonic")


@intrinsic
def store_release(typing_context, array, index, value):  # type: ignore[no-untyped-def]
    """Set array[index] = value, int64; earlier reads and writes are not moved after it."""
    return types.void(array, types.intp, types.int64), _store("release")


@intrinsic
def store_relaxed(typing_context, array, index, value):  # type: ignore[no-untyped-def]
    """Set array[index] = value, int64, stored to memory exactly once."""
    return types.void(array, types.intp, types.int64), _store("monotonic")


@intrinsic
def fence_acquire(typing_context):  # type: ignore[no-untyped-def]
    """Prevent later reads and writes from moving before an earlier read."""
    return types.void(), _fence("acquire")


@intrinsic
def fence_release(typing_context):  # type: ignore[no-untyped-def]
    """Prevent earlier reads and writes from moving after a later write."""
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
