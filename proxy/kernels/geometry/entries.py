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

from softfinger.proxy.kernels.model import Facet, Mesh, Object
from softfinger.proxy.kernels.native.dispatch import by_type
from softfinger.proxy.kernels.native.rows import Rows


@by_type
def places(entry: Any) -> Any:
    """How many objects there are in it."""


@by_type
def places_on(shape: Any) -> Any:
    """How many objects a shape is to the fingertip: each triangle of a mesh is one, held and rubbed by itself."""


@places_on.otherwise
def one_place(shape: Any) -> float:
    return 1.0


@places_on.of(Mesh)
def places_on_mesh(shape: Mesh) -> float:
    triangles = shape.row[0]
    return triangles.number


@places.otherwise
def places_of_object(entry: Any) -> float:
    return places_on(entry.shape)


@places.of(Rows)
def places_in_rows(entry: Any) -> float:
    return float(len(entry))


@by_type
def has(entry: Any, at: float, index: float) -> Any:
    """Whether the object with the place `index` is in the entry that begins with the place `at`."""


@has.otherwise
def has_object(entry: Any, at: float, index: float) -> bool:
    return on_shape(entry.shape, at, index)


@by_type
def on_shape(shape: Any, at: float, index: float) -> Any:
    """`has` of an object with that shape."""


@on_shape.otherwise
def is_it(shape: Any, at: float, index: float) -> bool:
    return at == index


@on_shape.of(Mesh)
def is_on_mesh(shape: Mesh, at: float, index: float) -> bool:
    triangles = shape.row[0]
    return at <= index < at + triangles.number


@has.of(Rows)
def is_in_rows(entry: Any, at: float, index: float) -> bool:
    return at <= index < at + len(entry)


@by_type
def member(entry: Any, number: float) -> Any:
    """The object of an entry with that number in it, from 0 on."""


@member.otherwise
def member_of_object(entry: Any, number: float) -> Any:
    return part(entry.shape, entry, number)


@by_type
def part(shape: Any, body: Any, number: float) -> Any:
    """`member` of an object with that shape."""


@part.otherwise
def itself(shape: Any, body: Any, number: float) -> Any:
    return body


@part.of(Mesh)
def facet(shape: Mesh, body: Any, number: float) -> Object:
    return Object(
        shape=Facet(shape, number),
        pose=body.pose,
        motion=body.motion,
        material=body.material,
        number=body.number,
        effects=body.effects,
        was=body.was,
        texture=body.texture,
    )


@member.of(Rows)
def in_rows(entry: Any, number: float) -> Any:
    return entry[int(number)]
