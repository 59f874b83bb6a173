"""Typed access to memory at an address: C functions called from the loop use it for the state of their device.

A handle is one int64. These intrinsics convert it to typed pointers, which kernels index like arrays; bounds are not
checked, and the object that owns the memory must outlive the handle. `address_of` is the inverse, for a C
function that takes the address of an array. Little-endian processors only. In plain Python (`decorators.PLAIN`) the
typed pointers are ctypes pointers, so that a debugger can step through the packets of a driver.
"""

import ctypes
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.core.cgutils import get_item_pointer, raw_memcpy
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from softfinger.proxy.kernels.jit.decorators import PLAIN

_CPointer: Any = types.CPointer


def _pointer_to(element: Any) -> Any:
    def typed(typing_context: Any, address: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return _CPointer(element)(types.int64), build

    return typed


def _pointer(element: Any, in_c: Any) -> Any:
    """Return a function from an address to a typed pointer: an intrinsic, or in plain Python a ctypes cast."""
    if not PLAIN:
        return intrinsic(_pointer_to(element))

    def typed(address: int) -> Any:
        return ctypes.cast(int(address), ctypes.POINTER(in_c))

    return typed


def _array_of(element: Any) -> Any:
    def array(typing_context: Any, address: Any, size: Any) -> Any:
        kind = types.Array(element, 1, "C")

        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            made = context.make_array(kind)(context, builder)
            item = ir.Constant(arguments[1].type, element.bitwidth // 8)
            data = builder.inttoptr(arguments[0], made.data.type)
            populate_array(made, data, shape=[arguments[1]], strides=[item], itemsize=item, meminfo=None)
            return made._getvalue()

        return kind(types.int64, types.intp), build

    return array


def _exchange(typing_context: Any, address: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], context.get_value_type(_CPointer(types.int64)))
        return builder.atomic_rmw("xchg", pointer, arguments[1], "seq_cst")

    return types.int64(types.int64, types.int64), build


def element_pointer(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Return the pointer to an element, from an array and an index, the first two arguments of an intrinsic."""
    kind = signature.args[0]
    array = context.make_array(kind)(context, builder, arguments[0])
    return get_item_pointer(context, builder, kind, array, list(arguments[1:2]))


def _address_of(typing_context: Any, array: Any, index: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ptrtoint(element_pointer(context, builder, signature, arguments), ir.IntType(64))

    return types.int64(array, types.intp), build


def _copy_numbers(typing_context: Any, target: Any, source: Any) -> Any:
    if not all(isinstance(each, types.Array) and (each.ndim, each.layout) == (1, "C") for each in (target, source)):
        return None

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to, of = (
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(signature.args, arguments, strict=True)
        )
        raw_memcpy(builder, to.data, of.data, to.nitems, signature.args[0].dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(target, source), build


def _put_big_endian(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    kind = types.float64 if isinstance(value, types.Float) else types.int64

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        pointer = builder.bitcast(element_pointer(context, builder, signature, arguments), ir.PointerType(word))
        builder.store(builder.bswap(builder.bitcast(arguments[2], word)), pointer, align=1)
        return context.get_dummy_value()

    return types.void(array, types.intp, kind), build


address_of: Any = intrinsic(_address_of)
"""address_of(array, index) -> address of that element, int64; the array is one-dimensional."""

copy_numbers: Any = np.copyto if PLAIN else intrinsic(_copy_numbers)
"""copy_numbers(target, source): copy the elements of `target` from `source`, contiguous arrays (n,) of one type.

A loop of assignments takes four times as many instructions: the light optimisation of kernels (`numba_internals.py`)
unrolls it, and then LLVM does not vectorise it."""

put_big_endian: Any = intrinsic(_put_big_endian)
"""put_big_endian(array of bytes, index, value): store the eight bytes of a float64 or int64 from index on, highest
first."""

float64_at: Any = _pointer(types.float64, ctypes.c_double)
"""float64_at(address: int64) -> pointer to float64."""

int64_at: Any = _pointer(types.int64, ctypes.c_int64)
"""int64_at(address: int64) -> pointer to int64."""

int32_at: Any = _pointer(types.int32, ctypes.c_int32)
"""int32_at(address: int64) -> pointer to int32."""

float32_at: Any = _pointer(types.float32, ctypes.c_float)
"""float32_at(address: int64) -> pointer to float32."""

uint8_at: Any = _pointer(types.uint8, ctypes.c_uint8)
"""uint8_at(address: int64) -> pointer to uint8."""

float64_array_at: Any = (
    (lambda address, size: carray(float64_at(address), size)) if PLAIN else intrinsic(_array_of(types.float64))
)
"""float64_array_at(address, size) -> array (size,) float64. A kernel cannot return the array of numba's `carray`."""

int64_array_at: Any = (
    (lambda address, size: carray(int64_at(address), size)) if PLAIN else intrinsic(_array_of(types.int64))
)
"""int64_array_at(address, size) -> array (size,) int64."""

exchange_int64: Any = intrinsic(_exchange)
"""exchange_int64(address: int64, value: int64) -> previous value; atomic, sequentially consistent."""
