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


class Mutable(ReadOnly):
    """Numbers that kernels write: what a scene of any number of objects remembers, which no tuple has room for.

    Copies of a state share them. Readers and writers are one thread.
    """

    __slots__ = ()

    def __init__(self, values: ArrayLike) -> None:
        super().__init__(values)
        self.array.setflags(write=True)

    def __setitem__(self, index: int, value: float) -> None:
        self.array[index] = value


class MutableType(ReadOnlyType):
    """Compiler's type of `Mutable`."""

    instance_class = Mutable

    def __init__(self, dtype: types.Type) -> None:
        self.dtype = dtype
        types.Type.__init__(self, name=f"Mutable({dtype})")


@typeof_impl.register(Mutable)
def _typeof_mutable(value: Mutable, context: Any) -> MutableType:
    return MutableType(from_dtype(value.array.dtype))


register_address(MutableType)


@intrinsic
def _write_at(typing_context, values, index, value):  # type: ignore[no-untyped-def]
    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        first = builder.inttoptr(args[0], ir.PointerType(context.get_value_type(values.dtype)))
        builder.store(args[2], builder.gep(first, [args[1]]))
        return context.get_dummy_value()

    return types.void(values, types.int64, values.dtype), generate


@overload(operator.setitem, jit_options=INLINED)
def _setitem(values, index, value):  # type: ignore[no-untyped-def]
    if type(values) is MutableType and isinstance(index, types.Integer):
        return lambda values, index, value: _write_at(values, index, value)
    return None


@intrinsic
def _number_at(typing_context, values, index):  # type: ignore[no-untyped-def]
    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        first = builder.inttoptr(args[0], ir.PointerType(context.get_value_type(values.dtype)))
        return builder.load(builder.gep(first, [args[1]]))

    return values.dtype(values, types.int64), generate


@overload(operator.getitem, jit_options=INLINED)
def _getitem(values, index):  # type: ignore[no-untyped-def]
    if type(values) in (ReadOnlyType, MutableType) and isinstance(index, types.Integer):
        return lambda values, index: _number_at(values, index)
    return None
