"""Entries of a scene's tuple of objects: an object, `Rows` of objects of one type, or a mesh of many triangles.

The flat index of an object counts through the tuple, its rows and its triangles. The loop over the tuple is unrolled,
once for each entry; a loop over rows runs at run time, so the compile time depends on the number of types only.

    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            ... element(entry, index - at) ...
        at += count(entry)
"""

from typing import Any

from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.query.motion import in_row
from softfinger.proxy.kernels.shapes.composite import count_of_shape, element_of_shape, shape_contains


@by_type
def count(entry: Any) -> Any:
    """Return the number of objects in an entry."""


@count.otherwise
def count_of_object(entry: Any) -> float:
    return count_of_shape(entry.shape)


@count.of(Rows)
def count_of_rows(entry: Any) -> float:
    return float(len(entry))


@by_type
def contains(entry: Any, at: float, index: float) -> Any:
    """Return True if object `index` is in the entry that starts at index `at`."""


@contains.otherwise
def object_contains(entry: Any, at: float, index: float) -> bool:
    return shape_contains(entry.shape, at, index)


@contains.of(Rows)
def rows_contain(entry: Any, at: float, index: float) -> bool:
    return at <= index < at + len(entry)


@by_type
def element(entry: Any, number: float) -> Any:
    """Return an object of an entry; `number` is its index in the entry, from 0."""


@element.otherwise
def element_of_object(entry: Any, number: float) -> Any:
    return element_of_shape(entry.shape, entry, number)


@element.of(Rows)
def element_of_rows(entry: Any, number: float) -> Any:
    body = entry[int(number)]
    return in_row(body.motion, body)
