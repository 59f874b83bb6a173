"""Read-only arrays that a node of a scene owns: the tree of a mesh, a height map.

    class Relief(NamedTuple):
        spacing: float
        heights: ReadOnly        # in a kernel: shape.heights[i]

A kernel reaches the numbers by their address: that alone is the leaf of the scene's tree, so parameters stay a few
words however large the array is, and nothing of it is copied into a running loop. The numbers belong to the
`ReadOnly`, the `ReadOnly` to the scene that was built. So whoever hands `flatten(scene)` to a kernel keeps the scene
until that kernel has ended or has taken another one: the engine and the servo do, and a function that holds it in
a variable. Where the array lies is in no type and in no compiled code.
"""

import operator
from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core import cgutils
from numba.extending import NativeValue, intrinsic, models, overload, register_model, typeof_impl, unbox
from numpy.typing import ArrayLike, NDArray

from softfinger.proxy.kernels.jit.decorators import INLINED

KINDS: Final = ("float64", "float32", "int64", "int32")


class ReadOnly:
    """Numbers of a node, copied once and never changed; indexed as a flat array, in kernels and in Python.

    values  array of any shape, row by row, of one of KINDS; TypeError for another

    A kernel that writes to it does not compile. As with all memory behind an address nothing checks the bounds there:
    the node has the sizes as fields of its own.
    """

    __slots__ = ("__weakref__", "address", "array")

    def __init__(self, values: ArrayLike) -> None:
        array: NDArray[Any] = np.array(values, order="C").ravel()
        if array.dtype.name not in KINDS or not array.dtype.isnative:
            raise TypeError(f"an array of {array.dtype}: a scene may own arrays of {', '.join(KINDS)}")
        array.setflags(write=False)
        self.array = array
        self.address = int(array.ctypes.data)

    def __getitem__(self, index: int) -> Any:
        return self.array.item(index)  # a number of Python: kernels that are plain Python count with those

    def __len__(self) -> int:
        return len(self.array)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the numbers: a copy has an address of its own."""
        return ReadOnly, (self.array,)


class ReadOnlyType(types.Type):  # type: ignore[misc]
    """What `ReadOnly` is to the compiler: an address, and what kind of number is there."""

    def __init__(self, dtype: types.Type) -> None:
        self.dtype = dtype
        super().__init__(name=f"ReadOnly({dtype})")


@typeof_impl.register(ReadOnly)
def _typeof(value: ReadOnly, context: Any) -> ReadOnlyType:
    return ReadOnlyType(from_dtype(value.array.dtype))


class _Address(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, numba_type: ReadOnlyType) -> None:
        super().__init__(manager, numba_type, ir.IntType(64))


def _unbox(numba_type: ReadOnlyType, value: Any, c: Any) -> Any:
    address = c.pyapi.object_getattr_string(value, "address")
    number = c.pyapi.long_as_longlong(address)
    c.pyapi.decref(address)
    return NativeValue(number, is_error=cgutils.is_not_null(c.builder, c.pyapi.err_occurred()))


def register_address(numba_type: type[ReadOnlyType]) -> None:
    """Values of this type are the address of what they own."""
    register_model(numba_type)(_Address)
    unbox(numba_type)(_unbox)


register_address(ReadOnlyType)


@intrinsic
def _number_at(typing_context, values, index):  # type: ignore[no-untyped-def]
    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        first = builder.inttoptr(args[0], ir.PointerType(context.get_value_type(values.dtype)))
        return builder.load(builder.gep(first, [args[1]]))

    return values.dtype(values, types.int64), generate


@overload(operator.getitem, jit_options=INLINED)
def _getitem(values, index):  # type: ignore[no-untyped-def]
    if type(values) is ReadOnlyType and isinstance(index, types.Integer):
        return lambda values, index: _number_at(values, index)
    return None
