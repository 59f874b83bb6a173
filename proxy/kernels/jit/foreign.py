"""Calls, by address, of C functions of a library that is loaded at run time.

numba can name only symbols of libraries linked to the process; a vendor's library is found when its device is opened.
Its addresses are stored in the device's block, so kernels that call it can still be cached.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def _called(returns: Any) -> Any:
    """Return a code generator that calls the function at an address with the elements of a tuple."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values = cgutils.unpack_tuple(builder, args[1], len(signature.args[1]))
        function = ir.FunctionType(returns, [value.type for value in values])
        called = builder.call(builder.inttoptr(args[0], ir.PointerType(function)), values)
        return context.get_dummy_value() if isinstance(returns, ir.VoidType) else called

    return generate


@intrinsic
def call_int32(typing_context, address, arguments):  # type: ignore[no-untyped-def]
    """Call int32 f(...) at `address` (int64) with a tuple of float64, int32, int64 and pointers, passed unchanged.

    Pass an int32 for a C `char` or `bool` parameter: the callee reads only the low byte, with either sign convention.
    """
    if not isinstance(arguments, types.BaseTuple):
        return None
    return types.int32(types.int64, arguments), _called(ir.IntType(32))


@intrinsic
def call_void(typing_context, address, arguments):  # type: ignore[no-untyped-def]
    """Call void f(...) at `address`, as `call_int32`."""
    if not isinstance(arguments, types.BaseTuple):
        return None
    return types.void(types.int64, arguments), _called(ir.VoidType())


@intrinsic
def call_two_int64(typing_context, address, arguments):  # type: ignore[no-untyped-def]
    """Call f(...) at `address`, which returns a struct of integers by value, 9 to 16 bytes; return (int64, int64).

    x86-64 and AArch64 both return such a struct in two registers. Bits beyond the struct are undefined.
    """
    if not isinstance(arguments, types.BaseTuple):
        return None
    both = types.UniTuple(types.int64, 2)
    call = _called(ir.LiteralStructType([ir.IntType(64), ir.IntType(64)]))

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        given = call(context, builder, signature, args)
        return context.make_tuple(builder, both, [builder.extract_value(given, k) for k in range(2)])

    return both(types.int64, arguments), generate
