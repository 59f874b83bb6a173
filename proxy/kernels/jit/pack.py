"""Trees of named tuples of float64 as flat arrays, and back.

Such a tree compiles to a structure of doubles without padding, so its memory is the flat list of its
leaves in order. `unpack` reads the whole tree from an array at once and `pack` writes it: this is how
parameters reach a running loop and how state outlives a call. A part that is absent (None) takes one
slot, which is not used. A read-only array takes one too: the bits of its address, see `arrays`.
"""

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic

from softfinger.proxy.kernels.jit.arrays import ReadOnly, ReadOnlyType
from softfinger.proxy.kernels.jit.decorators import PLAIN


def flatten(tree: Any) -> np.ndarray:
    """Leaves of `tree` in order, as float64; None gives one 0, an array its address, which keeps no array alive."""
    leaves: list[float] = []

    def walk(node: Any) -> None:
        if isinstance(node, tuple):
            for child in node:
                walk(child)
        elif isinstance(node, ReadOnly):
            leaves.append(np.int64(node.address).view(np.float64))
        else:
            leaves.append(0.0 if node is None else float(node))

    walk(tree)
    return np.array(leaves, dtype=np.float64)


def unflatten(like: Any, values: Any) -> Any:
    """The tree whose leaves `flatten` has made `values` (n,): parts that are absent and arrays are those of `like`."""
    leaves = iter(np.asarray(values).tolist())

    def build(node: Any) -> Any:
        if isinstance(node, tuple):
            children = [build(child) for child in node]
            return type(node)(*children) if hasattr(node, "_fields") else tuple(children)
        leaf = next(leaves)
        return node if node is None or isinstance(node, ReadOnly) else leaf

    return build(like)


class Packed(NamedTuple):
    """A tree for a kernel, which `unpack` reads and `pack` writes to; other leaves compile nothing anew.

    like    a tree of the same type
    values  (n,) float64, its leaves as `flatten` gives them; (m, n) for m trees
    """

    like: Any
    values: np.ndarray

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle with the addresses of the copied arrays."""
        return repacked, (self.like, self.values)


def repacked(like: Any, values: np.ndarray) -> Packed:
    """Return `values` as the leaves of `like`, with the addresses of its arrays."""
    rows = [flatten(unflatten(like, row)) for row in np.atleast_2d(values)]
    return Packed(like, np.reshape(rows, values.shape))


def packed(tree: Any) -> Packed:
    """The tree with its own leaves."""
    return Packed(tree, flatten(tree))


def _check(tree: types.Type) -> None:
    if isinstance(tree, types.BaseTuple):
        for child in tree:
            _check(child)
    elif tree != types.float64 and not isinstance(tree, types.NoneType | ReadOnlyType):
        raise TypingError(f"a tree may hold float64, read-only arrays and None only, not {tree}")


def _data_pointer(context: Any, builder: Any, array_type: types.Type, array: Any, tree: types.Type) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(data, ir.PointerType(context.get_value_type(tree)))


@intrinsic
def unpack(typing_context, like, values):  # type: ignore[no-untyped-def]
    """The tree whose leaves are `values` (n,) float64, of the same type as `like`, or of the type that `like` is."""
    tree = like.instance_type if isinstance(like, types.TypeRef) else like
    _check(tree)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = _data_pointer(context, builder, signature.args[1], args[1], tree)
        return builder.load(pointer, align=8)

    return tree(like, values), generate


@intrinsic
def unpack_at(typing_context, like, address):  # type: ignore[no-untyped-def]
    """The tree of the same type as `like` whose leaves are the float64 at `address` (int64)."""
    _check(like)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = builder.inttoptr(args[1], ir.PointerType(context.get_value_type(like)))
        return builder.load(pointer, align=8)

    return like(like, types.int64), generate


@intrinsic
def pack(typing_context, values, tree):  # type: ignore[no-untyped-def]
    """Write the leaves of `tree` to `values` (n,) float64."""
    _check(tree)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = _data_pointer(context, builder, signature.args[0], args[0], tree)
        builder.store(args[1], pointer, align=8)
        return context.get_dummy_value()

    return types.void(values, tree), generate


if PLAIN:
    unpack = unflatten

    def pack(values: Any, tree: Any) -> None:
        values[:] = flatten(tree)
