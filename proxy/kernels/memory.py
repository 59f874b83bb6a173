"""Memory behind an address: how a C function called from the loop reaches the state of its device.

A handle is one int64. These intrinsics turn it into typed pointers, which kernels index like
arrays; nothing checks the bounds, and the object that owns the memory must outlive the handle.
"""

from typing import Any

from numba import types
from numba.extending import intrinsic

_CPointer: Any = types.CPointer


def _pointer_to(element: Any) -> Any:
    def typed(typing_context: Any, address: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return _CPointer(element)(types.int64), build

    return typed


def _exchange(typing_context: Any, address: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], context.get_value_type(_CPointer(types.int64)))
        return builder.atomic_rmw("xchg", pointer, arguments[1], "seq_cst")

    return types.int64(types.int64, types.int64), build


float64_at: Any = intrinsic(_pointer_to(types.float64))
"""float64_at(address: int64) -> pointer to float64."""

int64_at: Any = intrinsic(_pointer_to(types.int64))
"""int64_at(address: int64) -> pointer to int64."""

int32_at: Any = intrinsic(_pointer_to(types.int32))
"""int32_at(address: int64) -> pointer to int32."""

float32_at: Any = intrinsic(_pointer_to(types.float32))
"""float32_at(address: int64) -> pointer to float32."""

uint8_at: Any = intrinsic(_pointer_to(types.uint8))
"""uint8_at(address: int64) -> pointer to uint8."""

exchange_int64: Any = intrinsic(_exchange)
"""exchange_int64(address: int64, value: int64) -> the old value; atomic, sequentially consistent."""
