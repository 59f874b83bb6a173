"""The entries of a scene's tuple of objects: one object, `Rows` of many of one type, or a mesh of many triangles.

An object's place is counted through the tuple and its rows. The loop over the tuple is unrolled, one type after the
other; of rows a loop at run time takes one after the other, so compiling costs as much as there are types.

    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            ... member(entry, index - at) ...
        at += places(entry)
"""

from typing import Any

from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.query.motion import in_row
from softfinger.proxy.kernels.shapes.composite import count_of_shape, element_of_shape, shape_contains


@by_type
def count(entry: Any) -> Any:
    """How many objects there are in it."""


@count.otherwise
def count_of_object(entry: Any) -> float:
    return count_of_shape(entry.shape)


@count.of(Rows)
def count_of_rows(entry: Any) -> float:
    return float(len(entry))


@by_type
def contains(entry: Any, at: float, index: float) -> Any:
    """Whether the object with the place `index` is in the entry that begins with the place `at`."""


@contains.otherwise
def object_contains(entry: Any, at: float, index: float) -> bool:
    return shape_contains(entry.shape, at, index)


@contains.of(Rows)
def rows_contain(entry: Any, at: float, index: float) -> bool:
    return at <= index < at + len(entry)


@by_type
def element(entry: Any, number: float) -> Any:
    """The object of an entry with that number in it, from 0 on."""


@element.otherwise
def element_of_object(entry: Any, number: float) -> Any:
    return element_of_shape(entry.shape, entry, number)


@element.of(Rows)
def element_of_rows(entry: Any, number: float) -> Any:
    body = entry[int(number)]
    return in_row(body.motion, body)
