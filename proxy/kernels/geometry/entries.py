"""The entries of a scene's tuple of objects: one object, or `Rows` of many of one type.

An object's place is counted through the tuple and its rows. The loop over the tuple is unrolled, one type after the
other; of rows a loop at run time takes one after the other, so compiling costs as much as there are types.

    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            ... member(entry, index - at) ...
        at += places(entry)
"""

from typing import Any

from softfinger.proxy.kernels.native.dispatch import by_type
from softfinger.proxy.kernels.native.rows import Rows


@by_type
def places(entry: Any) -> Any:
    """How many objects there are in it."""


@places.otherwise
def one_place(entry: Any) -> float:
    return 1.0


@places.of(Rows)
def places_in_rows(entry: Any) -> float:
    return float(len(entry))


@by_type
def has(entry: Any, at: float, index: float) -> Any:
    """Whether the object with the place `index` is in the entry that begins with the place `at`."""


@has.otherwise
def is_it(entry: Any, at: float, index: float) -> bool:
    return at == index


@has.of(Rows)
def is_in_rows(entry: Any, at: float, index: float) -> bool:
    return at <= index < at + len(entry)


@by_type
def member(entry: Any, number: float) -> Any:
    """The object of an entry with that number in it, from 0 on."""


@member.otherwise
def itself(entry: Any, number: float) -> Any:
    return entry


@member.of(Rows)
def in_rows(entry: Any, number: float) -> Any:
    return entry[int(number)]
