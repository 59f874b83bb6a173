"""Selection of code by the kinds of objects in a scene, at compile time.

Only meshes and height maps can touch a fingertip at several points. Other scenes are compiled without the code for
that.
"""

from collections.abc import Callable
from typing import Any, Final

from softfinger.proxy.kernels.jit.cache import kinds_in
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type, chosen_by
from softfinger.proxy.kernels.model import Bodies, Creased, Faceted, Heightmap, Many, Mesh, Single
from softfinger.proxy.kernels.query.container import object_at
from softfinger.proxy.kernels.shapes.composite import has_creases, is_mesh_shape


def moves_by_itself(*given: Any) -> bool:
    """Return True if one of the arguments contains an object attached to a body of a simulation.

    A tick of a simulation takes microseconds, so a call by address costs little. Inlining the code of each finger into
    each of its callers would take a minute to compile.
    """
    return Bodies in kinds_in(given)


def takes_long(*given: Any) -> bool:
    """Return True if one of the arguments contains several objects, a mesh or a height map.

    Queries of them take so long that the cost of a call by address is negligible.
    """
    return not {Many, Mesh, Heightmap}.isdisjoint(kinds_in(given))


SINGLE_POINT: Final = "single point"
WITH_MESH: Final = "mesh"
WITH_HEIGHTMAP: Final = "height map"


def _kind_among(kinds: Any) -> str:
    if not {Heightmap, Creased}.isdisjoint(kinds):
        return WITH_HEIGHTMAP
    return SINGLE_POINT if {Mesh, Faceted}.isdisjoint(kinds) else WITH_MESH


def by_multipoint(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel chosen by the objects of a scene; only the chosen implementation is compiled.

    .of(WITH_HEIGHTMAP)  at least one is a height map
    .of(WITH_MESH)       at least one is a mesh, and none a height map
    .of(SINGLE_POINT)    no mesh and no height map: each object touches a fingertip at one point
    """

    def sort(objects: Any) -> str:
        return _kind_among({type(objects.search if isinstance(objects, Many) else objects.body.shape)})

    return chosen_by(declaration, sort, lambda kind: kind, lambda objects: _kind_among(kinds_in((objects,))))


ONE_PATCH: Final = "one patch"
SEVERAL_PATCHES: Final = "several patches"


def by_patches(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel chosen by how many patches of contact the objects of a scene can have with a fingertip.

    .of(ONE_PATCH)        a single object that is not a mesh
    .of(SEVERAL_PATCHES)  a mesh, or many objects
    """

    def among(kinds: Any) -> str:
        return ONE_PATCH if {Many, Mesh}.isdisjoint(kinds) else SEVERAL_PATCHES

    def sort(objects: Any) -> str:
        return among({Many if isinstance(objects, Many) else type(objects.body.shape)})

    return chosen_by(declaration, sort, lambda kind: kind, lambda objects: among(kinds_in((objects,))))


@by_multipoint
def any_mesh(objects: Any) -> Any:
    """Return True if one of the objects is a mesh."""


@any_mesh.of(SINGLE_POINT)
def has_no_mesh(objects: Any) -> bool:
    return False


@any_mesh.of(WITH_MESH)
def has_a_mesh(objects: Any) -> bool:
    return True


@any_mesh.of(WITH_HEIGHTMAP)
def may_have_mesh(objects: Any) -> bool:
    return has_meshes(objects)


@by_type
def has_meshes(objects: Any) -> Any:
    """Return True if there is a mesh, in a scene with a height map."""


@has_meshes.of(Single)
def single_has_none(objects: Single) -> bool:
    return False


@has_meshes.of(Many)
def many_have_meshes(objects: Many) -> bool:
    return bool(objects.search.meshes > 0.0)


@by_multipoint
def any_creases(objects: Any) -> Any:
    """Return True if one of the objects is a height map."""


@any_creases.of(WITH_HEIGHTMAP)
def has_a_heightmap(objects: Any) -> bool:
    return True


@any_creases.otherwise
def has_no_heightmap(objects: Any) -> bool:
    return False


@by_multipoint
def kind_at(objects: Any, index: float) -> Any:
    """Return 1 if object `index` is a triangle of a mesh, 2 if it is a height map, 0 for any other object or none."""


@kind_at.of(SINGLE_POINT)
def kind_touched_in_one_point(objects: Any, index: float) -> float:
    return 0.0


@kind_at.otherwise
def kind_of_surface(objects: Any, index: float) -> float:
    if index < 0.0:
        return 0.0
    shape = object_at(objects, index).shape
    return is_mesh_shape(shape) + 2.0 * has_creases(shape)


@jit
def is_mesh_at(objects: Any, index: float) -> bool:
    """Return True if object `index` is a triangle of a mesh."""
    return kind_at(objects, index) == 1.0


@jit
def has_creases_at(objects: Any, index: float) -> bool:
    """Return True if object `index` is a height map."""
    return kind_at(objects, index) == 2.0
