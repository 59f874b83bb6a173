"""Tables of addresses, by which a kernel for many objects calls the kernels of any kind of shape.

Each kind of shape has a table with the addresses of the kernels that it implements itself. A kernel is compiled when
the first scene needs it, once for all scenes, and cached. It takes the row of a shape, the index of a triangle, and its
other arguments (`call_kernel`). `any_shape`, `rest/one_object` and `rolling` register the slots of the table in SLOTS.
"""

from __future__ import annotations

import functools
from typing import Any, Final, NamedTuple

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, typeof_impl

from softfinger.proxy.kernels.jit.arrays import ReadOnly, ReadOnlyType
from softfinger.proxy.kernels.jit.compiler.numba_internals import InlinedKernel, link_unit
from softfinger.proxy.kernels.jit.decorators import INLINED, KERNEL_FOLDER, PLAIN, entry
from softfinger.proxy.kernels.jit.outlined import in_and_out
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model import AnyShape, Facet, Mesh, Plane
from softfinger.proxy.kernels.shapes.protocol import is_hollow

CLOSEST, CLOSEST_FROM, CLOSEST_OR_BOUND, CLOSEST_WITHIN, CONSTRAINT, CURVATURE = 0, 1, 2, 3, 4, 5
TRANSPORT, CONCAVITY, FOLLOWS, TRAVEL, MEETS, NEAREST, NEIGHBOUR, RAISED, SHADED = 6, 7, 8, 9, 10, 11, 12, 13, 14
REST, AHEAD, UNROLL, CHART, MINKOWSKI = 15, 16, 17, 18, 19
"""Indices of the slots of a table."""
OPTIONAL: Final = frozenset({AHEAD, UNROLL, CHART, MINKOWSKI})
"""Slots that few scenes use: a rolling method, textures, an ellipsoidal fingertip."""
INLINE: Final[dict[type, frozenset[int]]] = {Plane: frozenset({CLOSEST, TRANSPORT, TRAVEL, REST})}
"""Kernels of a kind that are compiled into their callers."""
TABLE_SIZE: Final = 20


class KernelSlot(NamedTuple):
    """Slot of a table: the kernel chosen by shape, and examples of its arguments and its result, for their types."""

    choice: Any
    arguments: tuple[Any, ...]
    result: Any


SLOTS: Final[dict[int, KernelSlot]] = {}
"""Slots by their index."""


class KernelTable(ReadOnly):
    """Addresses of the kernels of one kind of shape, which are compiled when the first scene needs them.

    shape  example of that kind
    slots  indices of the filled slots
    """

    def __init__(self, shape: Any, slots: frozenset[int]) -> None:
        self._shape, self._rows, self.slots = shape, numba.typeof(Rows([shape])), slots

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy as the table of the same kind in this process: addresses of code are invalid in another process."""
        return shared_table, (self._shape, self.slots)

    @functools.cached_property
    def array(self) -> Any:  # type: ignore[override]
        addresses = np.zeros(TABLE_SIZE, np.int64)
        for slot in sorted(self.slots):
            addresses[slot] = 1 if PLAIN else _address(SLOTS[slot], self._rows)
        return addresses

    @property
    def address(self) -> int:  # type: ignore[override]
        return int(self.array.ctypes.data)


_TABLES: Final[dict[Any, KernelTable]] = {}


def kernel_table(shape: Any, needs: frozenset[int]) -> KernelTable:
    """Return the table of a shape's kind, including the OPTIONAL kernels that the scene `needs`."""
    kind = type(shape)
    slots = frozenset(
        slot
        for slot, (choice, _, _) in SLOTS.items()
        if (slot in needs or slot not in OPTIONAL)
        and slot not in INLINE.get(kind, ())
        and _has(choice, kind)
        and not (slot == CONCAVITY and is_two_sided(shape))
    )
    return shared_table(shape, slots)


def shared_table(shape: Any, slots: frozenset[int]) -> KernelTable:
    """Return the only table with these slots of a shape's kind."""
    key = type(shape), slots
    if key not in _TABLES:
        _TABLES[key] = KernelTable(shape, slots)
    return _TABLES[key]


def is_two_sided(shape: Any) -> bool:
    """Return True if the shape has `side` (`may_be_hollow`)."""
    return is_hollow.has(type(shape)) and hasattr(shape, "side")


class ShapeRow(Rows):
    """Row of one shape, of any kind."""


@typeof_impl.register(ShapeRow)
def _typeof(value: ShapeRow, context: Any) -> ReadOnlyType:
    return ReadOnlyType(types.float64)


@typeof_impl.register(KernelTable)
def _typeof_table(value: KernelTable, context: Any) -> ReadOnlyType:
    return ReadOnlyType(types.int64)


def _has(choice: Any, kind: type) -> bool:
    return bool(choice.has(kind) or (kind is Mesh and choice.has(Facet)))


def _address(slot: KernelSlot, rows: Any) -> int:
    """Return the address of a kernel for shapes in rows of that type, compiled or from the disk."""
    choice, arguments, result = slot
    if rows.like.instance_class is Mesh and choice.has(Facet):

        def call(row: Any, facet: float, *rest: Any) -> Any:
            return choice(Facet(row[0], facet), *rest)

    else:

        def call(row: Any, facet: float, *rest: Any) -> Any:
            return choice(row[0], *rest)

    packed = types.Tuple((rows, types.float64, *map(numba.typeof, arguments)))
    inner = InlinedKernel(call, INLINED, None, entry)
    symbol = link_unit(
        choice.__wrapped__, KERNEL_FOLDER, packed, lambda: in_and_out(inner, packed, numba.typeof(result))
    )
    return int(llvm.address_of_symbol(symbol))


_BYTES: Final = ir.IntType(8).as_pointer()


@intrinsic
def _call_kernel(typing_context, shape, slot, like, arguments):  # type: ignore[no-untyped-def]
    sizes, kernels, facet = shape.fields.index("sizes"), shape.fields.index("kernels"), shape.fields.index("facet")
    kinds = tuple(map(types.unliteral, arguments))
    packed, result = types.Tuple((shape.types[sizes], types.float64, *kinds)), types.unliteral(like)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        fields = cgutils.unpack_tuple(builder, args[0])
        values = [fields[sizes], fields[facet], *cgutils.unpack_tuple(builder, args[3])]
        arguments_slot = cgutils.alloca_once(builder, context.get_value_type(packed))
        result_slot = cgutils.alloca_once(builder, context.get_value_type(result))
        builder.store(context.make_tuple(builder, packed, values), arguments_slot)
        table = builder.inttoptr(fields[kernels], ir.IntType(64).as_pointer())
        function = ir.FunctionType(ir.VoidType(), [_BYTES, _BYTES]).as_pointer()
        code = builder.inttoptr(builder.load(builder.gep(table, [args[1]])), function)
        builder.call(code, [builder.bitcast(pointer, _BYTES) for pointer in (arguments_slot, result_slot)])
        return builder.load(result_slot)

    return result(shape, types.int64, like, types.Tuple(kinds)), generate


def _call_kernel_in_python(shape: AnyShape, slot: int, like: Any, arguments: tuple[Any, ...]) -> Any:
    choice, bare = SLOTS[slot].choice, shape.sizes[0]
    if isinstance(bare, Mesh) and choice.has(Facet):
        bare = Facet(bare, shape.facet)
    return choice(bare, *arguments)


call_kernel: Any = _call_kernel_in_python if PLAIN else _call_kernel
"""call_kernel(shape: AnyShape, slot, like, arguments): calls the kernel in that slot of the shape's table.

like       a value of the result's type
arguments  tuple, of the types of the slot
"""
