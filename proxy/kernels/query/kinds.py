"""Kinds of objects in a scene, and of one of its objects.

Only meshes and height maps can touch a fingertip at several points. Other scenes are compiled without the code for
that: `isinstance(objects.search, FacetedSearch)` is known at compile time.
"""

from typing import Any

from softfinger.proxy.kernels.jit.cache import kinds_in
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import (
    CREASED,
    FACETED,
    SMOOTH,
    ActiveSet,
    AnyShape,
    Bodies,
    CreasedSearch,
    Facet,
    FacetedSearch,
    Heightmap,
    Many,
    Mesh,
    SmoothSearch,
)
from softfinger.proxy.kernels.query.container import find_object


def has_simulated_object(*given: Any) -> bool:
    """Return True if one of the arguments contains an object attached to a body of a simulation.

    A tick of a simulation takes microseconds, so a call by address costs little. Inlining the code of each finger into
    each of its callers would take a minute to compile.
    """
    return Bodies in kinds_in(given)


def has_slow_query(*given: Any) -> bool:
    """Return True if one of the arguments contains several objects, a mesh or a height map.

    Queries of them take so long that the cost of a call by address is negligible.
    """
    return not {Many, Mesh, Heightmap}.isdisjoint(kinds_in(given))


@jit
def has_mesh(objects: Any) -> bool:
    """Return True if one of the objects is a mesh."""
    if isinstance(objects, Many) and isinstance(objects.search, CreasedSearch):
        return objects.search.meshes > 0.0
    return isinstance(objects.search, FacetedSearch)


@jit
def has_creases_near(objects: Any) -> bool:
    """Return True if a height map may be within reach in this tick."""
    if isinstance(objects.search, CreasedSearch):
        return objects.search.is_near > 0.0
    return False


@jit
def find_surface_kind(shape: Any) -> float:
    """Return the surface of a shape, see `AnyShape`."""
    if isinstance(shape, AnyShape):
        return shape.surface
    if isinstance(shape, Facet):
        return FACETED
    return CREASED if isinstance(shape, Heightmap) else SMOOTH


@jit
def find_surface_kind_at(objects: Any, index: float) -> float:
    """Return the surface of object `index`, SMOOTH if `index` names no object."""
    if isinstance(objects.search, SmoothSearch) or index < 0.0:
        return SMOOTH
    return find_surface_kind(find_object(objects, index).shape)


@jit
def is_smooth_at(objects: Any, index: float) -> bool:
    """Return True if object `index` is neither a triangle of a mesh nor a height map."""
    surface = find_surface_kind_at(objects, index)
    return surface != FACETED and surface != CREASED


@jit
def are_all_smooth(objects: Any, active: ActiveSet) -> bool:
    """Return True if no constraint is a triangle of a mesh or a height map."""
    one, two, three = active
    return (
        is_smooth_at(objects, one.object_index)
        and is_smooth_at(objects, two.object_index)
        and is_smooth_at(objects, three.object_index)
    )


@jit
def is_mesh_at(objects: Any, index: float) -> bool:
    """Return True if object `index` is a triangle of a mesh."""
    return find_surface_kind_at(objects, index) == FACETED


@jit
def has_creases_at(objects: Any, index: float) -> bool:
    """Return True if object `index` is a height map."""
    return find_surface_kind_at(objects, index) == CREASED
