"""The eight lanes of a node of the tree, asked at once: what the processor has for eight numbers side by side."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8
FIELDS = 8
"""Numbers of a lane: see `Mesh.nodes`."""
NODE = LANES * FIELDS
ROUNDED = 4e-6
"""Share by which a squared distance in float32 may come out too large: some ten roundings of 6e-8, twice over."""


def _numbers(kind: Any, count: int) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        element = context.get_value_type(kind)
        memory = cgutils.alloca_once(builder, ir.ArrayType(element, count))
        return builder.bitcast(memory, ir.PointerType(element))

    return types.CPointer(kind)(), generate


DEEP = 128
"""Room for what is still to be visited: seven siblings on each of the levels, of which 10^9 triangles have ten."""


@intrinsic
def room_for_bounds(typing_context):  # type: ignore[no-untyped-def]
    return _numbers(types.float32, DEEP)


@intrinsic
def room_for_nodes(typing_context):  # type: ignore[no-untyped-def]
    return _numbers(types.int32, DEEP)


@intrinsic
def lane_room(typing_context):  # type: ignore[no-untyped-def]
    return _numbers(types.float32, LANES)


@intrinsic
def lowest_bit(typing_context, bits):  # type: ignore[no-untyped-def]
    """Number of the lowest bit that is set; of none, 64."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 0))

    return types.int64(types.int64), generate


@intrinsic
def within_lanes(typing_context, nodes, node, x, y, z, best, out):  # type: ignore[no-untyped-def]
    """Squares of the distances (m^2) of x, y, z from the discs of a node, none larger than the true one.

    returns  bits of the lanes where it is below `best`; the squares are in `out`, eight float32
    """
    vector = ir.VectorType(ir.FloatType(), LANES)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        nodes, node, *point, best, out = args
        base = builder.inttoptr(nodes, ir.PointerType(vector))
        at = builder.mul(node, ir.Constant(ir.IntType(64), FIELDS))

        def lane(field: int) -> Any:
            return builder.load(builder.gep(base, [builder.add(at, ir.Constant(ir.IntType(64), field))]), align=4)

        def splat(value: Any) -> Any:
            filled = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
            mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
            return builder.shuffle_vector(filled, ir.Constant(vector, ir.Undefined), mask)

        def constant(value: float) -> Any:
            return ir.Constant(vector, [value] * LANES)

        def calling(name: str, *values: Any) -> Any:
            kind = ir.FunctionType(vector, [vector] * len(values))
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v8f32"), values)

        d = [builder.fsub(splat(value), lane(field)) for field, value in enumerate(point)]
        n = [lane(3), lane(4), lane(5)]

        def product(a: Any, b: Any) -> Any:
            return builder.fmul(a, b)

        along = builder.fadd(builder.fadd(product(n[0], d[0]), product(n[1], d[1])), product(n[2], d[2]))
        across = [
            builder.fsub(product(n[(i + 1) % 3], d[(i + 2) % 3]), product(n[(i + 2) % 3], d[(i + 1) % 3]))
            for i in range(3)
        ]
        square = builder.fadd(
            builder.fadd(product(across[0], across[0]), product(across[1], across[1])), product(across[2], across[2])
        )
        none = constant(0.0)
        beside = calling("maxnum", builder.fsub(calling("sqrt", square), lane(6)), none)
        above = calling("maxnum", builder.fsub(calling("fabs", along), lane(7)), none)
        bounds = builder.fadd(product(beside, beside), product(above, above))
        bounds = product(bounds, constant(1.0 - ROUNDED))
        builder.store(bounds, builder.bitcast(out, ir.PointerType(vector)), align=4)
        nearer = builder.fcmp_ordered("<", bounds, splat(best))
        return builder.zext(builder.bitcast(nearer, ir.IntType(LANES)), ir.IntType(64))

    number = types.float32
    return types.int64(nodes, types.int64, number, number, number, number, out), generate
