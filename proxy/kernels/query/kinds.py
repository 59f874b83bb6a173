"""Selection of code by the kinds of objects in a scene, at compile time.

Only meshes and height maps can touch a fingertip at several points. A scene without them is compiled without that code.
"""

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
    """Return True if one of the arguments contains an object attached to a body of a simulation.

    A tick of a simulation takes microseconds, so a call by address costs little. Inlining the code of each finger into
    each of its callers would take a minute to compile.
    """
    return Simulated in kinds_in(given)


def takes_long(*given: Any) -> bool:
    """Return True if one of the arguments contains an object on a simulated body, a mesh or a height map.

    Queries of them take so long that the cost of a call by address is negligible.
    """
    return moves_by_itself(*given) or not {Mesh, Heightmap}.isdisjoint(kinds_in(given))


SINGLE_POINT: Final = "single point"
WITH_MESH: Final = "mesh"
WITH_HEIGHTMAP: Final = "height map"


def _kind_among(kinds: Any) -> str:
    return WITH_HEIGHTMAP if Heightmap in kinds else WITH_MESH if Mesh in kinds else SINGLE_POINT


def by_multipoint(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel chosen by the objects in a tuple; only the chosen implementation is compiled.

    .of(WITH_HEIGHTMAP)  at least one is a height map
    .of(WITH_MESH)       at least one is a mesh, and none a height map
    .of(SINGLE_POINT)    no mesh and no height map: each object touches a fingertip at one point
    """

    def sort(objects: Any) -> str:
        return _kind_among({type((entry[0] if isinstance(entry, Rows) else entry).shape) for entry in objects})

    return chosen_by(declaration, sort, lambda kind: kind, lambda objects: _kind_among(kinds_in(tuple(objects))))


@by_type
def shape_in(entry: Any) -> Any:
    """Return the shape of an entry; of rows, the shape of the first, since all have the same type."""


@shape_in.otherwise
def shape_of_object(entry: Any) -> Any:
    return entry.shape


@shape_in.of(Rows)
def shape_of_first(entry: Any) -> Any:
    return entry[0].shape


@by_multipoint
def any_mesh(objects: Any) -> Any:
    """Return True if one of the objects is a mesh."""


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
    """Return True if one of the objects is a height map."""


@any_creases.of(WITH_HEIGHTMAP)
def some_creases(objects: Any) -> bool:
    return True


@any_creases.otherwise
def no_creases(objects: Any) -> bool:
    return False


@jit
def any_multipoint(objects: Any) -> bool:
    """Return True if one of the objects is a mesh or a height map."""
    return any_mesh(objects) or any_creases(objects)


@jit
def kind_at(objects: Any, index: float) -> float:
    """Return 1 if object `index` is a triangle of a mesh, 2 if it is a height map, 0 for any other object or none."""
    kind = 0.0
    at = 0.0
    for entry in literal_unroll(objects):
        if contains(entry, at, index):
            kind = is_mesh_shape(shape_in(entry)) + 2.0 * has_creases(shape_in(entry))
        at += count(entry)
    return kind


@jit
def is_mesh_at(objects: Any, index: float) -> bool:
    """Return True if object `index` is a triangle of a mesh."""
    return kind_at(objects, index) == 1.0


@jit
def has_creases_at(objects: Any, index: float) -> bool:
    """Return True if object `index` is a height map."""
    return kind_at(objects, index) == 2.0
