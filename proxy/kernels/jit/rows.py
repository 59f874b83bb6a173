"""Trees of one type in consecutive memory, which a kernel reads by index.

    entries: Rows        # in a kernel: entries[i]

Each tree of a tuple is compiled separately. Rows are compiled once, for one tree, and their number costs only run time.
It is not part of the type, so kernels receive it separately. Memory and lifetime are as in `arrays`.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import typeof_impl

from softfinger.proxy.kernels.jit.arrays import ReadOnly, ReadOnlyType, register_address
from softfinger.proxy.kernels.jit.pack import flatten


class Rows(ReadOnly):
    """One or more trees of one type, copied once and immutable.

    Raises
    ------
    TypeError
        If the trees differ in type.

    Notes
    -----
    They are copied when a kernel first needs them, since the kernel table of a tree is compiled for its address.
    """

    def __init__(self, trees: Sequence[Any]) -> None:
        self.trees = tuple(trees)
        self.like = numba.typeof(self.trees[0])
        for tree in self.trees:
            if numba.typeof(tree) != self.like:
                raise TypeError(f"rows of {self.like} and {numba.typeof(tree)}: all must be of one type")

    @cached_property
    def array(self) -> Any:  # type: ignore[override]
        values = np.stack([flatten(tree) for tree in self.trees]).ravel()
        values.setflags(write=False)
        return values

    @property
    def address(self) -> int:  # type: ignore[override]
        return int(self.array.ctypes.data)

    def __getitem__(self, index: int) -> Any:
        return self.trees[index]

    def __len__(self) -> int:
        return len(self.trees)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.trees,)


class RowsType(ReadOnlyType):
    """numba type of `Rows`: an address, with the type of the trees stored there."""

    instance_class = Rows

    def __init__(self, like: types.Type) -> None:
        self.item = self.like = like
        types.Type.__init__(self, name=f"Rows({like})")


@typeof_impl.register(Rows)
def _typeof(value: Rows, context: Any) -> RowsType:
    return RowsType(value.like)


register_address(RowsType)
