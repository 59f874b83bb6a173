"""Read-only arrays that belong to a node of a scene: the tree of a mesh, a height map.

    class Relief(NamedTuple):
        spacing: float
        heights: ReadOnly        # in a kernel: shape.heights[i]

A kernel accesses the numbers by address. Only the address is a leaf of the scene's tree, so the size of the parameters
does not depend on that of the array, and its numbers are not copied into a running loop. The `ReadOnly` owns the
numbers, and the scene owns the `ReadOnly`. Therefore the caller of a kernel that received `flatten(scene)` has to keep
a reference to the scene until that kernel has returned or has received another scene: the engine and the servo do, as
does a function with the scene in a variable. Neither types nor compiled code depend on the address.
"""

import operator
from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core import cgutils
from numba.extending import NativeValue, lower_builtin, models, register_model, type_callable, typeof_impl, unbox
from numpy.typing import ArrayLike, NDArray

ARRAY_TYPES: Final = ("float64", "float32", "int64", "int32")


class ReadOnly:
    """Immutable numbers of a node; indexed as a flat array, in kernels and in Python.

    Parameters
    ----------
    values
        Array of any shape with a dtype of ARRAY_TYPES; copied in row-major order.

    Raises
    ------
    TypeError
        If the dtype is not supported.

    Notes
    -----
    A kernel that writes to it does not compile. Kernels do not check bounds: the node stores the sizes in other fields.
    """

    __slots__ = ("__weakref__", "address", "array")

    def __init__(self, values: ArrayLike) -> None:
        array: NDArray[Any] = np.array(values, order="C").ravel()
        if array.dtype.name not in ARRAY_TYPES or not array.dtype.isnative:
            raise TypeError(f"an array of {array.dtype}: a scene can contain arrays of {', '.join(ARRAY_TYPES)}")
        array.setflags(write=False)
        self.array = array
        self.address = int(array.ctypes.data)

    def __getitem__(self, index: int) -> Any:
        return self.array.item(index)  # a Python number, for the arithmetic of kernels in plain Python

    def __len__(self) -> int:
        return len(self.array)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the numbers: a copy has a different address."""
        return type(self), (self.array,)


class ReadOnlyType(types.Type):  # type: ignore[misc]
    """numba type of `ReadOnly`: an address, with the type of the items stored there."""

    def __init__(self, dtype: types.Type) -> None:
        self.item = dtype
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
    """Register a numba type with values that compile to the address of their memory."""
    register_model(numba_type)(_Address)
    unbox(numba_type)(_unbox)


register_address(ReadOnlyType)


class Mutable(ReadOnly):
    """Numbers that kernels write: the state of a scene of any number of objects, too large for a tuple.

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
        self.item = dtype
        types.Type.__init__(self, name=f"Mutable({dtype})")


@typeof_impl.register(Mutable)
def _typeof_mutable(value: Mutable, context: Any) -> MutableType:
    return MutableType(from_dtype(value.array.dtype))


register_address(MutableType)


# `overload` would compile a function for each type of array, and call it for each item.


@type_callable(operator.getitem)
def _type_of_item(context: Any) -> Any:
    def typer(values: Any, index: Any) -> Any:
        return values.item if isinstance(values, ReadOnlyType) and isinstance(index, types.Integer) else None

    return typer


@type_callable(operator.setitem)
def _type_of_write(context: Any) -> Any:
    def typer(values: Any, index: Any, value: Any) -> Any:
        return types.void if type(values) is MutableType and isinstance(index, types.Integer) else None

    return typer


def _pointer(context: Any, builder: Any, kinds: Any, args: Any) -> Any:
    """Return the pointer to an item, from the types and values of the array and the index."""
    first = builder.inttoptr(args[0], ir.PointerType(context.get_value_type(kinds[0].item)))
    return builder.gep(first, [context.cast(builder, args[1], kinds[1], types.int64)])


@lower_builtin(operator.getitem, ReadOnlyType, types.Integer)
def _read(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    return builder.load(_pointer(context, builder, signature.args, args))


@lower_builtin(operator.setitem, MutableType, types.Integer, types.Any)
def _write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    values, _, kind = signature.args
    builder.store(context.cast(builder, args[2], kind, values.item), _pointer(context, builder, signature.args, args))
    return context.get_dummy_value()
