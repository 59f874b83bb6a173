"""Conversion between trees of named tuples of float64 and flat arrays.

Such a tree compiles to a structure of doubles without padding, so its memory is the flat list of its leaves in order.
`unpack` reads a complete tree from an array, and `pack` writes one: this transfers parameters to a running loop, and
preserves state between calls. A missing part (None) occupies one unused element. A read-only array occupies one, too:
the bits of its address, see `arrays`.
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
    """Return the leaves of `tree` in order, as float64; None gives one 0, an array its address.

    The result does not keep the arrays of the tree alive.
    """
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
    """Return the tree with the leaves `values` (n,) from `flatten`; missing parts and arrays are taken from `like`."""
    leaves = iter(np.asarray(values).tolist())

    def build(node: Any) -> Any:
        if isinstance(node, tuple):
            children = [build(child) for child in node]
            return type(node)(*children) if hasattr(node, "_fields") else tuple(children)
        leaf = next(leaves)
        return node if node is None or isinstance(node, ReadOnly) else leaf

    return build(like)


class PackedTree(NamedTuple):
    """Tree in the form of kernel arguments, which `unpack` reads and `pack` writes.

    like    tree of the same type
    values  (n,) float64, its leaves as returned by `flatten`; (m, n) for m trees

    Other values need no compilation.
    """

    like: Any
    values: np.ndarray

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle with the addresses of the copied arrays."""
        return repack, (self.like, self.values)


def repack(like: Any, values: np.ndarray) -> PackedTree:
    """Return a PackedTree of `values`, with the addresses of the arrays of `like`."""
    rows = [flatten(unflatten(like, row)) for row in np.atleast_2d(values)]
    return PackedTree(like, np.reshape(rows, values.shape))


def packed(tree: Any) -> PackedTree:
    """Return the PackedTree of `tree`."""
    return PackedTree(tree, flatten(tree))


def _check(tree: types.Type) -> None:
    if isinstance(tree, types.BaseTuple):
        for child in tree:
            _check(child)
    elif tree != types.float64 and not isinstance(tree, types.NoneType | ReadOnlyType):
        raise TypingError(f"a tree can contain float64, read-only arrays and None only, not {tree}")


def _data_pointer(context: Any, builder: Any, array_type: types.Type, array: Any, tree: types.Type) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(data, ir.PointerType(context.get_value_type(tree)))


@intrinsic
def unpack(typing_context, like, values):  # type: ignore[no-untyped-def]
    """Return the tree with the leaves `values` (n,) float64; `like` is a tree of the same type, or the type."""
    tree = like.instance_type if isinstance(like, types.TypeRef) else like
    _check(tree)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = _data_pointer(context, builder, signature.args[1], args[1], tree)
        return builder.load(pointer, align=8)

    return tree(like, values), generate


@intrinsic
def unpack_at(typing_context, like, address):  # type: ignore[no-untyped-def]
    """Return the tree of the type of `like` stored as float64 at `address` (int64)."""
    _check(like)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = builder.inttoptr(args[1], ir.PointerType(context.get_value_type(like)))
        return builder.load(pointer, align=8)

    return like(like, types.int64), generate


@intrinsic
def pack(typing_context, values, tree):  # type: ignore[no-untyped-def]
    """Store `tree` as float64 in `values` (n,)."""
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
