"""Which objects may be touched in many places: what a scene without any leaves out, known when it is compiled."""

from collections.abc import Callable
from typing import Any, Final

from numba import literal_unroll

from softfinger.proxy.kernels.jit.cache import kinds_in
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type, chosen_by
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model import Heightmap, Mesh, Simulated
from softfinger.proxy.kernels.query.elements import contains, count
from softfinger.proxy.kernels.shapes.composite import has_creases, is_mesh_shape


def moves_by_itself(*given: Any) -> bool:
    """Whether there is an object on a body of a simulation among arguments of those types: such a tick takes
    microseconds, and the code of each finger, compiled into each of its callers, would take a minute."""
    return Simulated in kinds_in(given)


def takes_long(*given: Any) -> bool:
    """Whether there is one, a mesh or a height map: what is asked of them takes long enough for a call by address not
    to count."""
    return moves_by_itself(*given) or not {Mesh, Heightmap}.isdisjoint(kinds_in(given))


SINGLE_POINT: Final = "single point"
WITH_MESH: Final = "mesh"
WITH_HEIGHTMAP: Final = "height map"


def _kind_among(kinds: Any) -> str:
    return WITH_HEIGHTMAP if Heightmap in kinds else WITH_MESH if Mesh in kinds else SINGLE_POINT


def by_multipoint(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel chosen by the objects in a tuple; of the others nothing is compiled.

    .of(WITH_HEIGHTMAP)  one is a height map
    .of(WITH_MESH)       one is a mesh, and none a height map
    .of(SINGLE_POINT)    none is either: each is touched in one point
    """

    def sort(objects: Any) -> str:
        return _kind_among({type((entry[0] if isinstance(entry, Rows) else entry).shape) for entry in objects})

    return chosen_by(declaration, sort, lambda kind: kind, lambda objects: _kind_among(kinds_in(tuple(objects))))


@by_type
def shape_in(entry: Any) -> Any:
    """The shape of an entry, or of the first of a row, whose others are of its kind."""


@shape_in.otherwise
def shape_of_object(entry: Any) -> Any:
    return entry.shape


@shape_in.of(Rows)
def shape_of_first(entry: Any) -> Any:
    return entry[0].shape


@by_multipoint
def any_mesh(objects: Any) -> Any:
    """Whether there is a mesh among them."""


@any_mesh.of(SINGLE_POINT)
def no_mesh(objects: Any) -> bool:
    return False


@any_mesh.otherwise
def some_mesh(objects: Any) -> bool:
    found = 0.0
    for entry in literal_unroll(objects):
        found += is_mesh_shape(shape_in(entry))
    return found > 0.0


@by_multipoint
def any_creases(objects: Any) -> Any:
    """Whether there is a height map among them."""


@any_creases.of(WITH_HEIGHTMAP)
def some_creases(objects: Any) -> bool:
    return True


@any_creases.otherwise
def no_creases(objects: Any) -> bool:
    return False


@jit
def any_multipoint(objects: Any) -> bool:
    """Whether there is one of either."""
    return any_mesh(objects) or any_creases(objects)


@jit
def kind_at(objects: Any, index: float) -> float:
    """Of the object with that place: 1 a triangle of a mesh, 2 a height map, 0 anything else, or nothing."""
    kind = 0.0
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            kind = is_mesh_shape(shape_in(entry)) + 2.0 * has_creases(shape_in(entry))
        at += count(entry)
    return kind


@jit
def is_mesh_at(objects: Any, index: float) -> bool:
    """Whether the object with that place is a triangle of a mesh."""
    return kind_at(objects, index) == 1.0


@jit
def has_creases_at(objects: Any, index: float) -> bool:
    """Whether the object with that place is a height map."""
    return kind_at(objects, index) == 2.0
