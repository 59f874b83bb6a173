"""Test of all eight lanes of a tree node at once, with vector instructions; also a version in plain Python."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.shapes.budget import QUEUE_SIZE

LANES = 8
FIELDS = 12
"""Numbers per lane: see `model.Triangles.nodes`."""
NODE = LANES * FIELDS
SQUARE_MARGIN = 4e-6
"""Share by which a squared distance in float32 may be too large: about ten roundings of 6e-8, times two, and margin."""


def _numbers(kind: Any, count: int) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        element = context.get_value_type(kind)
        with builder.goto_entry_block():  # as numba's helper does, which would also zero the memory in every query
            memory = builder.alloca(ir.ArrayType(element, count))
        return builder.bitcast(memory, ir.PointerType(element))

    return types.CPointer(kind)(), generate


@intrinsic
def room_for_bounds(typing_context):  # type: ignore[no-untyped-def]
    return _numbers(types.float32, LANES * (QUEUE_SIZE + 1))


@intrinsic
def room_for_lanes(typing_context):  # type: ignore[no-untyped-def]
    """Allocate eight more than QUEUE_SIZE: `sift` always writes eight."""
    return _numbers(types.int32, QUEUE_SIZE + LANES)


@intrinsic
def room_for_nodes(typing_context):  # type: ignore[no-untyped-def]
    return _numbers(types.int32, QUEUE_SIZE + 1)


def _packings() -> ir.Constant:
    """Return a table of the lanes in each bit mask, packed to the front."""
    rows = [[i for i in range(LANES) if bits >> i & 1] for bits in range(1 << LANES)]
    row = ir.ArrayType(ir.IntType(8), LANES)
    return ir.Constant(
        ir.ArrayType(row, len(rows)), [ir.Constant(row, (places + [0] * LANES)[:LANES]) for places in rows]
    )


@intrinsic
def sift(typing_context, nodes, node, point, top, bounds, waiting, begin):  # type: ignore[no-untyped-def]
    """Compute the squared distances (m^2) of a node's boxes from a point (3,) m, float32, never above the exact ones.

    bounds    filled with the eight distances, from index `begin`
    waiting   filled with the indices in `bounds` of the boxes below `top`, packed to the front; room for eight
    returns   number of boxes below `top`
    """
    vector, whole = ir.VectorType(ir.FloatType(), LANES), ir.VectorType(ir.IntType(32), LANES)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        nodes, node, point, top, bounds, waiting, begin = args
        base = builder.inttoptr(nodes, ir.PointerType(vector))
        at = builder.mul(node, ir.Constant(ir.IntType(64), FIELDS))

        def lane(field: int) -> Any:
            return builder.load(builder.gep(base, [builder.add(at, ir.Constant(ir.IntType(64), field))]), align=4)

        def splat(value: Any, kind: Any = vector) -> Any:
            filled = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
            return builder.shuffle_vector(filled, ir.Constant(kind, ir.Undefined), ir.Constant(whole, [0] * LANES))

        def call(name: str, *values: Any) -> Any:
            kind = ir.FunctionType(vector, [vector] * len(values))
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v8f32"), values)

        def product(a: Any, b: Any) -> Any:
            return builder.fmul(a, b)

        def beyond(axis: Any, half: Any) -> Any:
            """Return the squared distance of the point from the box along an axis."""
            along = builder.fadd(builder.fadd(product(axis[0], d[0]), product(axis[1], d[1])), product(axis[2], d[2]))
            out = call("maxnum", builder.fsub(call("fabs", along), half), ir.Constant(vector, [0.0] * LANES))
            return product(out, out)

        d = [
            builder.fsub(splat(value), lane(field)) for field, value in enumerate(cgutils.unpack_tuple(builder, point))
        ]
        up, u = [lane(3), lane(4), lane(5)], [lane(6), lane(7), lane(8)]
        v = [
            builder.fsub(product(up[(i + 1) % 3], u[(i + 2) % 3]), product(up[(i + 2) % 3], u[(i + 1) % 3]))
            for i in range(3)
        ]
        squares = builder.fadd(builder.fadd(beyond(u, lane(9)), beyond(v, lane(10))), beyond(up, lane(11)))
        squares = product(squares, ir.Constant(vector, [1.0 - SQUARE_MARGIN] * LANES))
        into = builder.bitcast(builder.gep(bounds, [begin]), ir.PointerType(vector))
        builder.store(squares, into, align=4)
        nearer = builder.bitcast(builder.fcmp_ordered("<", squares, splat(top)), ir.IntType(LANES))
        table = cgutils.global_constant(builder, "softfinger_packings", _packings())
        chosen = builder.gep(table, [ir.Constant(ir.IntType(64), 0), builder.zext(nearer, ir.IntType(64))])
        chosen = builder.load(builder.bitcast(chosen, ir.PointerType(ir.VectorType(ir.IntType(8), LANES))), align=1)
        places = builder.add(builder.zext(chosen, whole), splat(builder.trunc(begin, ir.IntType(32)), whole))
        builder.store(places, builder.bitcast(waiting, ir.PointerType(whole)), align=4)
        return builder.zext(builder.ctpop(nearer), ir.IntType(64))

    number = types.float32
    return types.int64(nodes, types.int64, types.UniTuple(number, 3), number, bounds, waiting, types.int64), generate


@intrinsic
def slice_from(typing_context, lanes, at):  # type: ignore[no-untyped-def]
    """Return the address of element `at`."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.gep(args[0], [args[1]])

    return lanes(lanes, types.int64), generate


if PLAIN:
    _SHRUNK = np.float32(1.0 - SQUARE_MARGIN)
    _PLACES = np.arange(LANES, dtype=np.int32)

    def room_for_bounds() -> Any:
        return np.empty(LANES * (QUEUE_SIZE + 1), np.float32)

    def room_for_lanes() -> Any:
        return np.empty(QUEUE_SIZE + LANES, np.int32)

    def room_for_nodes() -> Any:
        return np.empty(QUEUE_SIZE + 1, np.int32)

    def _beyond(axis: Any, half: Any, d: Any) -> Any:
        out = np.fmax(np.abs(axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2]) - half, np.float32(0.0))
        return out * out

    def sift(nodes: Any, node: int, point: Any, top: Any, bounds: Any, waiting: Any, begin: int) -> int:
        """Compute the same sums in the same order as the compiled version, for identical numbers."""
        lanes = nodes.array[node * NODE : (node + 1) * NODE].reshape(FIELDS, LANES)
        d = np.array(point, np.float32)[:, None] - lanes[:3]
        up, u = lanes[3:6], lanes[6:9]
        v = [up[(i + 1) % 3] * u[(i + 2) % 3] - up[(i + 2) % 3] * u[(i + 1) % 3] for i in range(3)]
        squares = (_beyond(u, lanes[9], d) + _beyond(v, lanes[10], d)) + _beyond(up, lanes[11], d)
        squares *= _SHRUNK
        bounds[begin : begin + LANES] = squares
        nearer = _PLACES[squares < top]
        waiting[: len(nearer)] = nearer + np.int32(begin)
        return len(nearer)

    def slice_from(lanes: Any, at: int) -> Any:
        return lanes[at:]
