"""C functions of a library that is loaded at run time, called by address.

numba can only name what the process was linked with; a vendor's library is found when its device is
opened. Its addresses stand in the device's block, so kernels that call it still come from the cache.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@intrinsic
def call_int32(typing_context, address, arguments):  # type: ignore[no-untyped-def]
    """int32 f(...) at `address` (int64); `arguments` is a tuple of float64, int32 and pointers, passed as they are.

    A C `char` or `bool` parameter takes an int32: the callee looks at the low byte, whatever its sign convention.
    """
    if not isinstance(arguments, types.BaseTuple):
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values = cgutils.unpack_tuple(builder, args[1], len(arguments))
        function = ir.FunctionType(ir.IntType(32), [value.type for value in values])
        return builder.call(builder.inttoptr(args[0], ir.PointerType(function)), values)

    return types.int32(types.int64, arguments), generate
