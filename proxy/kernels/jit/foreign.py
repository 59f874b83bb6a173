"""C functions of a library that is loaded at run time, called by address.

numba can only name what the process was linked with; a vendor's library is found when its device is
opened. Its addresses stand in the device's block, so kernels that call it still come from the cache.
"""

import ctypes
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from softfinger.proxy.kernels.jit.decorators import PLAIN


def _called(returns: Any) -> Any:
    """A call of the function at `address` with what a tuple holds, that gives a number of this type of LLVM."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values = cgutils.unpack_tuple(builder, args[1], len(signature.args[1]))
        function = ir.FunctionType(returns, [value.type for value in values])
        called = builder.call(builder.inttoptr(args[0], ir.PointerType(function)), values)
        return context.get_dummy_value() if isinstance(returns, ir.VoidType) else called

    return generate


@intrinsic
def call_int32(typing_context, address, arguments):  # type: ignore[no-untyped-def]
    """int32 f(...) at `address` (int64); `arguments` is a tuple of float64, int32 and pointers, passed as they are.

    A C `char` or `bool` parameter takes an int32: the callee looks at the low byte, whatever its sign convention.
    """
    if not isinstance(arguments, types.BaseTuple):
        return None
    return types.int32(types.int64, arguments), _called(ir.IntType(32))


def _call_void(typing_context: Any, address: Any, arguments: Any) -> Any:
    if not isinstance(arguments, types.BaseTuple):
        return None
    return types.void(types.int64, arguments), _called(ir.VoidType())


def _call_void_by_ctypes(address: int, arguments: tuple[int, ...]) -> None:
    ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * len(arguments))(address)(*arguments)


call_void: Any = _call_void_by_ctypes if PLAIN else intrinsic(_call_void)
"""call_void(address, arguments): void f(...) at `address` (int64); a tuple as of `call_int32`, pointers as int64."""
